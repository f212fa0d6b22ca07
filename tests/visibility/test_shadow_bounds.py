"""No tile is left out that a shadow touches, however soft its edges are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import REACH
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.shadows import may_shade, shadow_bounds, soft_sight
from inspe_jax.visibility.tiles import Tile

SIZES = {"semi": (16.5, 2.55, 4.0), "truck": (9.8, 2.55, 3.8), "car": (4.3, 1.8, 1.5)}
FRAMES, COLUMNS = 1500, 24


@pytest.fixture(scope="module")
def read():
    def both(sensor, prisms, columns, heights, width, at_sensor):
        every = bitmask.marks(jnp.ones((1, FRAMES), bool))
        at = sensor, prisms, every, columns, heights, width
        clear = soft_sight(*at, at_sensor=at_sensor)
        bounds = shadow_bounds(sensor, prisms, REACH * width)

        def of_column(xy):
            ground, one = jnp.zeros(1), jnp.ones(1, jnp.uint8)
            tile = Tile(xy[:, None], heights[:, :1], ground, one, xy, jnp.zeros(()),
                        heights.min(), heights.max())  # fmt: skip
            return may_shade(sensor, bounds, tile)[0]

        return clear, jax.vmap(of_column, 1, 1)(columns)

    return jax.jit(both, static_argnames="at_sensor")


@pytest.mark.parametrize("at_sensor", [True, False])
@pytest.mark.parametrize("kind", SIZES)
@pytest.mark.parametrize("width", [0.25, 0.5, 1.0])
def test_a_prism_that_hides_anything_of_a_column_may_shade_it(read, at_sensor, kind, width):
    """Vehicles about the sensor, which is little higher than they are: there edges matter most."""
    rng = np.random.default_rng(3)
    size = np.array(SIZES[kind])
    center = rng.uniform(-14, 14, (FRAMES, 1, 2))
    prisms = Prism(
        center=jnp.asarray(center, jnp.float32),
        yaw=jnp.asarray(rng.uniform(-np.pi, np.pi, (FRAMES, 1)), jnp.float32),
        half=jnp.full((FRAMES, 1, 2), size[:2] / 2, jnp.float32),
        top=jnp.full((FRAMES, 1), size[2], jnp.float32),
        valid=jnp.ones((FRAMES, 1), bool),
    )
    columns = jnp.asarray(rng.uniform(-25, 25, (2, COLUMNS)), jnp.float32)
    heights = jnp.asarray(np.tile([[0.2], [1.0], [2.6]], (1, COLUMNS)), jnp.float32)
    sensor = jnp.asarray([0.0, 0.0, size[2] + 0.3], jnp.float32)
    clear, may = read(sensor, prisms, columns, heights, jnp.float32(width), at_sensor)
    hides = np.asarray((clear < 1).any(0))
    assert hides.sum() > 1000
    assert not (hides & ~np.asarray(may)).any()
    assert may.mean() < 0.9  # and it still tells something
