"""Agents: the frame of each, and the same number of cameras for each where readers want it so.

Readers of camera data sets put the pictures of an agent into one array, four of each in OPV2V. A
station with more cameras becomes several agents; one with fewer is filled up with black pictures
of cameras that look straight up, where nothing is that a detector looks for.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from inspe_jax.simulation.frame import Image, Station

UP = np.array([0.0, np.pi / 2, 0.0])
"""Roll, pitch and yaw of a camera that looks straight up [rad]."""


def frame_of(agent: Station) -> Float[np.ndarray, "6"]:
    """The pose of the frame that readers know an agent by: that of its first LiDAR, or of its unit
    where it has none (x, y, z [m], roll, pitch, yaw [rad])."""
    return np.asarray(agent.scans[0].pose if agent.scans else agent.pose, float)


def with_cameras(stations: Sequence[Station], count: int) -> tuple[Station, ...]:
    """The stations as agents with ``count`` cameras each; 0 leaves them as they are.

    The first agent of a station keeps its number and its LiDARs. Others have the numbers after the
    last station's, in the order of the stations, and no LiDAR. A station without a camera stays
    without one where no other has one.
    """
    if not count or not any(station.images for station in stations):
        return tuple(stations)
    first, further = [], []
    number = max(station.number for station in stations)
    like = next(image for station in stations for image in station.images)
    for station in stations:
        images = list(station.images)
        first.append(replace(station, images=_filled(images[:count], count, station, like)))
        for start in range(count, len(images), count):
            number += 1
            own = _filled(images[start : start + count], count, station, like)
            name = f"{station.name} {start // count + 1}"
            further.append(replace(station, number=number, name=name, images=own, scans=()))
    return (*first, *further)


def is_blank(image: Image) -> bool:
    """Whether an image only fills up an agent's cameras."""
    return bool(np.allclose(image.pose[3:], UP, atol=1e-6)) and not np.any(image.rgb)


def _filled(images: list[Image], count: int, station: Station, like: Image) -> tuple[Image, ...]:
    if len(images) == count:
        return tuple(images)
    size = (images or [like])[0]
    black = Image(
        pose=np.array([*station.pose[:3], *UP]),
        intrinsic=size.intrinsic,
        rgb=np.zeros_like(size.rgb),
        **{
            name: _nothing(getattr(size, name))
            for name in ("depth", "instance", "semantic", "pixels", "share")
        },
    )
    return (*images, *[black] * (count - len(images)))


def _nothing(layer: np.ndarray | None) -> np.ndarray | None:
    """A layer of a picture that shows nothing: 0, or infinitely far."""
    if layer is None:
        return None
    return np.full_like(layer, np.inf if layer.dtype.kind == "f" and layer.ndim == 2 else 0)
