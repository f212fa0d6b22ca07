"""Sight line against a prism: the one cut, both exact forms, its derivatives, and shapely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapely.geometry import LineString, MultiPoint, Polygon
from worlds import double_precision

from inspe_jax.core import convex
from inspe_jax.core.geometry import FAR, Prism, shadow_ceiling, shadow_terms

ROOM = 8
LINES = 200


def random_outlines(seed: int, count: int) -> np.ndarray:
    """Convex outlines with three to eight corners, padded as those of scores are."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        hull = MultiPoint(rng.normal(size=(rng.integers(4, 12), 2)) * 3).convex_hull
        corners = np.array(hull.exterior.coords)[-1:0:-1]  # counter-clockwise
        if len(corners) <= ROOM:
            found.append(corners[np.minimum(np.arange(ROOM), len(corners) - 1)])
    return np.array(found)


def prisms(corners: np.ndarray) -> convex.ConvexPrism:
    each = np.zeros(len(corners))
    return convex.ConvexPrism(corners, *convex.sides(corners), each, each, each, each == 0)


@jax.jit
def cuts(prism, sensors, columns):
    """The cuts (P, N) of P prisms by N sight lines."""
    at = *sensors.T, *columns.T
    return jax.vmap(lambda one: convex.sight_cut(one, *at))(prism)


def test_a_line_meets_what_shapely_says_and_there():
    """The margins' signs, and the ends of the part in the prism."""
    shapes, rng = random_outlines(1, 25), np.random.default_rng(2)
    sensors, columns = rng.uniform(-9, 9, (2, LINES, 2))
    with double_precision():
        found = jax.tree.map(np.asarray, cuts(prisms(shapes), sensors, columns))
    least = np.minimum(np.minimum(found.left, found.right), found.ahead)
    for p, shape in enumerate(shapes):
        polygon = Polygon(shape)
        assert polygon.exterior.is_ccw
        for k, (sensor, column) in enumerate(zip(sensors, columns, strict=True)):
            segment = LineString([column, sensor])
            part = segment.intersection(polygon)
            assert (least[p, k] > 0) == (part.length > 0)
            if part.length > 0:
                ends = sorted(np.hypot(*(np.array(part.coords) - column).T) / segment.length)
                assert [found.near[p, k], found.far[p, k]] == pytest.approx(ends, abs=1e-9)


def vehicles(rng, count):
    return Prism(
        center=rng.uniform(-30, 30, (count, 2)),
        yaw=rng.uniform(-np.pi, np.pi, count),
        half=rng.uniform([0.3, 0.3], [9.0, 2.0], (count, 2)),
        top=rng.uniform(0.5, 4.5, count),
        valid=np.full(count, True),
    )


@jax.jit
def by_the_cut(prism, sensor, columns, z):
    """The least of a prism's margins (P, N) on the sight lines to N voxels: it hides where it is
    positive."""
    sx, sy, sz = sensor
    cut = jax.vmap(lambda one: convex.sight_cut(one, sx, sy, *columns))(prism)
    top, bottom = prism.top[:, None], prism.bottom[:, None]
    lowest = jnp.where(sz > z, cut.near, cut.far)
    highest = jnp.where(sz > z, cut.far, cut.near)
    below, above = top - z - (sz - z) * lowest, (sz - z) * highest + z - bottom
    margins = cut.left, cut.right, cut.ahead, below, above
    return jnp.stack(margins).min(0)


@pytest.mark.parametrize("kind", ["vehicles", "bodies"])
def test_both_exact_forms_follow_from_the_cut(kind):
    """In double precision, at random, with sensors inside, above, beneath and beside.

    Rounding, with ε = 2⁻⁵² and D = 90 m, more than any distance here: a coordinate across a line
    has an error of a few ε D, which the lever makes 1/NO_LEVER times as large, and heights alike.
    So margins above 1e3 ε D/NO_LEVER = 1e-9 m decide. Bodies are wider by SEAM in the exact form
    alone, which the lever makes 1/NO_LEVER times as large.
    """
    rng, count = np.random.default_rng(5), 60
    sure = 1.01 * convex.SEAM / convex.NO_LEVER if kind == "bodies" else 1e-9
    with double_precision():
        if kind == "vehicles":
            own = jax.tree.map(jnp.asarray, vehicles(rng, count))
            prism = jax.jit(convex.outlines)(own)
        else:
            bottom = np.where(np.arange(count) % 2, rng.uniform(0, 3, count), -FAR)
            top = np.maximum(bottom, 0) + rng.uniform(0.5, 4, count)
            prism = prisms(random_outlines(6, count) * 2)._replace(bottom=bottom, top=top)
            prism = jax.tree.map(jnp.asarray, prism)
        columns = jnp.asarray(rng.uniform(-30, 30, (2, 400)))
        z = jnp.asarray(rng.uniform(0.1, 4.0, (1, 400)))

        @jax.jit
        def exactly(sensor):
            dx, dy = columns - sensor[:2, None]
            if kind == "bodies":
                terms = convex.convex_terms(sensor, prism)
                floor, ceiling = convex.convex_shadow(terms, dx, dy, sensor[2])
                return (z > floor) & (z < ceiling)
            terms = jax.tree.map(lambda leaf: leaf[:, None], shadow_terms(sensor, own))
            return z < shadow_ceiling(terms, dx[None], dy[None], sensor[2])

        hidden = total = 0
        for sensor in rng.uniform([-30, -30, 0.3], [30, 30, 9.0], (60, 3)):
            margin = np.asarray(by_the_cut(prism, jnp.asarray(sensor), columns, z))
            exact = np.asarray(exactly(jnp.asarray(sensor)))
            differ = (exact != (margin > 0)) & (np.abs(margin) > sure)
            hidden, total = hidden + exact.sum(), total + differ.sum()
            assert not differ.any()
    assert hidden > 5000


def test_derivatives_of_a_cut_are_its_differences():
    """Across the line and along it, but within 1e-5 of where another corner or side decides."""
    rng, count, h = np.random.default_rng(7), 40, 1e-6
    sensors, columns = rng.uniform(-9, 9, (2, LINES, 2))
    along = (sensors - columns) / np.hypot(*(sensors - columns).T)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    with double_precision():
        prism = jax.tree.map(jnp.asarray, prisms(random_outlines(8, count)))
        at = lambda sensors: jax.tree.map(np.asarray, cuts(prism, sensors, columns))  # noqa: E731
        moves = [[at(sensors + k * h * way) for k in (1, -1)] for way in (along, across)]
        cut = at(sensors)
    length = np.hypot(*(sensors - columns).T)
    far = np.where(cut.far < 1, cut.far, 0)
    expected = (
        (cut.along_left, cut.along_right, cut.along_ahead, -cut.near / length, -far / length),
        (cut.of_left, cut.of_right, cut.of_ahead, cut.of_near, cut.of_far),
    )
    beside = np.minimum(cut.left, cut.right) > -3  # where soft scores read them
    for (more, less), slopes in zip(moves, expected, strict=True):
        for k, slope in enumerate(slopes):
            difference = (more[k] - less[k]) / (2 * h)
            some = beside & (np.abs(cut[k]) < 3) if k < 3 else beside
            slope = np.broadcast_to(slope, difference.shape)
            close = np.isclose(difference, slope, rtol=1e-4, atol=1e-4)
            assert close[some].mean() > 0.98
