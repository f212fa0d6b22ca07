"""The report: its numbers, its figures, that it needs no network; and that a browser shows it."""

import base64
import importlib.util
import io
import json
import re
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import browser, errors_of
from PIL import Image
from worlds import CAMERA, LIDAR, place_sensors, random_layout, world

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import optimise
from inspe_jax.placement.problem import Case
from inspe_jax.placement.result import load_result, save_result
from inspe_jax.report import page as pages
from inspe_jax.report.layers import BLIND, HIDDEN, layers
from inspe_jax.report.page import CAPTIONS, ReportEntry, report_entry
from inspe_jax.report.tables import scores_record
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.scoring.viewshed import viewshed
from inspe_jax.viewer.page_views import VIEWS


@pytest.fixture(scope="module")
def scene():
    return world(radius=12.0, voxel=1.0, count=6, frames=4, seed=1)


@pytest.fixture(scope="module")
def entries(scene):
    found = []
    for k, specs in enumerate(([CAMERA, CAMERA], [CAMERA, LIDAR])):
        layout = random_layout(scene, specs, seed=k, heights=(3.0, 5.0))
        layout = replace(layout, name=f"layout <{k}> & co")
        found.append(ReportEntry(layout, evaluate(scene, layout), viewshed(scene, layout)))
    return found


@pytest.fixture(scope="module")
def page(scene, entries):
    told = []
    made = report_page(scene, entries, progress=lambda done, total: told.append((done, total)))
    done, totals = zip(*told, strict=True)
    assert list(done) == sorted(done)
    assert totals == (done[-1],) * len(done)
    return made


report_page = partial(pages.report_page, views=VIEWS)

RECORDED = importlib.util.find_spec("embreex") is not None
"""Whether a page has a picture of each layout in its place."""


def picture(file):
    """Its pixels (H, W, 3)."""
    return np.asarray(Image.open(io.BytesIO(file)).convert("RGB"))


