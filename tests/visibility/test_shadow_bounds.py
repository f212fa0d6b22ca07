"""Nothing is left out that a shadow touches, however soft its edges are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.core.convex import outlines
from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import REACH
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.shadows import may_shade, shadow_bounds
from inspe_jax.visibility.soft_sight import Sights, cell_marks, clear_chance
from inspe_jax.visibility.tiles import Tile

SIZES = {"semi": (16.5, 2.55, 4.0), "truck": (9.8, 2.55, 3.8), "car": (4.3, 1.8, 1.5)}
FRAMES, CELLS, EACH = 1500, 16, 4


@jax.jit
def read(sensor, prisms, tile, width):
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
    clear, near, marked = map(np.asarray, read(*singles))
    hides = (clear < 1).any(0).reshape(FRAMES, CELLS, EACH).any(2)
    assert hides.sum() > (1000 if low < 1 else 0)
    assert not (hides & ~near[:, None]).any()
    assert not (hides & ~marked).any()
    if low < 1:
        assert marked.mean() < 1.6 * hides.mean() + 0.05  # and little more is marked
