"""Layouts as users give them: as such, by the name of a file, or by that of a strategy."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError, nearest, wrong_kind
from inspe_jax.core.records import check_record
from inspe_jax.scene.geojson import SUFFIX
from inspe_jax.scene.scene import Scene, what_is
from inspe_jax.sensing.layout import Layout, load_layout
from inspe_jax.sensing.layout_geojson import load_layout_geojson

LAYOUT_RULES: dict[str, Callable[[Scene, str], Layout]] = {}
"""Rules that make a layout for a scene, by name: the strategies register themselves here."""


def layout_of(given: Any, scene: Scene, *, unit_rule: bool = True) -> Layout:
    """A layout on a scene that is given as such, as a file, or by the name of a strategy; checked.
    ``unit_rule`` is for files. Raises InspeError as :func:`~inspe_jax.sensing.layout.load_layout`
    and :func:`~inspe_jax.sensing.layout.make_layout`, and for anything else than a layout."""
    if isinstance(given, Layout):
        check_record(given, given.name, S=len(given))
        return given
    if not isinstance(given, str | os.PathLike):
        known = ", ".join(LAYOUT_RULES)
        wanted = f"a Layout, the name of a .yaml or .geojson file, or a strategy: {known}"
        raise wrong_kind("layout", given, wanted)
    if Path(given).suffix.lower() == SUFFIX:
        return load_layout_geojson(given, scene.intersection, unit_rule=unit_rule)
    if (rule := rule_of(given)) is not None:
        return rule(scene, str(given))
    return load_layout(given, scene, unit_rule=unit_rule)


def rule_of(given: str | os.PathLike[str]) -> Callable[[Scene, str], Layout] | None:
    """The rule of this name; None if it is that of a file. Raises InspeError if it is neither."""
    if Path(given).suffix.lower() in (".yaml", ".yml", SUFFIX):
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
