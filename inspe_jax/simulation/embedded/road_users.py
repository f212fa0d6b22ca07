"""Who moves: the road users of a frame as things with names, and as triangles."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.traffic.frames import CLASSES, TrafficFrames
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.shapes import PARTS, VARIANTS, paint, shape_of
from inspe_jax.simulation.frame import RoadUserBox

STRIDE = {"pedestrian": 1.4, "cyclist": 4.5}
"""How far a whole stride or a turn of the crank leads [m]."""


@dataclass(frozen=True, eq=False)
class RoadUserTriangles:
    """Triangles (F, 3, 3) about a centre; which thing each is of, and which part of it."""

    triangles: Float[np.ndarray, "F 3 3"]
    box: Int[np.ndarray, " F"]
    part: Int[np.ndarray, " F"]


def boxes_at(traffic: TrafficFrames, t: int, seed: int) -> tuple[RoadUserBox, ...]:
    """The road users of frame t; who has a name keeps it, for it hangs on track and seed alone."""
    return tuple(
        RoadUserBox(
            track=int(traffic.track[t, b]),
            kind=(kind := CLASSES[traffic.kind[t, b]]),
            name=VARIANTS[kind][_variant(kind, int(traffic.track[t, b]), seed)],
            center=np.asarray(traffic.center[t, b], float),
            yaw=float(traffic.yaw[t, b]),
            size=np.asarray(traffic.size[t, b], float),
            velocity=np.asarray(traffic.velocity[t, b], float),
        )
        for b in np.flatnonzero(traffic.valid[t])
    )


def _variant(kind: str, track: int, seed: int) -> int:
    return int(np.random.default_rng([seed, track, 1]).integers(len(VARIANTS[kind])))


def pose_road_users(
    boxes: tuple[RoadUserBox, ...], center: Float[np.ndarray, "3"]
) -> RoadUserTriangles:
    """Things as triangles, where the frame has them."""
    found, owner, part = [np.zeros((0, 3, 3))], [], []
    for k, box in enumerate(boxes):
        shape = shape_of(box.kind, VARIANTS[box.kind].index(box.name), _phase(box))
        turn = rotation(np.array([0.0, 0.0, box.yaw]), np)
        at = box.center - center
        found.append(((shape.vertices * box.size) @ turn.T + at)[shape.faces])
        owner.append(np.full(len(shape.faces), k))
        part.append(shape.part)
    none = [np.zeros(0, int)]
    return RoadUserTriangles(
        np.concatenate(found), np.concatenate(none + owner), np.concatenate(none + part)
    )


def _phase(box: RoadUserBox) -> float:
    """Where in its stride somebody is: by how far along its heading it has come."""
    if box.kind not in STRIDE:
        return 0.0
    along = box.center[0] * np.cos(box.yaw) + box.center[1] * np.sin(box.yaw)
    return float(box.track * 0.381966 + along / STRIDE[box.kind])


def paints(boxes: tuple[RoadUserBox, ...], seed: int) -> Float[np.ndarray, "K P 3"]:
    """Linear albedo of every part of every thing, which keeps its paint."""
    each = [_paint(box.kind, box.track, seed) for box in boxes]
    return np.array(each, np.float32).reshape(-1, len(PARTS), 3)


@cache
def _paint(kind: str, track: int, seed: int) -> Float[np.ndarray, "P 3"]:
    return np.array(list(paint(kind, np.random.default_rng([seed, track, 2])).values()))


class FrameActors:
    """Everybody in one frame, ready to be met by rays at any moment about it."""

    def __init__(self, boxes: tuple[RoadUserBox, ...], center: Float[np.ndarray, "3"]) -> None:
        self.boxes = boxes
        self.velocity = np.array([box.velocity for box in boxes], float).reshape(-1, 3)
        self._now = pose_road_users(boxes, center)
        self._at: dict[float, tuple[RoadUserTriangles, Caster]] = {}

    def at(self, after: float) -> tuple[RoadUserTriangles, Caster]:
        """Where they are ``after`` seconds from the frame's time: each goes on as its velocity
        says."""
        if after not in self._at:
            way = after * self.velocity[self._now.box]
            road_users = replace(self._now, triangles=self._now.triangles + way[:, None])
            self._at[after] = road_users, Caster(road_users.triangles)
        return self._at[after]
