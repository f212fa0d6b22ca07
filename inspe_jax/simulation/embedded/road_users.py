"""The road users of a frame, with parked vehicles: as named boxes, and as triangles for rays."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.placed_bodies import grounds
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.statics import StaticBody
from inspe_jax.scene.traffic.frames import CLASSES, Snapshot
from inspe_jax.simulation.embedded.embree import F33, Caster
from inspe_jax.simulation.embedded.shapes import PARTS, fitting, paint, shape_of
from inspe_jax.simulation.frame import MOST_TRACK, Boxes, RoadUserBox

STRIDE = {"pedestrian": 1.4, "cyclist": 4.5}
"""Distance of a whole stride, or of a turn of the crank [m]."""
LARGEST_CAR = 6.5  # a parked vehicle that is longer than this is a truck [m]


@dataclass(frozen=True, eq=False)
class RoadUserTriangles:
    """Triangles relative to a centre [m], with the index of the road user and that of its part."""

    triangles: F33
    box: Int[np.ndarray, " F"]
    part: Int[np.ndarray, " F"]


def boxes_of(seen: Snapshot, seed: int) -> Boxes:
    """Road users as boxes; names, which are shapes, depend only on track, size and seed."""
    return tuple(
        RoadUserBox(
            track=int(track),
            kind=CLASSES[kind],
            name=str(np.random.default_rng([seed, track, 1]).choice(fitting(CLASSES[kind], size))),
            center=np.asarray(center, float),
            yaw=float(yaw),
            size=np.asarray(size, float),
            velocity=np.asarray(velocity, float),
        )
        for center, yaw, size, kind, track, velocity in zip(*seen, strict=True)
    )


def pose_road_users(boxes: Boxes, center: Float[np.ndarray, "3"]) -> RoadUserTriangles:
    """The shapes of road users, each in its box; positions are relative to ``center`` [m]."""
    shapes = [shape_of(box.name, _phase(box)) for box in boxes]
    triangles = [np.zeros((0, 3, 3))]
    for box, shape in zip(boxes, shapes, strict=True):
        turn = rotation(np.array([0.0, 0.0, box.yaw]), np)
        at = box.center - center
        triangles.append(((shape.vertices * box.size) @ turn.T + at)[shape.faces])
    owner = np.repeat(np.arange(len(boxes)), np.array([len(x.faces) for x in shapes], int))
    part = np.concatenate([np.zeros(0, int), *(shape.part for shape in shapes)])
    return RoadUserTriangles(np.concatenate(triangles), owner, part)


def _phase(box: RoadUserBox) -> float:
    """The phase of a stride or a crank, in cycles: it follows the position along the heading."""
    if box.kind not in STRIDE:
        return 0.0
    along = box.center[0] * np.cos(box.yaw) + box.center[1] * np.sin(box.yaw)
    return float(box.track * 0.381966 + along / STRIDE[box.kind])


def paints(boxes: Boxes, seed: int) -> Float[np.ndarray, "K P 3"]:
    """Linear albedo of every part of every road user; it depends only on track and seed."""
    each = [_paint(box.kind, box.track, seed) for box in boxes]
    return np.array(each, np.float32).reshape(-1, len(PARTS), 3)


@cache
def _paint(kind: str, track: int, seed: int) -> Float[np.ndarray, "P 3"]:
    return paint(kind, np.random.default_rng([seed, track, 2]))


class FrameActors:
    """The road users of one frame, ready for rays at any moment close to the frame's time."""

    def __init__(self, boxes: Boxes, center: Float[np.ndarray, "3"]) -> None:
        self.boxes, self.center = boxes, center
        self._made: dict[Any, Any] = {}
        self.velocity = np.array([box.velocity for box in boxes], float).reshape(-1, 3)
        self._now = pose_road_users(boxes, center)
        self._at: dict[float, tuple[RoadUserTriangles, Caster]] = {}
        self._alone: dict[int, Caster] = {}

    def at(self, after: float) -> tuple[RoadUserTriangles, Caster]:
        """The road users ``after`` seconds from the frame's time: each moves on at its velocity."""
        if after not in self._at:
            way = after * self.velocity[self._now.box]
            road_users = replace(self._now, triangles=self._now.triangles + way[:, None])
            self._at[after] = road_users, Caster(road_users.triangles)
        return self._at[after]

    def alone(self, k: int) -> Caster:
        """The k-th road user without the others, at the frame's time."""
        if k not in self._alone:
            self._alone[k] = Caster(self._now.triangles[self._now.box == k])
        return self._alone[k]

    def once(self, make: Callable[["FrameActors"], Any]) -> Any:
        """What ``make`` returns for these road users: made once a frame for all sensors."""
        if make not in self._made:
            self._made[make] = make(self)
        return self._made[make]


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
    """Parked vehicles with centres in a scene's region as road users, and the other bodies; tracks,
    and so looks, depend on their own place, unless that number is taken."""
    place, radius = scene.intersection, scene.voxels.radius
    found, left = list[StaticBody](), list[StaticBody]()
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
