"""The page in a real browser: sensors are dragged by their handles, and everything follows."""

import re
from pathlib import Path

import numpy as np
import pytest
from browser import browser, errors_of
from common import UNDRAWN
from viser.transforms import SO3
from worlds import world

from inspe_jax.placement.problem import Case
from inspe_jax.placement.space import Space
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.sensing.layout import layout_text, load_layout
from inspe_jax.viewer.app import Viewer
from inspe_jax.viewer.blind_spot_panel import LETTERS
from inspe_jax.viewer.panel import set_value
from inspe_jax.viewer.scene3d import LENGTH
from inspe_jax.viewer.server import new_token

pytestmark = pytest.mark.browser

WAIT = 120_000
"""For what compiles first [ms]."""


@pytest.fixture(scope="module")
def scene():
    return world(radius=14.0, voxel=1.0, frames=30, count=6)


@pytest.fixture(scope="module")
def chromium():
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def viewer(scene, layout, tmp_path_factory):
    found = Viewer(Case(scene), layout, tmp_path_factory.mktemp("page") / "layout.yaml", port=0)
    yield found
    found.close()


def new_page(chromium):
    found = chromium.new_page(viewport={"width": 1440, "height": 900})
    found.add_init_script(UNDRAWN)
    return found


@pytest.fixture(scope="module")
def page(chromium, viewer):
    """A page on the viewer; it must not complain."""
    found = new_page(chromium)
    wrong = errors_of(found)
    found.goto(viewer.url)
    settled(found)
    yield found
    found.close()
    assert wrong == []


@pytest.fixture
def tab(page, viewer, layout):
    """The page with the opened layout, its first sensor in hand, the scores of all frames, and
    everything in view."""
    viewer.change(lambda: viewer.session.take(layout))
    view_of(viewer).select(0)
    (client,) = viewer.server.get_clients().values()
    viewer.look_at_all(client)
    wait_until(page, lambda: viewer.display._current and viewer.layout is layout)
    wait_until(page, lambda: viewer.display.scored.frames == viewer.frames)
    wait_until(page, lambda: score_of(page) == viewer.display.scored.scores.surrogate)
    settled(page)
    return page


def view_of(viewer):
    """What the only browser has of its own."""
    (view,) = viewer.views.values()
    return view


def score_of(tab):
    return float(tab.locator("[data-score]").get_attribute("data-score"))


def settled(tab, other_than=None):
    """Wait for the scores of all frames, and for others than those; gives P_sm."""
    script = """old => {
        const board = document.querySelector('[data-state^="all frames"]');
        return board && (old === null || board.dataset.score !== String(old));
    }"""
    tab.wait_for_function(script, arg=other_than, timeout=WAIT)
    return score_of(tab)


def comes_true(tab, true, seconds):
    """Whether it does within some seconds, in which the page goes on."""
    for _ in range(10 * seconds):
        if true():
            return True
        tab.wait_for_timeout(100)
    return False


def wait_until(tab, true):
    assert comes_true(tab, true, 60)


def turn_of(one):
    """The rotation matrix of a camera or a handle."""
    return SO3(np.asarray(one.wxyz)).as_matrix()


def on_screen(viewer, point):
    """Where a world point is in the browser's window [pixel]."""
    (client,) = viewer.server.get_clients().values()
    camera = client.camera
    x, y, z = turn_of(camera).T @ (point - viewer.scene3d.shift - np.array(camera.position))
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / z
    return camera.image_width / 2 + scale * x, camera.image_height / 2 + scale * y


def click(tab, viewer, point, true):
    """On a world point; where a slow page has not drawn yet what is there, once more."""
    for _ in range(12):
        tab.mouse.click(*on_screen(viewer, point))
        if comes_true(tab, true, 5):
            return
    pytest.fail("no click on it comes to that")


def drag(tab, viewer, begin, end):
    """From one pixel to another; where a slow page has not drawn the handle yet, once more."""
    for _ in range(10):
        tab.mouse.move(*np.add(begin, 2))
        tab.wait_for_timeout(300)
        tab.mouse.move(*begin)
        tab.wait_for_timeout(300)
        tab.mouse.down()
        if not comes_true(tab, lambda: view_of(viewer).dragging is not None, 1):
            tab.mouse.up()
            continue
        for t in np.linspace(0, 1, 9)[1:]:
            tab.mouse.move(*(np.array(begin) + t * (np.array(end) - begin)))
            tab.wait_for_timeout(60)
        tab.mouse.up()
        return
    pytest.fail("there is no handle to grip")


def grip(viewer, axis, share):
    """A point of an arrow of the handle: the sensor's place and so far along it."""
    handle, (client,) = view_of(viewer).selection3d.gizmo, viewer.server.get_clients().values()
    camera = client.camera
    ahead = turn_of(camera)[:, 2] @ (np.array(handle.position) - np.array(camera.position))
    metre = camera.image_height / 2 / np.tan(camera.fov / 2) / ahead  # [pixel]
    out = turn_of(handle)[:, axis] * share * LENGTH / metre
    return np.array(handle.position) + viewer.scene3d.shift + out


