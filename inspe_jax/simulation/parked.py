"""Parked vehicles as road users that stand still: a detector has to find them like any other."""

import numpy as np

from inspe_jax.scene.placed_bodies import grounds
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.statics import StaticBody
from inspe_jax.scene.traffic.frames import CLASSES, Snapshot
from inspe_jax.simulation.frame import MOST_TRACK

LARGEST_CAR = 6.5
"""A parked vehicle that is longer than this is a truck [m]."""


def kind_of(size: np.ndarray) -> str:
    """The class of a parked vehicle of this length, width and height [m]."""
    return "truck" if size[0] > LARGEST_CAR else "car"


def box_of(one: StaticBody) -> tuple[np.ndarray, float]:
    """Length, width and height [m] and yaw [rad] of a body whose outline is a rectangle."""
    (ahead, across), up = np.diff(one.outline[:3], axis=0), one.height
    return np.array([np.hypot(*ahead), np.hypot(*across), up]), float(np.arctan2(*ahead[::-1]))


def is_box(one: StaticBody) -> bool:
    """Whether a body is a parked vehicle with the outline of one: four corners, on the ground."""
    return one.kind == "parked vehicle" and len(one.outline) == 4 and one.base == 0


def parked_vehicles(scene: Scene) -> tuple[Snapshot, tuple[StaticBody, ...]]:
    """The parked vehicles of a scene's region as road users, and the bodies that are left.

    A vehicle is a road user where a moving one would be: with its centre in the region. Its track,
    and so its shape and colour, hang on its own place alone, unless that number is taken.
    """
    place, radius = scene.intersection, scene.voxels.radius
    found: list[StaticBody] = []
    left: list[StaticBody] = []
    for one in scene.statics:
        inside = np.hypot(*(one.middle - np.asarray(place.center)[:2])) <= radius
        (found if is_box(one) and inside else left).append(one)
    boxes = [box_of(one) for one in found]
    size = np.array([size for size, _ in boxes], float).reshape(-1, 3)
    at = np.array([one.middle for one in found]).reshape(-1, 2)
    taken = set(scene.traffic.track.ravel().tolist())
    tracks = list[int]()
    for one in found:
        track = one.number % MOST_TRACK
        while track in taken:
            track = (track + 1) % MOST_TRACK
        taken.add(track)
        tracks.append(track)
    road_users = Snapshot(
        center=np.column_stack([at, grounds(found, place) + size[:, 2] / 2]),
        yaw=np.array([yaw for _, yaw in boxes]),
        size=size,
        kind=np.array([CLASSES.index(kind_of(one)) for one in size], int),
        track=np.array(tracks, int),
        velocity=np.zeros((len(found), 3)),
    )
    return road_users, tuple(left)
