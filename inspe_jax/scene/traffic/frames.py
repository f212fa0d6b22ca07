"""Traffic as frames of oriented prisms, with road-user classes, mixes and densities."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.core.errors import InspeError, check_known, nearest
from inspe_jax.core.pytree import pytree
from inspe_jax.core.records import ByContent, Described, check_values
from inspe_jax.scene.intersection import CLEARANCE, Intersection

DENSITIES: dict[str, int] = {"none": 0, "low": 20, "medium": 40, "high": 60}
"""Mean number of objects in the region of interest at each density (paper, section 4)."""

MOST_FRAMES = 10_000  # more frames than this are taken for a mistake
NOTICEABLE, LEAST_NOTICED = 0.1, 0.5
"""Share of a class's quota, and number of users, from which on :func:`shortfall` names a class. Of
all road users half that share."""

SMALLEST = 0.01  # least length, width and height of a road user [m]
CLASSES: tuple[str, ...] = ("car", "truck", "cyclist", "pedestrian")
"""Road-user classes; ``TrafficFrames.kind`` holds the index."""


@dataclass(frozen=True)
class RoadUser:
    """One class: mean ``size`` (length, width, height) [m], how it moves [m/s, m/s²], which
    ``path`` of :data:`~inspe_jax.scene.traffic.waypoint.paths.PATH_USERS`, and its ``gap`` at a
    standstill [m]."""

    name: str
    path: str
    size: tuple[float, float, float]
    top_speed: float
    acceleration: float
    gap: float


ROAD_USERS: tuple[RoadUser, ...] = (
    RoadUser("car", "vehicle", (4.6, 1.85, 1.55), top_speed=10, acceleration=2.0, gap=1.5),
    RoadUser("truck", "vehicle", (8.5, 2.5, 3.4), top_speed=8.5, acceleration=1.2, gap=2.0),
    RoadUser("cyclist", "cyclist", (1.8, 0.65, 1.75), top_speed=5, acceleration=1.0, gap=1.0),
    RoadUser("pedestrian", "pedestrian", (0.5, 0.5, 1.72), 1.5, acceleration=1.5, gap=0.3),
)
"""How each class looks and moves in the waypoint model, in the order of :data:`CLASSES`."""


class BodySize(NamedTuple):
    """A sort of body: its share among others, and its mean length, width and height [m]."""

    share: float
    size: tuple[float, float, float]


def drawn_size(bodies: Sequence[BodySize], rng: np.random.Generator) -> tuple[float, float, float]:
    """The mean size [m] of one of these bodies, drawn by their shares."""
    share = np.array([body.share for body in bodies])
    return bodies[int(rng.choice(len(bodies), p=share / share.sum()))].size


@dataclass(frozen=True)
class Mix:
    """Who is on the road: the share of each of :data:`CLASSES`. Sizes are normal, of standard
    deviation ``spread``·mean, cut at two, about the mean of the class or of ``bodies`` drawn by
    their shares. Raises InspeError if shares or sizes are none.

    Another one is a row of ``MIXES``, here with trams among the trucks:

    >>> tram = inspe_jax.BodySize(share=1, size=(32.0, 2.65, 3.5))
    >>> inspe_jax.MIXES["trams"] = inspe_jax.Mix((0.6, 0.1, 0.1, 0.2), 0.03, {"truck": (tram,)})
    >>> trams = inspe_jax.build_scene("four_way", mix="trams", frames=1, voxel=2.0)
    >>> bool(trams.traffic.size[..., 0].max() > 30)
    True
    """

    shares: tuple[float, ...]
    spread: float
    bodies: Mapping[str, tuple[BodySize, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        own = len(self.shares) == len(CLASSES) and all(share >= 0 for share in self.shares)
        if not (own and 0 < sum(self.shares) < np.inf):
            words = f"a share of each of {', '.join(CLASSES)}, none of them negative"
            raise InspeError(f"shares: {words}; got {self.shares}")
        if not 0 <= self.spread < 0.5:
            raise InspeError(f"spread {self.spread:g}: at least 0, and below 0.5")
        for name, bodies in self.bodies.items():
            check_known(name, CLASSES, "bodies: road user")
            if not all(body.share > 0 and min(body.size) >= SMALLEST for body in bodies):
                raise InspeError(f"bodies: {name}: shares and sizes [m] must be positive")

    def mean_size(self, kind: int, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
        """The mean size [m] of a road user of the class CLASSES[kind]."""
        bodies = self.bodies.get(CLASSES[kind])
        return np.array(drawn_size(bodies, rng) if bodies else ROAD_USERS[kind].size)


FLEET: Mapping[str, tuple[BodySize, ...]] = {
    "car": (
        BodySize(7, (3.60, 1.65, 1.50)),  # mini: VW up
        BodySize(18, (4.07, 1.75, 1.45)),  # small: VW Polo
        BodySize(24, (4.28, 1.79, 1.49)),  # compact: VW Golf
        BodySize(12, (4.77, 1.83, 1.48)),  # medium: VW Passat
        BodySize(5, (4.94, 1.87, 1.47)),  # large: Mercedes E class
        BodySize(10, (4.51, 1.84, 1.68)),  # SUV: VW Tiguan
        BodySize(6, (4.92, 2.00, 1.75)),  # off-road: BMW X5
        BodySize(9, (4.53, 1.83, 1.66)),  # mini van: VW Touran
        BodySize(4, (4.90, 1.90, 1.99)),  # large van: VW T6
        BodySize(5, (5.93, 2.02, 2.62)),  # van of trade: Mercedes Sprinter, medium
    ),
    "truck": (
        BodySize(35, (7.10, 2.30, 3.20)),  # 7.5 t: Mercedes Atego
        BodySize(25, (9.80, 2.55, 3.80)),  # 18 t with a box
        BodySize(10, (9.50, 2.55, 3.50)),  # refuse collector, three axles
        BodySize(15, (12.14, 2.55, 3.12)),  # city bus: Mercedes Citaro
        BodySize(15, (16.50, 2.55, 4.00)),  # semi-trailer: the longest and highest of 96/53/EC
    ),
    "cyclist": (
        BodySize(80, (1.80, 0.65, 1.75)),
        BodySize(8, (2.50, 0.75, 1.75)),  # cargo bicycle: Urban Arrow
        BodySize(12, (2.10, 0.80, 1.65)),  # motorcycle or scooter with its rider
    ),
    "pedestrian": (
        BodySize(82, (0.50, 0.50, 1.72)),
        BodySize(10, (0.45, 0.45, 1.45)),  # 11 years old
        BodySize(8, (0.40, 0.40, 1.15)),  # 6 years old
    ),
}
"""Vehicles as they are registered, and people of all ages.

