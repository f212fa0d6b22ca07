"""What sensing works on: a scene's arrays, about its centre."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.geometry import Prism
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout


class Ground(NamedTuple):
    """A scene's arrays about its centre, where single precision is finest.

    ``columns`` (L, 2), ``heights`` (L, Z) of the voxel centres, ``prisms`` (T, B).
    """

    columns: Float[Array, "L 2"]
    heights: Float[Array, "L Z"]
    prisms: Prism

    @property
    def centers(self) -> Float[Array, "V 3"]:
        """Voxel centres, column by column."""
        z = self.heights.reshape(-1, 1)
        return jnp.concatenate([jnp.repeat(self.columns, self.heights.shape[1], 0), z], axis=1)


def about_center(scene: Scene) -> Ground:
    """The scene's columns, heights and prisms, relative to its centre."""
    grid, traffic = scene.voxels, scene.traffic
    x, y, z = grid.center
    return Ground(
        columns=jnp.asarray(grid.columns - [x, y], float),
        heights=jnp.asarray(grid.ground[:, None] - z + grid.levels, float),
        prisms=Prism(
            center=jnp.asarray(traffic.center[..., :2] - [x, y], float),
            yaw=jnp.asarray(traffic.yaw, float),
            half=jnp.asarray(traffic.size[..., :2] / 2, float),
            top=jnp.asarray(traffic.center[..., 2] + traffic.size[..., 2] / 2 - z, float),
            valid=jnp.asarray(traffic.valid),
        ),
    )


def poses_about_center(scene: Scene, layout: Layout) -> Float[Array, "S 6"]:
    """The layout's poses relative to the scene's centre, traced or not."""
    shift = np.concatenate([scene.voxels.center, np.zeros(3)])
    return jnp.asarray(layout.poses - shift[None], float)
