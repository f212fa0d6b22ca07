"""LiDAR returns and pixels a metre: against rays cast into traffic with Embree, and by hand."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import (
    CAMERA,
    LIDAR,
    box_triangles,
    emptied,
    place_sensors,
    triangles,
    with_boxes,
    world,
)

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.report.targets import PIXELS, banded, targets_change, targets_record, targets_view
from inspe_jax.scene.statics import body, octagon
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.scoring.detection import BANDS, detection_curves
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing.lidar_returns import LidarNoise

SIZE = dict(radius=20.0, voxel=0.5, frames=6)
KEPT = 1.0 - LidarNoise().lost
"""Share of returns that come back from so near that none is weak."""


@pytest.fixture(scope="module")
def scene():
    return world(**SIZE, count=10, seed=7)


@pytest.fixture(scope="module")
def coarse():
    """Where numbers are not compared with rays."""
    return world(**SIZE | dict(voxel=1.0), count=10, seed=7)


@pytest.fixture(scope="module")
def lidars():
    return place_sensors(
        (LIDAR, [9.0, 9.0, 5.0, 0.0, 0.0, 0.3]), (LIDAR, [-9.0, -9.0, 4.0, 0.0, 0.03, 1.0])
    )


@pytest.mark.parametrize("name", ["pedestrian", "car"])
def test_returns_behind_traffic_are_those_of_rays_that_are_cast(scene, lidars, name):
    """Some columns, six frames, eight headings: rays that meet the target before any vehicle.

    In the mean over these columns within 5 %, and each within 15 % and three returns: traffic hides
    whole slabs here, by the line to the middle of the column, and parts of slabs there.
    """
    caster = pytest.importorskip("inspe_jax.simulation.embedded.embree").Caster
    pytest.importorskip("embreex")
    user = ROAD_USERS[CLASSES.index(name)]
    view, open_ = (target_view(of, lidars, name) for of in (scene, emptied(scene)))
    traffic, columns = scene.traffic, scene.voxels.columns
    away = np.abs(columns[:, None, None] - traffic.center[None, ..., :2]).max(-1)
    free = np.where(traffic.valid[None], away, 99.0).min((1, 2)) > 4.0
    rng = np.random.default_rng(0)
    chosen = rng.choice(np.flatnonzero(free), 8, replace=False)
    body, found = LIDAR.grid.directions(), np.zeros(len(chosen))
    headings = np.arange(8) * np.pi / 8 + 0.1
    for k in range(traffic.frame_count):
        around = triangles(scene, k)
        for i, column in enumerate(chosen):
            for yaw in headings:
                target = box_triangles((*columns[column], 0.0), user.size, yaw)
                world_of = caster(np.concatenate([target, around]))
                for pose in np.asarray(lidars.poses):
                    to = [*columns[column], 1.0] - pose[:3]
                    toward = body @ (rotation(pose[3:], np).T @ to) / np.linalg.norm(to)
                    near = body[toward > np.cos(min(2.5, 4.0 / np.linalg.norm(to[:2]) + 0.3))]
                    hits = world_of.cast(pose[:3], near @ rotation(pose[3:], np).T, 50.0)
                    found[i] += ((hits.face >= 0) & (hits.face < 12)).sum()
    found /= traffic.frame_count * len(headings)
    expected = view.points_on_target[chosen] / KEPT
    assert (expected < 0.98 * open_.points_on_target[chosen] / KEPT).sum() >= 3
    assert expected.mean() == pytest.approx(found.mean(), rel=0.05)
    np.testing.assert_allclose(expected, found, rtol=0.15, atol=3.0)


def test_pixels_per_metre_by_hand():
    """f / depth in the middle of the picture; nothing behind the camera or out of reach."""
    scene = world(radius=35.0, voxel=1.0, count=0)
    layout = place_sensors((CAMERA, [0.5, 0.5, 0.86, 0.0, 0.0, 0.0]))
    view = target_view(scene, layout)
    columns = scene.voxels.columns
    ahead = np.flatnonzero((columns[:, 1] == 0.5) & (columns[:, 0] > 1))
    depth = columns[ahead, 0] - 0.5
    expected = np.where(depth < 30.0, CAMERA.focal / depth, 0.0)
    np.testing.assert_allclose(view.pixel_density[ahead], expected, rtol=1e-4)
    assert not view.pixel_density[columns[:, 0] < 0].any()
    assert not view.points_on_target.any()
    # Aside it is more: a metre square on to the line of sight is further across the picture.
    aside = np.flatnonzero((columns == [10.5, 5.5]).all(1))
    away = np.hypot(10.0, 5.0)
    across = CAMERA.focal * away / 10.0**2  # d(y/x) over a metre along (−5, 10)/away
    assert view.pixel_density[aside][0] == pytest.approx(across, rel=1e-4)


@pytest.mark.parametrize("roll", [0.6, np.pi / 2])
def test_a_rolled_camera_has_as_many_pixels(roll):
    scene = emptied(world(**SIZE))
    ahead = (scene.voxels.columns == [10.25, 0.25]).all(1)
    level, rolled = (
        place_sensors((CAMERA, [0.25, 0.25, 0.86, of, 0.0, 0.0])) for of in (0.0, roll)
    )
    expected = target_view(scene, level).pixel_density[ahead]
    np.testing.assert_allclose(target_view(scene, rolled).pixel_density[ahead], expected, 1e-4)


def test_who_is_higher_than_the_region_is_not_cut(coarse, lidars):
    """Levels of 3 m end below a truck's roof of 3.4 m."""
    low = world(**SIZE | dict(voxel=1.0), spacing=3.0)
    fine, cut = (target_view(emptied(of), lidars, "truck").points_on_target for of in (coarse, low))
    assert cut.mean() == pytest.approx(fine.mean(), rel=0.05)


