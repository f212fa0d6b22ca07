"""Traffic as frames of oriented prisms, and the paper's waypoint model that makes them."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.errors import InspeError, nearest
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.waypoint_model import RoadUser, WaypointModel
from inspe_jax.scene.waypoint_paths import USERS, Paths, lay_paths

DENSITIES: dict[str, int] = {"none": 0, "low": 20, "medium": 40, "high": 60}
"""Mean number of objects in the region of interest at each density (paper, section 4)."""

MOST_FRAMES = 10_000
"""More frames than this are taken for a slip."""

CLASSES: tuple[str, ...] = ("car", "truck", "cyclist", "pedestrian")
"""Road-user classes; ``TrafficFrames.kind`` holds the index."""

ROAD_USERS: tuple[RoadUser, ...] = (
    RoadUser("car", "vehicle", (4.6, 1.85, 1.55), top_speed=10, acceleration=2.0, gap=1.5),
    RoadUser("truck", "vehicle", (8.5, 2.5, 3.4), top_speed=8.5, acceleration=1.2, gap=2.0),
    RoadUser("cyclist", "cyclist", (1.8, 0.65, 1.75), top_speed=5, acceleration=1.0, gap=1.0),
    RoadUser("pedestrian", "pedestrian", (0.5, 0.5, 1.72), 1.5, acceleration=1.5, gap=0.3),
)
"""How each class looks and moves in the waypoint model, in the order of :data:`CLASSES`."""


@dataclass(frozen=True)
class Mix:
    """Who is on the road: the share of each of :data:`CLASSES`, and how much sizes vary.

    Length, width and height are each normal about the class mean with standard
    deviation ``spread``·mean, cut at two of them.
    """

    shares: tuple[float, ...]
    spread: float


MIXES: dict[str, Mix] = {
    "mixed": Mix(shares=(0.68, 0.10, 0.10, 0.12), spread=0.06),
    "largest": Mix(shares=(0.0, 1.0, 0.0, 0.0), spread=0.0),
}
"""Traffic mixes by name; ``largest`` is the paper's, every box the largest vehicle."""

WARM_UP = 40.0
"""Time [s] that the model runs before the first frame."""

STEP = 0.2
"""Longest step of the model [s]."""


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


def waypoint_traffic(
    intersection: Intersection,
    *,
    radius: float,
    count: int,
    frames: int,
    mix: str = "mixed",
    step: float = 1.0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> TrafficFrames:
    """Traffic on the waypoints of an intersection's routes (paper, section 4).

    About ``count`` objects at a time whose centre lies within ``radius`` [m] of
    the centre, or as many as the roads hold, in ``frames`` frames ``step``
    seconds apart. ``mix`` is a key of :data:`MIXES`. Beyond the paper they
    behave: they keep their distance, slow for bends, give way where paths
    cross, first come first served, and never overlap; cyclists keep to the
    right of the lane, pedestrians walk their own routes. Who leaves is replaced
    at an entry as soon as there is room. Yaw is the direction of travel; boxes
    stand on the route's own height. ``progress`` is told (frames done, frames).

    The same seed gives the same traffic; turning the intersection turns it.
    Raises InspeError for a value out of range, an unknown mix, or where no
    route lies within the radius.
    """
    if mix not in MIXES:
        raise InspeError(f"traffic mix '{mix}': one of {', '.join(MIXES)}{nearest(mix, [*MIXES])}")
    for name, value, least in (("count", count, 0), ("frames", frames, 1), ("seed", seed, 0)):
        if value < least:
            raise InspeError(f"traffic {name} {value} is out of range: at least {least}")
    if frames > MOST_FRAMES:
        raise InspeError(f"traffic frames {frames} is out of range: at most {MOST_FRAMES}")
    for name, size in (("radius", radius), ("step", step)):
        if not (np.isfinite(size) and size > 0):
            raise InspeError(f"traffic {name} {size} is out of range: above 0")
    paths = lay_paths(intersection, radius)
    kind = _quota(paths, MIXES[mix], count)
    if len(kind) < count:
        raise InspeError(
            f"{intersection.name}: no route within {radius:g} m of the centre for mix '{mix}'"
        )
    rng = np.random.default_rng(seed)
    model = WaypointModel(paths, ROAD_USERS, rng.permutation(kind), MIXES[mix].spread, rng)
    model.fill()
    _advance(model, WARM_UP)
    seen = []
    for frame in range(frames):
        if frame:
            _advance(model, step)
        seen.append(_snapshot(model, intersection.center, radius))
        if progress is not None:
            progress(frame + 1, frames)
    return _pack(seen)


def _quota(paths: Paths, mix: Mix, count: int) -> Int[np.ndarray, " M"]:
    """Classes of ``count`` users by largest remainder, among those that have a path.

    Cyclists ride where people walk too: not on motorways.
    """
    has_path = [bool((paths.user == USERS.index(u.path)).any()) for u in ROAD_USERS]
    has_path[CLASSES.index("cyclist")] &= has_path[CLASSES.index("pedestrian")]
    share = np.where(has_path, mix.shares, 0.0)
    if not share.any():
        return np.zeros(0, np.int8)
    exact = count * share / share.sum()
    each = np.floor(exact).astype(int)
    most = np.argsort(each - exact, kind="stable")
    each[most[: count - each.sum()]] += 1
    return np.repeat(np.arange(len(CLASSES), dtype=np.int8), each)


def _advance(model: WaypointModel, time: float) -> None:
    steps = int(np.ceil(time / STEP - 1e-9))
    for _ in range(steps):
        model.step(time / steps)


def _snapshot(
    model: WaypointModel, center: Float[np.ndarray, "3"], radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Centres, yaws, sizes and kinds of those on the road within the radius."""
    away = model.point[:, :2] - np.asarray(center)[:2]
    on = np.flatnonzero(model.active & (away[:, 0] ** 2 + away[:, 1] ** 2 <= radius**2))
    middle = model.point[on].copy()
    middle[:, 2] += model.size[on, 2] / 2
    yaw = np.arctan2(model.heading[on, 1], model.heading[on, 0])
    return middle, yaw, model.size[on].copy(), model.kind[on]


def _pack(seen: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> TrafficFrames:
    """Frames of unequal number, padded at the end to the fullest."""
    shape = (len(seen), max(len(kind) for *_, kind in seen))
    center, yaw, size = np.zeros((*shape, 3)), np.zeros(shape), np.ones((*shape, 3))
    valid, kind = np.zeros(shape, bool), np.zeros(shape, np.int8)
    for t, (middle, angle, extent, index) in enumerate(seen):
        many = len(index)
        center[t, :many], yaw[t, :many], size[t, :many] = middle, angle, extent
        valid[t, :many], kind[t, :many] = True, index
    return TrafficFrames(center=center, yaw=yaw, size=size, valid=valid, kind=kind)