Sizes are of makers' data sheets. Shares of cars are those of Germany's stock on 1 January 2022
(Kraftfahrt-Bundesamt), rounded, without sports cars and camping vans, and with vans of trade.
Heights of children are medians of WHO's growth reference 2007. Other shares are assumptions.
"""

MIXES: dict[str, Mix] = {
    "mixed": Mix(shares=(0.68, 0.10, 0.10, 0.12), spread=0.06),
    "fleet": Mix(shares=(0.68, 0.10, 0.10, 0.12), spread=0.03, bodies=FLEET),
    "largest": Mix(shares=(0.0, 1.0, 0.0, 0.0), spread=0.0),
}
"""Traffic mixes by name. ``fleet`` is as varied as real traffic, for data sets; ``largest`` is the
paper's: every box is the largest vehicle."""


@pytree
@dataclass(frozen=True, eq=False, repr=False)
class TrafficFrames(ByContent, Described):
    """T frames of up to B vehicles or people, each an oriented vertical prism, in world metres.

    ``center`` is at mid-height; ``yaw`` in radians; ``size`` is length, width, height; ``kind``
    indexes :data:`CLASSES`. Entries with ``valid`` false are padding. A road user keeps its number
    in ``track``, which is −1 in padding, but not its entry. ``velocity`` in m/s; ``time`` of each
    frame in seconds, from the first.

    >>> scene.traffic.center.shape, scene.traffic.frame_count, scene.traffic.mean_count
    ((4, 31, 3), 4, 30.25)
    """

    center: Float[np.ndarray, "T B 3"]
    yaw: Float[np.ndarray, "T B"]
    size: Float[np.ndarray, "T B 3"]
    valid: Bool[np.ndarray, "T B"]
    kind: Int[np.ndarray, "T B"]
    track: Int[np.ndarray, "T B"]
    velocity: Float[np.ndarray, "T B 3"]
    time: Float[np.ndarray, " T"]

    def _facts(self) -> dict[str, Any]:
        return {"frames": self.frame_count, "road users a frame": f"{self.mean_count:.1f}"}

    def _check(self, prefix: str) -> None:
        if not self.frame_count:
            raise InspeError(f"{prefix}time: at least one frame is needed, also of an empty road")
        check_values(self.kind, f"{prefix}kind", 0, len(CLASSES) - 1, self.valid)
        check_values(self.size, f"{prefix}size", SMALLEST, there=self.valid[..., None])

    @property
    def frame_count(self) -> int:
        """Number of frames T."""
        return self.center.shape[0]

    def at(self, t: int) -> "Snapshot":
        """Frame t, without padding."""
        parts = self.center, self.yaw, self.size, self.kind, self.track, self.velocity
        return Snapshot(*(np.asarray(part)[t][self.valid[t]] for part in parts))

    @property
    def mean_by_class(self) -> Float[np.ndarray, " K"]:
        """Mean number of each of :data:`CLASSES` a frame.

        >>> scene.traffic.mean_by_class.tolist()
        [14.5, 2.0, 3.0, 10.75]
        """
        counts = np.bincount(self.kind[self.valid], minlength=len(CLASSES))
        return counts / max(self.frame_count, 1)

    @property
    def mean_count(self) -> float:
        """Mean number of objects a frame."""
        return float(self.valid.sum(1).mean()) if self.frame_count else 0.0


