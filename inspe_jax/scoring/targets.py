"""What a road user gets where it stands: LiDAR returns, pixels per metre, chance of detection.

Practitioners ask how many LiDAR points fall on a pedestrian there, and how many pixels per metre a
camera has there. Both are found for a target that stands at each column of the region of interest.
Returns are means over the frames of traffic, which hides slabs of the target.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import check_known
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS, RoadUser
from inspe_jax.scoring.detection import (
    DetectionCurve,
    DetectionCurves,
    detection_curves,
)
from inspe_jax.scoring.exact import ONE_MORE, sight_shares
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.sensor_array import SensorSet, sensor_array
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from inspe_jax.sensing.conditions import Case, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.lidar_returns import LidarNoise
from inspe_jax.sensing.sensors import Spec
from inspe_jax.visibility.centered_scene import about_center, poses_about_center
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.queries import check_layout
from inspe_jax.visibility.target_rays import picture_scale, rays_on_target

_AT_ONCE = 64  # points of pixel_density_at are compiled for multiples of this


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class TargetView:
    """What a layout's sensors have on one road user that stands at each of L columns.

    ``returns`` (S, L) are expected LiDAR returns of each sensor, the mean over the frames of
    traffic; ``returns_in_the_open`` (S, L) without traffic. They are 0 for cameras.
    ``pixels_per_metre`` (S, L) are those across the middle of the target, without traffic; 0 for
    LiDARs, and where the target's middle is out of the picture or of reach. ``seen`` (S, L) is
    the share of the target's height, mean over frames, that traffic leaves in line of sight.
    ``found`` (S, L) is the chance that a detector finds the target by that sensor alone, mean over
    frames.
    """

    road_user: str
    returns: Float[np.ndarray, "S L"]
    returns_in_the_open: Float[np.ndarray, "S L"]
    pixels_per_metre: Float[np.ndarray, "S L"]
    seen: Float[np.ndarray, "S L"]
    found: Float[np.ndarray, "S L"]

    @property
    def detectability(self) -> Float[np.ndarray, " L"]:
        """The chance that a detector finds the target by some sensor: 1 − ∏(1 − p)."""
        return 1.0 - np.prod(1.0 - self.found, axis=0)

    @property
    def points_on_target(self) -> Float[np.ndarray, " L"]:
        """Expected LiDAR returns of all sensors together, mean over frames."""
        return self.returns.sum(0)

    @property
    def pixel_density(self) -> Float[np.ndarray, " L"]:
        """Pixels per metre [px/m] of the camera that has most, without traffic."""
        return self.pixels_per_metre.max(0)


def target_view(
    scene: Scene | Case | str,
    layout: Layout | str,
    road_user: str = "pedestrian",
    *,
    conditions: Conditions | str | None = None,
    noise: LidarNoise | None = None,
    detection: DetectionCurves | None = None,
) -> TargetView:
    """LiDAR returns and pixels per metre on a road user that stands at each column of a scene.

    ``road_user`` is one of :data:`~inspe_jax.scene.traffic.frames.CLASSES`, in its typical size and
    with any heading. ``conditions`` shorten what a sensor reaches; ``noise`` says which returns are
    lost, as in recordings; ``detection`` has the curves of detection, the usual ones if None. A
    vehicle that stands on the target's own place does not hide it: the target is in its stead.

    Traffic is looked at slab by slab of the target's height, by the line of sight to the middle of
    the column. Raises InspeError as :func:`inspe_jax.evaluate` does, and where ``road_user`` is no
    class.
    """
    user = _road_user(road_user)
    scene, layout, conditions = check_layout(scene, layout, conditions)
    layout, grid = conditions.layout(layout), scene.voxels
    sight = _line_of_sight(scene, layout)  # (S, L, Z)
    centered = about_center(scene)
    ground = grid.ground[:, None] - grid.center[2]
    feet = jnp.asarray(np.concatenate([np.asarray(centered.columns), ground], 1), float)
    height = user.size[2]
    edges = np.arange(grid.level_count + 1) * grid.spacing
    edges[-1] = max(edges[-1], height)  # what is higher than the levels is seen as the last one
    slabs = jnp.asarray(edges, float)
    points, free, pixels, found = (np.zeros((len(layout), len(feet))) for _ in range(4))
    curves, number = detection or detection_curves(), CLASSES.index(road_user)
    for s, pose in enumerate(poses_about_center(scene, layout)):
        spec = layout.sensors[s].spec
        at = spec.grid.rays, transform_of(jnp.asarray(pose, float)), feet
        lidar = spec.focal_pixels is None
        given = (noise or LidarNoise()) if lidar else None
        on = np.asarray(rays_on_target(*at, slabs, size=user.size, noise=given))
        found[s] = _found(
            (curves.lidar if lidar else curves.camera)[number], on * spec.pixels_per_ray, sight[s]
        )
        if spec.focal_pixels is None:
            free[s], points[s] = on.sum(1), (on * sight[s]).sum(1)
        else:
            scale = picture_scale(*at, height=height / 2)
            pixels[s] = np.asarray(scale) * spec.focal_pixels
    within = np.diff(np.minimum(edges, height))
    return TargetView(road_user, points, free, pixels, sight @ (within / within.sum()), found)


def pixel_density_at(
    spec: Spec, pose: Float[np.ndarray, "6"], points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, " N"]:
    """Pixels per metre across each of N points of the world [m], of a camera at a world pose.

    As in :attr:`TargetView.pixels_per_metre`. They are 0 outside of the picture and beyond reach,
    and for LiDARs.
    """
    if spec.focal_pixels is None:
        return np.zeros(len(points))
    to = np.zeros((-(-max(len(points), 1) // _AT_ONCE) * _AT_ONCE, 3))  # few sizes to compile for
    to[: len(points)] = points - pose[:3]
    turned = transform_of(jnp.asarray([0.0, 0.0, 0.0, *pose[3:]], float))
    scale = picture_scale(spec.grid.rays, turned, jnp.asarray(to, float), height=0.0)
    return np.asarray(scale)[: len(points)] * spec.focal_pixels


def _found(
    curve: DetectionCurve, on: Float[np.ndarray, "L Z"], sight: Float[np.ndarray, "L Z"]
) -> Float[np.ndarray, " L"]:
    """The mean over frames of the chance of detection. Traffic hides a target from below, so that
    what is in sight with a level is that level and all above it, but for those that nothing shows,
    as behind a crown."""
    above = np.cumsum(np.where(sight > 0, on, 0.0)[:, ::-1], 1)[:, ::-1]
    chance = np.asarray(curve.chance(jnp.asarray(above, float)))
    return ((chance - np.pad(chance[:, 1:], ((0, 0), (0, 1)))) * sight).sum(1)


def _road_user(name: str) -> RoadUser:
    check_known(name, CLASSES, "road user")
    return ROAD_USERS[CLASSES.index(name)]


def _line_of_sight(scene: Scene, layout: Layout) -> Float[np.ndarray, "S L Z"]:
    """The share of frames in which no other vehicle hides each voxel from each sensor.

    Which voxels rays meet does not matter: all are taken to be in view.
    """
    tiled = tiled_scene_of(scene)
    sensors = sensor_array(SensorSet.of(layout), ONE_MORE)
    positions = sensors.padded(poses_about_center(scene, layout))[:, :3]
    there = np.asarray(tiled.tiles.tile.there)
    views = np.broadcast_to(there, (len(positions), *there.shape)).copy()
    views[len(layout) :] = 0
    options = ScoreOptions.of(visibility="past_others")
    found = sight_shares(tiled, views, positions, options, len(layout))
    return found.reshape(len(layout), -1, scene.voxels.level_count)
