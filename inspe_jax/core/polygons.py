"""Outlines in plan: convex pieces from triangles. All is in metres, in NumPy."""

import numpy as np
from jaxtyping import Float

LEAST_AREA = 0.05
"""Pieces of ground smaller than this are left out [m²]."""

Corner = tuple[float, float]


def merge(
    triangles: Float[np.ndarray, "N 3 2"], least: float = LEAST_AREA
) -> list[Float[np.ndarray, "M 2"]]:
    """Convex outlines, counter-clockwise, that together cover the triangles exactly.

    Neighbours are joined over their longest sides first, as long as the union is convex. The number
    of pieces is at most four times the smallest possible (Hertel and Mehlhorn, 1983). Pieces of
    less than ``least`` [m²] are left out.
    """
    pieces: dict[int, list[Corner]] = {}
    owner: dict[tuple[Corner, Corner], int] = {}
    for k, triangle in enumerate(np.asarray(triangles, float)):
        a, b, c = (tuple(corner) for corner in triangle.tolist())
        outline = [a, b, c] if _cross(a, b, c) > 0 else [a, c, b]
        pieces[k] = outline
        owner.update(dict.fromkeys(_sides(outline), k))
    shared = [side for side in owner if side < side[::-1] and side[::-1] in owner]
    for a, b in sorted(shared, key=lambda s: -np.hypot(s[0][0] - s[1][0], s[0][1] - s[1][1])):
        here, there = owner[a, b], owner[b, a]
        ours, theirs = _from(pieces[here], b), _from(pieces[there], a)
        # ours runs b … a, theirs a … b.
        joined = [*ours, *theirs[1:-1]]
        bends = _cross(ours[-2], a, theirs[1]), _cross(theirs[-2], b, ours[1])
        once = sum(owner.get(side[::-1]) == there for side in _sides(pieces[here])) == 1
        if here == there or not once or min(bends) < 0:
            continue
        pieces[here] = joined
        owner.update(dict.fromkeys(_sides(pieces.pop(there)), here))
        del owner[a, b], owner[b, a]
    found = [np.array(outline) for outline in pieces.values()]
    return [outline for outline in found if _area(outline) >= least]


def _sides(outline: list[Corner]) -> list[tuple[Corner, Corner]]:
    return list(zip(outline, outline[1:] + outline[:1], strict=True))


def _from(outline: list[Corner], first: Corner) -> list[Corner]:
    k = outline.index(first)
    return outline[k:] + outline[:k]


def _cross(a: Corner, b: Corner, c: Corner) -> float:
    """Twice the area of a triangle, positive if it turns left at b."""
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])


def _area(outline: np.ndarray) -> float:
    x, y = (outline - outline[0]).T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
