"""A layout in somebody's hands: every change is as mounting allows, and can be taken back."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from worlds import CAMERA, LIDAR, world

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.space import Space
from inspe_jax.sensing.layout import Sensor, Unit, layout_text, make_layout, parse_layout
from inspe_jax.viewer.session import HEIGHT, LayoutSession

FEET = np.array([[9.0, 9.0], [-9.0, -9.0]])


def two_units(scene):
    """Two cameras on one pole in the north-east, a LiDAR on one in the south-west."""
    north, south = scene.intersection.ground(FEET).tolist()
    units = [Unit("north", (9.0, 9.0, north)), Unit("south", (-9.0, -9.0, south))]
    sensors = [Sensor("a", CAMERA, 0), Sensor("b", CAMERA, 0), Sensor("c", LIDAR, 1)]
    poses = np.array(
        [
            [9.0, 9.0, north + 6.0, 0, -0.3, -2.3],
            [9.0, 9.5, north + 7.0, 0, -0.2, 2.0],
            [-9.0, -9.0, south + 5.0, 0, 0, 0],
        ]
    )
    return make_layout(sensors, units, poses)


@pytest.fixture
def session(scene):
    return LayoutSession(scene, two_units(scene))


def pose_of(session, s):
    return np.array(session.layout.poses[s], float)


def assert_mounted(session):
    """By the map's own polygons, in a feasible set made anew; and the file can be read again."""
    assert Space(session.scene, session.layout).violations(session.layout) == []
    again = parse_layout(yaml.safe_load(layout_text(session.layout)), "x", "x")
    np.testing.assert_allclose(again.poses, session.layout.poses, atol=1e-8)


