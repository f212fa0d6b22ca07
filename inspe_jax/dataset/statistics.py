"""Statistics of a data set: of each split, of each class of road user, and points by range."""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.core.errors import InspeError
from inspe_jax.core.words import counted
from inspe_jax.dataset.folders import Dataset, Scenario, disk_size, open_dataset
from inspe_jax.dataset.formats.protocol_file import section_of
from inspe_jax.dataset.formats.registry import FORMATS
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.simulation.frame import KINDS, Boxes, Scan

RANGE_EDGES: Float[np.ndarray, " R"] = 5 * 2 ** (np.arange(-4, 14) / 2)
"""Limits of the range bands [m], each √2 times the one before: 1.25, 1.8, 2.5 … 453."""


@dataclass(frozen=True)
class Split:
    """The counts of a split: agents of each scenario, boxes of each frame, and ``size`` [bytes]."""

    name: str
    scenarios: int
    frames: int
    agents: int
    images: int
    clouds: int
    points: int
    boxes: int
    size: int


COUNTS = tuple(f.name for f in fields(Split) if f.name != "name")


@dataclass(frozen=True, eq=False)
class Users:
    """The K road users of all scenarios: index in KINDS, and sizes of their first boxes [m]."""

    kind: Int[np.ndarray, " K"]
    size: Float[np.ndarray, "K 3"]


@dataclass(frozen=True, eq=False)
class PointCounts:
    """Of N boxes: index in KINDS, ``range`` from the nearest LiDAR [m], and points inside."""

    kind: Int[np.ndarray, " N"]
    range: Float[np.ndarray, " N"]
    points: Int[np.ndarray, " N"]


@dataclass(frozen=True)
class Band:
    """Boxes between two ranges [m]: the ``share`` with a point, and quartiles of their points."""

    low: float
    high: float
    boxes: int
    share: float
    quartiles: tuple[float, float, float] | None

    @property
    def middle(self) -> float:
        """The geometric mean of the limits [m]."""
        return float(np.sqrt(self.low * self.high))


@dataclass(frozen=True, eq=False)
class Statistics:
    """The statistics of a data set: ``boxes`` of each class count once per frame; ``crowd`` is the
    number of road users in each of F frames; ``cameras`` and ``lidars`` are the least and the most
    in a frame; ``agents`` are of each scenario; ``towns`` are the maps, None where unknown."""

    path: Path
    splits: tuple[Split, ...]
    boxes: Mapping[str, int]
    users: Users
    crowd: Int[np.ndarray, " F"]
    points: PointCounts = field(repr=False)
    cameras: tuple[int, int]
    lidars: tuple[int, int]
    agents: tuple[tuple[int, ...], ...] = field(repr=False)
    towns: frozenset[str | None] = field(repr=False)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def total(self) -> Split:
        """All splits together."""
        return Split("all", **{k: sum(getattr(each, k) for each in self.splits) for k in COUNTS})

    @property
    def mean_points(self) -> float | None:
        """Mean number of points in a point cloud; None if there is no point cloud."""
        total = self.total
        return total.points / total.clouds if total.clouds else None

    @property
    def tracks(self) -> dict[str, int]:
        """Number of road users of each class; each counts once per scenario."""
        count = np.bincount(self.users.kind, minlength=len(KINDS))
        return dict(zip(KINDS, count.tolist(), strict=True))


