"""Counts what sensors recorded of each road user: points inside its box, pixels that show it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.geometry import rotation
from inspe_jax.simulation.frame import MOST_TRACK, Frame, RoadUserBox, Scan

SLACK = 1e-3
"""Boxes are larger by this, but not at the bottom [m]: points on faces count, not the road."""


def count_inside(scans: Sequence[Scan], boxes: Sequence[RoadUserBox]) -> Int[np.ndarray, "S B"]:
    """How many points of each of S scans lie in each of B boxes; points are sorted by x once."""
    counts = np.zeros((len(scans), len(boxes)), np.int64)
    if not counts.size:
        return counts
    cloud = np.concatenate([world_points(scan) for scan in scans], 1)  # (3, N)
    owner = np.repeat(np.arange(len(scans)), [len(scan.points) for scan in scans])
    order = np.argsort(cloud[0])
    x = cloud[0, order]
    for k, box in enumerate(boxes):
        half = np.asarray(box.size, float) / 2 + SLACK
        cos, sin = np.cos(box.yaw), np.sin(box.yaw)
        reach = abs(cos) * half[0] + abs(sin) * half[1]
        first = np.searchsorted(x, box.center[0] - reach)
        end = np.searchsorted(x, box.center[0] + reach, side="right")
        near = order[first:end]
        dy = cloud[1, near] - box.center[1]
        close_in_y = np.abs(dy) <= abs(sin) * half[0] + abs(cos) * half[1]
        near, dy = near[close_in_y], dy[close_in_y]
        dx, dz = cloud[0, near] - box.center[0], cloud[2, near] - box.center[2]
        inside = (np.abs(cos * dx + sin * dy) <= half[0]) & (np.abs(cos * dy - sin * dx) <= half[1])
        inside &= (dz <= half[2]) & (dz >= 2 * SLACK - half[2])
        counts[:, k] = np.bincount(owner[near[inside]], minlength=len(scans))
    return counts


def with_counts(frame: Frame) -> Frame:
    """The frame with returns and pixels of each road user, counted where its recorder told none."""
    tracks, stations = np.array([box.track for box in frame.boxes], int), []
    for station in frame.stations:
        images, scans = list(station.images), list(station.scans)
        for i, image in enumerate(images):
            if image.pixels is None and image.instance is not None:
                instance = np.bincount(np.ravel(image.instance), minlength=MOST_TRACK + 2)
                images[i] = replace(image, pixels=instance[tracks + 1])
        for i, scan in enumerate(scans):
            if scan.returns is None:
                scans[i] = replace(scan, returns=count_inside([scan], frame.boxes)[0])
        stations.append(replace(station, images=tuple(images), scans=tuple(scans)))
    return replace(frame, stations=tuple(stations))


def world_points(scan: Scan) -> Float[np.ndarray, "3 N"]:
    """The points of a scan in the world, as rows of x, y and z [m]."""
    pose = np.asarray(scan.pose, float)
    points: np.ndarray = rotation(pose[3:], np) @ np.asarray(scan.points[:, :3], float).T
    return points + pose[:3, None]
