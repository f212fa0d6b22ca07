"""Claim: from its cache, a set gives at least 200 LiDAR frames a second on two cores.

Four LiDARs with about 60 000 points each, and eight cameras: the layout Cam-d1/L-d1 at the built-in
four-way intersection, recorded anew. Measured: bytes of a frame as recorded and in the cache, how
long decoding takes, and frames a second as batches of four, by number of workers:

- LiDARs as padded points, as stored and augmented (mirror, turn, scale), and as pillars;
- eight pictures of 300 × 400, and all sensors together;
- beside them, the same frames read from the set itself, without a cache.

The set was just written, so all reads come from the system's memory: the figures are those of the
loader, not of a disk. Each is the median of several rounds.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, console, kept_folder, machine, output, show, write_results
from matplotlib.figure import Figure

from inspe_jax.dataset import Dataset, cache, generate, load_generation, open
from inspe_jax.dataset.loading import Augment, Cache, Loader, PillarGrid
from inspe_jax.dataset.loading.loader import Sensor
from inspe_jax.dataset.statistics import statistics

STUDY = """
scenes: [{{built_in: four_way}}]
layouts: [{{strategy: Cam-d1/L-d1, lidar: velodyne-hdl-64e, name: dense}}]
settings: {{density: medium, light: midday, seconds: {seconds}}}
rate_hz: 10
splits: {{train: 1, validate: 0, test: 0}}
"""
BATCH = 4
WORKERS = (0, 1, 2, 4)
"""0: batches are made when they are asked for."""
TARGET = 200
"""LiDAR frames a second, on two cores."""
ROUNDS, LASTS = 5, 1.0
"""Rounds of each measurement, and how long one takes at least [s]."""

LIDAR: tuple[Sensor, ...] = ("lidar",)
CAMERA: tuple[Sensor, ...] = ("camera",)
KINDS: dict[str, dict[str, Any]] = {
    "LiDARs, points": dict(sensors=LIDAR),
    "LiDARs, augmented": dict(sensors=LIDAR, augment=Augment()),
    "LiDARs, 0.4 m pillars": dict(
        sensors=LIDAR, points=PillarGrid(most_pillars=16_000), augment=Augment()
    ),
    "8 pictures": dict(sensors=CAMERA, augment=Augment()),
    "all sensors": dict(augment=Augment()),
}


def record(into: Path, quick: bool) -> Dataset:
    """The set: one scenario, recorded unless it is there."""
    study = into / "study.yaml"
    study.write_text(STUDY.format(seconds=0.4 if quick else 4))
    made = generate(load_generation(study), into / "set", workers=1 if quick else None)
    assert not made.failures, made.failures
    return open(into / "set")


def rate(steps: Iterator[Any], size: int, lasts: float) -> tuple[float, float]:
    """Frames a second of batches of ``size``, and what one takes of all cores together [ms]."""
    next(steps)  # what is done once
    began, busy, count = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - began < lasts:
        next(steps)
        count += size
    seconds = time.perf_counter() - began
    return count / seconds, 1e3 * (time.process_time() - busy) / count


def from_the_set(data: Dataset, name: str) -> Iterator[int]:
    """Frames as they are without a cache: points or pixels read from their files."""
    (scenario,) = data.scenarios
    while True:
        for number in scenario.frames:
            stations = scenario.frame(number).stations
            if name == "8 pictures":
                yield sum(image.rgb.size for unit in stations for image in unit.images)
            else:
                yield sum(scan.points.size for unit in stations for scan in unit.scans)


Case = tuple[str, str, int]
"""A kind of batch, what reads it, and the number of workers."""


def cases(
    data: Dataset, found: Cache, quick: bool, seed: int
) -> dict[Case, tuple[Callable[[], Iterator[Any]], int]]:
    """What is measured: a function that begins to read, and the frames of each step."""
    listed: dict[Case, tuple[Callable[[], Iterator[Any]], int]] = {}
    for kind in ("LiDARs, points", "8 pictures"):
        listed[kind, "set", 0] = partial(from_the_set, data, kind), 1
    for kind, settings in KINDS.items():
        for workers in WORKERS[2:3] if quick else WORKERS:
            loader = Loader(found, batch=BATCH, seed=seed, workers=workers, **settings)
            listed[kind, "cache", workers] = loader.steps, BATCH
    return listed


def measure(data: Dataset, found: Cache, quick: bool, seed: int) -> list[dict[str, Any]]:
    """Frames a second of every case. Each round has all of them, so that what else the machine
    does meanwhile disturbs all alike."""
    rates: dict[Case, list[float]] = defaultdict(list)
    busy: dict[Case, list[float]] = defaultdict(list)
    listed = cases(data, found, quick, seed)
    for _ in range(1 if quick else ROUNDS):
        for case, (begin, size) in listed.items():
            per_second, each = rate(begin(), size, 0.3 if quick else LASTS)
            rates[case].append(per_second)
            busy[case].append(each)
    rows = []
    for (kind, reader, workers), of in rates.items():
        row = dict(kind=kind, reader=reader, workers=workers, median=float(np.median(of)))
        cpu = float(np.median(busy[kind, reader, workers]))
        rows.append(row | dict(least=min(of), most=max(of), cpu_ms=cpu))
    return rows


def figure(rows: list[dict[str, Any]]) -> Figure:
    """Frames a second by workers, with the least and the most, and the target."""
    view = Figure(figsize=(8, 4.5), layout="constrained")
    axes = view.subplots()
    for kind in KINDS:
        own = [row for row in rows if row["kind"] == kind and row["reader"] == "cache"]
        x, y = [row["workers"] for row in own], np.array([row["median"] for row in own])
        ends = [[row["least"] for row in own], [row["most"] for row in own]]
        axes.errorbar(x, y, np.abs(np.array(ends) - y), marker="o", capsize=3, label=kind)
    axes.axhline(TARGET, color="grey", linestyle="--", linewidth=1)
    axes.annotate(f"{TARGET}", (3, TARGET), color="grey", va="bottom", fontsize=8)
    for row in rows:
        if row["reader"] == "set":
            axes.axhline(row["median"], color="grey", linestyle=":", linewidth=1)
            label = f"{row['kind']}: from the set"
            axes.annotate(label, (0.5, row["median"]), color="grey", va="bottom", fontsize=8)
    axes.set(xlabel="workers (threads)", ylabel="frames a second", yscale="log")
    axes.set_xticks(sorted({row["workers"] for row in rows}))
    view.legend(loc="outside right center")
    return view


def main() -> None:
    """Record, decode, measure, draw and write."""
    given = arguments(__doc__, "seed", "keep")
    with kept_folder(given.keep) as into:
        data = record(into, given.quick)
        began = time.perf_counter()
        found = cache(data, into / "cache", workers=1)
        decoding = time.perf_counter() - began
        counted = statistics(data)
        frames = counted.total.frames
        stored = found.scenarios[0].record
        sizes = {
            "set, MB a frame": counted.total.size / frames / 1e6,
            "cache, MB a frame": found.size / frames / 1e6,
            "cache, points": stored.files["points.raw"] / frames / 1e6,
            "cache, pictures": stored.files["pictures.raw"] / frames / 1e6,
            "points of a cloud": counted.mean_points or 0.0,
            "decoding, s a frame": decoding / frames,
        }
        for name, value in sizes.items():
            console.print(f"{name}: {value:.3g}")
        rows = measure(data, found, given.quick, given.seed)
    cells = []
    for row in rows:
        numbers = [f"{row[key]:.0f}" for key in ("median", "least", "most")]
        cells.append((row["kind"], row["reader"], row["workers"], *numbers, f"{row['cpu_ms']:.1f}"))
    show(("", "read by", "workers", "frames a second", "least", "most", "CPU ms a frame"), cells)
    reached = max(
        row["median"]
        for row in rows
        if row["kind"] == "LiDARs, points" and row["reader"] == "cache"
    )
    console.print(f"LiDAR frames a second: {reached:.0f}, {TARGET} were claimed")
    console.print(" · ".join(f"{key} {value}" for key, value in machine().items()))
    settings = {"seed": given.seed, "quick": given.quick, "batch": BATCH, "frames": frames}
    write_results(output(given, "loading"), rows, settings | sizes, figure(rows))


if __name__ == "__main__":
    main()