def test_a_unit_goes_with_its_sensor_in_plan_and_no_other(session):
    """Height and direction are a sensor's own."""
    before = np.array(session.layout.poses)
    pose = pose_of(session, 0) + [0.5, 1.0, 1.5, 0, -0.1, 0.4]
    shown, _ = session.moved(0, pose)
    np.testing.assert_array_equal(session.layout.poses, before)  # only looked at
    session.move(0, pose)
    np.testing.assert_array_equal(session.layout.poses, shown.poses)
    went = np.array(session.layout.poses) - before
    np.testing.assert_allclose(went[0], [0.5, 1.0, 1.5, 0, -0.1, 0.4], atol=1e-6)
    np.testing.assert_allclose(went[1], [0.5, 1.0, 0, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(went[2], 0, atol=1e-9)
    assert session.layout.units[0].base[:2] == pytest.approx((9.5, 10.0))
    assert height(session, 0) == pytest.approx(7.5, abs=1e-6)
    assert session.notes == ()
    assert_mounted(session)


def test_sensors_go_along_with_another(session):
    """One on its own unit and one on another: as far in plan, up, and round, each on its own; and
    not out of the region."""
    before = np.array(session.layout.poses)
    session.move(0, pose_of(session, 0) + [0.5, 1.0, 1.5, 0, -0.1, 0.4], along=(2, 1))
    went = np.array(session.layout.poses) - before
    np.testing.assert_allclose(went[:2], [[0.5, 1.0, 1.5, 0, -0.1, 0.4]] * 2, atol=1e-6)
    np.testing.assert_allclose(went[2, :3], [0.5, 1.0, 1.5], atol=1e-6)
    assert session.layout.units[1].base[:2] == pytest.approx((-8.5, -8.0))
    assert_mounted(session)
    assert session.undo()
    np.testing.assert_array_equal(session.layout.poses, before)
    session.move(2, pose_of(session, 2) + [22.0, 22.0, 0, 0, 0, 0], along=(0,))
    center = session.scene.voxels.center[:2]
    away = np.hypot(*(np.array(session.layout.poses)[:, :2] - center).T)
    assert (away <= session.scene.voxels.radius + 1.0).all()  # the other camera is beside its foot
    assert_mounted(session)


def test_a_number_changes_by_as_much_for_those_along(session):
    before = np.array(session.layout.poses)
    session.set_number(0, "yaw", 170.0, along=(1,))  # from -131.8 degrees: the short way round
    turned = np.degrees(np.array(session.layout.poses)[:, 5] - before[:, 5])
    change = 170.0 - np.degrees(before[0, 5])
    assert (turned[0] - change) % 360 == pytest.approx(0, abs=1e-4)
    assert turned[1] == pytest.approx(change - 360, abs=1e-4)
    session.set_number(2, "height", 7.0, along=(1,))
    went = np.array(session.layout.poses)[:, 2] - before[:, 2]
    np.testing.assert_allclose(went, [0, 2.0, 2.0], atol=1e-6)


def test_what_is_let_go_on_the_road_snaps_to_the_sidewalk(session):
    session.move(0, np.array([5.0, 11.0, 6.0, 0, -0.3, -2.3]))
    assert session.layout.poses[0, 0] == pytest.approx(7.3, abs=2e-3)  # 0.3 m from the kerb
    assert any("moved 2.30 m to the nearest mounting area" in note for note in session.notes)
    assert_mounted(session)


@pytest.mark.parametrize(("key", "typed", "said"), [
    ("x", 1000.0, "x is {x:.2f} m, not 1000 m as asked for"),
    ("y", -14.0, "y is {y:.2f} m, not -14 m as asked for"),
    ("height", 60.0, "height is 12.00 m, not 60 m as asked for"),
    ("pitch", 85.5, "pitch is 10.00°, not 85.5° as asked for"),
    ("yaw", 400.0, None),
    ("x", 9.5, None),
])  # fmt: skip
def test_what_is_typed_and_what_comes_of_it_are_said(session, key, typed, said):
    session.set_number(0, key, typed)
    assert session.notes[:1] == (() if said is None else (said.format(**numbers(session)),))
    away = pose_of(session, 0)[:2] - session.scene.voxels.center[:2]
    assert np.hypot(*away) < session.scene.voxels.radius + 1e-6
    assert_mounted(session)


def numbers(session, s=0):
    return session.numbers(session.layout, s)


def height(session, s):
    return numbers(session, s)["height"]


def test_numbers_far_off_are_brought_back_and_what_is_none_is_refused(session):
    for sign, key in zip((1, -1, 1, -1, 1), numbers(session), strict=True):
        session.set_number(0, key, sign * 1e9)
    assert np.isfinite(session.layout.poses).all()
    assert_mounted(session)
    before = session.layout
    for wrong in (np.nan, np.inf, 1e300):
        for key in numbers(session):
            with pytest.raises(InspeError, match="is not a finite number, or too large"):
                session.set_number(0, key, wrong)
    with pytest.raises(InspeError, match="no such place"):
        session.add("paper-camera", np.array([np.nan, 0.0]))
    assert session.layout is before


def test_on_a_slope_a_unit_keeps_its_heights_above_the_ground():
    """Also where its base is not on the ground: a file may give a base any height."""
    scene = world(radius=15.0, voxel=1.0, frames=2, count=4, slope=0.2)
    layout = two_units(scene)
    x, y, z = layout.units[0].base
    raised = replace(layout.units[0], base=(x, y, z + 2.0))
    session = LayoutSession(scene, replace(layout, units=(raised, layout.units[1])))
    session.move(0, pose_of(session, 0) + [1.5, 0, 0, 0, 0, 0])
    assert [height(session, s) for s in (0, 1)] == pytest.approx([6.0, 7.0], abs=1e-6)
    ground = float(scene.intersection.ground(np.array([[10.5, 9.0]]))[0])
    assert session.layout.poses[0, 2] == pytest.approx(6.0 + ground, abs=1e-6)


def test_from_a_span_wire_to_the_roadside(scene):
    """Hung over the middle it stays there; pulled far enough away it stands on a sidewalk."""
    ground = float(scene.intersection.ground(np.zeros((1, 2)))[0])
    poses = np.array([[0.0, 0.0, ground + 7.0, 0, 0, 0]])
    hung = make_layout([Sensor("a", LIDAR, 0)], [Unit("wire", (0.0, 0.0, ground))], poses)
    session = LayoutSession(scene, hung)
    assert session.faults() == []
    session.move(0, poses[0] + [1.0, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(session.layout.poses[0, :2], 0, atol=1e-6)
    session.move(0, poses[0] + [9.0, 9.0, 0, 0, 0, 0])
    np.testing.assert_allclose(session.layout.poses[0, :2], 9.0, atol=1e-3)
    assert session.faults() == []
    session.undo()
    session.undo()
    assert session.layout is hung
    assert session.faults() == []


def test_a_new_sensor_stands_on_a_unit_of_its_own_and_looks_at_the_centre(session):
    s = session.add("paper-camera", np.array([9.0, -9.0]))
    assert (s, len(session.layout.units)) == (3, 3)
    pose = pose_of(session, s)
    np.testing.assert_allclose(pose[:2], [9.0, -9.0], atol=1e-3)
    assert height(session, s) == pytest.approx(HEIGHT)
    assert np.degrees(pose[5]) == pytest.approx(135, abs=0.1)
    assert -40 < np.degrees(pose[4]) < -10
    assert_mounted(session)
    assert session.add("paper-camera", np.array([0.0, 12.0])) == 4
    (note,) = session.notes  # in the road, from where it goes to the kerb
    unit = session.layout.units[-1]
    away = np.hypot(*(np.array(unit.base[:2]) - [0.0, 12.0]))
    near = f"the nearest mounting area, {away:.2f} m from the point asked for"
    assert note == f"unit '{unit.name}' added at {near}"
    assert len({sensor.name for sensor in session.layout.sensors}) == 5
    s = session.add("paper-camera", session.scene.voxels.center[:2] + [0.0, 900.0])
    back = f"{900.0 - session.scene.voxels.radius:.2f} m back to the rim"
    assert any(back in note for note in session.notes)
    away = pose_of(session, s)[:2] - session.scene.voxels.center[:2]
    assert np.hypot(*away) < session.scene.voxels.radius + 1e-6


def test_a_copy_stands_beside_its_model_and_looks_to_its_left(session):
    s = session.duplicate(0)
    layout = session.layout
    assert [sensor.unit for sensor in layout.sensors] == [0, 0, 0, 1]
    assert (layout.sensors[s].spec, layout.sensors[s].unit) == (CAMERA, 0)
    turn = np.degrees(layout.poses[s, 5] - layout.poses[0, 5])
    assert turn == pytest.approx(0.8 * 100, abs=0.1)  # of a field of view of 100°
    np.testing.assert_allclose(layout.poses[s, :3], layout.poses[0, :3], atol=1e-6)
    lidar = session.duplicate(3)
    np.testing.assert_allclose(session.layout.poses[lidar], session.layout.poses[3], atol=1e-6)
    assert_mounted(session)


def test_a_unit_goes_with_its_last_sensor_and_the_last_sensor_stays(session):
    with pytest.raises(InspeError, match="all 3 sensors cannot be removed"):
        session.remove(0, 1, 2)
    assert not session.undo()
    session.remove(2, 0)
    assert [sensor.name for sensor in session.layout.sensors] == ["b"]
    assert [unit.name for unit in session.layout.units] == ["north"]
    assert session.notes == ("unit 'south' removed with its last sensor",)
    with pytest.raises(InspeError, match="the last sensor cannot be removed"):
        session.remove(0)
    assert session.undo()
    assert session.notes == ()
    assert not session.undo()


def test_another_device(session):
    session.swap(2, "paper-camera")
    assert session.layout.sensors[2].spec.name == "paper-camera"
    assert session.layout.sensors[2].name == "c"
    with pytest.raises(InspeError, match="paper-camera"):
        session.swap(2, "paper-camra")
    session.swap(2, LIDAR.name)  # which the catalogue has not, and the opened layout had
    assert session.layout.sensors[2].spec is LIDAR
    assert_mounted(session)


def test_every_change_can_be_taken_back_and_done_again(session):
    begun = session.layout
    steps = [begun]
    for change in (
        lambda: session.move(0, pose_of(session, 0) + [0.5, 0, 0, 0, 0, 0.3]),
        lambda: session.duplicate(0),
        lambda: session.add("paper-lidar-32", np.array([9.0, -9.0])),
        lambda: session.swap(0, "paper-camera"),
        lambda: session.remove(1),
    ):
        change()
        steps.append(session.layout)
    for layout in reversed(steps[:-1]):
        assert session.undo()
        assert session.layout is layout
    assert not session.undo()
    assert session.layout is begun
    for layout in steps[1:]:
        assert session.redo()
        assert session.layout is layout
    assert not session.redo()
    session.undo()
    session.move(0, pose_of(session, 0))
    assert not session.redo()  # another way was taken


def test_a_layout_that_breaks_a_rule_opens_and_says_which(scene):
    layout = two_units(scene)
    poses = np.array(layout.poses)
    poses[1, :2] += [4.0, 0.0]
    with pytest.raises(InspeError, match="apart in plan"):
        make_layout(list(layout.sensors), list(layout.units), poses)
    torn = make_layout(list(layout.sensors), list(layout.units), poses, unit_rule=False)
    session = LayoutSession(scene, torn)
    assert session.layout is torn
    faults = session.faults()
    assert {s for fault in faults for s in fault.sensors} == {0, 1}
    assert any("apart in plan" in fault.words for fault in faults)
    session.move(1, pose_of(session, 1))  # whatever is touched is mended
    assert session.faults() == []


def test_where_nothing_can_stand_it_is_said_and_kept(scene):
    place = scene.intersection
    bare = replace(scene, intersection=replace(place, mounting=place.mounting.buffer(-9)))
    session = LayoutSession(bare, two_units(scene))
    (fault,) = session.faults()
    assert "nowhere to stand" in fault.words
    assert fault.sensors == (0, 1, 2)
    session.move(0, pose_of(session, 0) + [1, 0, 0, 0, 0, 0])
    assert session.layout.poses[0, 0] == pytest.approx(10.0)
    assert "nowhere to stand" in session.notes[0]
