"""The table of sensor kinds: what simulates each. To add a kind, add a row to :data:`SENSORS`."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.simulation.embedded.camera import Camera
from inspe_jax.simulation.embedded.lidar import Lidar
from inspe_jax.simulation.embedded.road_users import FrameActors
from inspe_jax.simulation.embedded.surroundings import Surroundings
from inspe_jax.simulation.frame import Image, Scan


class SimulatedSensor(Protocol):
    """One sensor at its place."""

    def record(self, actors: FrameActors, rng: np.random.Generator) -> Image | Scan:
        """What the sensor records of one frame; ``rng`` is for its noise."""
        ...


SENSORS: dict[str, Callable[[Any, Float[np.ndarray, "6"], Surroundings], SimulatedSensor]] = {
    "camera": Camera,
    "lidar": Lidar,
}
"""By the ``kind`` of a spec: called with the spec, the pose in the world and the surroundings."""


def simulated_sensor(
    spec: Any, pose: Float[np.ndarray, "6"], surroundings: Surroundings
) -> SimulatedSensor:
    """The simulation of a sensor. Raises InspeError for a kind that is not in :data:`SENSORS`."""
    if spec.kind not in SENSORS:
        raise InspeError(
            f"{spec.name}: backend embedded cannot simulate a sensor of kind '{spec.kind}', only "
            f"{' and '.join(SENSORS)}"
        )
    return SENSORS[spec.kind](spec, pose, surroundings)
