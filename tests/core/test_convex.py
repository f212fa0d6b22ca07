"""Sight line against a convex outline: shapely's answer, and the rectangle's own form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapely.geometry import LineString, MultiPoint, Polygon

from inspe_jax.core.convex import (
    SEAM,
    ConvexPrism,
    convex_cut,
    convex_shadow,
    convex_terms,
    prism_margins,
    sides,
)
from inspe_jax.core.geometry import FAR, Line, plan_cut

ROOM = 8
LINES = 400


def outlines(seed: int, count: int) -> np.ndarray:
    """Convex outlines with three to eight corners, padded as those of scores are."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        hull = MultiPoint(rng.normal(size=(rng.integers(4, 12), 2)) * 3).convex_hull
        corners = np.array(hull.exterior.coords)[-1:0:-1]  # counter-clockwise
        if len(corners) <= ROOM:
            found.append(corners[np.minimum(np.arange(ROOM), len(corners) - 1)])
    return np.array(found)


def prisms(corners: np.ndarray) -> ConvexPrism:
    each = np.zeros(len(corners))
    return ConvexPrism(corners, *sides(corners), each, each, each, each == 0)


_cuts = jax.jit(jax.vmap(convex_cut, (0, None)))


def cuts(prism, line):
    """In single precision, for up to :data:`ROOM` corners."""
    return _cuts(jax.tree.map(lambda x: x.astype(np.float32), prism), line)


rectangle_cut = jax.jit(plan_cut)


def test_a_line_meets_what_shapely_says_and_there():
    shapes, rng = outlines(1, 25), np.random.default_rng(2)
    ends = rng.uniform(-9, 9, (LINES, 4))
    line = Line(*(x.astype(np.float32) for x in ends.T))
    found = jax.tree.map(np.asarray, cuts(prisms(shapes), line))
    for shape, beside, enters, leaves in zip(shapes, *found, strict=True):
        polygon = Polygon(shape)
        assert polygon.exterior.is_ccw
        for k, (x, y, ex, ey) in enumerate(ends):
            segment = LineString([(x, y), (x + ex, y + ey)])
            part = segment.intersection(polygon)
            away = segment.distance(polygon)
            assert (beside[k] > SEAM + 1e-5) <= (part.length > 0)
            if away > 1e-4:
                assert -away * 1.001 - 1e-4 <= beside[k] < 0
            if part.length > 1e-3:
                assert beside[k] > 0
                assert leaves[k] - enters[k] == pytest.approx(
                    part.length / segment.length, abs=1e-4
                )
                middle = (enters[k] + leaves[k]) / 2 * segment.length
                at = segment.interpolate(middle)
                assert at.distance(part.centroid) < 1e-3


def test_a_rectangle_in_both_forms():
    half = np.array([2.5, 0.9])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    ends = np.random.default_rng(3).uniform(-9, 9, (LINES, 4))
    line = Line(*(x.astype(np.float32) for x in ends.T))
    padded = corners[np.minimum(np.arange(ROOM), 3)][None]
    general = jax.tree.map(lambda x: np.asarray(x)[0], cuts(prisms(padded), line))
    own = jax.tree.map(np.asarray, rectangle_cut(line, tuple(half.astype(np.float32))))
    assert general.beside == pytest.approx(own.beside + SEAM, abs=1e-5)
    assert general.enters == pytest.approx(own.enters, abs=1e-4)
    assert general.leaves == pytest.approx(own.leaves, abs=1e-4)


@jax.jit
def both_forms(prism, sensor, columns, heights):
    """What is hidden by the exact form (P, Z, C), and by the margins; and how near to an edge."""
    terms = convex_terms(sensor, prism)
    to = columns - sensor[:2, None]
    floor, ceiling = convex_shadow(terms, to[0], to[1], sensor[2])
    z = heights[None]
    exact = (z > floor[:, None]) & (z < ceiling[:, None])
    beside, below, above = jax.vmap(lambda one: prism_margins(one, sensor, columns, heights))(prism)
    margins = jnp.minimum(jnp.minimum(beside[:, None], below), above)
    return exact, margins > 0, jnp.abs(margins)


def test_both_forms_hide_the_same():
    """But for lines within 1 mm of an edge, from sensors inside, above, beneath and beside."""
    rng, count = np.random.default_rng(5), 40
    bottom = np.where(np.arange(count) % 2, rng.uniform(0, 3, count), -FAR)
    top = np.maximum(bottom, 0) + rng.uniform(0.5, 4, count)
    prism = prisms(outlines(6, count))._replace(bottom=bottom, top=top)
    prism = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(np.float32), prism)
    columns = rng.uniform(-9, 9, (2, 200)).astype(np.float32)
    heights = np.repeat(np.arange(8)[:, None] * 0.6, 200, 1).astype(np.float32)
    for sensor in ([0.3, 0.2, 6.0], [7.0, -2.0, 5.0], [-8.0, 3.0, 1.1], [0.5, -0.4, 0.7]):
        given = np.array(sensor, np.float32), columns, heights
        exact, soft, near = map(np.asarray, both_forms(prism, *given))
        assert 0.05 < exact.mean() < 0.9
        assert (exact == soft)[near > 1e-3].all()


def test_sides_of_corners_that_are_repeated_are_those_of_the_next():
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
    padded = square[[0, 1, 2, 3, 3, 3, 3, 3]][None]
    normal, offset = sides(padded)
    assert normal[0].tolist() == [[0, -1], [1, 0], [0, 1], *[[-1, 0]] * 5]
    assert offset[0].tolist() == [0, 2, 2, 0, 0, 0, 0, 0]


def test_straight_down_the_sides_decide():
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)[[0, 1, 2, 3, 3, 3, 3, 3]][None]
    line = Line(*(np.full(LINES, x, np.float32) for x in (0.5, 1.0, 0.0, 0.0)))
    found = jax.tree.map(np.asarray, cuts(prisms(square), line))
    assert found.beside[0, 0] == pytest.approx(0.5, abs=1e-3)
    assert (found.enters[0, 0], found.leaves[0, 0]) == (0.0, 1.0)
