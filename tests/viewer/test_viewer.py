"""The page's server without a browser: what its handle and its buttons ask for."""

import asyncio
import threading
from base64 import b64decode
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from page_socket import enter, socket_of, wait_until
from page_socket import set_value as send_value
from PIL import Image as Pillow
from scipy.spatial.transform import Rotation

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.points_in_boxes import world_points
from inspe_jax.placement.problem import Case
from inspe_jax.scene.statics import upright_box
from inspe_jax.scoring.blind_spots import blind_spots
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Unit, load_layout
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.frame import Image
from inspe_jax.simulation.recorder import Recording
from inspe_jax.viewer import sensor_view
from inspe_jax.viewer.app import Viewer
from inspe_jax.viewer.blind_spot_panel import LETTERS, plan_picture
from inspe_jax.viewer.panel import set_value
from inspe_jax.viewer.scene3d import BROKEN_COLOR, HandleDrag, Scene3D, rgb
from inspe_jax.viewer.score_panel import LEGEND
from inspe_jax.viewer.sensor_view import image_size
from inspe_jax.viewer.workers import SearchEnding

AHEAD, LEFT, UP = np.eye(3)
YAW = np.radians(-100)


@pytest.fixture
def viewer(scene, layout, tmp_path, monkeypatch, plain_plan):
    """A page with a browser that is not there. What is typed waits until it is settled."""
    monkeypatch.setattr("inspe_jax.viewer.browser_view.TYPED", 600.0)
    found = Viewer(Case(scene), layout, tmp_path / "layout.yaml", port=0)
    found.told = []
    found.display.notify = lambda *words: found.told.append(words)
    found.view = opened(found)
    yield found
    found.close()


def opened(viewer):
    """The view of a browser that is not there: it has the server's panel and scene."""
    views = []
    client = SimpleNamespace(client_id=-1, gui=viewer.server.gui, scene=viewer.server.scene)
    viewer.queue.submit(lambda: views.append(viewer.open_view(client)))
    done(viewer)
    return views[0]


def done(viewer, true=lambda: True):
    """Wait until the queue has done what it was asked and what follows, and something holds."""

    def held():
        empty = threading.Event()
        viewer.queue.submit(lambda: viewer.queue.submit(empty.set))
        empty.wait()
        return true()

    wait_until(held)


def about(axis, degrees):
    """The handle's turn by so much about one of its own axes, from where it stands upright."""
    rotvec = np.radians(degrees) * axis
    return rotation(np.array([0, 0, YAW]), np) @ Rotation.from_rotvec(rotvec).as_matrix()


def pull(viewer, shift=(0, 0, 0), turn=None, phases=("start", "update", "end"), at=None):
    at = np.array(viewer.layout.poses[viewer.view.in_hand, :3]) if at is None else at
    turn = about(UP, 0) if turn is None else turn
    for phase in phases:
        to = at if phase == "start" else at + shift
        viewer.queue.submit(
            lambda phase=phase, to=to: viewer.view.drag(HandleDrag(phase, to, turn))
        )
    done(viewer)


@pytest.mark.parametrize(("axis", "degrees", "yaw", "pitch"), [
    (UP, 30, 30, 0), (LEFT, -12, 0, 12), (LEFT, 12, 0, -12), (AHEAD, 90, 0, 0),
])  # fmt: skip
def test_rings_turn_by_yaw_and_pitch_and_never_roll(layout, axis, degrees, yaw, pitch):
    """Nose-up is a turn about the axis to the left by a negative angle."""
    pose, away = np.array(layout.poses[0], float), np.array([1.0, 2.0, 3.0])
    turned = HandleDrag("end", pose[:3] + away, about(axis, degrees)).on(pose)
    np.testing.assert_allclose(turned[:3], pose[:3] + away)
    np.testing.assert_allclose(np.degrees(turned - pose)[3:], [0, pitch, yaw], atol=1e-3)


