"""Viewsheds: for each voxel, how many sensors have it in view and in which frames it is seen.

They are the cumulative viewsheds of geographic information systems.
"""

from dataclasses import dataclass
from enum import IntEnum

import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from inspe_jax.core.arrays import from_center, pad_rows
from inspe_jax.core.geometry import Prism
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.accumulate import seen_in_tile
from inspe_jax.scoring.exact import ONE_MORE, in_view_of
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS, Frames
from inspe_jax.scoring.tiled_scene import by_level, tiled_scene_of
from inspe_jax.sensing.conditions import FAIR, Conditions, perceiving
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.named import check_layout
from inspe_jax.sensing.sensor_array import SensorSet, sensor_array
from inspe_jax.visibility.queries import check_frame
from inspe_jax.visibility.tiles import Tile, Tiles, unless_empty


class Visibility(IntEnum):
    """What a voxel is to a layout in one frame."""

    OUT_OF_VIEW = 0
    HIDDEN = 1
    SEEN = 2
    OCCUPIED = 3


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Viewshed:
    """How well a layout sees each voxel of a scene.

    ``sensors`` is how many sensors have the voxel in view. Of ``frame_count`` frames, some sensor
    sees it in ``seen``, and it is inside a road user in ``occupied``.
    """

    sensors: Int[np.ndarray, " V"]
    seen: Int[np.ndarray, " V"]
    occupied: Int[np.ndarray, " V"]
    frame_count: int


def viewshed(scene: Scene, layout: Layout, *, conditions: Conditions = FAIR) -> Viewshed:
    """How well a layout sees each voxel, over all frames; a scene may be without traffic.

    Raises InspeError as :func:`inspe_jax.evaluate` does.
    """
    layout, tiles, views, sensors = _views(scene, layout, conditions)
    levels = tiles.tile.heights.shape[1]
    seen = np.zeros((*views.shape[1:], levels), int)
    occupied = np.zeros_like(seen)
    for chunk in tiled_scene_of(scene, whole=True).chunks:
        assert chunk.solid is not None  # the scene has masks
        found = _seen_masks(tiles.tile, views, chunk.solid, chunk.prisms, sensors)
        seen += np.asarray(by_level(found, levels))
        occupied += np.asarray(by_level(chunk.solid, levels))
    return Viewshed(
        sensors=tiles.by_voxel(views[: len(layout)]).sum(0),
        seen=tiles.of_voxels(seen),
        occupied=tiles.of_voxels(occupied),
        frame_count=scene.traffic.frame_count,
    )


def sight_in(
    scene: Scene, layout: Layout, frame: int, *, conditions: Conditions = FAIR
) -> UInt[np.ndarray, " V"]:
    """What each voxel is to a layout in one frame: a :class:`Visibility` for each voxel.

    Raises InspeError as :func:`viewshed` does, and where there is no such frame.
    """
    frame = check_frame(scene, frame)
    layout, tiles, views, sensors = _views(scene, layout, conditions)
    tiled = tiled_scene_of(scene, whole=True)
    (chunk,) = (c for c in tiled.chunks if c.begin <= frame < c.begin + len(c.prisms.top))
    assert chunk.solid is not None  # the scene has masks
    at = slice(frame - chunk.begin, frame - chunk.begin + 1)
    prisms = jax.tree.map(lambda leaf: np.asarray(leaf)[at], chunk.prisms)
    solid = np.asarray(chunk.solid)[:, at]
    seen = np.asarray(_seen_masks(tiles.tile, views, solid, prisms, sensors))
    found = np.where(tiles.by_voxel(views).any(0), Visibility.HIDDEN, Visibility.OUT_OF_VIEW)
    found[tiles.by_voxel(seen[:, 0])] = Visibility.SEEN
    found[tiles.by_voxel(solid[:, 0])] = Visibility.OCCUPIED
    return found.astype(np.uint8)


def _views(
    scene: Scene, layout: Layout, conditions: Conditions
) -> tuple[Layout, Tiles, UInt[np.ndarray, "S N C"], Float[np.ndarray, "S 3"]]:
    """The layout under the conditions, the tiles, and, padded, masks in view and positions [m]."""
    check_layout(scene, layout)
    layout, tiled = perceiving(scene, layout, conditions), tiled_scene_of(scene, whole=True)
    sensors = sensor_array(SensorSet.of(layout), ONE_MORE)
    poses = pad_rows(from_center(scene.voxels.center, layout.poses), len(sensors.kind))
    views = np.asarray(in_view_of(tiled, poses, sensors, scene.voxels.size / 2))
    return layout, tiled.tiles, views, poses[:, :3]


@jax.jit
def _seen_masks(
    tiles: Tile,
    views: UInt[Array, "S N C"],
    solid: UInt[Array, "N T C"],
    prisms: Prism,
    sensors: Float[Array, "S 3"],
) -> UInt[Array, "N T C"]:
    shadows = BITS.shadows(sensors, prisms)

    @unless_empty
    def see_tile(tile: Tile, views: Array, solid: Array) -> Array:
        rows = sensors, shadows, views
        return seen_in_tile(BITS, rows, tile, Frames(prisms, solid), None, ScoreOptions())[0].all

    return jax.lax.map(lambda part: see_tile(*part), (tiles, views.swapaxes(0, 1), solid))
