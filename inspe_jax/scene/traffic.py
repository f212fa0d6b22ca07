"""Traffic as frames of oriented prisms, and the paper's waypoint model that makes them."""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

DENSITIES: dict[str, int] = {"none": 0, "low": 20, "medium": 40, "high": 60}
"""Mean number of objects in the region of interest at each density (paper, section 4)."""

CLASSES: tuple[str, ...] = ("car", "truck", "cyclist", "pedestrian")
"""Road-user classes; ``TrafficFrames.kind`` holds the index."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrafficFrames:
    """T frames of up to B vehicles or people, each an oriented vertical prism, in world metres.

    ``center`` is at mid-height; ``yaw`` in radians; ``size`` is length, width,
    height; ``kind`` indexes :data:`CLASSES`. Entries with ``valid`` false are
    padding. A row b is not one vehicle's track.
    """

    center: Float[np.ndarray, "T B 3"]
    yaw: Float[np.ndarray, "T B"]
    size: Float[np.ndarray, "T B 3"]
    valid: Bool[np.ndarray, "T B"]
    kind: Int[np.ndarray, "T B"]

    @property
    def frame_count(self) -> int:
        """Number of frames T."""
        return self.center.shape[0]

    @property
    def mean_count(self) -> float:
        """Mean number of objects a frame."""
        return float(self.valid.sum(1).mean()) if self.frame_count else 0.0


def no_traffic() -> TrafficFrames:
    """One frame of an empty road."""
    return TrafficFrames(
        center=np.zeros((1, 0, 3)),
        yaw=np.zeros((1, 0)),
        size=np.ones((1, 0, 3)),
        valid=np.zeros((1, 0), bool),
        kind=np.zeros((1, 0), np.int8),
    )