def press(tab, name):
    tab.get_by_role("button", name=name).click()


def test_a_sensor_is_dragged_by_its_handle_and_the_scores_follow(tab, viewer, scene, layout):
    first = score_of(tab)
    assert first == evaluate(scene, layout).surrogate
    begin = on_screen(viewer, grip(viewer, 2, 0.95))  # the arrow that points up
    drag(tab, viewer, begin, on_screen(viewer, grip(viewer, 2, 0.95) + [0, 0, 3.0]))
    second = settled(tab, first)
    assert 1.0 < viewer.layout.poses[0, 2] - layout.poses[0, 2] < 5.0
    np.testing.assert_allclose(viewer.layout.poses[0, :2], layout.poses[0, :2], atol=1e-6)
    assert second == evaluate(scene, viewer.layout).surrogate
    press(tab, "Undo")
    assert settled(tab, second) == first
    with tab.expect_download() as sent:
        press(tab, "Download layout")
    assert sent.value.suggested_filename == "layout.yaml"
    assert Path(sent.value.path()).read_text() == layout_text(layout)


def test_a_sensor_is_taken_in_hand_and_snaps_to_where_it_can_stand(tab, viewer, scene):
    """By a click on it; then to the middle of the road, from where it goes back to the kerb."""
    first = score_of(tab)
    place = np.array(viewer.layout.poses[1, :3])
    relative = place - viewer.scene3d.shift
    handle = view_of(viewer).selection3d.gizmo
    click(tab, viewer, place, lambda: np.allclose(handle.position, relative))
    wait_until(tab, lambda: view_of(viewer).in_hand == 1)  # the list follows the handle
    drawn = viewer.scene3d.drawn["sensors/2/view"].points
    (outline,) = view_of(viewer).selection3d.outlines
    wait_until(tab, lambda: np.array_equal(outline.points, drawn))  # and so does its outline
    begin = grip(viewer, 1, 0.95)  # the arrow to its left, which is north
    drag(tab, viewer, on_screen(viewer, begin), on_screen(viewer, begin + [0, 5.0, 0]))
    settled(tab, first)
    x, y, z = viewer.layout.poses[1, :3]
    assert x == pytest.approx(-9.0, abs=0.1)
    assert y == pytest.approx(-7.3, abs=1e-3)  # 0.3 m from the kerb
    assert z == pytest.approx(place[2], abs=1e-6)
    assert Space(scene, viewer.layout).violations(viewer.layout) == []
    assert tab.get_by_text(re.compile("moved .* to the nearest mounting area")).is_visible()


def test_a_blind_spot_is_clicked_and_looked_at(tab, viewer):
    (client,) = viewer.server.get_clients().values()
    panel = viewer.display.blind_spots
    wait_until(tab, lambda: len(panel.spots) > 1)
    for spot, letter in zip(panel.spots[:2], LETTERS, strict=False):
        tab.get_by_role("button", name=f"{letter} {spot.name}").click()
        there = np.array(spot.at) - viewer.scene3d.shift[:2]
        wait_until(tab, lambda at=there: np.allclose(client.camera.look_at[:2], at, atol=0.05))
    assert tab.get_by_alt_text("Plan view").count() == 1


def test_keys_undo_remove_and_are_listed(tab, viewer, layout):
    first = score_of(tab)
    tab.get_by_label("height [m]").press("Delete")  # of a digit, not of the sensor
    tab.wait_for_timeout(1000)
    assert len(viewer.layout) == 2
    tab.get_by_label("height [m]").fill("8")
    tab.keyboard.press("Enter")
    second = settled(tab, first)
    tab.keyboard.press("Control+z")  # of the change, not of a digit
    assert settled(tab, second) == first
    tab.keyboard.press("Control+Shift+z")
    assert settled(tab, first) == second
    view_of(viewer).select(1)
    wait_until(tab, lambda: view_of(viewer).in_hand == 1)
    tab.keyboard.press("Delete")
    tab.get_by_text("1 sensor on 1 unit").wait_for(timeout=WAIT)
    assert viewer.layout.sensors == layout.sensors[:1]
    (client,) = viewer.server.get_clients().values()
    begun = np.array(client.camera.position)
    client.camera.position = begun / 2
    tab.keyboard.press("Home")
    wait_until(tab, lambda: np.allclose(client.camera.position, begun, atol=0.1))
    tab.keyboard.press("h")
    tab.get_by_text("Ctrl+Z: undo").wait_for()