def test_a_wall_of_a_truck_hides_a_pedestrian(scene):
    wall = with_boxes(scene, (0.0, 5.0, 0.0, 30.0, 1.0, 3.9), frames=6)
    one = place_sensors((LIDAR, [0.0, 9.0, 3.0, 0.0, 0.0, 0.0]))
    south = (scene.voxels.columns == [0.25, -5.75]).all(1)
    open_, behind = (target_view(of, one).returns[0, south] for of in (emptied(scene), wall))
    assert open_ > 10 * KEPT
    assert behind == 0.0


def test_fog_takes_what_is_far(coarse, lidars):
    fog = inspe_jax.Conditions.of(weather="fog:50")
    clear, dim = target_view(coarse, lidars), target_view(coarse, lidars, conditions=fog)
    assert dim.points_on_target.sum() < 0.9 * clear.points_on_target.sum()
    assert (dim.returns <= clear.returns + 1e-4).all()


def test_who_is_no_road_user_is_named(scene, lidars):
    with pytest.raises(InspeError, match="did you mean pedestrian"):
        target_view(scene, lidars, "pedestrain")


def test_bands_and_records():
    kinds = banded("", np.array([0.0, 12.4, 12.5, 62.5, 249.0, 1e3]), PIXELS).values
    assert kinds.tolist() == [0, 0, 1, 3, 4, 5]
    assert list(BANDS.values()) == [12.5, 25.0, 62.5, 125.0, 250.0]  # EN 62676-4


def test_the_map_has_one_panel_for_each_kind_of_sensor(coarse, lidars):
    """And one for the chance of detection where there is only one kind."""
    view = target_view(coarse, lidars)
    assert len(targets_view(coarse, lidars, view).axes) == 2
    assert "pixels_per_metre" not in targets_record(coarse, lidars, view)
    with pytest.raises(InspeError, match="frame 99 is out of range"):
        targets_view(coarse, lidars, view, frame=99)
    blind = place_sensors((CAMERA, [9.0, 9.0, 5.0, 0, 0.5, 0.8]))
    view = target_view(coarse, blind)
    assert not view.pixel_density.any()
    assert view.detectability.mean() < 0.01
    assert len(targets_view(coarse, blind, view).axes) == 2
    both = place_sensors((LIDAR, [9.0, 9.0, 5.0, 0, 0, 0]), (CAMERA, [9.0, -9.0, 5.0, 0, -0.2, 2]))
    view = target_view(coarse, both)
    assert len(targets_view(coarse, both, view).axes) == 2
    record = targets_record(coarse, both, view)
    shares = record["lidar_returns"]["all"]["shares"]
    values = view.points_on_target
    assert shares["at least 5"] == pytest.approx((values >= 5).mean())
    assert set(record["pixels_per_metre"]["all"]["shares"]) == set(BANDS)
    assert record["detectability"]["all"] == pytest.approx(view.detectability.mean())
    assert len(targets_change(coarse, (both, view), (both, view)).axes) == 4


def test_a_target_is_found_by_what_is_in_sight_of_it():
    """Behind a truck all of a pedestrian is hidden; behind a car, what is above it is found."""
    open_ = emptied(world(**SIZE))
    layout = place_sensors((LIDAR, [-15.0, 0.25, 4.0, 0.0, 0.0, 0.0]))
    place = np.flatnonzero((open_.voxels.columns == [6.25, 0.25]).all(1))[0]
    found = []
    for height in (None, 1.2, 3.6):
        car = (3.5, 0.25, 0, 3.0, 2.5, height)
        scene = open_ if height is None else with_boxes(open_, car, frames=6)
        found.append(target_view(scene, layout, "pedestrian").detectability[place])
    assert found[0] > found[1] > 0.1
    assert found[2] == 0


def test_what_is_in_sight_below_a_crown_counts_for_itself():
    """A beam hides all but the feet of a pedestrian from a low LiDAR in all frames."""
    scene = emptied(world(**SIZE))
    beam = body("building", octagon(np.array([-6.0, 0.25]), 2.5), 4.0, base=1.0)
    layout = place_sensors((LIDAR, [-15.0, 0.25, 1.2, 0.0, 0.0, 0.0]))
    place = (scene.voxels.columns == [3.25, 0.25]).all(1)
    open_, below = (target_view(of, layout) for of in (scene, replace(scene, statics=(beam,))))
    returns = below.points_on_target[place]
    assert 0.2 < returns / open_.points_on_target[place] < 0.8
    chance = detection_curves().of("lidar")[CLASSES.index("pedestrian")].chance(returns)
    assert below.detectability[place] == pytest.approx(float(chance[0]), rel=1e-5)
