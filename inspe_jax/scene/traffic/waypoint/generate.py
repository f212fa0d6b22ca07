"""Traffic from the paper's waypoint model."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.traffic.frames import (
    CLASSES,
    MIXES,
    ROAD_USERS,
    Mix,
    Snapshot,
    TrafficFrames,
    check_traffic,
    pack_frames,
    quota,
)
from inspe_jax.scene.traffic.waypoint.congestion import CongestedModel
from inspe_jax.scene.traffic.waypoint.model import WaypointModel
from inspe_jax.scene.traffic.waypoint.paths import PATH_USERS, Paths, lay_paths
from inspe_jax.scene.traffic.waypoint.walkways import with_walkways

WARM_UP = 40.0  # time [s] that the model runs before the first frame

CONGESTED_WARM_UP = 60.0  # the same where the roads fill: queues form behind the junction

WATCHED = 20.0  # last part of the warm-up [s], over which road users are counted

MISSING, CLASS_MISSING = (0.05, 2.0), (0.3, 1.5)
"""Roads do not hold all if this share is missing, and this many; and the same of any class."""

STEP = 0.2  # longest step of the model [s]


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

    There are about ``count`` objects at a time within ``radius`` [m] of the centre, in ``frames``
    frames ``step`` seconds apart. ``mix`` is a key of :data:`MIXES`. They are on the waypoints of
    the whole region; the paper takes those in view of the sensors. Unlike in the paper, road users
    never overlap: they keep their distance, slow down for bends and give way where paths cross.
    Where roads do not hold all, traffic is that of
    :class:`~inspe_jax.scene.traffic.waypoint.congestion.CongestedModel`; where nobody walks on the
    map, people walk as :func:`~inspe_jax.scene.traffic.waypoint.walkways.with_walkways` says.
    ``progress`` is called with (frames done, frames).

    The same seed gives the same traffic; turning the intersection turns it. Raises InspeError if a
    value is out of range, the mix is unknown, or no route lies within the radius.
    """
    check_traffic(radius=radius, count=count, frames=frames, mix=mix, step=step, seed=seed)
    walked = MIXES[mix].shares[CLASSES.index("pedestrian")] > 0
    place = with_walkways(intersection, radius) if walked else intersection
    paths = lay_paths(place, radius)
    kind = _kinds(paths, MIXES[mix], count)
    if len(kind) < count:
        raise InspeError(
            f"{intersection.name}: no route within {radius:g} m of the centre for mix '{mix}'"
        )
    model = _warmed_up(paths, kind, mix, seed)
    seen = []
    for frame in range(frames):
        if frame:
            _advance(model, step)
        seen.append(_snapshot(model).within(intersection.center, radius))
        if progress is not None:
            progress(frame + 1, frames)
    return pack_frames(seen, step)


def _kinds(paths: Paths, mix: Mix, count: int) -> Int[np.ndarray, " M"]:
    """Classes of ``count`` road users, among those that have a path."""
    has_path = [bool((paths.user == PATH_USERS.index(u.path)).any()) for u in ROAD_USERS]
    # Cyclists ride only where there are pedestrians too, so not on motorways.
    has_path[CLASSES.index("cyclist")] &= has_path[CLASSES.index("pedestrian")]
    return np.repeat(np.arange(len(CLASSES), dtype=np.int8), quota(mix, has_path, count))


def _warmed_up(paths: Paths, kind: np.ndarray, mix: str, seed: int) -> WaypointModel:
    """A model after its warm-up: of free roads, or of congested ones if those do not hold all."""
    rng = np.random.default_rng(seed)
    model = WaypointModel(paths, rng.permutation(kind), MIXES[mix], rng)
    model.fill()
    _advance(model, WARM_UP - WATCHED)
    wanted = np.bincount(kind, minlength=len(CLASSES))
    missing = wanted - _advance(model, WATCHED)
    each = np.maximum(CLASS_MISSING[0] * wanted, CLASS_MISSING[1])
    if (missing < each).all() and missing.sum() < max(MISSING[0] * wanted.sum(), MISSING[1]):
        return model
    rng = np.random.default_rng(seed)
    full = CongestedModel(paths, rng.permutation(kind), MIXES[mix], rng)
    full.fill()
    _advance(full, CONGESTED_WARM_UP)
    return full


def _advance(model: WaypointModel, time: float) -> Float[np.ndarray, " K"]:
    """Run a model for some time [s]; the mean number of road users there by class."""
    steps = int(np.ceil(time / STEP - 1e-9))
    there = np.zeros(len(CLASSES))
    for _ in range(steps):
        model.step(time / steps)
        there += np.bincount(model.kind[model.active], minlength=len(CLASSES))
    return there / max(steps, 1)


def _snapshot(model: WaypointModel) -> Snapshot:
    """Every road user that is on a path."""
    on = np.flatnonzero(model.active)
    middle = model.point[on].copy()
    middle[:, 2] += model.size[on, 2] / 2
    heading, size = model.heading[on], model.size[on].copy()
    velocity = np.column_stack([heading * model.speed[on, None], np.zeros(len(on))])
    yaw = np.arctan2(heading[:, 1], heading[:, 0])
    return Snapshot(middle, yaw, size, model.kind[on], model.track[on], velocity)
