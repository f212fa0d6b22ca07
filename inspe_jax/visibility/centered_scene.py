"""A scene's arrays relative to its centre, which visibility works on."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.core.arrays import bucket, on_device
from inspe_jax.core.convex import ConvexPrism, sides
from inspe_jax.core.geometry import FAR, Prism
from inspe_jax.core.height_field import HeightField
from inspe_jax.core.parallel import shapes_of
from inspe_jax.scene.placed_bodies import convex_parts
from inspe_jax.scene.scene import Scene
from inspe_jax.visibility.motion import Motion, motion_of

PRISMS = 16  # least number of places for prisms in a frame
PARTS = 32  # least number of places for the convex prisms of static bodies


class Statics(NamedTuple):
    """What stands in every frame: the convex prisms of bodies, and the ground as a surface; None
    where there is nothing of it."""

    bodies: ConvexPrism | None = None
    ground: HeightField | None = None

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """The shapes of its arrays, for which programs are compiled."""
        return shapes_of(self)


class CenteredScene(NamedTuple):
    """A scene's arrays relative to its centre, where single precision is finest.

    ``columns`` (L, 2) are x and y of the columns, ``heights`` (L, Z) those of the voxel centres
    and ``ground`` (L,) that of the ground [m], ``prisms`` (T, B) the road users in T frames.
    ``statics`` are static bodies and the ground where it hides something, and ``inside`` (L, Z)
    says which voxels are inside a body; None where there is nothing of it. ``motion`` is how road
    users move about each column, in all frames; None where it is not known.
    """

    columns: Float[Array, "L 2"]
    heights: Float[Array, "L Z"]
    ground: Float[Array, " L"]
    prisms: Prism
    inside: Bool[Array, "L Z"] | None = None
    statics: Statics | None = None
    motion: Motion | None = None

    @property
    def centers(self) -> Float[Array, "V 3"]:
        """Voxel centres, column by column."""
        z = self.heights.reshape(-1, 1)
        return jnp.concatenate([jnp.repeat(self.columns, self.heights.shape[1], 0), z], axis=1)


def about_center(scene: Scene) -> CenteredScene:
    """The scene's arrays relative to its centre.

    Frames end in prisms that are not valid: scenes of similar traffic have arrays of one shape.
    """
    grid, traffic = scene.voxels, scene.traffic
    x, y, z = grid.center
    bodies, ground = _bodies_about_center(scene), _ground_about_center(scene)
    spare = bucket(traffic.valid.shape[1], PRISMS) - traffic.valid.shape[1]

    def padded(values: np.ndarray) -> np.ndarray:
        return np.pad(values, [(0, 0), (0, spare)] + [(0, 0)] * (values.ndim - 2))

    return CenteredScene(
        columns=on_device(grid.columns - [x, y], float),
        heights=on_device(grid.ground[:, None] - z + grid.levels, float),
        ground=on_device(grid.ground - z, float),
        prisms=Prism(
            center=on_device(padded(traffic.center[..., :2] - [x, y]), float),
            yaw=on_device(padded(traffic.yaw), float),
            half=on_device(padded(traffic.size[..., :2] / 2), float),
            top=on_device(padded(traffic.center[..., 2] + traffic.size[..., 2] / 2 - z), float),
            valid=on_device(padded(traffic.valid)),
        ),
        inside=None if scene.inside_statics is None else on_device(scene.inside_statics),
        statics=None if bodies is None and ground is None else Statics(bodies, ground),
        motion=Motion(*(on_device(x, float) for x in motion_of(traffic, grid.columns))),
    )


def _ground_about_center(scene: Scene) -> HeightField | None:
    if (terrain := scene.terrain) is None:
        return None
    x, y, z = scene.voxels.center
    heights = terrain.heights - z
    return HeightField(
        corner=on_device(terrain.corner - [x, y], float),
        step=on_device(np.array(terrain.step), float),
        heights=on_device(heights, float),
        highest=on_device(heights.max(), float),
        steepest=on_device(np.array(terrain.steepest), float),
    )


def _bodies_about_center(scene: Scene) -> ConvexPrism | None:
    """The convex prisms of a scene's bodies relative to its centre; None if it has none.

    They end in some that are not valid, so that scenes of similar size have arrays of one shape.
    """
    if not scene.statics:
        return None
    parts, (x, y, z) = convex_parts(scene.statics, scene.intersection), scene.voxels.center
    corners = parts.corners - [x, y]
    normal, offset = sides(corners)
    spare = bucket(len(corners), PARTS) - len(corners)

    def padded(values: np.ndarray, kind: type = float) -> Array:
        return on_device(np.pad(values, [(0, spare)] + [(0, 0)] * (values.ndim - 1)), kind)

    return ConvexPrism(
        corners=padded(corners),
        normal=padded(normal),
        offset=padded(offset),
        bottom=padded(np.maximum(parts.bottom - z, -FAR)),
        top=padded(parts.top - z),
        clear=padded(parts.transmittance),
        valid=padded(np.ones(len(corners)), bool),
    )