def test_a_drag_is_of_the_sensor_that_it_began_on(viewer, layout):
    """Another browser takes another sensor in hand meanwhile, or changes the layout."""
    at = np.array(layout.poses[0, :3]) + [0, 0, 1.0]
    pull(viewer, (0, 0, 1.0), phases=("start", "update"))
    viewer.view.select(1)
    pull(viewer, phases=("end",), at=at)
    assert viewer.layout.poses[0, 2] == pytest.approx(7.0, abs=1e-6)
    np.testing.assert_allclose(viewer.layout.poses[1], layout.poses[1], atol=1e-6)

    viewer.view.select(0)
    done(viewer)
    pull(viewer, (0, 0, 1.0), phases=("start", "update"))
    viewer.change(lambda: viewer.session.remove(1))
    pull(viewer, (0, 0, 3.0), phases=("end",), at=at)
    assert len(viewer.layout) == 1
    assert viewer.layout.poses[0, 2] == pytest.approx(7.0, abs=1e-6)


def test_what_is_undone_to_what_was_opened_leaves_no_file(viewer, layout):
    """And a click on the handle is no change."""
    pull(viewer, phases=("start", "end"))
    assert viewer.layout is layout
    assert not list(viewer.store.path.parent.glob("*unsaved*"))
    pull(viewer, (0, 0, 1.0))
    assert viewer.store.unsaved.is_file()
    viewer.undo_or_redo("Undo")
    done(viewer)
    assert viewer.layout is layout
    assert not list(viewer.store.path.parent.glob("*unsaved*"))
    viewer.undo_or_redo("Undo")
    done(viewer)
    assert viewer.told[-1][:2] == ("Undo", "there is nothing more to undo")


def test_where_nothing_can_be_kept_the_page_goes_on(viewer):
    viewer.store.path = viewer.store.path.parent / "gone" / "layout.yaml"
    pull(viewer, (0, 0, 1.0))
    assert viewer.layout.poses[0, 2] == pytest.approx(7.0, abs=1e-6)
    done(viewer, lambda: viewer.display.scored and viewer.display.scored.layout is viewer.layout)
    assert viewer.told[-1][0] == "That failed"
    assert "gone" in viewer.told[-1][1]


def test_a_search_that_fails_leaves_its_best(viewer, layout, monkeypatch):
    better = replace(layout, poses=np.array(layout.poses) + [0, 0, 1.0, 0, 0, 0])
    monkeypatch.setattr(viewer.searcher, "start", lambda *_: None)
    viewer.optimise()
    done(viewer, lambda: viewer.searching)
    viewer.searcher._found(better, 0.9)
    viewer.searcher._ended(SearchEnding(better, 0.8, 0.9, "too large", failed=True))
    done(viewer, lambda: viewer.told)
    assert not viewer.searching
    assert viewer.panel.course.content.startswith("Failed: too large: P_sm 0.8000 → 0.9000")
    assert viewer.layout is better
    assert any("too large" in words and color == "red" for _, words, color in viewer.told)
    np.testing.assert_allclose(load_layout(viewer.store.unsaved).poses, better.poses, atol=1e-8)


def test_nothing_is_changed_or_saved_while_a_search_runs(viewer, layout, monkeypatch):
    monkeypatch.setattr(viewer.searcher, "start", lambda *_: None)
    viewer.optimise()
    better = replace(layout, poses=np.array(layout.poses) + [0, 0, 1.0, 0, 0, 0])
    viewer.searcher._found(better, 0.9)
    done(viewer, lambda: viewer.view.controls.add.disabled)
    for control in (viewer.panel.save, viewer.panel.report, viewer.panel.target):
        assert control.disabled
    viewer.save()
    viewer.view.remove()
    viewer.undo_or_redo("Undo")
    pull(viewer, (0, 0, 1.0))
    assert viewer.layout is layout
    assert not viewer.store.path.exists()
    kept = load_layout(viewer.store.unsaved)  # the search's best so far
    np.testing.assert_allclose(kept.poses, better.poses, atol=1e-8)
    same = replace(layout, name="layout, optimised")
    viewer.searcher._ended(SearchEnding(same, 0.5, 0.5, "ended"))
    done(viewer, lambda: not viewer.panel.save.disabled)
    assert viewer.layout is layout
    assert viewer.told[-1][:2] == ("Search", "ended: P_sm stays at 0.5000 in 0 s, with compiling")


