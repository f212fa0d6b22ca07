"""Traffic from SUMO: signals, turning, queues, and people on crossings. Each class arrives by a
Poisson process, whose rate is changed until as many are in the region as wanted."""

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Int

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.geojson import SUFFIX as GEOJSON
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.maps.sumo.network import run
from inspe_jax.scene.maps.sumo.reader import SumoMap, load_net
from inspe_jax.scene.traffic import frames as traffic
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS, Mix, Snapshot, TrafficFrames
from inspe_jax.scene.traffic.sumo.routes import V_CLASS, TravelPath, paths_through

WARM_UP = 120.0  # time [s] that SUMO runs before the first frame
OBSERVED = 120.0  # road users are counted over at least this time [s]
TRIES = 8  # most runs in which the rates of arrival are adjusted
NEAR_ENOUGH = 0.05  # the mean number may differ from the wanted one by this share
SWIFTEST = 0.5  # most arrivals a second on each lane that leads in
STEP = 0.2  # longest step of SUMO [s]
OPTIONS = (
    "--lanechange.duration 2.5 --fcd-output.attributes x,y,z,angle,speed --precision 4 "
    "--time-to-teleport 60 --collision.action remove --max-depart-delay 10 "
    "--ignore-route-errors true --no-step-log true --no-warnings true"
)

Arrival = tuple[int, int, np.ndarray]  # class, track and size [m] of a road user
Progress = Callable[[int, int], None]


@dataclass
class ArrivalStream:
    """Arrivals of one class: times at a rate of one a second, numbers of paths, and sizes. Another
    rate brings the same road users, earlier or later."""

    kind: int
    paths: list[TravelPath]
    mix: Mix
    rng: np.random.Generator
    drawn: list[tuple[float, int, np.ndarray]] = field(default_factory=list)

    def until(self, time: float) -> list[tuple[float, int, np.ndarray]]:
        """The arrivals up to a time at one a second; missing ones are drawn."""
        weight = np.array([path.weight for path in self.paths])
        last = self.drawn[-1][0] if self.drawn else 0.0
        while not self.drawn or last < time:
            last += self.rng.exponential()
            path = int(self.rng.choice(len(self.paths), p=weight / weight.sum()))
            mean = self.mix.mean_size(self.kind, self.rng)
            varied = np.clip(self.rng.standard_normal(3), -2, 2) * self.mix.spread
            self.drawn.append((last, path, mean * (1 + varied)))
        return [one for one in self.drawn if one[0] < time]


def sumo_traffic(
    intersection: Intersection,
    *,
    radius: float,
    count: int,
    frames: int,
    mix: str = "mixed",
    step: float = 1.0,
    seed: int = 0,
    progress: Progress | None = None,
) -> TrafficFrames:
    """Traffic that SUMO simulates on the map an intersection was read from.

    Options are those of :func:`~inspe_jax.scene.traffic.waypoint.generate.waypoint_traffic`. People
    walk and cross where the network has sidewalks and crossings. Bodies overlap where SUMO allows
    it, as where long vehicles turn. Road users on another level are left out. ``progress`` is
    called with (runs done, most runs). The same seed gives the same traffic with the same version
    of SUMO. Raises InspeError as that does, and if the intersection was not read from a map, SUMO
    is missing, or no road leads through the radius.
    """
    traffic.check_traffic(radius=radius, count=count, frames=frames, mix=mix, step=step, seed=seed)
    small = _small_step(step)
    if intersection.map is None or intersection.map.suffix.lower() == GEOJSON:
        raise InspeError(
            f"{intersection.name}: SUMO runs on a map (.net.xml, .osm or .xodr); "
            "a built-in or a saved scene has none"
        )
    streets = load_net(intersection.map, intersection.driving_side)
    paths = paths_through(streets, intersection.center, radius)
    wanted = traffic.quota(traffic.MIXES[mix], [bool(paths[kind]) for kind in CLASSES], count)
    if count and not wanted.any():
        raise InspeError(
            f"{intersection.name}: no road leads through {radius:g} m of the centre for mix '{mix}'"
        )
    own = np.random.default_rng(seed).spawn(len(CLASSES))  # random numbers for each class
    streams = [
        ArrivalStream(kind, paths[name], traffic.MIXES[mix], own[kind])
        for kind, name in enumerate(CLASSES)
        if wanted[kind]
    ]
    with tempfile.TemporaryDirectory() as folder:
        sumo = _SumoRuns(Path(folder), streets, intersection, radius, seed, small, streams)
        seen = sumo.simulate(sumo.rates(wanted, frames * step, progress), frames, step)
    if progress is not None:
        progress(TRIES + 1, TRIES + 1)
    return traffic.pack_frames(seen, step)


def _small_step(step: float) -> float:
    """The longest step of SUMO [s] that divides the step of frames, 20 to 200 ms."""
    time = round(step * 1000)
    parts = [n for n in range(1, time + 1) if time % n == 0 and 20 <= time / n <= 1000 * STEP]
    if abs(step * 1000 - time) > 1e-6 or not parts:
        raise InspeError(
            f"traffic step {step:g} s: SUMO needs a step of whole milliseconds that divides into "
            "equal parts of 20 to 200 ms"
        )
    return time / parts[0] / 1000


