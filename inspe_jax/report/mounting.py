"""What an installation schedule refers to and what it leaves open, in words for who mounts it."""

from collections.abc import Sequence
from itertools import combinations
from math import dist

import numpy as np

from inspe_jax.report.scene_tables import resolution_of
from inspe_jax.report.schedule import EXISTING_POLE, MaterialRow, UnitRow
from inspe_jax.scene.intersection import BUILT_IN, Intersection
from inspe_jax.scene.maps.sumo.network import GEOGRAPHIC, SUMO
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import LidarSpec

ONE_POINT = 0.05
"""Sensors that are nearer to each other are at one point, and as high as each other [m]."""


def origin_words(place: Intersection) -> str:
    """Where x, y and z are counted from; and that a built-in place is made up."""
    if place.source == BUILT_IN:
        level = not place.ground_points[:, 2].any()
        return (
            "x and y are 0 in the middle of the junction, "
            f"and z {'on its level ground' if level else 'is the height of its ground'}. "
            f"{place.name} is made up, not surveyed: this plan is an example."
        )
    heights = (
        "z is the height of its ground, there or in the model that the notes on the scene name"
    )
    if place.georeference is not None:
        east, north = place.georeference.shift
        moved = f", plus {east:.2f} and {north:.2f}" if east or north else ""
        doubt = place.georeference.doubt(place.center)
        return (
            f"x and y are those of the projection {place.georeference.crs}{moved}; latitude and "
            f"longitude are WGS 84; {heights}.{f' But {doubt}.' if doubt else ''}"
        )
    shifted = f", less its netOffset unless that is over {GEOGRAPHIC:,.0f} m"
    shifted = shifted if place.source.endswith(SUMO) else ""
    return f"x and y are the coordinates of the map {place.source}{shifted}; {heights}."


def mounting_words(scene: Scene, units: Sequence[UnitRow]) -> str:
    """What the plan leaves to who mounts it: poles that hide something, sensors on the axis of
    their pole, and sensors at one point."""
    words = [
        "In the scores only poles that are bodies of the scene hide something; arms and housings "
        "hide nothing."
        if scene.statics
        else "In the scores no pole, arm or housing hides anything."
    ]
    if not scene.statics and any(unit.pole == EXISTING_POLE for unit in units):
        words.append("How high existing poles are is not known.")
    on_axis = [(row, unit) for unit in units for row in unit.sensors if row.on_axis]
    if any(not row.all_round for row, _ in on_axis):
        words.append(
            "An aimed sensor on the axis of its pole goes on the side of the pole that it faces."
        )
    around = [(row, unit) for row, unit in on_axis if row.all_round]
    if around:
        words.append(
            "Where a sensor on the axis looks all round, the pole ends below it. If the pole goes "
            "on past it, mount it beside the pole: what the pole then hides, the scores count as "
            "seen."
        )
    below = [
        str(row.number)
        for row, unit in around
        if any(one is not row and one.height >= row.height - ONE_POINT for one in unit.sensors)
    ]
    if below:
        *first, last = below
        who = f"sensors {', '.join(first)} and {last}" if first else f"sensor {last}"
        words.append(f"So with {who}, as other sensors of the unit are as high or higher.")
    places = [[(*row.position, row.height) for row in unit.sensors] for unit in units]
    if any(dist(a, b) < ONE_POINT for at in places for a, b in combinations(at, 2)):
        words.append(
            "Sensors of a unit at one point are mounted side by side, as near to it as their "
            "housings allow."
        )
    return " ".join(words)


def model_words(layout: Layout, rows: Sequence[MaterialRow]) -> list[str]:
    """For each device that nobody sells, what a device that is bought in its place must have."""
    specs = {sensor.spec.name: sensor.spec for sensor in layout.sensors}
    found = []
    for row in rows:
        if not row.product:
            spec = specs[row.device]
            resolution, view = resolution_of(spec)
            what = f"{resolution} pixels"
            if isinstance(spec, LidarSpec):
                low, high = np.degrees([spec.elevations[0], spec.elevations[-1]])
                what = f"{resolution} channels at elevations from {low:.1f}° to {high:.1f}°"
            found.append(
                f"{row.device} is a model and cannot be bought. The scores hold for a device with "
                f"{what}, a field of view of {view} and a reach of {spec.grid.reach:g} m."
            )
    return found
