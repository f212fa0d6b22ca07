"""The installation schedule, worked out by hand; and that a page says the same."""

import re
from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, crossing, world

from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.report import schedule
from inspe_jax.report.page import report_entry, report_page
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scoring.blind_spots import blind_spots
from inspe_jax.sensing.layout import Sensor, Unit, make_layout


@pytest.fixture(scope="module")
def layout():
    """A pole with two cameras, one on an arm of 1.5 m to the north, and a LiDAR on a second."""
    units = [Unit("corner", (9.0, 8.0, 0.0)), Unit("pole", (-9.0, 8.0, 0.0))]
    sensors = [Sensor("east", CAMERA, 0), Sensor("arm", CAMERA, 0), Sensor("top", LIDAR, 1)]
    poses = np.array([[9.0, 8.0, 5.0], [9.0, 9.5, 6.0], [-9.0, 8.0, 4.25]])
    turns = np.radians([[0, -12, 0], [3, -30, -135], [0, 0, 100]])
    poses = np.column_stack([poses, turns])
    return make_layout(sensors, units, poses, name="three")


def test_on_a_map_without_coordinates(layout):
    """Azimuths are clockwise from the y axis: yaw 0 is east, 90°."""
    place = replace(crossing(), poles=np.array([[-9.0, 8.4, 0.0]]))
    corner, pole = schedule.installation_schedule(layout, place, {"test-camera": 900.0})
    assert (corner.position, corner.degrees) == ((9.0, 8.0, 0.0), None)
    assert corner.pole == "new pole, 18 m from the nearest"
    assert (pole.pole, pole.position[:2]) == ("existing pole", (-9.0, 8.4))
    assert (pole.sensors[0].offset, pole.sensors[0].offset_azimuth) == pytest.approx((0.4, 180.0))
    assert [row.number for unit in (corner, pole) for row in unit.sensors] == [1, 2, 3]
    east, arm = corner.sensors
    of_east = (east.height, east.azimuth, east.tilt, east.roll, east.offset)
    assert of_east == pytest.approx((5.0, 90.0, 12.0, 0.0, 0.0))
    assert (arm.azimuth, arm.tilt, arm.roll) == pytest.approx((225.0, 30.0, 3.0))
    assert (arm.offset, arm.offset_azimuth) == pytest.approx((1.5, 0.0))
    assert (east.price, pole.sensors[0].price) == (900.0, None)
    assert pole.sensors[0].azimuth == pytest.approx(350.0)


def test_heights_are_above_the_ground_at_the_base(layout):
    place = crossing(slope=0.1)
    lifted = replace(layout, poses=np.asarray(layout.poses) + np.array([[0, 0, 0.9, 0, 0, 0]]))
    corner, _ = schedule.installation_schedule(lifted, place, {})
    assert corner.position[2] == pytest.approx(0.9, abs=0.05)
    assert corner.sensors[1].position == pytest.approx((9.0, 9.5))
    assert corner.sensors[0].height == pytest.approx(5.9 - corner.position[2])


def test_on_the_earth_azimuths_are_from_true_north(layout):
    """UTM's north is off by the convergence, 1.9° near Munich."""
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    place = replace(crossing(), georeference=Georeference("EPSG:32632", (-690_000.0, -5_335_000.0)))
    corner, _ = schedule.installation_schedule(layout, place, {})
    latitude, longitude = corner.degrees
    assert 48.0 < latitude < 48.3
    assert 11.4 < longitude < 11.7
    assert corner.sensors[0].azimuth == pytest.approx(91.9, abs=0.1)
    assert corner.sensors[1].offset_azimuth == pytest.approx(1.9, abs=0.1)


def test_materials_and_their_price(layout):
    rows = schedule.materials(layout, {"test-camera": 900.0})
    camera, lidar = rows
    of_camera = (camera.count, camera.price, camera.total, camera.units)
    assert of_camera == (2, 900.0, 1800.0, ("corner",))
    assert (lidar.count, lidar.price, lidar.total) == (1, None, None)
    assert schedule.total_price(rows) == (1800.0, ("test-lidar",))
    unknown = schedule.total_price(schedule.materials(layout, {}))
    assert unknown == (None, ("test-camera", "test-lidar"))
    assert schedule.sensors_in_words(layout) == "2 cameras and 1 LiDAR"


@pytest.fixture(scope="module")
def page(layout):
    scene = world(radius=12.0, voxel=1.0, count=6, frames=4, seed=1)
    entry = report_entry(Case(scene), layout, Objective())
    return report_page(scene, [entry], prices={"test-camera": 900.0}), scene, entry


def test_a_page_says_what_to_mount_where(page):
    html, scene, entry = page
    words = " ".join(
        re.sub(r"<style.*?</style>|<script.*?</script>|<[^>]+>", " ", html, flags=re.S).split()
    )
    assert "2 units with 2 cameras and 1 LiDAR watch 12 m around" in words
    assert "for 1,800 US dollars without test-lidar, of unknown price" in words
    assert "corner: x 9.00 , y 8.00 , z 0.00 m; new pole" in words
    assert "1 east test-camera 9.00 8.00 5.00 90.0 12.0 0.0 0.00 – 900" in words
    assert "2 arm test-camera 9.00 9.50 6.00 225.0 30.0 3.0 1.50 0 900" in words
    assert "--price test-lidar=USD" in words
    assert "scores, weights coverage 0.3, occlusion 0.5, information gain 0.2" in words
    assert "inspe tolerance" in words
    assert "total, without prices that are unknown 1,800" in words
    first, second, *_ = blind_spots(scene, entry.scores.seen_share)
    assert f"Most is missed on the {first.name} ({first.unseen:.0%} of time" in words
    assert f"1 {first.name} {100 * first.unseen:.0f} %" in words
    assert f"2 {second.name} {100 * second.unseen:.0f} %" in words