def test_numbers_typed_one_after_another_all_count(viewer, layout):
    """Also the last, when the page is closed."""
    viewer.view.type_number("height", 1.0)  # on the way to 10
    viewer.view.type_number("height", 10.0)
    viewer.view.type_number("yaw", -90.0)
    viewer.settle()
    done(viewer)
    wanted = np.array(layout.poses)
    wanted[0, 2], wanted[0, 5] = 10.0, np.radians(-90)
    np.testing.assert_allclose(viewer.layout.poses, wanted, atol=1e-6)
    assert [viewer.session.undo() for _ in range(3)] == [True, True, False]
    viewer.view.type_number("height", 60.0)
    viewer.settle()
    done(viewer, lambda: "height is 12.00 m, not 60 m as asked" in viewer.panel.notes.content)
    viewer.view.type_number("yaw", 30.0)
    viewer.close()
    kept = load_layout(viewer.store.unsaved)
    assert np.degrees(kept.poses[0, 5]) == pytest.approx(30.0)


def test_what_is_typed_counts_before_whatever_is_pressed(viewer, monkeypatch):
    """Nobody waits the moment for which more may be typed: the press is what counts."""
    for name in ("add", "swap"):
        monkeypatch.setattr(viewer.view, name, lambda *_: None)
    begun, client = [], SimpleNamespace(camera=None, send_file_download=lambda *_, **__: None)
    monkeypatch.setattr(viewer.searcher, "start", lambda *told: begun.append(told))
    set_value(viewer.panel.target, 0.9)
    monkeypatch.setattr("inspe_jax.viewer.app.report_entry", lambda *_, **__: None)
    monkeypatch.setattr("inspe_jax.viewer.app.report_page", lambda *_, **__: "")
    own, panel = viewer.view.controls, viewer.panel
    pressed = panel.save, panel.report, own.existing, own.add, own.device, panel.optimise
    for yaw, control in enumerate(pressed, 10):
        viewer.view.type_number("yaw", float(yaw))
        for called in control._impl.update_cb:
            asyncio.run(called(SimpleNamespace(client=client, client_id=-1)))
        done(viewer)
        assert np.degrees(viewer.layout.poses[0, 5]) == pytest.approx(yaw)
        viewer.view.select(0)  # and not the copy that was asked for
        done(viewer)
    saved = load_layout(viewer.store.path)
    assert np.degrees(saved.poses[0, 5]) == pytest.approx(10.0)
    assert begun == [(viewer.layout, panel.method.value, 60.0, 0.9)]


def test_what_is_typed_counts_before_a_drag_and_a_click(viewer, layout):
    at = np.array(layout.poses[0, :3])
    viewer.view.type_number("yaw", -90.0)
    viewer.view.on_drag(HandleDrag("start", at, about(UP, 0)))
    for phase in ("update", "end"):
        viewer.view.on_drag(HandleDrag(phase, at + [0, 0, 1.0], about(UP, 0)))
    done(viewer)
    assert viewer.layout.poses[0, 2] == pytest.approx(layout.poses[0, 2] + 1.0)
    viewer.view.type_number("height", 4.0)
    (clicked, *_) = viewer.scene3d.drawn["sensors/2/device"]._impl.click_cb
    asyncio.run(clicked.callback(SimpleNamespace(client_id=-1)))
    done(viewer)
    assert viewer.layout.poses[0, 2] == pytest.approx(4.0)
    assert viewer.view.in_hand == 1


def test_a_new_sensor_stands_where_one_looks(viewer):
    viewer.view.client = SimpleNamespace(camera=SimpleNamespace(look_at=np.array([9.0, -9.0, 0.0])))
    viewer.view.add("paper-lidar-32")
    done(viewer, lambda: len(viewer.layout) == 3)
    np.testing.assert_allclose(viewer.layout.poses[2, :2], [9.0, -9.0], atol=1e-2)


