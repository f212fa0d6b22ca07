"""Convex pieces of ground, and single points, as of poles: the nearest point of their union, and a
smooth chart of each. Plan geometry in metres, by ``xp``, NumPy or JAX."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

INSIDE = 0.99
"""The inverses of charts map the edge to here, where the slope is still 0.14."""
_STEEP = 0.05  # an edge with a smaller share of its length along the axis ends the piece's chart
_FURTHEST = 1e4  # chart coordinates are cut at this many radii, after many turns [–]


# ── Bounded coordinates from unbounded ones ─────────────────────────────────


def to_bounded(v: Any, radius: Any, xp: Any) -> Any:
    """r·sin(v/r), from any v to −r … r; near 0, v counts metres or radians. At 98 % of the range
    its slope is 0.2, that of v/√(1 + v²) 0.0075."""
    return radius * xp.sin(turns(v, radius, xp))


def turns(v: Any, radius: Any, xp: Any) -> Any:
    """v/r, cut at a large number; v itself where r is 0."""
    safe = xp.where(radius > 0, radius, xp.ones_like(radius))
    return xp.clip(v / safe, -_FURTHEST, _FURTHEST)


def from_bounded(x: Any, radius: Any, xp: Any) -> Any:
    """The inverse of :func:`to_bounded`; an end counts as slightly inside."""
    return radius * xp.arcsin(xp.clip(turns(x, radius, xp), -INSIDE, INSIDE))


# ── Regions ─────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class ConvexRegions:
    """K convex pieces, made by :func:`make_regions`.

    ``corners`` are counter-clockwise, the last one repeated; ``area`` [m²] is 0 for a single point.
    A chart's long side is along ``axis`` through ``middle``, ``half`` to each side; across it the
    piece lies between the highest of the lines ``lower`` (slope, height) and the lowest of
    ``upper``, at most ``across`` to each side of their mean [m].
    """

    corners: Float[np.ndarray, "K E 2"]
    area: Float[np.ndarray, " K"]
    middle: Float[np.ndarray, "K 2"]
    axis: Float[np.ndarray, "K 2"]
    half: Float[np.ndarray, " K"]
    lower: Float[np.ndarray, "K E 2"]
    upper: Float[np.ndarray, "K E 2"]
    across: Float[np.ndarray, " K"]

    def __len__(self) -> int:
        return len(self.area)

    def nearest(
        self, p: Float[Any, "U 2"], allowed: Bool[np.ndarray, "U K"], xp: Any = np
    ) -> tuple[Float[Any, "U 2"], Int[Any, " U"], Float[Any, "U K"]]:
        """The nearest point of the allowed pieces to each given point, the index of its piece, and
        the squared distance to every piece [m²], infinite for those that are not allowed."""
        start = xp.asarray(self.corners, p.dtype)  # (K, E, 2)
        edge = xp.roll(start, -1, axis=1) - start
        to = p[:, None, None] - start[None]  # (U, K, E, 2)
        length = xp.maximum((edge * edge).sum(-1), 1e-12)[None]  # squared
        # How far along each edge the nearest point is, from 0 to 1; 0 on one without length.
        share = xp.clip((to * edge[None]).sum(-1) / length, 0.0, 1.0)
        off = to - share[..., None] * edge[None]
        squared = (off * off).sum(-1)  # (U, K, E)
        left = edge[None, ..., 0] * to[..., 1] - edge[None, ..., 1] * to[..., 0] >= 0
        inside = left.all(-1) & xp.asarray(self.area > 0)[None]  # (U, K)
        far = xp.where(inside, xp.zeros_like(squared[..., 0]), squared.min(-1))
        far = xp.where(xp.asarray(allowed), far, xp.full_like(far, xp.inf))
        which = far.argmin(-1)  # (U,)
        u = xp.arange(len(p))
        e = squared[u, which].argmin(-1)
        foot = start[which, e] + share[u, which, e][:, None] * edge[which, e]
        return xp.where(inside[u, which][:, None], p, foot), which, far

    def at(self, v: Float[Any, "U 2"], which: Int[Any, " U"], xp: Any) -> Float[Any, "U 2"]:
        """The points with chart coordinates ``v`` [m] on pieces ``which``; any v is inside."""
        axis, middle, half, across = self._frame(which, v.dtype, xp)
        along = to_bounded(v[:, 0], half, xp)
        low, high = self._chord(along, which, v.dtype, xp)
        aside = (low + high) / 2 + (high - low) / 2 * xp.sin(turns(v[:, 1], across, xp))
        normal = xp.stack([-axis[:, 1], axis[:, 0]], -1)
        return middle + along[:, None] * axis + aside[:, None] * normal

    def chart(self, p: Float[Any, "U 2"], which: Int[Any, " U"], xp: Any) -> Float[Any, "U 2"]:
        """The inverse of :meth:`at`; the edge of a piece counts as slightly inside."""
        axis, middle, half, across = self._frame(which, p.dtype, xp)
        normal = xp.stack([-axis[:, 1], axis[:, 0]], -1)
        v = from_bounded(((p - middle) * axis).sum(-1), half, xp)
        low, high = self._chord(to_bounded(v, half, xp), which, p.dtype, xp)
        aside = ((p - middle) * normal).sum(-1) - (low + high) / 2
        share = aside / xp.maximum((high - low) / 2, 1e-6)
        return xp.stack([v, across * xp.arcsin(xp.clip(share, -INSIDE, INSIDE))], -1)

    def _frame(self, which: Any, dtype: Any, xp: Any) -> tuple[Any, ...]:
        tables = (self.axis, self.middle, self.half, self.across)
        return tuple(xp.asarray(table, dtype)[which] for table in tables)

    def _chord(self, along: Any, which: Any, dtype: Any, xp: Any) -> tuple[Any, Any]:
        lower, upper = (xp.asarray(lines, dtype)[which] for lines in (self.lower, self.upper))
        low = (lower[..., 0] * along[:, None] + lower[..., 1]).max(-1)
        high = (upper[..., 0] * along[:, None] + upper[..., 1]).min(-1)
        return low, high

    def draw(
        self, rng: np.random.Generator, allowed: Bool[np.ndarray, " K"], count: int
    ) -> Float[np.ndarray, "N 2"]:
        """Points spread evenly over the area of the allowed pieces."""
        first, second, third = self.corners[:, :1], self.corners[:, 1:-1], self.corners[:, 2:]
        a, b = second - first, third - first  # a fan of triangles in each piece, (K, E - 2, 2)
        double = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) * allowed[:, None]
        chosen = rng.choice(double.size, count, p=double.ravel() / double.sum())
        k, e = np.unravel_index(chosen, double.shape)
        s, t = rng.uniform(size=(2, count, 1))
        s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
        return self.corners[k, 0] + s * a[k, e] + t * b[k, e]


def make_regions(outlines: list[Float[np.ndarray, "N 2"]]) -> ConvexRegions:
    """Regions from their corners, counter-clockwise; an outline of one corner is a point."""
    room = max(3, *(len(outline) for outline in outlines))
    rows = []
    for outline in outlines:
        outline = np.asarray(outline, float)
        corners = np.concatenate([outline, np.repeat(outline[-1:], room - len(outline), 0)])
        rows.append((corners, *_chart_of(outline, room)))
    return ConvexRegions(*(np.stack(column) for column in zip(*rows, strict=True)))


def _chart_of(outline: np.ndarray, room: int) -> tuple[Any, ...]:
    """(area, middle, axis, half, lower, upper, across) of one piece."""
    lines = np.zeros((2, room, 2))
    if len(outline) == 1:
        return 0.0, outline[0], np.array([1.0, 0.0]), 0.0, *lines, 0.0
    edge = np.roll(outline, -1, 0) - outline
    area = float((outline[:, 0] * np.roll(outline, -1, 0)[:, 1]).sum()) / 2
    area -= float((outline[:, 1] * np.roll(outline, -1, 0)[:, 0]).sum()) / 2
    # The long axis is along an edge: that of the narrowest rectangle round the piece.
    directions = edge / np.linalg.norm(edge, axis=1, keepdims=True)
    normals = np.stack([-directions[:, 1], directions[:, 0]], 1)
    axis = directions[np.ptp(outline @ normals.T, axis=0).argmin()]
    turn = np.stack([axis, [-axis[1], axis[0]]], 1)
    middle = turn @ ((outline @ turn).max(0) + (outline @ turn).min(0)) / 2
    at = (outline - middle) @ turn  # along and across
    step = np.roll(at, -1, 0) - at
    slant = step[:, 0] / np.linalg.norm(step, axis=1)
    first, last = at[:, 0].min(), at[:, 0].max()
    # An edge nearly across the axis would be a line that is too steep to compute with. The chart
    # ends before it, which leaves out a sliver.
    for k in np.flatnonzero(np.abs(slant) < _STEEP):
        ends = at[k, 0], at[(k + 1) % len(at), 0]
        if step[k, 1] > 0:
            last = min(last, *ends)
        else:
            first = max(first, *ends)
    for row, part in zip(lines, (slant >= _STEEP, slant <= -_STEEP), strict=True):
        slope = step[part, 1] / step[part, 0]
        found = np.stack([slope, at[part, 1] - slope * at[part, 0]], 1)
        row[:] = found[np.minimum(np.arange(room), len(found) - 1)]
    shift, half = (first + last) / 2, (last - first) / 2
    middle = middle + shift * axis
    lines[..., 1] += lines[..., 0] * shift
    knots = np.clip(at[:, 0] - shift, -half, half)[:, None]
    low = (lines[0][:, 0] * knots + lines[0][:, 1]).max(1)
    high = (lines[1][:, 0] * knots + lines[1][:, 1]).min(1)
    return area, middle, axis, half, *lines, float((high - low).max() / 2)