def statistics(
    given: Dataset | str | os.PathLike[str], progress: Callable[[int, int], None] | None = None
) -> Statistics:
    """Count the content of a data set; ``progress`` is called with (frames done, all). Raises
    InspeError if there is no such data set, it has no frame, or a file is broken."""
    data = given if isinstance(given, Dataset) else open_dataset(given)
    total_frames = sum(len(scenario.frames) for scenario in data.scenarios)
    if not total_frames:
        examples = " or ".join(row.example for row in FORMATS.values())
        where = counted(len(data.scenarios), "scenario")
        raise InspeError(f"{data.path}: no frame in {where}: expected {examples}, for every agent")
    splits, crowd, inside, sensors = [], [], [], []
    users: dict[tuple[Path, int], tuple[int, list[float]]] = {}
    boxes = dict.fromkeys(KINDS, 0)
    for name, scenarios in data.splits.items():
        counts = Counter[str](scenarios=len(scenarios))
        for scenario in scenarios:
            counts.update(agents=len(scenario.agents), size=disk_size(scenario.path))
            for number in scenario.frames:
                frame = scenario.frame(number)
                scans = [scan for station in frame.stations for scan in station.scans]
                images = sum(len(station.images) for station in frame.stations)
                points = sum(len(scan.points) for scan in scans)
                counts.update(frames=1, images=images, clouds=len(scans), points=points)
                counts.update(boxes=len(frame.boxes))
                for box in frame.boxes:
                    first = KINDS.index(box.kind), np.asarray(box.size).tolist()
                    users.setdefault((scenario.path, box.track), first)
                    boxes[box.kind] += 1
                if scans and frame.boxes:
                    inside.append(_points_in_boxes(scans, frame.boxes))
                sensors.append((images, len(scans)))
                crowd.append(len(frame.boxes))
                if progress:
                    progress(len(crowd), total_frames)
        splits.append(Split(name, **{key: counts[key] for key in COUNTS}))
    kind, away, points = np.concatenate(inside or [np.zeros((3, 0), np.float32)], 1)
    least, most = np.min(sensors, 0).tolist(), np.max(sensors, 0).tolist()
    return Statistics(
        path=data.path,
        splits=tuple(splits),
        boxes=boxes,
        users=Users(
            np.array([kind for kind, _ in users.values()], np.int64),
            np.array([size for _, size in users.values()], float).reshape(-1, 3),
        ),
        crowd=np.array(crowd),
        points=PointCounts(kind.astype(np.int8), away, points.astype(np.int32)),
        cameras=(least[0], most[0]),
        lidars=(least[1], most[1]),
        agents=tuple(scenario.agents for scenario in data.scenarios),
        towns=frozenset(map(_town, data.scenarios)),
    )


def bands(counts: PointCounts, kind: int) -> tuple[Band, ...]:
    """The boxes of a class by range, without empty bands; the first and last have all beyond."""
    own = counts.kind == kind
    points = counts.points[own]
    last = len(RANGE_EDGES) - 2
    place = np.clip(np.searchsorted(RANGE_EDGES, counts.range[own], side="right") - 1, 0, last)
    found = []
    for k in np.unique(place):
        within = points[place == k]
        nonempty = within[within > 0]
        quartiles = tuple(np.percentile(nonempty, [25, 50, 75]).tolist()) if len(nonempty) else None
        low, high = RANGE_EDGES[k : k + 2].tolist()
        found.append(Band(low, high, len(within), len(nonempty) / len(within), quartiles))
    return tuple(found)


def table_row(found: Statistics) -> dict[str, str | int | None]:
    """The row of a data set in a table that compares data sets; unknown values are None."""
    total = found.total
    return {
        "name": found.name,
        "V2X": _v2x(found.agents),
        "cameras": _span(found.cameras),
        "LiDARs": _span(found.lidars),
        "frames": total.frames,
        "images": total.images,
        "point clouds": total.clouds,
        "3D boxes": total.boxes,
        "classes": sum(count > 0 for count in found.tracks.values()),
        "scenarios": total.scenarios,
        "maps": None if None in found.towns else len(found.towns),
    }


def _town(scenario: Scenario) -> str | None:
    town = section_of(scenario.protocol, "world").get("town")
    return None if town is None else str(town)


def _points_in_boxes(scans: Sequence[Scan], boxes: Boxes) -> Float[np.ndarray, "3 B"]:
    """Kind, range to the nearest scan, and points of each box."""
    kind = [KINDS.index(box.kind) for box in boxes]
    sensors = np.array([scan.pose[:3] for scan in scans])
    middles = np.array([box.center for box in boxes])
    away = np.linalg.norm(middles - sensors[:, None], axis=-1)  # (S, B)
    return np.stack([kind, away.min(0), count_inside(scans, boxes).sum(0)]).astype(np.float32)


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
