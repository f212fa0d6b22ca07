"""The content of the figures and tables of a data set and of its frames."""

import json
from dataclasses import replace

import numpy as np
import pytest
from drawn import printed
from frames import AHEAD, CAMERA, LEVEL, WORLD, car, scan, station
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

import inspe_jax.dataset as dataset
from inspe_jax.core.sheet import CLASS_COLORS
from inspe_jax.dataset import Frame, Image, Station, write_frame, write_protocol
from inspe_jax.dataset.figure import statistics_view
from inspe_jax.dataset.frame_figure import frame_view
from inspe_jax.dataset.statistics import bands, statistics
from inspe_jax.dataset.tables import frame_table, statistics_record, statistics_table

BEHIND = car(2, kind="truck", center=np.array([-20.0, 0.0, 2.0]), size=np.array([9.0, 2.5, 4.0]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scenario of six frames with two road users, one of them ahead of a level camera."""
    root = tmp_path_factory.mktemp("sets") / "seen"
    masts = (Station(1, "mast", LEVEL, (CAMERA,), (scan(200, LEVEL),)), station(2, layers=False))
    for number in range(6):
        write_frame(root / "test" / "a", Frame(number, 0.05 * number, (AHEAD, BEHIND), masts))
    write_protocol(root / "test" / "a", {"world": WORLD}, masts)
    return root


@pytest.fixture(scope="module")
def found(folder):
    return statistics(folder)


@pytest.fixture
def scenario(folder):
    return dataset.open(folder).scenario()


def panels(fig: Figure) -> dict[str, list]:
    by: dict[str, list] = {}
    for ax in fig.axes:
        by.setdefault(ax.get_title(loc="left"), []).append(ax)
    return by


def words(fig: Figure) -> str:
    return "\n".join(text.get_text() for text in fig.texts)


def test_counts_of_a_set_are_drawn(found):
    fig = statistics_view(found)
    (ax,) = panels(fig)["Objects per class"]
    assert [bar.get_width() for bar in ax.patches] == [6, 6, 0, 0]
    assert [to_hex(bar.get_facecolor()) for bar in ax.patches] == list(CLASS_COLORS)
    assert [text.get_text() for text in ax.texts] == ["6 (1)", "6 (1)", "0", "0"]
    (ax,) = panels(fig)["Objects per frame"]
    assert sum(bar.get_height() for bar in ax.patches) == 6
    assert "mean 2.0" in ax.get_xlabel()
    assert "1 split, 1 scenario, 6 frames, 12 boxes of 2 road users" in words(fig)
    assert "18 images, 12 point clouds of 125 points on average" in words(fig)


def test_sets_without_point_clouds_or_road_users(tmp_path):
    write_frame(tmp_path / "a", Frame(1, 0.05, (), (station(),)))
    write_frame(tmp_path / "b", Frame(1, 0.05, (AHEAD,), (station(),)))  # no point is on it
    write_frame(tmp_path / "c", Frame(1, 0.05, (AHEAD,), (station(lidars=0),)))
    empty, missed, blind = (statistics(tmp_path / name) for name in "abc")
    assert (empty.crowd.tolist(), empty.users.size.shape) == ([0], (0, 3))
    assert sum(empty.boxes.values()) == 0
    assert (blind.total.clouds, blind.total.points, blind.mean_points) == (0, 0, None)
    assert bands(blind.points, 0) == ()
    empty, missed, blind = map(statistics_view, (empty, missed, blind))
    for fig in (empty, missed, blind):
        fig.draw_without_rendering()
    assert not len(panels(empty)["Length"][0].patches)
    assert "pedestrian" in panels(missed)
    assert "car" not in panels(blind)
    assert "The data set has no point clouds" in words(blind)


def test_boxes_that_no_pixel_shows_are_dotted(tmp_path):
    instance = np.zeros((600, 800), np.int32)
    instance[300, 400] = AHEAD.track + 1
    beside = replace(AHEAD, track=4, center=np.array([10.0, 5.0, 1.0]))
    told = Image(LEVEL, CAMERA.intrinsic, CAMERA.rgb, None, instance, None)
    masts = (Station(1, "mast", LEVEL, (told,), ()),)
    write_frame(tmp_path / "a", Frame(1, 0.05, (AHEAD, beside), masts))
    fig = frame_view(dataset.open(tmp_path / "a").scenario(), 1)
    (ax,) = panels(fig)["station 1, camera 0: 1 box"]
    dotted, full = ax.collections
    assert np.concatenate(full.get_segments())[:, 0].max() == pytest.approx(412.5)
    assert np.concatenate(dotted.get_segments())[:, 0].max() == pytest.approx(400 - 100 * 4 / 12)


def test_the_plan_has_points_boxes_and_stations(scenario):
    fig = frame_view(scenario, 3)
    plan = next(ax for ax in fig.axes if ax.get_xlabel() == "x, east [m]")
    cloud, boxes, heads = plan.collections
    assert 200 <= len(cloud.get_offsets()) <= 250
    assert (np.diff(cloud.get_array()) >= 0).all()  # the highest is drawn last
    car_, truck = (path.vertices[:4] for path in boxes.get_paths())
    np.testing.assert_allclose(car_.min(0), [8, -1], atol=1e-6)
    np.testing.assert_allclose(truck.max(0) - truck.min(0), [2.5, 9], atol=1e-6)  # faces north
    np.testing.assert_allclose(heads.get_segments()[0], [[10, 0], [12, 0]], atol=1e-6)
    assert [text.get_text() for text in plan.texts] == ["1", "2"]
    low, high = plan.get_xlim()
    assert low < -21.25
    assert high > 12
    assert "0.15 s; 2 objects; 2 stations" in words(fig)


def test_tables_and_the_record_have_the_counts(found, scenario):
    text = printed(statistics_table(found))
    assert "Data set seen" in text
    assert any(row.split()[:3] == ["car", "6", "1"] for row in text.splitlines())
    record = json.loads(json.dumps(statistics_record(found)))
    assert record["classes"]["truck"]["length"] == pytest.approx([9, 9, 9])
    assert record["classes"]["cyclist"]["length"] is None
    assert record["objects_per_frame"] == {"mean": 2, "least": 2, "most": 2}
    assert record["total"]["points"] == 1500
    assert sum(band["boxes"] for band in record["points"]["car"]) == 6
    rows = [row.split() for row in printed(frame_table(scenario, 0)).splitlines()]
    (row,) = (row for row in rows if row[:2] == ["2", "truck"])
    assert row[2:9] == ["-20.0", "0.0", "90", "10.0", "9.00", "2.50", "4.00"]
