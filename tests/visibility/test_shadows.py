"""Shadows read at the sensor: against the share of places near by from which a vehicle hides; and
nothing is left out that a shadow touches, however soft its edges are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.core.convex import outlines, sight_cut
from inspe_jax.core.numerics import REACH
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Prism
from inspe_jax.visibility.shadows import may_shade, shadow_bounds
from inspe_jax.visibility.soft_sight import Sights, _in_plan, cell_marks, clear_chance
from inspe_jax.visibility.tiles import Tile

WIDTH = 0.5


def meets(start, end, half):
    """Whether segments in plan meet a rectangle about the origin; slab by slab, in NumPy."""
    along = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (-half - start) / along, (half - start) / along
    first, last = np.minimum(one, two).max(-1), np.maximum(one, two).min(-1)
    return (first < last) & (first < 1) & (last > 0)


def places(count):
    """Shifts [widths] at which the derivative of the soft step has equal shares: its quantiles."""
    u = np.linspace(0, 1, 20001)
    return np.interp((np.arange(count) + 0.5) / count, u * u * (3 - 2 * u), (2 * u - 1) * REACH)


@pytest.fixture(scope="module")
def lines():
    """Random sensors 6 to 40 m from a car or a pedestrian, and columns about it."""
    rng = np.random.default_rng(0)
    count = 4000
    half = np.where(rng.uniform(size=(count, 1)) < 0.5, [2.25, 0.9], [0.25, 0.3])
    bearing, away = rng.uniform(0, 2 * np.pi, count), rng.uniform(6, 40, count)
    sensor = away[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    behind = rng.uniform(-3, 12, count)[:, None] * sensor / away[:, None]
    column = rng.normal(0, 1.5, (count, 2)) - behind
    return sensor, column, half


@jax.jit
def passing(sensor, column, half, width):
    def one(sensor, column, half):
        none = jnp.zeros(())
        about_origin = Prism(jnp.zeros(2), none, half, none, none == 0)
        return _in_plan(sight_cut(outlines(about_origin), *sensor, *column), width).met

    return jax.vmap(one)(sensor, column, half)


def read(sensor, column, half, width):
    """Chances that lines meet rectangles about the origin, in plan."""
    return np.asarray(passing(*map(jnp.asarray, (sensor, column, half)), width))


def test_it_is_the_share_of_places_from_which_the_line_meets(lines):
    """Places aside of the line's own. A shift of the sensor across its line moves every corner's
    offset by 1 − t to first order; the second, a square of 1.5 m over the line's length, is 0.002.
    A few columns level with a corner, or inside the prism, are read otherwise. 400 places resolve
    0.0025 each, and on the mean over lines much less."""
    sensor, column, half = lines
    along = column - sensor
    across = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1)[:, None]
    shifts = places(400) * WIDTH
    share = np.mean([meets(sensor + x * across, column, half) for x in shifts], 0)
    found = read(sensor, column, half, WIDTH)
    some = (share > 0.02) & (share < 0.98)
    assert some.mean() > 0.15
    error = found - share
    assert np.abs(error).mean() < 0.001
    assert np.quantile(np.abs(error), 0.995) < 0.005
    for small in (half[:, 0] < 1, half[:, 0] > 1):
        assert found[small].mean() == pytest.approx(share[small].mean(), rel=0.002)


def test_without_a_width_it_is_exact(lines):
    sensor, column, half = lines
    found = read(sensor, column, half, 1e-6)
    np.testing.assert_array_equal(found > 0.5, meets(sensor, column, half))


def test_a_top_is_read_by_how_far_the_sensor_has_to_rise():
    """A wall 2 m high half-way to a column: 1 m more of the sensor's height lifts the line by
    0.5 m. From 5 m up, the line to height z passes at (5 + z)/2, the wall's rear edge a little on.
    """
    prism = Prism(
        np.zeros((1, 1, 2)), np.zeros((1, 1)), np.array([[[0.05, 30.0]]]), np.full((1, 1), 2.0),
        np.ones((1, 1), bool),
    )  # fmt: skip
    heights = np.array([[-2.0], [-1.2], [-1.0], [-0.8], [0.0]])

    @jax.jit
    def chances(sensor, prism, columns, heights):
        marked = bitmask.marks(jnp.ones((1, 1, 1), bool))
        return clear_chance(sensor, Sights(outlines(prism), marked, columns, heights, WIDTH))

    at = np.array([-10.0, 0.0, 5.0]), prism, np.array([[10.0], [0.0]]), heights
    found = np.asarray(chances(*at))[:, 0, 0]
    t = 0.5 + 0.05 / 20
    need = (2.0 - (5.0 + (heights[:, 0] - 5.0) * t)) / (1 - t)
    u = np.clip(0.5 + need / (2 * REACH * WIDTH), 0, 1)
    np.testing.assert_allclose(found, 1 - u * u * (3 - 2 * u), atol=1e-4)


# ── What is left out ────────────────────────────────────────────────────────

SIZES = {"semi": (16.5, 2.55, 4.0), "truck": (9.8, 2.55, 3.8), "car": (4.3, 1.8, 1.5)}
FRAMES, CELLS, EACH = 1500, 16, 4


@jax.jit
def marks(sensor, prisms, tile, width):
    """How clear lines are past all prisms, marks of a tile and of its cells."""
    every = jnp.ones((1, FRAMES, CELLS), bool)
    shapes, bounds = outlines(prisms), shadow_bounds(sensor, prisms, REACH * width)
    marked = cell_marks(sensor, shapes, bounds, tile, REACH * width)
    at = shapes, bitmask.marks(every), tile.columns, tile.heights, width
    return clear_chance(sensor, Sights(*at)), may_shade(sensor, bounds, tile)[0], marked[0] != 0


@pytest.mark.parametrize("kind", SIZES)
@pytest.mark.parametrize("width", [0.25, 0.5, 1.0])
@pytest.mark.parametrize(("spread", "above", "low"), [
    (0.0, 0.3, 0.2), (1.5, 0.3, 0.2), (1.5, -0.5, 6.0), (0.5, 0.5, 5.0),
])  # fmt: skip
def test_a_prism_that_hides_anything_of_a_cell_is_marked(kind, width, spread, above, low):
    """Vehicles about the sensor, which is little higher than they are: there edges matter most; or
    lower, and with voxels above both. Cells are single columns, or up to 3 m wide."""
    rng = np.random.default_rng(3)
    size = np.array(SIZES[kind])
    center = rng.uniform(-14, 14, (FRAMES, 1, 2))
    prisms = Prism(
        center=center,
        yaw=rng.uniform(-np.pi, np.pi, (FRAMES, 1)),
        half=np.full((FRAMES, 1, 2), size[:2] / 2),
        top=np.full((FRAMES, 1), size[2]),
        valid=np.ones((FRAMES, 1), bool),
    )
    middle = rng.uniform(-23, 23, (2, CELLS))
    columns = middle[:, :, None] + rng.uniform(-spread, spread, (2, CELLS, EACH))
    radius = np.hypot(*(columns - middle[:, :, None])).max(1)
    heights = low + np.tile([[0.0], [0.8], [2.4]], (1, CELLS * EACH))
    flat = np.zeros(CELLS * EACH)
    tile = Tile(
        columns.reshape(2, -1), heights, flat, flat.astype(np.uint8), np.zeros(2), 36.0, low,
        low + 2.4, np.stack([*middle, radius]),
    )  # fmt: skip
    sensor = np.array([0.0, 0.0, size[2] + above])
    given = jax.tree.map(np.asarray, (sensor, prisms, tile, width))
    singles = jax.tree.map(lambda x: x.astype(x.dtype.char.replace("d", "f")), given)
    clear, near, marked = map(np.asarray, marks(*singles))
    hides = (clear < 1).any(0).reshape(FRAMES, CELLS, EACH).any(2)
    assert hides.sum() > (1000 if low < 1 else 0)
    assert not (hides & ~near[:, None]).any()
    assert not (hides & ~marked).any()
    if low < 1:
        assert marked.mean() < 1.6 * hides.mean() + 0.05  # and little more is marked
