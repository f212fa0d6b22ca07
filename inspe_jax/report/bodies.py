"""Static bodies on maps and in three dimensions: houses, walls, trees, parked vehicles."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Circle, Patch
from shapely.geometry import Point

from inspe_jax.scene.placed_bodies import convex_parts
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.statics import KINDS, StaticBody

BODY_COLORS: dict[str, str] = dict.fromkeys(KINDS, "#9b938a") | {
    "hedge": "#3f7d4b",
    "tree": "#3f7d4b",
    "parked vehicle": "#c9c9c9",
}
"""Colours of bodies, by kind: greys of stone and of sheet metal, and the green of leaves."""
_EDGE = 0.4  # width of outlines [pt]


def look_of(kind: str) -> dict[str, Any]:
    """How a kind looks on a map: filled; a tree, beneath which the ground is seen, as outline."""
    color = BODY_COLORS[kind]
    if kind == "tree":
        return dict(fc="none", ec=color, lw=2 * _EDGE)
    return dict(fc=color, ec="black", lw=_EDGE)


def draw_bodies(ax: Axes, scene: Scene) -> None:
    """Draw the outlines of a scene's bodies within the circle, filled where they stand on the
    ground: beneath others one sees it."""
    inside = Circle(tuple(scene.voxels.center[:2]), scene.voxels.radius, transform=ax.transData)
    for kind, bodies in _by_kind(scene):
        look = look_of(kind)
        color = look.pop("fc")
        fill = [color if one.base == 0 else "none" for one in bodies]
        drawn = PolyCollection([one.outline for one in bodies], fc=fill, **look, zorder=3.5)
        ax.add_collection(drawn, autolim=False)
        drawn.set_clip_path(inside)


def body_keys(scene: Scene) -> list[Any]:
    """Legend entries of the kinds that stand in the circle, kinds of one look in one entry."""
    words: dict[str, list[str]] = {}
    for kind, bodies in _by_kind(scene):
        outlines = np.array([one.polygon for one in bodies], object)
        if shapely.distance(outlines, Point(scene.voxels.center[:2])).min() <= scene.voxels.radius:
            words.setdefault(str(look_of(kind)), []).append(kind)
    return [Patch(**look_of(kinds[0]), label=", ".join(kinds)) for kinds in words.values()]


def _by_kind(scene: Scene) -> Iterator[tuple[str, list[StaticBody]]]:
    for kind in KINDS:
        if bodies := [one for one in scene.statics if one.kind == kind]:
            yield kind, bodies


def body_meshes(
    scene: Scene,
) -> Iterator[tuple[str, Float[np.ndarray, "N 3"], Int[np.ndarray, "F 3"]]]:
    """Each kind of body with the corners [m] and faces of its prisms, as scores have them. What
    stands on the ground begins at the lowest ground at its corners."""
    place = scene.intersection
    for kind, bodies in _by_kind(scene):
        points, faces, count = list[np.ndarray](), list[np.ndarray](), 0
        parts = convex_parts(bodies, place)
        for corners, bottom, top in zip(parts.corners, parts.bottom, parts.top, strict=True):
            outline = corners[: len(np.unique(corners, axis=0))]  # the last corner is repeated
            if np.isinf(bottom):
                bottom = min(float(place.ground(outline).min()), top)
            n = len(outline)
            points += [np.column_stack([outline, np.full(n, z)]) for z in (bottom, top)]
            k = np.arange(n)
            after = np.roll(k, -1)
            sides = np.stack([[k, k], [after, after + n], [after + n, k + n]], -1).reshape(-1, 3)
            fan = np.column_stack([np.zeros(n - 2, int), k[1:-1], k[2:]])
            faces.append(count + np.concatenate([sides, fan + n, fan[:, ::-1]]))
            count += 2 * n
        yield kind, np.concatenate(points), np.concatenate(faces)