def test_the_score_stays_in_sight_and_the_page_is_its_own(tab, viewer):
    """And nothing is drawn over the mark of the target."""
    assert tab.title() == "layout at test crossing – inspe_jax"
    assert not tab.get_by_text("Software WebGL rendering detected").is_visible()
    set_value(viewer.panel.target, 0.3)
    viewer.queue.submit(viewer.display.update_panel)
    mark, boxes = tab.locator("[data-target='0.3']"), []
    # Without a box while the panel is drawn anew, as it is for every score that comes.
    wait_until(tab, lambda: boxes.append(mark.bounding_box()) or boxes[-1])
    box = boxes[-1]
    assert box["width"] >= 8
    assert box["height"] >= 16
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    on_top = "([x, y]) => document.elementFromPoint(x, y).dataset.target"
    assert tab.evaluate(on_top, middle) == "0.3"
    tab.get_by_label("height [m]").scroll_into_view_if_needed()
    tab.mouse.move(1300, 600)
    tab.mouse.wheel(0, 5000)
    tab.get_by_role("button", name="Write report").wait_for()
    tab.wait_for_timeout(500)
    named = [tab.get_by_role("button", name=name) for name in ("Undo", "Write report")]
    found = [tab.locator("[data-score]"), *named]
    score, undo, report = (one.bounding_box()["y"] for one in found)
    assert 0 < score < undo < 160 < report < 900
    set_value(viewer.panel.target, 0.0)


def test_rows_of_the_sensors_are_clicked_one_or_several(tab, viewer, layout):
    first = score_of(tab)
    rows = tab.locator("[data-sensor]")
    rows.nth(1).click()  # waits until they are drawn, after the score
    assert rows.count() == 2
    wait_until(tab, lambda: view_of(viewer).selection == (1,))
    rows.nth(0).click(modifiers=["Shift"])
    wait_until(tab, lambda: view_of(viewer).selection == (1, 0))
    tab.get_by_text("2 sensors are selected").wait_for()
    tab.get_by_label("height [m]").fill("8")  # from 6 m, and the other from 5 m
    tab.keyboard.press("Enter")
    settled(tab, first)
    heights = np.array(viewer.layout.poses)[:, 2] - np.array(layout.poses)[:, 2]
    np.testing.assert_allclose(heights, [2.0, 2.0], atol=1e-6)
    rows.nth(1).locator("[data-box]").click()
    wait_until(tab, lambda: view_of(viewer).selection == (0,))
    rows.nth(1).focus()
    for row in (1, 0):  # the row in focus stays so in a table drawn anew
        view_of(viewer).select(row)
        tab.locator(f'[data-sensor="{row + 1}"][aria-pressed="true"]').wait_for()
        assert tab.evaluate("document.activeElement.dataset.sensor") == "2"
    tab.keyboard.press("Enter")
    wait_until(tab, lambda: view_of(viewer).selection == (1,))
    for name in ("Select", "Select together"):  # what a row presses is not in sight
        assert not tab.get_by_text(name, exact=True).is_visible()


def test_where_the_server_ends_the_page_says_so_and_gets_in_to_the_next(
    chromium, scene, layout, tmp_path
):
    """With the file that has the changes; at the same address, where what the earlier run has left
    is offered, and asked about before it is replaced."""
    given, token = (Case(scene), layout, tmp_path / "moved.yaml"), new_token()
    first = Viewer(*given, token=token, port=0)
    tab = new_page(chromium)
    tab.goto(first.url)
    before = settled(tab)
    assert tab.locator("#lost").count() == 0
    tab.get_by_label("height [m]").fill("9")
    tab.keyboard.press("Enter")
    higher = settled(tab, before)
    press(tab, "Save layout")
    tab.get_by_text("Saved", exact=True).wait_for()
    tab.get_by_label("height [m]").fill("10")
    tab.keyboard.press("Enter")
    settled(tab, higher)
    first.close()
    said = tab.locator("#lost")
    said.wait_for()
    assert f"not saved yet, kept in {tmp_path}/moved.unsaved.yaml." in said.inner_text()
    assert f"--port {first.port}" in said.inner_text()
    second = Viewer(*given, token=token, port=first.port)
    try:
        assert second.url == first.url
        said.wait_for(state="detached", timeout=WAIT)
        assert settled(tab) == before
        tab.get_by_text("An earlier run has left").wait_for()
        tab.get_by_label("height [m]").fill("8")
        tab.keyboard.press("Enter")
        for answer in ("Cancel", "Save as moved-2.yaml"):
            press(tab, "Save layout")
            tab.get_by_text("was not written by this run").wait_for()
            press(tab, answer)
            tab.get_by_text("was not written by this run").wait_for(state="hidden")
        wait_until(tab, (tmp_path / "moved-2.yaml").is_file)
        for name, height in (("moved", 9.0), ("moved-2", 8.0)):
            assert load_layout(tmp_path / f"{name}.yaml").poses[0, 2] == pytest.approx(height)
        for name, height in (("moved", 9.0), ("moved.unsaved", 10.0)):
            press(tab, f"Open {name}.yaml")
            wait_until(tab, lambda z=height: abs(second.layout.poses[0, 2] - z) < 1e-6)
        tab.get_by_text("An earlier run has left").wait_for(state="hidden")
    finally:
        tab.close()
        second.close()
