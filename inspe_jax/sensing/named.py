"""Scenes and layouts as users give them: as such, or by the name of a file or of a strategy."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from inspe_jax.core.errors import InspeError, nearest, wrong_kind
from inspe_jax.core.records import check_record
from inspe_jax.scene.geojson import SUFFIX
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.scene.scene import Scene, what_is
from inspe_jax.scene.voxels import ROI_HEIGHT
from inspe_jax.sensing.conditions import Case, Conditions, case_of
from inspe_jax.sensing.layout import Layout, load_layout
from inspe_jax.sensing.layout_geojson import load_layout_geojson

LAYOUT_RULES: dict[str, Callable[[Scene, str], Layout]] = {}
"""Rules that make a layout for a scene, by name: the strategies register themselves here."""

LAYOUT_FILES = {".yaml": load_layout, ".yml": load_layout, SUFFIX: load_layout_geojson}
"""What reads a layout file, by its suffix."""


def layout_of(given: Any, scene: Scene, *, unit_rule: bool = True) -> Layout:
    """A layout on a scene that is given as such, as a file, or by the name of a strategy; checked.
    ``unit_rule`` is for files. Raises InspeError as :func:`~inspe_jax.sensing.layout.load_layout`
    and :func:`~inspe_jax.sensing.layout.make_layout`, and for anything else than a layout."""
    if isinstance(given, str | os.PathLike):
        if (rule := rule_of(given)) is not None:
            return rule(scene, str(given))
        reader = LAYOUT_FILES.get(Path(given).suffix.lower(), load_layout)
        return reader(given, scene, unit_rule=unit_rule)
    if not isinstance(given, Layout):
        wanted = "a Layout, the name of a .yaml or .geojson file, or a strategy: "
        raise wrong_kind("layout", given, wanted + ", ".join(LAYOUT_RULES))
    check_record(given, given.name, S=len(given))
    return given


def rule_of(given: str | os.PathLike[str]) -> Callable[[Scene, str], Layout] | None:
    """The rule of this name; None if it is that of a file. Raises InspeError if it is neither."""
    if Path(given).suffix.lower() in LAYOUT_FILES:
        return None
    if other := what_is(given):
        raise InspeError(f"{given}: no layout: {other}")
    if Path(given).is_file():
        return None
    rules = {key.lower(): rule for key, rule in LAYOUT_RULES.items()}
    if str(given).lower() not in rules:
        raise InspeError(
            f"no layout '{given}': give a .yaml or .geojson file, or a strategy: "
            f"{', '.join(LAYOUT_RULES)}{nearest(str(given), tuple(LAYOUT_RULES))}"
        )
    return rules[str(given).lower()]


def check_layout(
    scene: Scene | Case | str, layout: Layout | str, conditions: Conditions | str | None = None
) -> tuple[Scene, Layout, Conditions]:
    """The scene, the layout and the conditions of a function that users call, each also by name.

    Raises InspeError where one of them is something else or has wrong numbers, as
    :func:`~inspe_jax.sensing.conditions.case_of` and :func:`layout_of` do, and where a sensor is in
    the ground, in a static body or out of reach. Traced poses have no values to check and pass.
    """
    case = case_of(scene, conditions)
    layout = layout_of(layout, case.scene)
    if not isinstance(layout.poses, jax.core.Tracer):
        check_places(case.scene, layout)
    return case.scene, layout, case.conditions


def check_places(scene: Scene, layout: Layout) -> None:
    """Raise InspeError where a sensor is in the ground, in a static body or out of reach."""
    grid, poses = scene.voxels, np.asarray(layout.poses, float)
    for pose, sensor in zip(poses, layout.sensors, strict=True):
        where = f"{layout.name}: sensor '{sensor.name}' at ({pose[0]:.2f}, {pose[1]:.2f})"
        away, reach = np.hypot(*(pose[:2] - grid.center[:2])), sensor.spec.grid.reach
        ground = float(scene.intersection.ground(pose[None, :2])[0])
        gap = np.hypot(max(away - grid.radius, 0.0), max(pose[2] - ground - ROI_HEIGHT, 0.0))
        if gap > reach:
            raise InspeError(
                f"{where}, {pose[2] - ground:.0f} m up, is {gap:.0f} m from the region of interest "
                f"of {scene.name} and reaches {reach:g} m; is this layout for another scene?"
            )
        if not pose[2] > ground:
            raise InspeError(
                f"{where} is in the ground: its height is {pose[2]:.2f} m and the ground's "
                f"{ground:.2f} m"
            )
        inside = body_at(scene.statics, scene.intersection, pose[:3])
        if inside is not None:
            raise InspeError(
                f"{where}, {pose[2] - ground:.1f} m up, is inside a body of {scene.name}, the "
                f"{inside.words}; move it out, above or beneath, or take the body away"
            )
