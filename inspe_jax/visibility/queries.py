"""Which voxels each sensor has in view, and which voxels vehicles leave in line of sight."""

import operator

import jax
import numpy as np
from jaxtyping import Array, Bool, UInt

from inspe_jax.core.arrays import from_center
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import Case
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.named import check_layout
from inspe_jax.visibility.centered_scene import CenteredScene, about_center
from inspe_jax.visibility.shadows import sight_masks
from inspe_jax.visibility.statics import past_statics_of_sensor
from inspe_jax.visibility.tiles import Tiles, tiles_of
from inspe_jax.visibility.view_masks import views_of_sensor


def in_view(scene: Scene | Case | str, layout: Layout | str) -> Bool[np.ndarray, "S V"]:
    """Whether some ray of each sensor passes through each voxel; traffic does not matter.

    A ray ends at a static body: a voxel behind one, by the line to its centre, is not in view.

    Args:
        scene, layout: As in :func:`inspe_jax.evaluate`, also by name.

    Returns:
        (S, V) by sensor and voxel; voxel v is in column v // Z, level v % Z.

    Raises:
        InspeError: As :func:`check_layout`.

    >>> seen = inspe_jax.in_view(scene, layout)
    >>> seen.shape, round(float(seen.any(0).mean()), 3)
    ((8, 344), 0.953)
    """
    scene, layout, conditions = check_layout(scene, layout)
    layout = conditions.layout(layout)
    centered, poses = about_center(scene), from_center(scene.voxels.center, layout.poses)
    tiles = tiles_of(centered)
    half, found = scene.voxels.size / 2, np.zeros((len(layout), scene.voxels.count), bool)
    for grid, index in layout.groups():
        for s in index:
            view = views_of_sensor(grid.rays, poses[s], tiles.tile, half)
            found[s] = tiles.by_voxel(_past_statics(centered, tiles, poses[s, :3], view))
    return found


def _past_statics(
    centered: CenteredScene, tiles: Tiles, sensor: np.ndarray, view: UInt[Array | np.ndarray, "N C"]
) -> UInt[np.ndarray, "N C"]:
    if centered.statics is None:
        return np.asarray(view)
    return np.asarray(view & past_statics_of_sensor(sensor, centered.statics, tiles.tile, view))


def line_of_sight(
    scene: Scene | Case | str, layout: Layout | str, frame: int
) -> Bool[np.ndarray, "S V"]:
    """Whether nothing cuts the line from each sensor to each voxel's centre in one frame: no
    vehicle, and no static body of which less than half of the light passes through.

    The rays and the reach do not matter. A voxel inside a vehicle or a body is not in line of
    sight.

    Args:
        scene, layout: As in :func:`inspe_jax.evaluate`, also by name.
        frame: Number of the frame.

    Returns:
        (S, V) by sensor and voxel.

    Raises:
        InspeError: There is no such frame, or as :func:`check_layout`.

    >>> clear = inspe_jax.line_of_sight(scene, layout, frame=0)
    >>> clear.shape, bool(clear.all())
    ((8, 344), False)
    """
    scene, layout, _ = check_layout(scene, layout)
    frame = check_frame(scene, frame)
    centered = about_center(scene)
    tiles, poses = tiles_of(centered), from_center(scene.voxels.center, layout.poses)
    prisms = jax.tree.map(lambda leaf: np.asarray(leaf)[frame : frame + 1], centered.prisms)
    clear = []
    for at in poses[:, :3]:
        sight = np.asarray(sight_masks(at, prisms, tiles.tile))[:, 0]
        clear.append(tiles.by_voxel(_past_statics(centered, tiles, at, sight)))
    return np.stack(clear)


def check_frame(scene: Scene, frame: int) -> int:
    """The frame as an int. Raises InspeError where there is no such frame."""
    frame, last = operator.index(frame), scene.traffic.frame_count - 1
    if not 0 <= frame <= last:
        raise InspeError(f"frame {frame} is out of range: {scene.name} has frames 0 to {last}")
    return frame
