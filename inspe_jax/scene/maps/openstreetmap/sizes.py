"""Sizes in OpenStreetMap's tags: numbers with units, levels, and what stands in for them."""

import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from inspe_jax.scene.maps.bodies import BUILDING, TREE
from inspe_jax.scene.maps.openstreetmap.extract import Tags
from inspe_jax.scene.statics import HIGHEST

LEVEL = 3.0  # height of a level of a building [m]
LOW_BUILDING = 3.0  # the same, of those of LOW [m]: one level
LOW = ("garage", "garages", "carport", "shed", "hut", "kiosk", "bungalow", "static_caravan",
       "toilets", "greenhouse", "service", "boathouse", "container", "guardhouse")  # fmt: skip
ROOF = 5.0, 0.5  # height and thickness of a roof without walls, as of a filling station [m]
SOLID_FENCES = ("brick", "concrete", "corrugated_metal", "metal_sheet", "panel", "wood")
"""The ``fence_type`` of fences that one does not see through."""
TREE_SPACING = 8.0  # distance of the trees of a row [m]
POLES = {
    ("highway", "street_lamp"): (8.0, 0.09),
    ("highway", "traffic_signals"): (3.4, 0.07),
    ("power", "pole"): (9.0, 0.14),
    ("man_made", "mast"): (15.0, 0.3),
}
"""Height and radius of poles [m], by their tag."""
FOOT, INCH = 0.3048, 0.0254
_METRES = re.compile(r"(\d+(?:[.,]\d+)?|\.\d+)\s*(m|metres?|meters?|cm|ft|feet)?", re.IGNORECASE)
_FEET = re.compile(r"(\d+(?:\.\d+)?)\s*'\s*(?:(\d+(?:\.\d+)?)\s*(?:\"|''))?")
_UNITS = {"cm": 0.01, "ft": FOOT, "feet": FOOT}


def length_of(text: str) -> float | None:
    """The metres of a tag, as of ``12``, ``12.5 m``, ``40 ft`` and ``3'6"``; None for others."""
    text = text.strip()
    if match := _METRES.fullmatch(text):
        return float(match[1].replace(",", ".")) * _UNITS.get((match[2] or "m").lower(), 1.0)
    if match := _FEET.fullmatch(text):
        return float(match[1]) * FOOT + float(match[2] or 0) * INCH
    return None


@dataclass
class Sizes:
    """Reads sizes from tags, and keeps count of those that are assumed or make no sense."""

    assumed: "Counter[str]" = field(default_factory=Counter)
    senseless: list[str] = field(default_factory=list)

    def length(
        self, tags: Tags, key: str, least: float = 0.1, most: float = HIGHEST
    ) -> float | None:
        """The length under a key [m]; None where there is none between the limits."""
        return self._value(tags, key, length_of, least, most)

    def number(self, tags: Tags, key: str) -> float | None:
        """The number under a key, from 0 to 200; None where there is none."""
        return self._value(tags, key, float, 0.0, 200.0)

    def _value(
        self, tags: Tags, key: str, read: Callable[[str], float | None], least: float, most: float
    ) -> float | None:
        if key not in tags:
            return None
        with suppress(ValueError):
            value = read(tags[key])
            if value is not None and least <= value <= most:
                return value
        self.senseless.append(f"{key}={tags[key]}")
        return None

    def heights(self, tags: Tags, kind: str) -> tuple[float, float]:
        """The base and the height of a building or a part of one; ``kind`` is its tag's value."""
        height = self.length(tags, "height")
        levels, base = self.number(tags, "building:levels"), self.length(tags, "min_height", 0.0)
        if height is None and levels is not None:
            over = self.length(tags, "roof:height", 0.0)
            if over is None:
                over = (self.number(tags, "roof:levels") or 0.0) * LEVEL
            height = levels * LEVEL + over
            if not 0 < height <= HIGHEST:
                height = None
        if base is None and (start := self.number(tags, "building:min_level")) is not None:
            base = start * LEVEL
        if kind == "roof":
            top, thick = ROOF
            top = height or top
            return (top - thick if base is None and top > thick else base or 0.0), top
        if height is None:
            self.assumed["building"] += 1
            height = (LOW_BUILDING if kind in LOW else BUILDING) + (base or 0.0)
        if base is not None and base >= height:
            self.senseless.append(f"min_height={base:g} of height={height:g}")
            base = None
        return base or 0.0, height

    def size_or(self, tags: Tags, key: str, kind: str, default: float, **limits: float) -> float:
        """The length under a key [m], or a default that is counted for its kind of body."""
        value = self.length(tags, key, **limits)
        if value is None and key == "height":
            self.assumed[kind] += 1
        return default if value is None else value

    def notes(self) -> list[str]:
        """What was assumed, in words."""
        found = []
        ways = {
            "building": f"{BUILDING:g} m high ({LOW_BUILDING:g} m for garages, sheds and the like)",
            "tree": f"{TREE['height']:g} m high",
            "wall": "of a usual height",
            "pole": "of a usual height",
        }
        for kind, words in ways.items():
            if count := self.assumed[kind]:
                found.append(
                    f"no height is given for {count} of the map's {kind}s: taken as {words}"
                )
        if self.senseless:
            some = ", ".join(dict.fromkeys(self.senseless[:3]))
            found.append(f"{len(self.senseless)} sizes of the map's bodies make no sense ({some})")
        return found
