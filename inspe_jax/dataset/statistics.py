"""What a data set holds, counted: of each split, of each class, and points against range."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.folders import Dataset, Scenario, open_dataset
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.simulation.frame import KINDS, Frame

RANGE_EDGES: Float[np.ndarray, " R"] = 5 * 2 ** (np.arange(-4, 14) / 2)
"""Ends of the bands of range [m], √2 apart: 1.25, 1.8, 2.5 … 5, 7.1, 10 … 453."""


@dataclass(frozen=True)
class Split:
    """What a split holds. An agent is counted once a scenario, a box once a frame.

    ``images`` have a picture, ``clouds`` are point clouds with ``points`` together; ``size`` in
    bytes on disk, of everything in the scenarios' folders.
    """

    name: str
    scenarios: int
    frames: int
    agents: int
    images: int
    clouds: int
    points: int
    boxes: int
    size: int


@dataclass(frozen=True, eq=False)
class Users:
    """Road users, each once a scenario: an index into KINDS, the size of the box where it was
    first met (length, width, height) [m], and in how many frames it is."""

    kind: Int[np.ndarray, " K"]
    size: Float[np.ndarray, "K 3"]
    frames: Int[np.ndarray, " K"]


@dataclass(frozen=True, eq=False)
class PointCounts:
    """Points within boxes: index into KINDS, metres from LiDAR to the box's middle, points."""

    kind: Int[np.ndarray, " N"]
    range: Float[np.ndarray, " N"]
    points: Int[np.ndarray, " N"]


@dataclass(frozen=True)
class Band:
    """Boxes of a band of range [m]. ``share`` of them have a point; of these are the quartiles."""

    low: float
    high: float
    boxes: int
    share: float
    quartiles: tuple[float, float, float] | None


@dataclass(frozen=True, eq=False)
class Statistics:
    """What a data set holds.

    ``merged`` has each box of each frame once, with the points of all the scans of that frame,
    and the range to the nearest of their LiDARs; ``single`` has it once for each scan. Both leave
    frames without a scan out. ``crowd`` is the number of things in each frame; ``cameras`` and
    ``lidars`` the least and the most that a frame has. ``protocols`` are those of the scenarios.
    """

    path: Path
    splits: tuple[Split, ...]
    users: Users
    crowd: Int[np.ndarray, " F"]
    merged: PointCounts = field(repr=False)
    single: PointCounts = field(repr=False)
    cameras: tuple[int, int]
    lidars: tuple[int, int]
    agents: tuple[tuple[int, ...], ...] = field(repr=False)
    protocols: tuple[Mapping[str, Any], ...] = field(repr=False)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def total(self) -> Split:
        """All splits together."""
        counts = {
            key: sum(getattr(split, key) for split in self.splits)
            for key in Split.__dataclass_fields__
            if key != "name"
        }
        return Split(name="all", **counts)

    @property
    def mean_points(self) -> float | None:
        """Points of a point cloud on average; None where there is no point cloud."""
        total = self.total
        return total.points / total.clouds if total.clouds else None

    @property
    def boxes(self) -> dict[str, int]:
        """Boxes of each class, each once a frame."""
        return {
            kind: int(self.users.frames[self.users.kind == k].sum()) for k, kind in enumerate(KINDS)
        }

    @property
    def tracks(self) -> dict[str, int]:
        """Road users of each class, each once a scenario."""
        return {kind: int((self.users.kind == k).sum()) for k, kind in enumerate(KINDS)}


