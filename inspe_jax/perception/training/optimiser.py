"""The optimiser of every training, so that detectors differ in nothing else."""

import optax

from inspe_jax.perception.training.settings import Settings

RISE = 0.3
"""Share of the steps in which the learning rate rises; as in OneCycle's usual setting."""
FEWEST = 4
"""Steps of the shortest schedule: of fewer, three tenths are none, and a rise has no length."""
DECAY = 0.01
"""AdamW's weight decay (Loshchilov and Hutter 2019)."""
MOST_GRADIENT = 10.0
"""Norm to which gradients are cut. A first step has 30 to 100; later ones are below it."""


def optimiser(settings: Settings) -> optax.GradientTransformation:
    """AdamW on cut gradients; its rate rises and falls once (Smith and Topin 2019)."""
    rate = optax.cosine_onecycle_schedule(max(settings.steps, FEWEST), settings.rate, RISE)
    return optax.chain(
        optax.clip_by_global_norm(MOST_GRADIENT), optax.adamw(rate, weight_decay=DECAY)
    )