def test_a_report_is_sent_to_who_asks_with_the_layout_that_was_opened_and_the_target(
    viewer, scene, layout, monkeypatch
):
    sent = []
    browser = SimpleNamespace(send_file_download=lambda *told, **_: sent.append(told))
    set_value(viewer.panel.target, 0.95)
    higher = replace(layout, poses=np.array(layout.poses) + [0, 0, 0.5, 0, 0, 0])
    viewer.change(lambda: viewer.session.take(higher))
    viewer.write_report(browser)
    done(viewer, lambda: sent and not viewer.panel.report.disabled)
    page = viewer.store.path.with_suffix(".html").read_text()
    assert sent == [("layout.html", page.encode())]
    before, after = (evaluate(scene, of).surrogate for of in (layout, viewer.layout))
    assert f"P_sm is {after:.4f}; before, it was {before:.4f} ({after - before:+.4f})." in page
    assert "The target for P_sm, 0.95, is" in page
    fails = Mock(side_effect=InspeError("no room"))
    monkeypatch.setattr("inspe_jax.viewer.app.report_entry", fails)
    viewer.write_report(browser)
    done(viewer, lambda: viewer.told[-1][1] == "no room" and not viewer.panel.report.disabled)
    assert len(sent) == 1


def test_a_layout_that_breaks_a_rule_opens_in_red_and_says_why(scene, layout, tmp_path, plain_plan):
    """What is touched is mended."""
    poses = np.array(layout.poses)
    poses[0, 2] = 20.0
    with closing(
        Viewer(Case(scene), replace(layout, poses=poses), tmp_path / "x.yaml", port=0)
    ) as found:
        view = opened(found)
        assert "This layout cannot be mounted" in found.panel.scores.content
        assert "is 20.00 m above the ground, not 3 to 12" in found.panel.scores.content
        assert found.scene3d.drawn["numbers/1"].text == "1 !"
        assert tuple(found.scene3d.drawn["sensors/1/device"].color) == rgb(BROKEN_COLOR)
        view.type_number("yaw", 0.0)
        found.settle()
        done(found, lambda: "cannot be mounted" not in found.panel.scores.content)
        assert found.layout.poses[0, 2] == pytest.approx(12.0, abs=1e-2)


def test_a_column_has_the_tint_that_most_of_its_voxels_are_of_and_hidden_ones_are_boxes(viewer):
    """So no tint lies on another one, and none hides a box."""
    grid = viewer.case.scene.voxels
    scene3d = Scene3D(viewer.server.scene, viewer.case.scene)
    kinds = np.full((len(grid.columns), grid.level_count), Visibility.OUT_OF_VIEW)
    kinds[:, 0], kinds[:5] = Visibility.HIDDEN, Visibility.SEEN
    scene3d.draw_voxels(kinds.ravel(), Visibility)

    def columns(kind):
        meshes = [
            mesh for name, mesh in scene3d.drawn.items() if name.startswith(f"voxels/{kind}/")
        ]
        return sum(len(mesh.faces) for mesh in meshes) // 2

    assert (columns("seen"), columns("out of view")) == (5, len(kinds) - 5)
    boxes = scene3d.drawn["voxels/hidden"].batched_scales
    np.testing.assert_allclose(boxes[:, 2], np.full(len(kinds) - 5, grid.spacing))


def test_bodies_stand_on_the_ground_where_they_are(viewer):
    scene = viewer.case.scene
    house = upright_box("building", scene.voxels.center[:2] + [8.0, 3.0], (4.0, 2.0, 5.0))
    drawn = Scene3D(viewer.server.scene, scene.with_statics([house])).drawn["ground/building"]
    low, high = drawn.vertices.min(0), drawn.vertices.max(0)
    level = scene.intersection.ground(house.middle[None])[0] - scene.voxels.center[2]
    np.testing.assert_allclose([*low[:2], *high], [6.0, 2.0, 10.0, 4.0, level + 5.0], atol=1e-3)
    assert low[2] < level


