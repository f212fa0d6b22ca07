"""Triangle meshes from outlines and tubes; x forward, y left, z up [m], winding outward."""

from collections.abc import Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

PARTS: tuple[str, ...] = (
    "body",
    "window",
    "trim",
    "tyre",
    "hub",
    "lamp",
    "lamp rear",
    "cargo",
    "tub",
    "load",
    "frame",
    "skin",
    "hair",
    "helmet",
    "cloth",
    "trousers",
    "shoe",
    "bag",
)
"""The parts of road users. The colour of a face depends on its part."""

Strip = str | tuple[str, str, float] | None
"""The part of a strip across a body; or (outer part, inner part, how much of each half is outer);
or None for no surface."""

Line = Sequence[tuple[float, float]]
"""Points (x, z), or (place, value) of a piecewise linear function."""


Points = Sequence[Sequence[float] | Float[np.ndarray, "3"]]
"""Points (x, y, z)."""


class Mesh(NamedTuple):
    """Vertices [m]; triangles as indices of vertices; their parts as indices into :data:`PARTS`."""

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]
    part: Int[np.ndarray, " F"]


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    start = np.cumsum([0] + [len(m.vertices) for m in meshes])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + first for m, first in zip(meshes, start, strict=False)]),
        np.concatenate([m.part for m in meshes]),
    )


def mirrored(mesh: Mesh) -> Mesh:
    """The mirror image, left and right exchanged."""
    return Mesh(mesh.vertices * [1, -1, 1], mesh.faces[:, ::-1], mesh.part)


def polygon(corners: Points, part: str) -> Mesh:
    """A convex polygon as a fan; its corners run counter-clockwise, seen from outside."""
    fan = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    index = np.full(len(fan), PARTS.index(part))
    return Mesh(np.array(corners, float), np.array(fan), index)


def triangulate(outline: Line) -> list[tuple[int, int, int]]:
    """Triangles of a simple polygon, counter-clockwise, by ear clipping, the roundest ear first.

    The polygon may run clockwise or counter-clockwise, and may have corners on a straight line.
    (Shapely's constrained Delaunay triangulation gives other triangles of the same surface, which
    would change recorded points in their last digits.)
    """
    points = np.array(outline, float)
    left = list(range(len(points)))
    if sum(_area(points[[0, k, k + 1]]) for k in range(1, len(left) - 1)) < 0:
        left.reverse()
    triangles = []
    while len(left) > 3:
        ears = [tuple(np.roll(left, 1 - k)[:3]) for k in range(len(left))]
        best = max(ears, key=lambda ear: _roundness(points, ear, left))
        triangles.append(best)
        left.remove(best[1])
    return [*triangles, (left[0], left[1], left[2])]


def _area(corners: Float[np.ndarray, "3 2"]) -> float:
    """Twice the signed area of a triangle."""
    (ax, ay), (bx, by) = corners[1] - corners[0], corners[2] - corners[0]
    return ax * by - ay * bx


def _roundness(
    points: Float[np.ndarray, "n 2"], ear: tuple[int, int, int], left: list[int]
) -> float:
    """Area of an ear over its squared longest side.

    −1 if it is reflex or flat, or if another corner lies in it: it must not be clipped then.
    """
    a, b, c = points[list(ear)]
    area = _area(points[list(ear)])
    if area < 1e-9:
        return -1.0
    for other in set(left) - set(ear):
        p = points[other]
        if min(_area(np.array(side)) for side in ((a, b, p), (b, c, p), (c, a, p))) > -1e-9:
            return -1.0
    return area / max(((p - q) ** 2).sum() for p, q in combinations((a, b, c), 2))


def strips(points: Line, halves: Sequence[float], parts: Sequence[Strip]) -> Mesh:
    """The surface across a body, from its right outline to its left.

    ``points`` (x, z) run counter-clockwise; ``halves`` are the half widths there [m]; ``parts`` are
    those of the edges between them. The corners of a split strip lie on lines along y, so that
    neighbours meet without a crack.
    """
    meshes = []
    for i, strip in enumerate(parts):
        j = (i + 1) % len(points)
        if strip is None:
            continue
        outer, inner, share = (strip, strip, 0.0) if isinstance(strip, str) else strip
        cuts = [-1.0, share - 1, 1 - share, 1.0] if share else [-1.0, 1.0]
        for k, (right, left) in enumerate(pairwise(cuts)):
            part = inner if k == 1 else outer
            corners = [(i, right), (i, left), (j, left), (j, right)]
            meshes.append(
                polygon([(points[p][0], y * halves[p], points[p][1]) for p, y in corners], part)
            )
    return join(meshes)


def sides(points: Line, halves: Sequence[float], part: str) -> Mesh:
    """A panel with corners (x, z) on the right side of a body, and its mirror image on the left."""
    right = np.array([(x, -half, z) for (x, z), half in zip(points, halves, strict=True)])
    faces = np.array(triangulate(points))
    mesh = Mesh(right, faces, np.full(len(faces), PARTS.index(part)))
    return join([mesh, mirrored(mesh)])