def statistics(
    given: Dataset | str | os.PathLike[str],
    progress: Callable[[int, int], None] | None = None,
) -> Statistics:
    """Count what a data set holds, frame by frame; pictures are not read.

    ``progress`` is told how many frames are done and how many there are. Raises InspeError
    where there is no such set, it has no frame, or a file of it is broken.
    """
    data = given if isinstance(given, Dataset) else open_dataset(given)
    many = sum(len(scenario.frames) for scenario in data.scenarios)
    if not many:
        count = len(data.scenarios)
        raise InspeError(
            f"{data.path}: no frame in {count} scenario{'s' * (count != 1)}: one is a YAML file of "
            f"the same number in the folder of every agent"
        )
    tally = _Tally()
    splits = []
    for name, scenarios in data.splits.items():
        start = dict(tally.counts)
        for scenario in scenarios:
            for _ in tally.add(scenario):
                if progress:
                    progress(len(tally.crowd), many)
        counts = {key: count - start[key] for key, count in tally.counts.items()}
        splits.append(Split(name=name, scenarios=len(scenarios), **counts))
    return tally.statistics(data, tuple(splits))


def bands(hits: PointCounts, kind: int) -> tuple[Band, ...]:
    """The points of a class's boxes by range, those bands that have any; KINDS[kind].

    What is nearer or further than all of :data:`RANGE_EDGES` is in the first or the last.
    """
    own = hits.kind == kind
    points = hits.points[own]
    last = len(RANGE_EDGES) - 2
    place = np.clip(np.searchsorted(RANGE_EDGES, hits.range[own], side="right") - 1, 0, last)
    found = []
    for k in np.unique(place):
        within = points[place == k]
        met = within[within > 0]
        quartiles = tuple(np.percentile(met, [25, 50, 75]).tolist()) if len(met) else None
        low, high = RANGE_EDGES[k : k + 2].tolist()
        found.append(Band(low, high, len(within), len(met) / len(within), quartiles))
    return tuple(found)


def table_row(found: Statistics) -> dict[str, str | int | None]:
    """The set's own row of a table that compares data sets; None where the set does not tell.

    Counted: ``V2X`` is V2V, I2I or V2X for vehicles, infrastructure or both (V or I where no
    scenario has two agents); ``cameras`` and ``LiDARs`` are of a frame; ``maps`` are the
    protocols' ``world.town``. Told by the protocols, where at all: ``year`` and ``source``, and
    ``intersection``, of which those of each map are counted. Who gives no source but a
    simulator's tick, ``world.fixed_delta_seconds``, is taken to be ``sim``.
    """
    total = found.total
    towns = [_world(protocol).get("town") for protocol in found.protocols]
    crossings = [protocol.get("intersection") for protocol in found.protocols]
    sources = [
        protocol.get("source", "sim" if "fixed_delta_seconds" in _world(protocol) else None)
        for protocol in found.protocols
    ]
    years = [protocol.get("year") for protocol in found.protocols]
    return {
        "name": found.name,
        "year": _joined(years),
        "source": _joined(sources),
        "V2X": _v2x(found.agents),
        "cameras": _span(found.cameras),
        "LiDARs": _span(found.lidars),
        "frames": total.frames,
        "images": total.images,
        "point clouds": total.clouds,
        "3D boxes": total.boxes,
        "classes": sum(count > 0 for count in found.tracks.values()),
        "scenarios": total.scenarios,
        "intersections": _distinct(list(zip(towns, crossings, strict=True)), crossings),
        "maps": _distinct(towns, towns),
    }