def test_a_unit_has_a_number_for_each_of_its_sensors_and_none_without(viewer):
    drawn = viewer.scene3d.drawn
    double = viewer.session.duplicate(0)
    bare = (*viewer.layout.units, Unit("spare", (0.0, 0.0, 0.0)))
    viewer.scene3d.draw_layout(replace(viewer.layout, units=bare), [double])
    numbers = [(name, drawn[name].text) for name in drawn if name.startswith("numbers/")]
    assert numbers == [("numbers/1", "1  2 !"), ("numbers/2", "3")]


def test_sensors_that_are_selected_together_move_turn_and_go_together(viewer, layout):
    view, before = viewer.view, np.array(layout.poses)
    view.select(1, toggle=True)
    done(viewer)
    assert view.selection == (0, 1)  # the last one has the handle
    done(viewer, lambda: view.controls.name.value == layout.sensors[1].name)
    assert view.controls.table.content.count("☑") == 2
    for outline, k in zip(view.selection3d.outlines, (1, 2), strict=True):
        drawn = viewer.scene3d.drawn[f"sensors/{k}/view"]
        np.testing.assert_array_equal(outline.points, drawn.points)
        assert outline.visible
    pull(viewer, (0.3, 0.4, 1.0), np.eye(3))
    view.type_number("height", 5.0)  # of the one in hand, from 6 m: down, both
    viewer.settle()
    done(viewer)
    went = np.array(viewer.layout.poses) - before
    np.testing.assert_allclose(went[:, :3], [[0.3, 0.4, 0.0]] * 2, atol=1e-6)
    view.remove()
    done(viewer, lambda: viewer.told)
    assert "at least one" in viewer.told[-1][1]
    view.select(1, toggle=True)
    view.select(0, toggle=True)  # the last one stays
    done(viewer, lambda: view.controls.name.value == layout.sensors[0].name)
    assert view.selection == (0,)
    assert not view.selection3d.outlines[1].visible


def test_each_browser_selects_its_own_sensors_of_everybodys_layout(viewer, layout, monkeypatch):
    """Over two sockets: one selects, the other's stays; one removes, both follow."""
    monkeypatch.setattr("inspe_jax.viewer.browser_view.TYPED", 0.01)

    def ready():
        return [n for n in viewer.views if n >= 0]

    with socket_of(viewer.url) as one, socket_of(viewer.url) as other:
        enter(one)
        done(viewer, lambda: len(ready()) == 1)
        (first,) = ready()
        enter(other)
        done(viewer, lambda: len(ready()) == 2)
        (second,) = set(ready()) - {first}
        a, b = viewer.views[first], viewer.views[second]
        send_value(one, a.controls.sensor, a.controls.sensor.options[1])
        done(viewer, lambda: a.selection == (1,))
        assert b.selection == viewer.view.selection == (0,)
        assert b.controls.sensor.value == b.controls.sensor.options[0]
        # What it was never shown, and then what it was: the first would be heard before.
        send_value(one, b.controls.existing, "Remove")
        send_value(one, b.controls.row_buttons, "2")
        send_value(one, b.controls.pose["pitch"], -9.0)
        send_value(one, a.controls.pose["yaw"], 12.5)
        done(viewer, lambda: viewer.layout is not layout)
        turned = np.array(layout.poses)
        turned[1, 5] = np.radians(12.5)
        np.testing.assert_allclose(viewer.layout.poses, turned, atol=1e-4)
        assert b.selection == (0,)
        send_value(other, b.controls.existing, "Duplicate")
        done(viewer, lambda: len(viewer.layout) == 3)
        done(viewer)  # and shown
        assert b.selection == (1,)  # the copy
        assert a.selection == (2,)  # the sensor that it had before, which is third now
        send_value(other, b.controls.existing, "Remove")
        done(viewer, lambda: len(viewer.layout) == 2)
        done(viewer)
        assert a.selection == b.selection == (1,)
    done(viewer, lambda: not ready())