class Reader(HTMLParser):
    """Addresses, images, text and the record of a page."""

    def __init__(self, page):
        super().__init__()
        self.addresses, self.images, self.words, self.titles = [], [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.addresses += [v for k, v in given.items() if k in ("src", "href", "action")]
        self.titles += [given["title"]] if tag == "span" and "title" in given else []
        if tag == "img":
            self.images.append(given)

    def handle_data(self, words):
        self.words.append(words)

    @property
    def record(self):
        (found,) = (a for a in self.addresses if a.startswith("data:application/json"))
        return json.loads(base64.b64decode(found.partition(",")[2]))


def test_its_numbers_are_the_record_of_a_score(scene, entries, page):
    reader = Reader(page)
    records = [scores_record(entry.scores, scene, entry.layout) for entry in entries]
    assert reader.record == json.loads(json.dumps(records))
    for record in records:
        shown = [record["surrogate"], record["coverage"], record["occlusion"]]
        shown += [row["surrogate"] for row in record["contributions"]]
        shown += record["region_coverage"].values()
        assert {str(value) for value in shown} <= set(reader.titles)


def test_it_stands_alone(page):
    """Nothing is fetched; names are text, not markup."""
    reader = Reader(page)
    assert all(a.startswith(("data:", "#")) for a in reader.addresses)
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest", page)
    assert "layout <1> & co" in " ".join(reader.words)
    assert "<1>" not in page
    assert len(page) < 8e6


def test_every_figure_is_there_and_shows_something(entries, page):
    images = Reader(page).images
    assert len(images) == 1 + len(entries) * (len(CAPTIONS) + RECORDED)
    for shown in images:
        assert shown["alt"]
        pixels = picture(base64.b64decode(shown["src"].partition(",")[2]))
        assert pixels.shape[1] > 1000
        levels = pixels[::3, ::3].astype(int) @ [1, 256, 256**2]
        assert len(np.unique(levels)) > 50


def test_what_a_search_found_comes_with_before_and_after(scene, tmp_path):
    """From files, as the command line has it."""
    case, begun = Case(scene), place_sensors((CAMERA, [9.0, 9.0, 6.0, 0, -0.3, 0.8]))
    save_result(optimise(scene, begun, "random", evaluations=8), tmp_path)
    result = load_result(tmp_path)
    entry = report_entry(case, result.layout, Objective(), result)
    assert entry.before.surrogate == evaluate(scene, begun).surrogate
    reader = Reader(pages.report_page(scene, [entry]))
    shown = [shown["alt"] for shown in reader.images]
    assert {"Before and after", "Score against time"} <= set(shown)
    assert len(shown) == 1 + len(CAPTIONS) + 2
    assert {str(result.objective_before), str(result.objective)} <= set(reader.titles)


def test_a_layout_comes_with_the_one_before_and_its_target(scene):
    """Scores of both and what was gained; a map of both where they have the same sensors, which the
    second layout has not."""
    case, objective = Case(scene), Objective()
    begun = place_sensors((CAMERA, [9.0, 9.0, 6.0, 0, -0.3, 0.8]))
    turned = place_sensors((CAMERA, [9.0, 9.0, 6.0, 0, -0.3, -2.4]))
    entry = report_entry(case, turned, objective, start=begun, target=0.99)
    first, second = (evaluate(scene, of).surrogate for of in (begun, turned))
    assert (entry.before.surrogate, entry.scores.surrogate) == (first, second)
    more = place_sensors(*[(CAMERA, [x, 9.0, 6.0, 0, -0.3, -2.4]) for x in (-9.0, 9.0)])
    more = replace(more, name="more")
    reached = report_entry(case, more, objective, start=begun, target=0.01)
    page = Reader(pages.report_page(scene, [entry, reached]))
    words = " ".join(" ".join(page.words).split())
    assert "Before is the layout as it was opened." in words
    assert words.count("metric before after gain") == 2
    assert f"surrogate P_sm {first:.3f} {second:.3f} {second - first:+.3f}" in words
    assert {str(first), str(second), str(second - first)} <= set(page.titles)
    assert f"The target for P_sm, 0.99, is missed by {0.99 - second:.4f}." in words
    assert "The target for P_sm, 0.01, is reached." in words
    assert [shown["alt"] for shown in page.images].count("Before and after") == 1


def test_layouts_have_names_of_their_own(scene, entries):
    with pytest.raises(InspeError, match="two layouts are named 'layout <0> & co'"):
        report_page(scene, [entries[0], entries[0]])
    with pytest.raises(InspeError, match="no layout"):
        report_page(scene, [])


def test_layers_are_shares_of_what_is_counted(scene, entries):
    shed, levels = entries[0].shed, scene.voxels.level_count
    found = layers(scene, shed)
    np.testing.assert_allclose(found["seen"].values, entries[0].scores.seen_share, atol=1e-6)
    sensors = shed.sensors.reshape(-1, levels)
    np.testing.assert_allclose(found["redundancy"].values, sensors.mean(1))
    assert found["redundancy"].most == sensors.max()
    kind = found["blind"].values
    names = [BLIND[int(k)][0] for k in kind]
    for name, in_view in zip(names, sensors > 0, strict=True):
        assert (name == "never in view") == (not in_view.any())
        assert (name == "in part out of view") == (in_view.any() and not in_view.all())
    whole = (sensors > 0).all(1)
    free = shed.frame_count * levels - shed.occupied.reshape(-1, levels).sum(1)
    share = shed.seen.reshape(-1, levels).sum(1) / np.maximum(free, 1)
    hidden = whole & (free > 0) & (share < 1 - HIDDEN)
    np.testing.assert_array_equal(kind == 1, hidden)


@pytest.mark.browser
def test_a_browser_shows_it_without_a_network_and_a_finger_scrolls_on_a_telephone(tmp_path, page):
    path = tmp_path / "report.html"
    path.write_text(page, encoding="utf-8")
    asked, size = [], {"width": 390, "height": 844}
    with browser() as chromium:
        tab = chromium.new_context(offline=True).new_page()
        wrong = errors_of(tab)
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(path.as_uri())
        width = tab.evaluate("[document.body.scrollWidth, window.innerWidth]")
        assert width[0] <= width[1]
        frame = tab.query_selector("iframe.scene3d")
        frame.scroll_into_view_if_needed()
        canvas = frame.content_frame().wait_for_selector("canvas", timeout=60_000)
        for _ in range(60):
            shown = picture(canvas.screenshot()) / 255.0
            if (np.abs(shown - shown[0, 0]).max(-1) > 0.1).mean() > 0.02:
                break
            tab.wait_for_timeout(500)
        else:
            pytest.fail("nothing is drawn in three dimensions")
        assert wrong == []
        assert all(url.startswith(("file:", "blob:", "data:")) for url in asked)
        tab.close()

        tab = chromium.new_context(viewport=size, has_touch=True, is_mobile=True).new_page()
        tab.goto(path.as_uri())
        assert tab.evaluate("document.documentElement.scrollWidth") <= 390
        scene3d = tab.locator("iframe.scene3d").first

        def caught():
            return scene3d.evaluate("frame => getComputedStyle(frame).pointerEvents") != "none"

        assert not caught()
        scene3d.scroll_into_view_if_needed()
        box = scene3d.bounding_box()
        tab.touchscreen.tap(box["x"] + 100, box["y"] + 100)
        assert caught()
        tab.get_by_text("tap on the scene to turn it").first.tap()
        assert not caught()
