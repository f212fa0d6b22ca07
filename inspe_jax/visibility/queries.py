"""Which voxels each sensor has in view, and which voxels vehicles leave in line of sight."""

import operator

import jax
import numpy as np
from jaxtyping import Array, Bool, UInt

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.voxels import ROI_HEIGHT
from inspe_jax.sensing.conditions import Case, Conditions, case_of
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.named import layout_of
from inspe_jax.visibility.centered_scene import CenteredScene, about_center, poses_about_center
from inspe_jax.visibility.shadows import sight_masks
from inspe_jax.visibility.statics import past_statics_of_sensor
from inspe_jax.visibility.tiles import Tiles, tiles_of
from inspe_jax.visibility.view_masks import view_masks


def in_view(scene: Scene | Case | str, layout: Layout | str) -> Bool[np.ndarray, "S V"]:
    """Whether some ray of each sensor passes through each voxel; traffic does not matter.

    A ray ends at a static body: a voxel behind one, by the line to its centre, is not in view.
    Raises InspeError as :func:`check_layout` does.
    """
    scene, layout, conditions = check_layout(scene, layout)
    layout = conditions.layout(layout)
    centered, poses = about_center(scene), poses_about_center(scene, layout)
    tiles = tiles_of(centered)
    half, found = scene.voxels.size / 2, np.zeros((len(layout), scene.voxels.count), bool)
    for grid, index in layout.groups():
        for s in index:
            view = view_masks(grid.rays, poses[s], tiles.tile, half)
            found[s] = tiles.by_voxel(_past_statics(centered, tiles, poses[s, :3], view))
    return found


def _past_statics(
    centered: CenteredScene, tiles: Tiles, sensor: np.ndarray, view: UInt[Array, "N C"]
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
    sight. Raises InspeError where there is no such frame, and as :func:`check_layout` does.
    """
    scene, layout, _ = check_layout(scene, layout)
    frame = check_frame(scene, frame)
    centered = about_center(scene)
    tiles, poses = tiles_of(centered), poses_about_center(scene, layout)
    prisms = jax.tree.map(lambda leaf: leaf[frame : frame + 1], centered.prisms)
    clear = []
    for at in poses[:, :3]:
        sight = sight_masks(at, prisms, tiles.tile)[:, 0]
        clear.append(tiles.by_voxel(_past_statics(centered, tiles, at, sight)))
    return np.stack(clear)


def check_frame(scene: Scene, frame: int) -> int:
    """The frame as an int. Raises InspeError where there is no such frame."""
    frame, last = operator.index(frame), scene.traffic.frame_count - 1
    if not 0 <= frame <= last:
        raise InspeError(f"frame {frame} is out of range: {scene.name} has frames 0 to {last}")
    return frame


def check_layout(
    scene: Scene | Case | str, layout: Layout | str, conditions: Conditions | str | None = None
) -> tuple[Scene, Layout, Conditions]:
    """The scene, the layout and the conditions of a function that users call, each also by name.

    Raises InspeError where one of them is something else or has wrong numbers, as
    :func:`~inspe_jax.sensing.conditions.case_of` and
    :func:`~inspe_jax.sensing.named.layout_of` do, and where a sensor is in the ground, in a static
    body or out of reach. Traced poses have no values to check and pass.
    """
    case = case_of(scene, conditions)
    layout = layout_of(layout, case.scene)
    if not isinstance(layout.poses, jax.core.Tracer):
        check_places(case.scene, layout)
    return case.scene, layout, case.conditions


def check_places(scene: Scene, layout: Layout) -> None:
    """Raise InspeError where a sensor is in the ground, in a static body or out of reach."""
    grid, poses = scene.voxels, np.asarray(layout.poses, float)
    for pose, sensor in zip(poses, layout.sensors, strict=True):
        where = f"{layout.name}: sensor '{sensor.name}' at ({pose[0]:.2f}, {pose[1]:.2f})"
        away, reach = np.hypot(*(pose[:2] - grid.center[:2])), sensor.spec.grid.reach
        ground = float(scene.intersection.ground(pose[None, :2])[0])
        gap = np.hypot(max(away - grid.radius, 0.0), max(pose[2] - ground - ROI_HEIGHT, 0.0))
        if gap > reach:
            raise InspeError(
                f"{where}, {pose[2] - ground:.0f} m up, is {gap:.0f} m from the region of interest "
                f"of {scene.name} and reaches {reach:g} m; is this layout for another scene?"
            )
        if not pose[2] > ground:
            raise InspeError(
                f"{where} is in the ground: its height is {pose[2]:.2f} m and the ground's "
                f"{ground:.2f} m"
            )
        inside = body_at(scene.statics, scene.intersection, pose[:3])
        if inside is not None:
            raise InspeError(
                f"{where}, {pose[2] - ground:.1f} m up, is inside a body of {scene.name}, the "
                f"{inside.words}; move it out, above or beneath, or take the body away"
            )
