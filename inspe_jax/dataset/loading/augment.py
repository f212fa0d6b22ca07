"""Random changes to a frame that leave it consistent: mirror, turn and scale."""

from dataclasses import dataclass

import numpy as np

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.loading.geometry import Similarity


@dataclass(frozen=True)
class Augment:
    """How frames are changed at random, each by itself.

    ``flip`` is the chance that the intersection is mirrored. ``turn`` [rad] limits its turn about
    the vertical to ± ``turn``, and ``scale`` its scale; both are uniform. A mirrored intersection
    has its traffic on the other side of the road: use ``flip=0`` where a model is to learn the
    side.

    The defaults are those of SECOND (Yan, Mao and Li 2018) and PointPillars (Lang et al. 2019): a
    mirror every other time, ±π/4, and 0.95 to 1.05.
    """

    flip: float = 0.5
    turn: float = np.pi / 4
    scale: tuple[float, float] = (0.95, 1.05)

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        if not 0 <= self.flip <= 1:
            raise InspeError(f"augment: flip {self.flip}: a chance, 0 to 1")
        if not 0 <= self.turn <= np.pi:
            raise InspeError(f"augment: turn {self.turn}: 0 to π, in radians")
        low, high = self.scale
        if not 0 < low <= high < np.inf:
            raise InspeError(f"augment: scale {self.scale}: two numbers above 0, the smaller first")

    def similarity(self, rng: np.random.Generator) -> Similarity:
        """A mirror, turn and scale at random."""
        return Similarity(
            mirrored=bool(rng.random() < self.flip),
            turn=float(rng.uniform(-self.turn, self.turn)),
            scale=float(rng.uniform(*self.scale)),
        )