def prism(points: Line, half: float, parts: Sequence[Strip], side: str) -> Mesh:
    """A solid with the outline ``points`` (x, z), which reaches ``half`` metres to either side."""
    halves = [half] * len(points)
    return join([strips(points, halves, parts), sides(points, halves, side)])


def block(x: tuple[float, float], half: float, z: tuple[float, float], part: str) -> Mesh:
    """A box of one part."""
    outline = [(x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1])]
    return prism(outline, half, [part] * 4, part)


def filled(
    x: tuple[float, float], half: float, z: tuple[float, float, float], tub: str, load: str
) -> Mesh:
    """The inside of an open tub: its walls from the rim down, and a load that rises to a ridge.

    ``z`` holds three heights [m]: of the rim, of the line where the load meets the walls, and of
    the ridge.
    """
    (back, front), (rim, low, high) = x, z
    corners = [(back, -half), (front, -half), (front, half), (back, half)]
    foot = [(0.95 * a, 0.9 * b, low) for a, b in corners]
    inset = 0.25 * (front - back)
    near, far = (back + inset, 0.0, high), (front - inset, 0.0, high)
    ridge = [(far, near), (far,), (near, far), (near,)]
    meshes = []
    for i, j in ((0, 1), (1, 2), (2, 3), (3, 0)):
        meshes.append(polygon([(*corners[i], rim), (*corners[j], rim), foot[j], foot[i]], tub))
        meshes.append(polygon([foot[i], foot[j], *ridge[i]], load))
    return join(meshes)


def axle(x: float, radius: float, half: float, *, edges: int = 8, hub: int = 4) -> Mesh:
    """Two wheels as one roller across the vehicle, with half as many faces as two wheels.

    The part between the wheels is hidden under the body. ``radius`` [m] is the distance to the
    flats, on one of which it stands. Each hub is a low pyramid of ``hub`` faces.
    """
    turn = 2 * np.pi * (np.arange(edges) + 0.5) / edges - np.pi / 2
    rim = radius / np.cos(np.pi / edges) * np.stack([np.cos(turn), np.sin(turn)], -1)
    rim += [x, radius]
    meshes = [prism([(a, b) for a, b in rim], half, ["tyre"] * edges, "tyre")]
    turn = 2 * np.pi * np.arange(hub) / hub + np.pi / 2
    bolts = 0.6 * radius * np.stack([np.cos(turn), np.sin(turn)], -1) + [x, radius]
    for side in (-1, 1):
        top = (x, side * (half + 0.01), radius)
        for k in range(hub):
            a, b = ((*bolts[(k + i) % hub], half) for i in range(2))
            corners = [(p[0], side * half, p[1]) for p in (a, b)] + [top]
            meshes.append(polygon(corners[::-side], "hub"))
    return join(meshes)


def tube(
    path: Points,
    wide: Sequence[float] | Float[np.ndarray, " n"],
    deep: Sequence[float] | Float[np.ndarray, " n"],
    parts: Sequence[str | Sequence[str]],
    *,
    edges: int,
    caps: tuple[bool, bool] = (True, True),
) -> Mesh:
    """Elliptical rings along a path, joined; a ring without width is an apex.

    ``wide`` is each ring's half width across the path, as close to the y axis as possible (to the
    x axis if the path runs along y); ``deep`` is the half width across both. ``parts`` has one
    entry per section between two rings: one part for all, or one for each of its ``edges``. The
    first edge is at the left; for an upright tube the others follow round the back. Left and right
    are mirror images. With four edges the left side is a flat, with six it is a corner. An end
    that lies inside another solid needs no cap.
    """
    rings = _rings(np.array(path, float), np.array(wide), np.array(deep), edges)
    meshes = []
    for i, part in enumerate(parts):
        for k in range(edges):
            m = (k + 1) % edges
            corners = [rings[i, k], rings[i, m], rings[i + 1, m], rings[i + 1, k]]
            if wide[i] == 0 or wide[i + 1] == 0:
                del corners[1 if wide[i] == 0 else 2]
            meshes.append(polygon(corners, part if isinstance(part, str) else part[k]))
    ends = ((rings[0][::-1], wide[0], parts[0]), (rings[-1], wide[-1], parts[-1]))
    for (ring, width, part), cap in zip(ends, caps, strict=True):
        if cap and width:
            meshes.append(polygon(ring, part if isinstance(part, str) else part[0]))
    return join(meshes)


def _rings(
    path: Float[np.ndarray, "n 3"],
    wide: Float[np.ndarray, " n"],
    deep: Float[np.ndarray, " n"],
    edges: int,
) -> Float[np.ndarray, "n e 3"]:
    """Corners of an ellipse at each point of a path, across the mean of its directions there."""
    step = np.diff(path, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    along = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    axis = np.eye(3)[0 if abs(step[0, 1]) > 0.9 else 1]
    u = axis - (along @ axis)[:, None] * along
    u *= (wide / np.linalg.norm(u, axis=1))[:, None]
    v = np.cross(along, axis)
    v *= (deep / np.linalg.norm(v, axis=1))[:, None]
    turn = 2 * np.pi * (np.arange(edges) + {3: 0.75, 4: 0.5, 6: 0.0}[edges]) / edges
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    return path[:, None] + cos * u[:, None] + sin * v[:, None]