@dataclass(frozen=True)
class _SumoRuns:
    """Runs of SUMO on one network: what they have in common."""

    folder: Path
    streets: SumoMap
    intersection: Intersection
    radius: float
    seed: int
    small: float
    streams: list[ArrivalStream]

    def rates(
        self, wanted: Int[np.ndarray, " K"], time: float, progress: Progress | None
    ) -> list[float]:
        """Arrivals a second of each stream with which about as many as wanted are there."""
        streams = self.streams
        target = np.array([wanted[a.kind] for a in streams], float)
        most = np.array([SWIFTEST * sum(w.weight for w in a.paths) for a in streams])
        stay = np.array([2 * self.radius / min(ROAD_USERS[a.kind].top_speed, 6.0) for a in streams])
        rates = np.minimum(target / stay, most)
        if not len(rates):
            return []
        best, off = rates, np.inf
        every = self.small * np.ceil(1.0 / self.small)
        many = int(np.ceil(max(time, OBSERVED) / every))
        for turn in range(TRIES):
            seen = self.simulate(rates.tolist(), many, every)
            here = np.array([[(s.kind == a.kind).sum() for a in streams] for s in seen]).mean(0)
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
            if np.allclose(mended, rates, rtol=1e-3):  # the roads do not let in more
                break
            rates = mended
        return best.tolist()

    def simulate(self, rates: list[float], frames: int, every: float) -> list[Snapshot]:
        """Road users in the region, in frames ``every`` so many seconds after the warm-up."""
        begin = self.small * np.ceil(WARM_UP / self.small)
        end = begin + (frames - 1) * every
        routes, found = self.folder / "routes.xml", self.folder / "found.xml"
        sizes = self._write_routes(routes, rates, end)
        options = {
            "net-file": self.streets.file,
            "route-files": routes,
            "fcd-output": found,
            "device.fcd.begin": f"{begin:.3f}",
            "device.fcd.period": f"{every:.3f}",
            "end": f"{end + self.small:.3f}",
            "step-length": f"{self.small:.3f}",
            "seed": self.seed,
        }
        arguments = [text for k, v in options.items() for text in (f"--{k}", str(v))]
        run("sumo", [*arguments, *OPTIONS.split()], self.streets.source)
        seen = []
        for _, element in ET.iterparse(found):
            if element.tag == "timestep":
                seen.append(self._snapshot([*element], sizes))
                element.clear()
        return (seen + [self._snapshot([], sizes)] * frames)[:frames]

    def _snapshot(self, moment: list[ET.Element], sizes: dict[str, Arrival]) -> Snapshot:
        """Road users at a moment of SUMO's output: middles of fronts, headings from north."""
        who = [sizes[one.attrib["id"]] for one in moment]
        size = np.array([s for _, _, s in who], float).reshape(-1, 3)
        kind = np.array([k for k, _, _ in who], np.int8)
        track = np.array([t for _, t, _ in who], np.int32)
        x, y, z, angle, speed = (
            np.array([float(one.get(key, "nan")) for one in moment])
            for key in ("x", "y", "z", "angle", "speed")
        )
        at = self.streets.to_world(np.column_stack([x, y, z]))
        yaw = np.pi / 2 - np.radians(angle)
        yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
        heading = np.column_stack([np.cos(yaw), np.sin(yaw)])
        middle = at[:, :2] - heading * size[:, :1] / 2
        velocity = np.column_stack([heading * speed[:, None], np.zeros(len(speed))])
        everybody = Snapshot(middle, yaw, size, kind, track, velocity)
        return traffic.standing_on(self.intersection, self.radius, everybody, at[:, 2])

    def _write_routes(self, file: Path, rates: list[float], end: float) -> dict[str, Arrival]:
        root = ET.Element("routes")
        people: list[tuple[float, ET.Element]] = []
        sizes: dict[str, Arrival] = {}
        for stream, rate in zip(self.streams, rates, strict=True):
            name, user = CLASSES[stream.kind], ROAD_USERS[stream.kind]
            looks = {"vClass": V_CLASS[name], "minGap": f"{user.gap:g}"}
            if user.path != "vehicle":
                looks["maxSpeed"] = f"{user.top_speed:g}"
            for k, path in enumerate(stream.paths):
                ET.SubElement(root, "route", id=f"{name}.{k}", edges=" ".join(path.edges))
            for n, (at_one, number, size) in enumerate(stream.until(end * rate)):
                who, when, path = f"{name}.{n}", at_one / rate, stream.paths[number]
                sizes[who] = (stream.kind, len(CLASSES) * n + stream.kind, size)
                sides = zip(("length", "width", "height"), size, strict=True)
                body = {side: f"{x:.3f}" for side, x in sides}
                ET.SubElement(root, "vType", {"id": who} | looks | body)
                start = {"id": who, "type": who, "depart": f"{when:.2f}"}
                start["departPos"], arrival = f"{path.begin:.2f}", f"{path.end:.2f}"
                if name == "pedestrian":
                    one = ET.Element("person", start)
                    to = {"from": path.edges[0], "to": path.edges[-1], "arrivalPos": arrival}
                    ET.SubElement(one, "walk", to)
                else:
                    start |= {"departLane": "best", "departSpeed": "desired", "arrivalPos": arrival}
                    one = ET.Element("vehicle", start | {"route": f"{name}.{number}"})
                people.append((when, one))
        root.extend(one for _, one in sorted(people, key=lambda pair: pair[0]))
        ET.ElementTree(root).write(file)
        return sizes