def test_what_somebody_else_removes_is_no_longer_selected_and_its_neighbour_is_not(viewer):
    """Nothing that follows, typed or pressed, is done to another sensor."""
    view = viewer.view
    viewer.change(lambda: viewer.session.remove(0))
    done(viewer)
    left = viewer.layout
    assert view.selection == ()
    assert "☑" not in view.controls.table.content
    for ask, *of in (
        (view.type_number, "height", 9.0), (view.rename, "mine"), (view.swap, "velodyne-vlp-16"),
        (view.duplicate,), (view.remove,),
    ):  # fmt: skip
        viewer.told.clear()
        ask(*of)
        viewer.settle()
        done(viewer)
        assert [words for _, words, _ in viewer.told] == ["no sensor is selected: select one first"]
    pull(viewer, at=np.zeros(3))
    assert viewer.layout is left
    done(viewer, lambda: view.controls.sensor.value == "No sensor is selected")
    assert view.controls.pose["x"].disabled
    assert not view.selection3d.gizmo.visible
    done(viewer, lambda: view.sensor_view._folder.label == "Through a sensor")
    view.select(0)
    done(viewer, lambda: view.selection3d.gizmo.visible and not view.controls.pose["x"].disabled)
    assert len(view.controls.sensor.options) == 1


def test_pictures_are_of_the_light_and_weather_of_the_case(scene, layout, tmp_path, plain_plan):
    pytest.importorskip("embreex", reason="no wheels of Embree for this platform")
    night = Conditions.of("night", "fog:50")
    assert night.spec(layout.sensors[0].spec).grid.reach < 9.5
    with closing(Viewer(Case(scene, night), layout, tmp_path / "layout.yaml", port=0)) as found:
        view = opened(found).sensor_view
        done(found, lambda: same(view.seen, recorded(scene, layout, 0, 0, night)))
        assert "beyond its reach" in view.picture.content


def test_blind_spots_are_listed_in_their_order_and_again_after_a_change(
    viewer, scene, layout, monkeypatch
):
    monkeypatch.setattr("inspe_jax.viewer.blind_spot_panel.plan_picture", plan_picture)
    panel = viewer.display.blind_spots

    def listed_for(of):
        return panel.spots == blind_spots(scene, evaluate(scene, of).seen_share)[: len(LETTERS)]

    done(viewer, lambda: panel.picture.content and viewer.panel.blind_spots.visible)
    assert listed_for(layout)
    for letter, spot, button in zip(LETTERS, panel.spots, panel.buttons, strict=False):
        assert button.label == f"{letter}  {spot.name}: {spot.unseen:.0%} unseen"
    before = panel.picture.content
    viewer.view.select(1)
    viewer.view.remove()
    done(viewer, lambda: viewer.layout is not layout and listed_for(viewer.layout))
    done(viewer, lambda: panel.picture.content != before)


def recorded(scene, layout, s, frame, around=FAIR):
    """What the recorder has of one sensor, in pictures of the page's size."""
    small = Recording(image_size=image_size(layout.sensors[s].spec))
    station = EmbeddedRecorder(scene, layout, around, small).frame(frame).stations
    unit = station[layout.sensors[s].unit]
    (found,) = (*unit.images, *unit.scans)
    return found


def same(seen, wanted):
    """Whether two recordings are the same, bit by bit."""
    if type(seen) is not type(wanted) or not np.array_equal(seen.pose, wanted.pose):
        return False
    of = (lambda one: one.rgb) if isinstance(seen, Image) else (lambda one: one.points)
    return np.array_equal(of(seen), of(wanted))


