"""What a training is told, all of which is in the record of its run, and the optimiser."""

import functools
from typing import Annotated, TypeAlias

import numpy as np
import optax
from pydantic import BaseModel, Field

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import STRICT
from inspe_jax.dataset.loading import Augment, Cache
from inspe_jax.perception.detector import model_of
from inspe_jax.perception.inputs import Agents, BevGrid

AUGMENT = Augment(flip=0.5, turn=np.pi, scale=(0.95, 1.05))
"""Intersections have arms in any direction, so they are turned by any angle."""

Optimiser: TypeAlias = optax.GradientTransformation

RISE = 0.3  # share of the steps in which the learning rate rises; as in OneCycle's usual setting
FEWEST = 4
"""Steps of the shortest schedule: of fewer, three tenths are none, and a rise has no length."""
DECAY = 0.01  # AdamW's weight decay (Loshchilov and Hutter 2019)
MOST_GRADIENT = 10.0
"""Norm to which gradients are cut. A first step has 30 to 100; later ones are below it."""


class TrainingSettings(BaseModel):
    """How a detector is trained.

    ``model`` is a name of :data:`~inspe_jax.perception.detector.MODELS`. ``steps`` of ``batch``
    frames each; ``rate`` is the highest learning rate, of AdamW under a schedule that rises for
    three tenths of the steps and falls for the rest (Smith and Topin 2019). After every ``every``
    steps the state is kept, and the mAP of ``validate_frames`` frames of the split ``validate`` is
    measured. With ``augment``, frames are mirrored, turned and scaled at random.

    The defaults are what two cores train in an hour.
    """

    model_config = STRICT

    model: str
    steps: Annotated[int, Field(ge=1)] = 1500
    batch: Annotated[int, Field(ge=1)] = 2
    rate: Annotated[float, Field(gt=0)] = 2e-3
    seed: Annotated[int, Field(ge=0)] = 0
    every: Annotated[int, Field(ge=1)] = 250
    validate_frames: Annotated[int, Field(ge=0)] = 60
    augment: bool = True


class Content(BaseModel):
    """What a run depends on: its settings, and what of the data set decides shapes and samples."""

    model_config = STRICT

    settings: TrainingSettings
    frames: dict[str, int]
    scenarios: str
    pictures: list[int] | None
    lidars: int
    cameras: int
    half: float
    cell: float
    low: float
    high: float

    @property
    def agents(self) -> Agents:
        """The agents that the detector is made for."""
        return Agents(self.lidars, self.cameras)

    @property
    def grid(self) -> BevGrid:
        """The cells that the detector is made for."""
        return BevGrid(half=self.half, cell=self.cell, low=self.low, high=self.high)


@functools.cache  # equal ones are the same, so that a step is compiled once for all of them
def optimiser(steps: int, rate: float) -> Optimiser:
    """AdamW on cut gradients; its rate rises to ``rate`` and falls once in ``steps`` (Smith and
    Topin 2019)."""
    rates = optax.cosine_onecycle_schedule(max(steps, FEWEST), rate, RISE)
    return optax.chain(
        optax.clip_by_global_norm(MOST_GRADIENT), optax.adamw(rates, weight_decay=DECAY)
    )


def agents_of(cache: Cache) -> Agents:
    """The most units with LiDARs, and with cameras, that a scenario of a cache has."""
    cameras = [
        len(np.unique(units[units > 0]))
        for units in (each.index["camera_unit"] for each in cache.scenarios)
    ]
    return Agents(
        lidars=max(each.record.lidar_units for each in cache.scenarios),
        cameras=max(cameras) if cache.pictures else 0,
    )


def check_sensors(name: str, cache: Cache) -> None:
    """Raise InspeError if a model needs sensors that a cache has no data of."""
    model, agents = model_of(name), agents_of(cache)
    if "lidar" in model.sensors and not agents.lidars:
        raise InspeError(f"{cache.path}: {name} needs LiDARs, and no scenario has one")
    if "camera" in model.sensors and not agents.cameras:
        why = (
            "no scenario has a camera"
            if cache.pictures
            else "the cache was made without pictures: cache the set again, with pictures"
        )
        raise InspeError(f"{cache.path}: {name} needs pictures, and {why}")
