"""The table of traffic models, which move the road users of a scene.

To add one, write a module with a function and add its row to :data:`TRAFFIC_MODELS`. Logs of
CARLA's recorder are not models; :mod:`~inspe_jax.scene.traffic.carla_log` reads them.
"""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.traffic.frames import TrafficFrames


@dataclass(frozen=True)
class TrafficModel:
    """A model of traffic: the ``function`` of a ``module``.

    It is called as :func:`~inspe_jax.scene.traffic.waypoint.generate.waypoint_traffic` is. The
    module is imported on first use, because it may need a package of an extra.
    """

    module: str
    function: str

    def make(self, intersection: Intersection, **options: Any) -> TrafficFrames:
        """The traffic of an intersection. Raises InspeError as the function does."""
        return getattr(import_module(self.module), self.function)(intersection, **options)


TRAFFIC_MODELS: dict[str, TrafficModel] = {
    "waypoints": TrafficModel("inspe_jax.scene.traffic.waypoint.generate", "waypoint_traffic"),
    "sumo": TrafficModel("inspe_jax.scene.traffic.sumo.generate", "sumo_traffic"),
}
"""The paper's model, and SUMO for an intersection that was read from a map."""


def traffic_model(name: str) -> TrafficModel:
    """A model by name. Raises InspeError that names those there are."""
    if name not in TRAFFIC_MODELS:
        raise InspeError(
            f"traffic '{name}': {', '.join(TRAFFIC_MODELS)}, or a log of CARLA's recorder (.log)"
            + nearest(name, tuple(TRAFFIC_MODELS))
        )
    return TRAFFIC_MODELS[name]