class Snapshot(NamedTuple):
    """One frame of n road users, with the fields of :class:`TrafficFrames`."""

    center: Float[np.ndarray, "n 3"]
    yaw: Float[np.ndarray, " n"]
    size: Float[np.ndarray, "n 3"]
    kind: Int[np.ndarray, " n"]
    track: Int[np.ndarray, " n"]
    velocity: Float[np.ndarray, "n 3"]

    def within(self, middle: Float[np.ndarray, "3"], radius: float) -> "Snapshot":
        """The road users whose centre lies within ``radius`` [m] of the middle, in plan."""
        away = self.center[:, :2] - np.asarray(middle)[:2]
        near = away[:, 0] ** 2 + away[:, 1] ** 2 <= radius**2
        return Snapshot(*(part[near] for part in self))


def pack_frames(seen: Sequence[Snapshot], step: float) -> TrafficFrames:
    """Snapshots ``step`` seconds apart as frames, each padded to the one with most road users."""
    count = np.array([len(frame.kind) for frame in seen])
    valid = np.arange(count.max()) < count[:, None]
    kinds, padding = {"kind": np.int8, "track": np.int32}, {"size": 1, "track": -1}
    filled: dict[str, np.ndarray] = {}
    for name, parts in zip(Snapshot._fields, zip(*seen, strict=True), strict=True):
        there = np.concatenate(parts)
        shape = (*valid.shape, *there.shape[1:])
        filled[name] = np.full(shape, padding.get(name, 0), kinds.get(name, float))
        filled[name][valid] = there
    return TrafficFrames(**filled, valid=valid, time=np.arange(len(seen)) * step)


