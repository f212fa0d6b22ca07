"""The table of traffic models, which move the road users of a scene.

To add one, write a function that is called as
:func:`~inspe_jax.scene.traffic.waypoint.generate.waypoint_traffic`, and add its row.
"""

from collections.abc import Callable
from importlib import import_module

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene.traffic.frames import TrafficFrames

TRAFFIC_MODELS: dict[str, str] = {
    "waypoints": "inspe_jax.scene.traffic.waypoint.generate:waypoint_traffic",
    "sumo": "inspe_jax.scene.traffic.sumo.generate:sumo_traffic",
}
"""Module and function of each model. Modules are imported on first use: they may need an extra.

They are the paper's model, and SUMO for an intersection that was read from a map.
"""


def traffic_model(name: str) -> Callable[..., TrafficFrames]:
    """A model by name. Raises InspeError that names those there are."""
    if name not in TRAFFIC_MODELS:
        raise InspeError(
            f"traffic '{name}': {', '.join(TRAFFIC_MODELS)}, or a log of CARLA's recorder (.log)"
            + nearest(name, tuple(TRAFFIC_MODELS))
        )
    module, _, function = TRAFFIC_MODELS[name].partition(":")
    model: Callable[..., TrafficFrames] = getattr(import_module(module), function)
    return model
