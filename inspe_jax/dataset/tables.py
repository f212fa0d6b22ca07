"""Tables for people, and records for JSON, of a data set and of a frame."""

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from inspe_jax.core.tables import table_of
from inspe_jax.core.version import __version__
from inspe_jax.dataset.folders import Scenario
from inspe_jax.dataset.plan import Generation
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.dataset.statistics import Statistics, bands, table_row
from inspe_jax.simulation.frame import KINDS

_AXES = ("length", "width", "height")
_NONE = "–"


def content_table(generation: Generation) -> RenderableType:
    """Tables of a data set that is to be generated: its splits, and how balanced they are."""
    splits = {name: plans for name, plans in generation.splits.items() if plans}
    sizes = table_of(f"Data set {generation.name}", "split", "scenes", "scenarios", "frames")
    for name, plans in splits.items():
        scenes = len({plan.traffic_key for plan in plans})
        counts = scenes, len(plans), sum(plan.frames for plan in plans)
        sizes.add_row(name, *(f"{count:,}" for count in counts))
    balance = table_of("Scenarios of each split", "", *splits)
    for of in (lambda plan: str(plan.settings["density"]), lambda plan: plan.kind):
        each = [Counter(map(of, plans)) for plans in splits.values()]
        for value in dict.fromkeys(map(of, generation.scenarios)):
            balance.add_row(Text(value), *(f"{counts[value]:,}" for counts in each))
    return Group(sizes, "", balance)


def statistics_table(found: Statistics) -> RenderableType:
    """Tables of a data set: its splits and its classes."""
    heads = ("scenarios", "frames", "agents", "images", "point\nclouds", "points\na cloud", "boxes")
    splits = table_of(f"Data set {found.name}", "split", *heads, "MB")
    rows = [*found.splits, *([found.total] if len(found.splits) > 1 else [])]
    for split in rows:
        whole = (split.scenarios, split.frames, split.agents, split.images, split.clouds)
        mean = f"{split.points / split.clouds:,.0f}" if split.clouds else _NONE
        numbers = [*(f"{count:,}" for count in whole), mean, f"{split.boxes:,}"]
        splits.add_row(Text(split.name), *numbers, f"{split.size / 1e6:,.1f}")

    sides = (f"{axis}\n[m]" for axis in _AXES)
    columns = ("boxes", "road\nusers", *sides, "points\na box", "boxes with\na point")
    classes = table_of("Classes, medians", "class", *columns)
    for k, kind in enumerate(KINDS):
        sizes = found.users.size[found.users.kind == k]
        points = found.points.points[found.points.kind == k]
        counts = (f"{count[kind]:,}" for count in (found.boxes, found.tracks))
        middle = [f"{value:.2f}" for value in np.median(sizes, 0)] if len(sizes) else [_NONE] * 3
        seen = [f"{np.median(points):,.0f}", f"{(points > 0).mean():.1%}"] if len(points) else []
        classes.add_row(kind, *counts, *middle, *(seen or [_NONE] * 2))
    return Group(splits, "", classes)


def statistics_record(found: Statistics) -> dict[str, Any]:
    """The statistics of a data set for JSON. Sizes [m] are given as quartiles."""
    return {
        "name": found.name,
        "splits": [asdict(split) for split in found.splits],
        "total": asdict(found.total),
        "points_per_cloud": found.mean_points,
        "classes": {
            kind: {"boxes": found.boxes[kind], "road_users": found.tracks[kind], **_sizes(found, k)}
            for k, kind in enumerate(KINDS)
        },
        "objects_per_frame": {
            "mean": float(found.crowd.mean()),
            "least": int(found.crowd.min()),
            "most": int(found.crowd.max()),
        },
        "points": {kind: list(map(asdict, bands(found.points, k))) for k, kind in enumerate(KINDS)},
        "row": table_row(found),
        "versions": {"inspe_jax": __version__, "numpy": np.__version__},
    }


def frame_table(scenario: Scenario, number: int) -> RenderableType:
    """A table of the road users of a frame, with the points of all scans inside the box of each."""
    frame = scenario.frame(number)
    heads = ("x\n[m]", "y\n[m]", "yaw\n[°]", "speed\n[m/s]", *(f"{axis}\n[m]" for axis in _AXES))
    table = table_of(f"{scenario.name}, frame {number}", "track", "class", *heads, "points")
    scans = [scan for station in frame.stations for scan in station.scans]
    points = count_inside(scans, frame.boxes).sum(0)
    for box, count in zip(frame.boxes, points, strict=True):
        place = [f"{value:z.1f}" for value in box.center[:2]]
        turn = [f"{np.degrees(box.yaw):z.0f}", f"{np.linalg.norm(box.velocity):.1f}"]
        size = [f"{value:.2f}" for value in box.size]
        seen = f"{count:,}" if scans else _NONE
        table.add_row(str(box.track), box.kind, *place, *turn, *size, seen)
    return table


def _sizes(found: Statistics, kind: int) -> dict[str, list[float] | None]:
    sizes = found.users.size[found.users.kind == kind]
    if not len(sizes):
        return dict.fromkeys(_AXES)
    quartiles = np.percentile(sizes, [25, 50, 75], axis=0).T.tolist()
    return dict(zip(_AXES, quartiles, strict=True))
