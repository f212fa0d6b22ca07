"""What a road user gets where it stands: LiDAR returns, pixels per metre, chance of detection.

It stands at each column; means over columns are :mod:`inspe_jax.scoring.target_metrics`.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.arrays import from_center, on_host, pad_rows
from inspe_jax.core.errors import check_known
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.exact import ONE_MORE, evidence_of_tiles
from inspe_jax.scoring.metric import Metric, TileEvidence, column_sums
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from inspe_jax.sensing.conditions import Case, Conditions, perceiving
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.named import check_layout
from inspe_jax.sensing.sensor_array import SensorSet, sensor_array
from inspe_jax.sensing.sensors import Spec
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.target_rays import scale_at

_AT_ONCE = 64  # points of pixel_density_at are compiled for multiples of this


@jax.jit
def _scale_at(rays: Any, pose: Float[Array, "6"], points: Any) -> Any:
    """:func:`scale_at` from a pose."""
    return scale_at(rays, transform_of(pose), tuple(points))


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class TargetView:
    """What a layout's sensors have on one road user that stands at each of L columns.

    ``returns`` are expected LiDAR returns of each sensor, the mean over frames; 0 for others.
    ``pixels_per_metre`` are those across the middle of the target, without traffic; 0 for others,
    and where the middle is out of the picture or of reach. ``found`` is the chance that a detector
    finds the target by that sensor alone, mean over frames.
    """

    road_user: str
    returns: Float[np.ndarray, "S L"]
    pixels_per_metre: Float[np.ndarray, "S L"]
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


def _returns_and_chance(at: TileEvidence) -> Float[Array, "S 2 K C"]:
    return jnp.stack([at.targets.returns, at.targets.chance], 1)


_MAP = Metric("target_view", "", 0.0, "", lambda _: jnp.zeros(1), _returns_and_chance, sight=True)


def target_view(
    scene: Scene | Case | str,
    layout: Layout | str,
    road_user: str = "pedestrian",
    *,
    conditions: Conditions | str | None = None,
    detection: DetectionCurves | None = None,
) -> TargetView:
    """LiDAR returns and pixels per metre on a road user that stands at each column of a scene.

    A vehicle that stands on the target's own place does not hide it: the target is in its stead.
    Traffic is looked at slab by slab of the target's height, by the line of sight to the middle of
    the column.

    Args:
        scene, layout: As in :func:`inspe_jax.evaluate`, also by name.
        road_user: One of :data:`~inspe_jax.scene.traffic.frames.CLASSES`, in its typical size and
            with any heading.
        conditions: Light and weather, which shorten what a sensor reaches.
        detection: Curves of detection, the usual ones if None.

    Returns:
        What each sensor has on the road user at each column.

    Raises:
        InspeError: The road user is unknown, or as :func:`inspe_jax.evaluate`.

    >>> view = inspe_jax.target_view(scene, layout, "pedestrian")
    >>> view.pixels_per_metre.shape, round(float(view.detectability.mean()), 2)
    ((8, 172), 0.73)
    """
    check_known(road_user, CLASSES, "road user")
    curves = None if detection is None else detection.for_road_users(())
    scene, layout, conditions = check_layout(scene, layout, conditions)
    layout = perceiving(scene, layout, conditions)
    tiled, sensors = tiled_scene_of(scene), sensor_array(SensorSet.of(layout), ONE_MORE)
    poses = pad_rows(from_center(scene.voxels.center, layout.poses), len(sensors.kind))
    options = ScoreOptions.of(names=(), detection=curves)._replace(metrics=(_MAP,))
    *_, terms = evidence_of_tiles(tiled, poses, sensors, scene.voxels.size, options)
    columns = column_sums(terms[_MAP.name], tiled.tiles.slabs)
    number, grid = CLASSES.index(road_user), scene.voxels
    returns, chance = columns[: len(layout), :, number].swapaxes(0, 1)
    middles = np.column_stack([grid.columns, grid.ground + ROAD_USERS[number].size[2] / 2])
    pairs = zip(layout.sensors, layout.poses, strict=True)
    pixels = [pixel_density_at(sensor.spec, pose, middles) for sensor, pose in pairs]
    place = np.asarray(tiled.tiles.place)
    return TargetView(road_user, returns[:, place], np.stack(pixels), chance[:, place])


def pixel_density_at(
    spec: Spec, pose: Float[np.ndarray, "6"], points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, " N"]:
    """Pixels per metre across each of N points of the world [m], of a camera at a world pose.

    As in :attr:`TargetView.pixels_per_metre`: 0 out of the picture or reach, and for LiDARs.
    """
    if spec.focal_pixels is None:
        return np.zeros(len(points))
    to = np.zeros((3, -(-max(len(points), 1) // _AT_ONCE) * _AT_ONCE))  # few sizes to compile for
    to[:, : len(points)] = (points - pose[:3]).T
    scale, depth = map(np.asarray, _scale_at(spec.grid.rays, on_host(pose, float), on_host(to)))
    return np.where(depth > 0, scale, 0.0)[: len(points)] * spec.focal_pixels
