"""Traffic from SUMO: signals, turning, queues, and people on crossings.

SUMO says who is where; how many come is found by trying: arrivals are a Poisson process for each
class, and their rates are raised or lowered until as many are in the region of interest as wanted.
"""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.parts import CLEARANCE
from inspe_jax.scene.maps.sumo.lanes import Streets, streets_of
from inspe_jax.scene.maps.sumo.network import load_net, run
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
from inspe_jax.scene.traffic.sumo.routes import V_CLASS, Way, ways_through

WARM_UP = 120.0
"""Time [s] that SUMO runs before the first frame."""
OBSERVED = 120.0
"""Least time [s] over which it is counted how many there are."""
TRIES = 8
"""How often the rates of arrival are mended, at most."""
NEAR_ENOUGH = 0.05
"""Share of the number wanted by which the mean may be off."""
SWIFTEST = 0.5
"""Most arrivals a second for each lane that leads in."""
STEP = 0.2
"""Longest step of SUMO [s]."""
LANE_CHANGE = 2.5
"""How long a change of lanes takes [s]."""


@dataclass
class Arrivals:
    """Who comes, of one class: when, at one arrival a second, by which way, and of what size.

    Longer lists begin with the shorter ones: another rate of arrival brings the same people,
    earlier or later.
    """

    kind: int
    ways: list[Way]
    spread: float
    rng: np.random.Generator
    when: list[float] = field(default_factory=list)
    way: list[int] = field(default_factory=list)
    size: list[np.ndarray] = field(default_factory=list)

    def until(self, time: float) -> int:
        """How many come by a time at one a second, found or drawn anew."""
        weight = np.array([way.weight for way in self.ways])
        while not self.when or self.when[-1] < time:
            last = self.when[-1] if self.when else 0.0
            self.when.append(last + self.rng.exponential())
            self.way.append(int(self.rng.choice(len(self.ways), p=weight / weight.sum())))
            varied = np.clip(self.rng.standard_normal(3), -2, 2) * self.spread
            self.size.append(np.array(ROAD_USERS[self.kind].size) * (1 + varied))
        return int(np.searchsorted(self.when, time))


