"""The colours of road users' shapes.

Colours are drawn as often as they occur on the road. Those of cars follow Axalta's 69th Global
Automotive Color Popularity Report (2021). The other frequencies are plausible guesses: most
clothing is dark, and most trucks' boxes are white.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError

PARTS: tuple[str, ...] = (
    "body", "window", "trim", "tyre", "hub", "lamp", "lamp rear", "cargo", "tub", "load", "frame",
    "skin", "hair", "helmet", "cloth", "trousers", "shoe", "bag",
)  # fmt: skip
"""The parts of road users, as ``shapes.npz`` counts them. Each has colours of its own."""

RGB = Float[np.ndarray, "3"]
Palette = dict[tuple[int, int, int], float]

CAR: Palette = {
    (236, 236, 234): 0.35,  # white
    (18, 18, 20): 0.19,  # black
    (92, 95, 99): 0.19,  # grey
    (176, 179, 182): 0.09,  # silver
    (28, 66, 140): 0.08,  # blue
    (160, 22, 26): 0.05,  # red
    (120, 96, 70): 0.03,  # brown, beige
    (226, 178, 30): 0.01,  # yellow
    (30, 84, 52): 0.01,  # green
}
CAB: Palette = {
    (232, 232, 230): 0.4,
    (170, 24, 28): 0.15,
    (30, 72, 150): 0.15,
    (228, 170, 24): 0.12,
    (90, 94, 98): 0.1,
    (34, 110, 70): 0.08,
}
BOX: Palette = {
    (240, 240, 238): 0.55,
    (200, 203, 206): 0.15,
    (40, 84, 160): 0.1,
    (226, 190, 60): 0.1,
    (180, 40, 36): 0.1,
}
TUB: Palette = {
    (216, 128, 30): 0.35,
    (120, 124, 128): 0.3,
    (60, 100, 70): 0.15,
    (170, 40, 34): 0.2,
}
LOAD: Palette = {(140, 118, 92): 0.4, (126, 124, 120): 0.4, (84, 64, 46): 0.2}
CLOTH: Palette = {
    (34, 36, 42): 0.28,
    (40, 56, 96): 0.18,
    (110, 112, 116): 0.12,
    (226, 224, 218): 0.12,
    (160, 36, 44): 0.1,
    (70, 96, 66): 0.08,
    (196, 160, 110): 0.07,
    (224, 196, 48): 0.05,
}
TROUSERS: Palette = {
    (38, 52, 84): 0.4,
    (28, 28, 32): 0.3,
    (92, 92, 96): 0.15,
    (170, 150, 120): 0.15,
}
SKIN: Palette = {(236, 196, 168): 0.4, (200, 150, 116): 0.3, (140, 94, 66): 0.2, (84, 56, 42): 0.1}
HAIR: Palette = {(26, 22, 20): 0.45, (78, 54, 36): 0.3, (190, 154, 96): 0.15, (170, 170, 170): 0.1}
BRIGHT: Palette = {
    (230, 230, 228): 0.3,
    (190, 30, 34): 0.2,
    (24, 24, 28): 0.2,
    (220, 200, 40): 0.15,
    (36, 90, 180): 0.15,
}

PALETTES: dict[str, Palette] = {
    "body": CAR,
    "window": {(34, 42, 50): 1.0},
    "trim": {(30, 31, 33): 1.0},
    "tyre": {(22, 22, 23): 1.0},
    "hub": {(158, 160, 164): 0.8, (60, 62, 66): 0.2},
    "lamp": {(246, 244, 232): 1.0},
    "lamp rear": {(176, 10, 14): 1.0},
    "cargo": BOX,
    "tub": TUB,
    "load": LOAD,
    "frame": BRIGHT,
    "skin": SKIN,
    "hair": HAIR,
    "helmet": BRIGHT,
    "cloth": CLOTH,
    "trousers": TROUSERS,
    "shoe": {(28, 27, 28): 0.6, (216, 214, 210): 0.25, (96, 66, 44): 0.15},
    "bag": {(30, 32, 38): 0.5, (150, 40, 40): 0.2, (52, 84, 60): 0.15, (120, 90, 60): 0.15},
}
"""Colours of each part, in sRGB of 0 … 255, and how frequent each is (of 1)."""

OF_CLASS: dict[str, Mapping[str, Palette]] = {
    "car": {},
    "truck": {"body": CAB, "hub": {(120, 122, 126): 1.0}},
    "cyclist": {"cloth": CLOTH | BRIGHT},
    "pedestrian": {},
}
"""Palettes that differ for one class of road users."""


def paint(kind: str, rng: np.random.Generator) -> dict[str, RGB]:
    """Linear RGB albedo of every part, in the order of ``PARTS``, for one road user of a class.

    A colour is drawn from each palette, made a few per cent brighter or darker, and converted from
    sRGB to linear light. Raises InspeError for an unknown class.
    """
    if kind not in OF_CLASS:
        raise InspeError(f"class '{kind}': one of {', '.join(OF_CLASS)}")
    return {part: _pick(OF_CLASS[kind].get(part, PALETTES[part]), rng) for part in PARTS}


def _pick(palette: Palette, rng: np.random.Generator) -> RGB:
    shares = np.array(list(palette.values()))
    colour = np.array(list(palette))[rng.choice(len(palette), p=shares / shares.sum())] / 255
    return linear(np.clip(colour * rng.normal(1.0, 0.05), 0, 1))


def linear(srgb: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Convert sRGB values of 0 … 1 to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
