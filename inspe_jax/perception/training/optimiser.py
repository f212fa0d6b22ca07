"""The optimiser of every training, so that detectors differ in nothing else."""

from functools import cache
from typing import TypeAlias

import optax

Optimiser: TypeAlias = optax.GradientTransformation

RISE = 0.3
"""Share of the steps in which the learning rate rises; as in OneCycle's usual setting."""
FEWEST = 4
"""Steps of the shortest schedule: of fewer, three tenths are none, and a rise has no length."""
DECAY = 0.01
"""AdamW's weight decay (Loshchilov and Hutter 2019)."""
MOST_GRADIENT = 10.0
"""Norm to which gradients are cut. A first step has 30 to 100; later ones are below it."""


@cache  # equal ones are the same, so that a step is compiled once for all of them
def optimiser(steps: int, rate: float) -> Optimiser:
    """AdamW on cut gradients; its rate rises to ``rate`` and falls once in ``steps`` (Smith and
    Topin 2019)."""
    rates = optax.cosine_onecycle_schedule(max(steps, FEWEST), rate, RISE)
    return optax.chain(
        optax.clip_by_global_norm(MOST_GRADIENT), optax.adamw(rates, weight_decay=DECAY)
    )