def sumo_traffic(
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
    """Traffic that SUMO simulates on the map an intersection was read from.

    About ``count`` objects at a time whose centre lies within ``radius`` [m] of the centre, or as
    many as the roads let in, in ``frames`` frames ``step`` seconds apart. ``mix`` is a key of
    :data:`~inspe_jax.scene.traffic.frames.MIXES`; people walk where the network has sidewalks, and
    cross where it has crossings. Cyclists ride in the middle of the lane. Bodies overlap where SUMO
    lets them, as where long ones turn: a pair or less in most frames. Boxes stand on the
    intersection's ground; who is on another level is left out. ``progress`` is told (runs done,
    most runs): SUMO runs until the number is about right.

    The same seed gives the same traffic, with the same version of SUMO. Raises InspeError for a
    value out of range, an unknown mix, an intersection that was not read from a map, where SUMO is
    missing, or where no road leads through the radius.
    """
    check_traffic(radius=radius, count=count, frames=frames, mix=mix, step=step, seed=seed)
    small = _small_step(step)
    if intersection.map is None:
        raise InspeError(
            f"{intersection.name}: SUMO runs on a map (.net.xml, .osm or .xodr); "
            "a built-in or a saved scene has none"
        )
    streets = streets_of(load_net(intersection.map))
    ways = ways_through(streets, intersection.center, radius)
    wanted = quota(MIXES[mix], [bool(ways[kind]) for kind in CLASSES], count)
    if count and not wanted.any():
        raise InspeError(
            f"{intersection.name}: no road leads through {radius:g} m of the centre for mix '{mix}'"
        )
    arrivals = _arrivals(ways, wanted, MIXES[mix], seed)
    with tempfile.TemporaryDirectory() as folder:
        world = _World(Path(folder), streets, intersection, radius, seed, small)
        rates = _rates(world, arrivals, wanted, frames * step, progress)
        seen = world.simulate(arrivals, rates, frames, step)
    if progress is not None:
        progress(TRIES + 1, TRIES + 1)
    return pack_frames(seen, step)


def _small_step(step: float) -> float:
    """The longest step [s] of SUMO, in its whole milliseconds, that goes into a step of frames."""
    time = round(step * 1000)
    parts = [n for n in range(1, time + 1) if time % n == 0 and 20 <= time / n <= 1000 * STEP]
    if abs(step * 1000 - time) > 1e-6 or not parts:
        raise InspeError(
            f"traffic step {step:g} s: SUMO needs whole milliseconds, in even parts of 20 to 200"
        )
    return time / parts[0] / 1000


def _arrivals(
    ways: dict[str, list[Way]], wanted: Int[np.ndarray, " K"], mix: Mix, seed: int
) -> list[Arrivals]:
    """Streams of arrivals of the classes that are wanted, each of its own random numbers."""
    streams = np.random.default_rng(seed).spawn(len(CLASSES))
    return [
        Arrivals(kind, ways[name], mix.spread, rng)
        for kind, (name, rng) in enumerate(zip(CLASSES, streams, strict=True))
        if wanted[kind]
    ]


def _rates(
    world: "_World",
    arrivals: list[Arrivals],
    wanted: Int[np.ndarray, " K"],
    time: float,
    progress: Callable[[int, int], None] | None,
) -> list[float]:
    """Arrivals a second of each class that keep about as many in the region as wanted, on average
    over a time [s]."""
    target = np.array([wanted[a.kind] for a in arrivals], float)
    most = np.array([SWIFTEST * sum(w.weight for w in a.ways) for a in arrivals])
    stay = np.array([2 * world.radius / min(ROAD_USERS[a.kind].top_speed, 6.0) for a in arrivals])
    rates = np.minimum(target / stay, most)
    if not len(rates):
        return []
    best, off = rates, np.inf
    every = world.small * np.ceil(1.0 / world.small)
    many = int(np.ceil(max(time, OBSERVED) / every))
    for turn in range(TRIES):
        seen = world.simulate(arrivals, rates.tolist(), many, every)
        here = np.array([[(s.kind == a.kind).sum() for a in arrivals] for s in seen]).mean(0)
        error = abs(here.sum() - target.sum())
        if error < off:
            best, off = rates, error
        if progress is not None:
            progress(turn + 1, TRIES + 1)
        near = np.abs(here - target) <= np.maximum(1.5, 0.25 * target)
        if error <= max(1.0, NEAR_ENOUGH * target.sum()) and near.all():
            break
        change = np.clip(target / np.maximum(here, 0.25), 0.5, 2.0)
        mended = np.minimum(rates * change**0.8, most)
        if np.allclose(mended, rates, rtol=1e-3):  # the roads let in no more
            break
        rates = mended
    return best.tolist()


# ── SUMO itself ─────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class _World:
    """What all runs have in common."""

    folder: Path
    streets: Streets
    intersection: Intersection
    radius: float
    seed: int
    small: float

    def simulate(
        self, arrivals: list[Arrivals], rates: list[float], frames: int, every: float
    ) -> list[Snapshot]:
        """Everybody in the region, in frames ``every`` so many seconds after the warm-up."""
        begin = self.small * np.ceil(WARM_UP / self.small)
        end = begin + (frames - 1) * every
        routes, found = self.folder / "routes.xml", self.folder / "found.xml"
        sizes = _write_routes(routes, arrivals, rates, end)
        options = {
            "net-file": self.streets.road.file,
            "route-files": routes,
            "fcd-output": found,
            "fcd-output.attributes": "x,y,z,angle,speed",
            "device.fcd.begin": f"{begin:.3f}",
            "device.fcd.period": f"{every:.3f}",
            "end": f"{end + self.small:.3f}",
            "step-length": f"{self.small:.3f}",
            "lanechange.duration": f"{LANE_CHANGE:g}",
            "precision": 4,
            "seed": self.seed,
            "time-to-teleport": 60,
            "collision.action": "remove",
            "max-depart-delay": 10,
            "ignore-route-errors": "true",
            "no-step-log": "true",
            "no-warnings": "true",
        }
        arguments = [text for k, v in options.items() for text in (f"--{k}", str(v))]
        run("sumo", arguments, self.streets.road.source)
        seen = [self._snapshot(moment, sizes) for moment in _moments(found)]
        empty = self._snapshot([], sizes)
        return (seen + [empty] * frames)[:frames]

    def _snapshot(
        self, moment: list[dict[str, str]], sizes: dict[str, tuple[int, int, np.ndarray]]
    ) -> Snapshot:
        """What SUMO says of one moment: it places vehicles by the middle of their front, headings
        clockwise from north."""
        who = [sizes[one["id"]] for one in moment]
        size = np.array([s for _, _, s in who], float).reshape(-1, 3)
        kind = np.array([k for k, _, _ in who], np.int8)
        track = np.array([t for _, t, _ in who], np.int32)
        at = self.streets.road.world(
            [(float(one["x"]), float(one["y"]), float(one.get("z", "nan"))) for one in moment]
        )
        yaw = np.pi / 2 - np.radians([float(one["angle"]) for one in moment])
        yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        speed = np.array([float(one["speed"]) for one in moment])
        middle = at[:, :2] - heading * size[:, :1] / 2
        ground = self.intersection.ground(middle) if len(middle) else np.zeros(0)
        here = ~(np.abs(at[:, 2] - ground) > CLEARANCE)
        center = np.column_stack([middle, ground + size[:, 2] / 2])
        velocity = np.column_stack([heading * speed[:, None], np.zeros(len(speed))])
        parts = (center, yaw, size, kind, track, velocity)
        everybody = Snapshot(*(part[here] for part in parts))
        return everybody.within(self.intersection.center, self.radius)


def _moments(path: Path) -> Iterator[list[dict[str, str]]]:
    """Who is where, by moments, of SUMO's output."""
    for _, element in ET.iterparse(path):
        if element.tag == "timestep":
            yield [dict(one.attrib) for one in element]
            element.clear()


def _write_routes(
    path: Path, arrivals: list[Arrivals], rates: list[float], end: float
) -> dict[str, tuple[int, int, np.ndarray]]:
    """SUMO's input: everybody's type, route and departure; gives (class, track, size) of each."""
    root = ET.Element("routes")
    people: list[tuple[float, ET.Element]] = []
    sizes: dict[str, tuple[int, int, np.ndarray]] = {}
    for stream, rate in zip(arrivals, rates, strict=True):
        name = CLASSES[stream.kind]
        for k, way in enumerate(stream.ways):
            ET.SubElement(root, "route", id=f"{name}.{k}", edges=" ".join(way.edges))
        for n in range(stream.until(end * rate)):
            who, size, way = f"{name}.{n}", stream.size[n], stream.ways[stream.way[n]]
            sizes[who] = (stream.kind, len(CLASSES) * n + stream.kind, size)
            length, width, height = (f"{x:.3f}" for x in size)
            kind = {"id": who, "vClass": V_CLASS[name], "length": length, "width": width}
            kind |= {"height": height, "minGap": f"{ROAD_USERS[stream.kind].gap:g}"}
            if name in ("cyclist", "pedestrian"):
                kind["maxSpeed"] = f"{ROAD_USERS[stream.kind].top_speed:g}"
            ET.SubElement(root, "vType", kind)
            when = stream.when[n] / rate
            common = {"id": who, "type": who, "depart": f"{when:.2f}"}
            if name == "pedestrian":
                one = ET.Element("person", common | {"departPos": f"{way.begin:.2f}"})
                to = {"from": way.edges[0], "to": way.edges[-1], "arrivalPos": f"{way.end:.2f}"}
                ET.SubElement(one, "walk", to)
            else:
                place = {"departLane": "best", "departPos": f"{way.begin:.2f}"}
                place |= {"departSpeed": "desired", "arrivalPos": f"{way.end:.2f}"}
                route = f"{name}.{stream.way[n]}"
                one = ET.Element("vehicle", common | {"route": route} | place)
            people.append((when, one))
    root.extend(one for _, one in sorted(people, key=lambda pair: pair[0]))
    ET.ElementTree(root).write(path)
    return sizes