def test_what_a_sensor_sees_follows_the_drag_and_is_the_recorders_on_release(viewer, scene):
    pytest.importorskip("embreex", reason="no wheels of Embree for this platform")
    view = viewer.view.sensor_view
    first = recorded(scene, viewer.layout, 0, 0)
    done(viewer, lambda: same(view.seen, first))
    pull(viewer, (0.7, 0, 0.5), phases=("start", "update"))
    done(viewer, lambda: view.seen.pose[2] == pytest.approx(6.5, abs=1e-6))
    pull(viewer, (0.7, 0, 0.5), phases=("end",))
    wanted = recorded(scene, viewer.layout, 0, 0)
    assert not same(first, wanted)
    done(viewer, lambda: same(view.seen, wanted))
    jpeg = view.picture.content.partition("data:image/jpeg;base64,")[2].partition('"')[0]
    shown = np.asarray(Pillow.open(BytesIO(b64decode(jpeg))), float)
    assert np.abs(shown - wanted.rgb).mean() < 6  # of 255
    listed = np.count_nonzero(wanted.pixels)
    assert f"{listed} of {len(wanted.pixels)} road users are in the picture" in view.picture.content
    assert "px/m" in view.picture.content

    viewer.view.select(1)  # the LiDAR, in another frame
    set_value(viewer.panel.frame, 2)
    viewer.scorer.select_frame(viewer.panel.shown_frame)
    scan = recorded(scene, viewer.layout, 1, 2)
    done(viewer, lambda: same(view.seen, scan))
    done(viewer, lambda: viewer.view.selection3d.points is not None)
    points, key = viewer.view.selection3d.points, dict(LEGEND)["LiDAR"]
    assert tuple(points.colors) == rgb(key)  # and so says the legend
    drawn = points.points + viewer.scene3d.shift
    np.testing.assert_allclose(drawn, world_points(scan).T, atol=0.02)  # float16 within 32 m
    assert f"{len(scan.points):,} points" in view.picture.content
    viewer.view.select(0)
    done(viewer, lambda: viewer.view.selection3d.points is None)


def test_the_view_can_be_switched_off_and_says_what_it_needs(viewer, monkeypatch):
    view = viewer.view.sensor_view
    done(viewer, lambda: view.picture.content)
    set_value(view.on, False)
    set_value(viewer.panel.frame, 1)
    viewer.scorer.select_frame(viewer.panel.shown_frame)
    done(viewer, lambda: view.seen is None and not view.picture.content)
    none = Mock(side_effect=InspeError("recording needs Embree: pip install it"))
    monkeypatch.setattr(sensor_view, "LiveSensor", none)
    set_value(view.on, True)
    viewer.view.select(1)
    done(viewer, lambda: "recording needs Embree: pip install it" in view.picture.content)
    assert not viewer.told


def test_a_table_lists_the_sensors_with_what_each_adds_and_costs(viewer, scene, layout):
    done(viewer, lambda: viewer.display.scored and viewer.display.scored.frames == 3)
    viewer.view.select(1)
    done(viewer, lambda: "font-weight:700" in viewer.view.controls.table.content.split("<tr")[3])
    for row in evaluate(scene, layout).contributions:
        assert row.sensor in viewer.view.controls.table.content
        assert f"{row.surrogate:.4f}" in viewer.view.controls.table.content
    viewer.view.swap("velodyne-vlp-16")
    price = devices()["velodyne-vlp-16"].price_usd
    done(viewer, lambda: f"{price:,.0f}" in viewer.view.controls.table.content)


def test_a_sensor_gets_another_name(viewer, layout):
    def renamed(*names):
        for name in names:
            viewer.view.rename(name)
        viewer.settle()
        done(viewer)

    for name in ("", "  ", layout.sensors[0].name):  # emptied, or typed again
        renamed(name)
    assert viewer.layout is layout
    assert not viewer.told
    viewer.view.select(1)
    renamed("north", " <b>north west</b> ")  # on the way, and at its end
    assert viewer.layout.sensors[1].name == "<b>north west</b>"
    assert "&lt;b&gt;north west&lt;/b&gt;" in viewer.view.controls.table.content
    assert "<b>" not in viewer.view.controls.table.content
    renamed(layout.sensors[0].name)
    assert "another sensor is named" in viewer.told[-1][1]
    done(viewer, lambda: viewer.view.controls.name.value == "<b>north west</b>")
    viewer.undo_or_redo("Undo")
    done(viewer, lambda: viewer.layout is layout)