class _Tally:
    """What has been counted so far."""

    def __init__(self) -> None:
        keys = ("frames", "agents", "images", "clouds", "points", "boxes", "size")
        self.counts = dict.fromkeys(keys, 0)
        self.crowd: list[int] = []
        self.users: list[tuple[int, list[float], int]] = []
        self.merged: list[np.ndarray] = []
        self.single: list[np.ndarray] = []
        self.cameras: set[int] = set()
        self.lidars: set[int] = set()

    def add(self, scenario: Scenario) -> Iterator[None]:
        """A scenario, one step a frame."""
        users: dict[int, tuple[int, list[float], int]] = {}
        self.counts["agents"] += len(scenario.agents)
        self.counts["size"] += _disk_size(scenario.path)
        for number in scenario.frames:
            frame = scenario.frame(number)
            for box in frame.boxes:
                kind, size = KINDS.index(box.kind), np.asarray(box.size).tolist()
                kind, size, before = users.get(box.track, (kind, size, 0))
                users[box.track] = kind, size, before + 1
            self._add_sensors(frame)
            self._add_hits(frame)
            self.crowd.append(len(frame.boxes))
            self.counts["frames"] += 1
            self.counts["boxes"] += len(frame.boxes)
            yield
        self.users += users.values()

    def _add_sensors(self, frame: Frame) -> None:
        images = sum(len(station.images) for station in frame.stations)
        scans = [scan for station in frame.stations for scan in station.scans]
        self.cameras.add(images)
        self.lidars.add(len(scans))
        self.counts["images"] += images
        self.counts["clouds"] += len(scans)
        self.counts["points"] += sum(len(scan.points) for scan in scans)

    def _add_hits(self, frame: Frame) -> None:
        scans = [scan for station in frame.stations for scan in station.scans]
        if not (scans and frame.boxes):
            return
        points = count_inside(scans, frame.boxes)  # (S, B)
        kind = np.array([KINDS.index(box.kind) for box in frame.boxes])
        sensors = np.array([scan.pose[:3] for scan in scans])
        middles = np.array([box.center for box in frame.boxes])
        away = np.linalg.norm(middles - sensors[:, None], axis=-1)  # (S, B)
        self.merged.append(np.stack([kind, away.min(0), points.sum(0)]).astype(np.float32))
        each = np.stack([np.broadcast_to(kind, away.shape), away, points])  # (3, S, B)
        self.single.append(each.reshape(3, -1).astype(np.float32))

    def statistics(self, data: Dataset, splits: tuple[Split, ...]) -> Statistics:
        """All together."""
        kind, size, frames = zip(*self.users, strict=True) if self.users else ((), (), ())
        return Statistics(
            path=data.path,
            splits=splits,
            users=Users(
                np.array(kind, np.int64),
                np.array(size, float).reshape(-1, 3),
                np.array(frames, int),
            ),
            crowd=np.array(self.crowd),
            merged=_hits(self.merged),
            single=_hits(self.single),
            cameras=(min(self.cameras), max(self.cameras)),
            lidars=(min(self.lidars), max(self.lidars)),
            agents=tuple(scenario.agents for scenario in data.scenarios),
            protocols=tuple(scenario.protocol for scenario in data.scenarios),
        )


def _hits(parts: list[np.ndarray]) -> PointCounts:
    kind, away, points = np.concatenate(parts, 1) if parts else np.zeros((3, 0), np.float32)
    return PointCounts(kind.astype(np.int8), away, points.astype(np.int32))


def _disk_size(folder: Path) -> int:
    """Bytes of the files in a folder and below it; one that has two names counts once."""
    sizes = {}
    for place, _, names in os.walk(folder):
        for name in names:
            status = os.stat(os.path.join(place, name), follow_symlinks=False)
            sizes[status.st_dev, status.st_ino] = status.st_size
    return sum(sizes.values())


def _world(protocol: Mapping[str, Any]) -> Mapping[str, Any]:
    world = protocol.get("world")
    return world if isinstance(world, Mapping) else {}


def _v2x(agents: Sequence[Sequence[int]]) -> str:
    vehicles = max(sum(agent >= 0 for agent in each) for each in agents)
    units = max(sum(agent < 0 for agent in each) for each in agents)
    if vehicles and units:
        return "V2X"
    letter = "V" if vehicles else "I"
    return f"{letter}2{letter}" if max(vehicles, units) > 1 else letter


def _span(ends: tuple[int, int]) -> str | int:
    low, high = ends
    return high if low == high else f"{low}–{high}"


def _joined(words: Sequence[Any]) -> str | None:
    return ", ".join(sorted({str(word) for word in words if word is not None})) or None


def _distinct(values: Sequence[Any], needed: Sequence[Any]) -> int | None:
    """How many values differ; None where one of those needed is not told."""
    return None if any(value is None for value in needed) else len({str(v) for v in values})
