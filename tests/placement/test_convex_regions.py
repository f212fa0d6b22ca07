"""Convex pieces: against shapely's own geometry, and on shapes worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from shapely.geometry import Point, Polygon, box

from inspe_jax.core.convex import LEAST_AREA, merge
from inspe_jax.placement.convex_regions import from_bounded, make_regions, to_bounded
from inspe_jax.placement.coordinates import Disc

SQUARE = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], float)
TRAPEZE = np.array([[0, 4], [12, 4], [9, 7], [1, 7]], float)
LEANING = SQUARE @ np.array([[0.8, 0.6], [-0.6, 0.8]]) * 3.0 + [12, -9]
WEDGE = np.array([[20, 0], [26, 0], [26.06, 2], [23, 2.5], [20, 2]], float)  # an end nearly upright
SHAPES = [SQUARE, TRAPEZE, LEANING, WEDGE, np.array([[-3.0, 5.0]])]
PIECES = make_regions(SHAPES)
SOLID = [Polygon(shape) for shape in SHAPES if len(shape) > 1]
ALL = np.ones((1, len(SHAPES)), bool)

nearest = jax.jit(lambda p, ok: PIECES.nearest(p, ok, jnp))


def triangles(shape) -> np.ndarray:
    parts = shapely.constrained_delaunay_triangles(shape).geoms
    return np.array([t.exterior.coords[:3] for t in parts])


def test_pieces_that_share_two_sides_in_line_stay_apart_and_slivers_are_left_out():
    (outline,) = merge(triangles(Point(0, 0).buffer(5)))
    assert len(outline) == 64
    assert merge(triangles(box(0, 0, 1, LEAST_AREA * 0.9))) == []
    assert merge(np.zeros((0, 3, 2))) == []
    middle, corners = [1.0, 1.0], [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]
    fan = [[a, b, middle] for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    outlines = merge(np.array(fan))
    assert sum(Polygon(outline).area for outline in outlines) == pytest.approx(4)
    for outline in outlines:
        assert len(np.unique(outline, axis=0)) == len(outline)


@pytest.mark.parametrize("nearest", [PIECES.nearest, nearest])
def test_nearest_point_is_shapelys(nearest):
    p = np.random.default_rng(1).uniform([-8, -12], [30, 12], (400, 2))
    found, which, squared = nearest(p, np.repeat(ALL, 400, 0))
    union = shapely.union_all([*SOLID, Point(-3, 5)])
    lines = shapely.shortest_line(union, shapely.points(p))
    np.testing.assert_allclose(found, shapely.get_coordinates(lines)[::2], atol=1e-5)
    for at, k, far in zip(np.asarray(found), np.asarray(which), np.asarray(squared), strict=True):
        shape = Point(SHAPES[k][0]) if len(SHAPES[k]) == 1 else Polygon(SHAPES[k])
        assert shape.distance(Point(at)) < 1e-5
        assert far[k] == far.min()


def test_nearest_keeps_to_the_allowed_pieces():
    only = np.arange(len(SHAPES))[None] == 4
    inside = np.array([[1.0, 1.0]])
    np.testing.assert_array_equal(PIECES.nearest(inside, ALL)[0], inside)
    np.testing.assert_array_equal(PIECES.nearest(inside, only)[0], [[-3.0, 5.0]])


def test_charts_invert():
    rng = np.random.default_rng(2)
    for k, shape in enumerate(SHAPES[:3]):
        # Away from the edges, which the inverse takes to lie slightly inside.
        polygon = Polygon(shape).buffer(-0.35)
        p = rng.uniform(shape.min(0), shape.max(0), (200, 2))
        p = p[shapely.contains_xy(polygon, p)]
        which = np.full(len(p), k)
        assert len(p) > 20
        np.testing.assert_allclose(PIECES.at(PIECES.chart(p, which, np), which, np), p, atol=1e-9)
    # On the edge: inside, and within 1 % of the piece's size.
    for k, shape in enumerate(SHAPES[:4]):
        which = np.full(len(shape), k)
        back = PIECES.at(PIECES.chart(shape, which, np), which, np)
        assert np.abs(back - shape).max() < 0.02 * np.ptp(shape, axis=0).max() + 0.1
        assert shapely.contains_xy(Polygon(shape), back).all()


def test_charts_reach_across_to_the_edges_and_stop_short_of_a_steep_end():
    rng = np.random.default_rng(6)
    for k, shape in enumerate(SHAPES[:4]):
        for side in (-1, 1):
            v = np.column_stack([rng.uniform(-9, 9, 50), np.full(50, side * PIECES.across[k])])
            v[:, 1] *= np.pi / 2
            p = PIECES.at(v, np.full(50, k), np)
            rim = Polygon(shape).exterior
            assert max(rim.distance(q) for q in shapely.points(p)) < 1e-9
    ends = np.pi / 2 * np.array([[PIECES.half[3], 0.0], [-PIECES.half[3], 0.0]])
    along = PIECES.at(ends, np.full(2, 3), np)[:, 0]
    np.testing.assert_allclose(np.sort(along), [20.0, 26.0], atol=0.1)
    assert along.max() < 26.02  # and not 26.06, where the edge across leans by 1 in 33


def test_intervals_and_discs_swing_and_invert():
    radius = np.array([2.0, 0.5, 0.0])
    discs = Disc(radius)
    x = radius * [0.9, -0.5, 0.0]
    np.testing.assert_allclose(to_bounded(from_bounded(x, radius, np), radius, np), x, atol=1e-12)
    way = np.array([[0.6, 0.8]]) * (radius * [0.9, 0.5, 0.0])[:, None]
    np.testing.assert_allclose(discs.to_bounded(discs.from_bounded(way, np), np), way)
    # In the middle both move as their argument does; the ends are reached and never passed.
    two, disc = np.float32(2.0), Disc(np.float32(2.0))
    line = lambda of: lambda v, xp: of(v, xp.asarray(two), xp)  # noqa: E731
    for rim, there, back in (
        (two[None], line(to_bounded), line(from_bounded)),
        (np.float32([2.0, 0.0]), disc.to_bounded, disc.from_bounded),
    ):
        slope = jax.jit(jax.jacobian(lambda v, there=there: there(v, jnp)))
        np.testing.assert_allclose(slope(0 * rim), np.eye(len(rim)), atol=1e-6)
        # What lies on the rim still moves.
        v = np.float32(back(rim, np))
        assert np.abs(slope(v)).ravel()[0] > 0.1  # outward, of the disc
        assert np.linalg.norm(there(v, np)) > 1.95
    v = np.linspace(-50, 50, 10001)
    assert np.abs(to_bounded(v, np.full(10001, 2.0), np)).max() == pytest.approx(2, abs=1e-4)
    wide = Disc(np.full(5000, 2.0))
    far = np.hypot(*wide.to_bounded(np.random.default_rng(4).normal(size=(5000, 2)) * 9, np).T)
    assert far.max() == pytest.approx(2, abs=1e-3)
    assert far.max() <= 2


def test_nearest_point_of_a_disc():
    x = np.array([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0], [1.0, 1.0]])
    discs = Disc(np.array([1.0, 1.0, 1.0, 0.0]))
    expected = [[0.6, 0.8], [0.3, 0.4], [0, 0], [0, 0]]
    np.testing.assert_allclose(discs.clip(x, np), expected, atol=1e-12)
    assert np.isfinite(jax.jit(jax.jacobian(lambda x: discs.clip(x, jnp)))(x)).all()


def test_draws_are_even_over_the_area():
    drawn = PIECES.draw(np.random.default_rng(5), ALL[0], 20_000)
    areas = np.array([polygon.area for polygon in SOLID])
    shares = np.array([shapely.contains_xy(polygon, drawn).mean() for polygon in SOLID])
    np.testing.assert_allclose(shares, areas / areas.sum(), atol=0.015)  # 4 standard deviations
    middle = drawn[shapely.contains_xy(SOLID[1], drawn)].mean(0)
    np.testing.assert_allclose(middle, SOLID[1].centroid.coords[0], atol=0.25)
