"""What grid and random search share: layouts in a step, and which of them to score exactly.

Layouts that are compared share a sample, and only the best on it is scored exactly. The next
comparison has another sample.
"""

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.run import Run

CHUNK = 32
"""Layouts in one step, which takes about half a second on a large scene."""


def offer_better(
    run: Run, x: Float[np.ndarray, "M N"], scores: Float[np.ndarray, " M"], value: float
) -> tuple[int, float]:
    """Score exactly the row of ``x`` that is best on a sample, unless that is row 0.

    ``scores`` are those on the sample, ``value`` is the exact score of row 0. Returns the index
    of the row with the better exact score, and that score.
    """
    best = int(np.argmax(scores))
    if best and (exact := run.offer(x[best])) > value:
        return best, exact
    return 0, value
