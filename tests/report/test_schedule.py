"""The installation schedule, worked out by hand; and what a page says to who mounts it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, crossing, world

from inspe_jax import built_in
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.report import schedule
from inspe_jax.report.page import FACTS, report_entry, report_page, template
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.statics import pole
from inspe_jax.scoring.blind_spots import blind_spots
from inspe_jax.sensing.catalogue import device
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
    markup = r"<style.*?</style>|<script.*?</script>|<[^>]+>"
    page_words = " ".join(re.sub(markup, " ", html, flags=re.S).split())
    first, second, *_ = blind_spots(scene, entry.scores.seen_share)
    for words in (
        "2 units with 2 cameras and 1 LiDAR watch 12 m around",
        "for 1,800 US dollars without test-lidar, of unknown price",
        "corner: x 9.00 , y 8.00 , z 0.00 m; new pole",
        "1 east test-camera 9.00 8.00 5.00 90.0 12.0 0.0 0.00 – 900",
        "2 arm test-camera 9.00 9.50 6.00 225.0 30.0 3.0 1.50 0 900",
        "--price test-lidar=USD",
        "scores, weights coverage 0.3, occlusion 0.5, information gain 0.2",
        "total, without prices that are unknown 1,800",
        f"Most is missed on the {first.name} ({first.unseen:.0%} of time",
        f"1 {first.name} {100 * first.unseen:.0f} %",
        f"2 {second.name} {100 * second.unseen:.0f} %",
    ):
        assert words in page_words


# ── What depends on the scene ──


def rendered(name, **about):
    return " ".join(template("report", name).render(**FACTS, **about).split())


def test_what_the_plan_leaves_open(layout):
    """Where a sensor is on the axis of a pole; where poles hide something, or nobody knows."""
    scene = world(radius=12.0, voxel=2.0, count=2, frames=2, seed=1)
    bare, on_axis = "no pole, arm or housing hides", "what the pole then hides, the scores count"
    unknown, bodies = "How high existing poles are is not", "only poles that are bodies of the"
    off = np.asarray(layout.poses) + [0, 1.0, 0, 0, 0, 0]
    there = replace(scene.intersection, poles=np.array([[9.0, 8.0, 0.0]]))
    for of, poses, said in (
        (scene, off, {bare}),
        (scene, layout.poses, {bare, on_axis}),
        (replace(scene, intersection=there), off, {bare, unknown}),
        (scene.with_statics([pole((-9.0, 9.0), radius=0.1, height=6.0)]), off, {bodies}),
    ):
        units = schedule.installation_schedule(layout.with_poses(poses), of.intersection, {})
        words = rendered("mounting.html.j2", scene=of, units=units)
        assert {part for part in (bare, on_axis, unknown, bodies) if part in words} == said


def test_coordinates_are_those_of_a_built_in_place_a_map_or_a_projection():
    far, sea = ("EPSG:32632", (-690_000.0, 12.5)), ("+proj=tmerc +lat_0=0 +lon_0=0",)
    shifted, doubted = "the projection EPSG:32632, plus -690000.00 and 12.50;", "But coordinates"
    for place, said, unsaid in (
        (built_in("four_way"), "x and y are 0 in the middle of the junction, and z on", "map"),
        (replace(crossing(), source="a.xodr"), "the coordinates of the map a.xodr; z is", "less"),
        (replace(crossing(), source="a.net.xml (SUMO)"), "less its netOffset", doubted),
        (replace(crossing(), georeference=Georeference(*far)), shifted, doubted),
        (replace(crossing(), georeference=Georeference(far[0])), "projection EPSG:32632;", "plus"),
        (replace(crossing(), georeference=Georeference(*sea)), f"{doubted} are in the sea", "plus"),
    ):
        words = rendered("origin.html.j2", place=place)
        assert said in words
        assert unsaid not in words


def test_a_model_cannot_be_bought():
    """The paper's devices; not those of makers, nor those that a layout describes."""
    names = "paper-camera", "paper-lidar-32", "velodyne-vlp-16"
    specs = [*(device(name).spec for name in names), CAMERA]
    sensors = [Sensor(spec.name, spec, 0) for spec in specs]
    poses = np.zeros((4, 6)) + [[0, 0, 5.0 + k, 0, 0, 0] for k in range(4)]
    rows = schedule.materials(make_layout(sensors, [Unit("corner", (0.0, 0.0, 0.0))], poses), {})
    assert [row.product for row in rows] == [False, False, True, True]
    about = {spec.name: spec for spec in specs}
    _, words, of_lidar = rendered("models.html.j2", materials=rows, specs=about).split("<p")
    assert "paper-camera is a model and cannot be bought." in words
    assert "800 × 600 pixels, a field of view of 100° × 84° and a reach of 38 m." in words
    low, high = np.degrees(specs[1].elevations)[[0, -1]]
    assert f"32 channels at elevations from {low:.1f}° to {high:.1f}°" in of_lidar