def quota(mix: Mix, may: Sequence[bool], count: int) -> Int[np.ndarray, " K"]:
    """How many of ``count`` road users are of each class that ``may`` be there, by the largest
    remainder; all 0 if no class of the mix may."""
    share = np.where(may, mix.shares, 0.0)
    if not share.any():
        return np.zeros(len(CLASSES), int)
    exact = count * share / share.sum()
    each = np.floor(exact).astype(int)
    most = np.argsort(each - exact, kind="stable")
    each[most[: count - each.sum()]] += 1
    return each


def shortfall(traffic: TrafficFrames, count: int, mix: str) -> str:
    """What frames have less of than ``count`` road users of a mix, in words; empty if they have it.

    A class is named where its mean is short of its quota by half a user and a tenth of it, or has
    as many too many: ``asked 60, got 58.9: cars 35.0 of 41, trucks 3.9 of 6; pedestrians 13.2
    instead of 7``. Raises InspeError if the mix is unknown.
    """
    check_known(mix, MIXES, "traffic mix")
    wanted = quota(MIXES[mix], [True] * len(CLASSES), count)
    off = traffic.mean_by_class - wanted
    much = np.maximum(NOTICEABLE * wanted, LEAST_NOTICED)
    rows = [*zip(CLASSES, off, wanted, much, strict=True)]
    less = ", ".join(f"{name}s {w + o:.1f} of {w}" for name, o, w, m in rows if o <= -m)
    more = ", ".join(f"{name}s {w + o:.1f} instead of {w}" for name, o, w, m in rows if o >= m)
    if not less and off.sum() > -max(NOTICEABLE / 2 * count, LEAST_NOTICED):
        return ""
    said = "; ".join(part for part in (less, more) if part)
    return f"asked {count}, got {count + off.sum():.1f}" + (said and f": {said}")


def standing_on(
    place: Intersection, radius: float, snapshot: Snapshot, foot: Float[np.ndarray, " n"]
) -> Snapshot:
    """The road users on the ground of a place and within ``radius`` [m] of its centre; ``foot`` [m]
    are heights in the map's own coordinates, which say who is on another level, NaN for the
    ground."""
    middle, up = snapshot.center[:, :2], snapshot.size[:, 2] / 2
    here = ~(np.abs(foot - place.level(middle)) > CLEARANCE)
    center = np.column_stack([middle, place.ground(middle) + up])
    everybody = Snapshot(*(part[here] for part in snapshot._replace(center=center)))
    return everybody.within(place.center, radius)


def check_traffic(
    *, radius: float, count: int, frames: int, mix: str, step: float, seed: int
) -> None:
    """Raise InspeError if a value is out of range or the mix is unknown."""
    check_known(mix, MIXES, "traffic mix")
    for name, value, least in (("count", count, 0), ("frames", frames, 1), ("seed", seed, 0)):
        if value < least:
            raise InspeError(f"traffic {name} {value} is out of range: at least {least}")
    if frames > MOST_FRAMES:
        raise InspeError(f"traffic frames {frames} is out of range: at most {MOST_FRAMES}")
    for name, size in (("radius", radius), ("step", step)):
        if not (np.isfinite(size) and size > 0):
            raise InspeError(f"traffic {name} {size} is out of range: above 0")


TRAFFIC_MODELS: dict[str, str] = {
    "waypoints": "inspe_jax.scene.traffic.waypoint.generate:waypoint_traffic",
    "sumo": "inspe_jax.scene.traffic.sumo.generate:sumo_traffic",
}
"""Module and function of each model, called as
:func:`~inspe_jax.scene.traffic.waypoint.generate.waypoint_traffic`; imported on first use."""


def traffic_model(name: str) -> Callable[..., TrafficFrames]:
    """A model by name. Raises InspeError that names those there are."""
    if name not in TRAFFIC_MODELS:
        raise InspeError(
            f"traffic '{name}': {', '.join(TRAFFIC_MODELS)}, or a file of tracks (.csv) or of "
            "CARLA's recorder (.log)" + nearest(name, tuple(TRAFFIC_MODELS))
        )
    return resolve_name(TRAFFIC_MODELS[name])
