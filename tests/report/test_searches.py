"""What the figures of searches and of a Pareto front show, read back; and their tables."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from drawn import misplaced, printed, row
from matplotlib.collections import PolyCollection
from matplotlib.patches import FancyArrowPatch
from worlds import CAMERA, LIDAR, place_sensors, world

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.optimise import METHODS
from inspe_jax.placement.result import Result
from inspe_jax.placement.run import Progress
from inspe_jax.placement.studies.pareto import DeviceMix
from inspe_jax.report.figures import layer_raster
from inspe_jax.report.layers import seen_layer
from inspe_jax.report.searches import MOVED, NAMED, WENT, before_after, history_view, pareto_view
from inspe_jax.report.tables import before_after_table, comparison_table, moves_table
from inspe_jax.scoring.evaluate import ManyScores, evaluate


@pytest.fixture(scope="module")
def scene():
    return world(radius=15, voxel=1.0)


@pytest.fixture(scope="module")
def result(scene):
    start = place_sensors(
        (CAMERA, [9.0, 9.0, 6.0, 0, -0.3, np.radians(-135)]), (LIDAR, [-9.0, -9.0, 5.0, 0, 0, 0])
    )
    poses = np.array(start.poses)
    poses[0] = [9.0, -8.0, 8.5, 0, -0.3 + np.radians(4), np.radians(175)]
    units = (replace(start.units[0], base=(9.0, -8.0, 0.5)), start.units[1])
    after = replace(start, poses=poses, units=units, name="after")
    history = (Progress(1.0, 1.0, 0.2, 0.2), Progress(3.0, 10.0, 0.4, 0.4))
    return Result(
        after, start, evaluate(scene, start), evaluate(scene, after), 0.2, 0.4, history,
        np.stack([start.poses, poses]), 12.0, 4.0, "converged", "first", 0,
        {"scenes": [{"name": "test crossing"}]}, {},
    )  # fmt: skip


def compare_of(result, scene):
    return before_after(scene, result.start, result.layout, result.scores_before, result.scores)


def maps_of(fig):
    return [ax for ax in fig.axes if ax.images]


def test_both_maps_show_their_scores_on_one_scale_and_an_arrow_what_moved(result, scene):
    left, right = maps_of(compare_of(result, scene))
    scored = (left, result.scores_before, "before"), (right, result.scores, "after")
    for ax, scores, when in scored:
        (image,) = ax.images
        assert (image.norm.vmin, image.norm.vmax) == (0, 1)
        shown = image.get_array().compressed()
        raster, _ = layer_raster(scene.voxels, seen_layer(scores.seen_share, scene))
        np.testing.assert_allclose(np.sort(shown), np.sort(raster[~np.isnan(raster)]))
        title = ax.get_title(loc="left")
        assert title.startswith(when)
        for value in (scores.surrogate, scores.coverage, scores.occlusion):
            assert f"{value:.3f}" in title
    arrows = [[p for p in ax.patches if isinstance(p, FancyArrowPatch)] for ax in (left, right)]
    assert not arrows[0]
    (arrow,) = arrows[1]  # of the camera from its old place; the LiDAR stayed
    assert arrow._posA_posB == [(9.0, 9.0), (9.0, -8.0)]
    assert left.get_xlim() == right.get_xlim()
    assert left.get_ylim() == right.get_ylim()
    assert (result.scores.seen_share != result.scores_before.seen_share).any()


def test_a_way_of_small_steps_is_drawn_as_it_went(result, scene):
    """Steps of 0.3 m on an arc, and another unit's round trip."""
    start, _ = result.path
    path = np.stack([start] * 40)
    turn = np.linspace(0, np.pi / 2, 40)
    path[:, 0, :2] = np.column_stack([9 * np.cos(turn), 9 * np.sin(turn)])
    path[:20, 1, 0] -= np.linspace(0, 3, 20)
    path[20:, 1, 0] -= np.linspace(3, 0, 20)
    fig = before_after(
        scene, result.start, result.layout, result.scores_before, result.scores, path=path
    )
    ways = [line.get_xydata() for line in maps_of(fig)[1].lines if len(line.get_xydata()) > 8]
    arcs = [way for way in ways if np.allclose(np.hypot(*way.T), 9.0)]
    assert len(arcs) == 1
    steps = np.hypot(*np.diff(arcs[0], axis=0).T)
    assert steps.max() < 2 * MOVED
    arrows = [p for p in maps_of(fig)[1].patches if isinstance(p, FancyArrowPatch)]
    assert len(arrows) == 2
    assert arrows[1]._posA_posB[1] == (-9.0, -9.0)
    assert WENT in [text.get_text() for legend in fig.legends for text in legend.get_texts()]


def test_one_map_and_no_key_of_arrows_where_nothing_moved(result, scene):
    fig = before_after(
        scene, result.start, result.start, result.scores_before, result.scores_before
    )
    words = [text.get_text() for legend in fig.legends for text in legend.get_texts()]
    assert WENT not in words
    (only,) = maps_of(fig)
    assert only.get_title(loc="left").startswith("nothing moved: ")
    assert "camera, view to 30 m" in words


def test_nothing_overlaps(result, scene):
    assert misplaced(compare_of(result, scene)) == []
    assert misplaced(history_view([replace(result, method=name) for name in METHODS])) == []


def test_what_cannot_be_drawn_is_refused(result, scene):
    other = replace(result, layout=place_sensors((CAMERA, [9.0, 9.0, 6.0, 0, -0.3, 0])))
    for draw, words in (
        (lambda: compare_of(other, scene), "not of the same sensors"),
        (lambda: compare_of(result, world(radius=12, voxel=1.0)), "scores of another scene"),
        (lambda: history_view([]), "no result"),
        (lambda: pareto_view([]), "no mix"),
    ):
        with pytest.raises(InspeError, match=words):
            draw()


def course(*rows):
    """Of (time, best) pairs; as much work as ten times the time."""
    return tuple(Progress(t, 10 * t, best, best) for t, best in rows)


def test_the_course_is_the_median_within_the_spread(result):
    """By hand: three seeds, each a staircase."""
    histories = [
        course((1, 0.2), (2, 0.5)),
        course((1, 0.2), (3, 0.3)),
        course((1.5, 0.2), (2.5, 0.4), (4, 0.9)),
    ]
    results = [
        replace(result, history=history, seed=seed, seconds=5.0, evaluations=60.0)
        for seed, history in enumerate(histories)
    ]
    fig = history_view(results)
    for ax, unit, end in zip(fig.axes, (1, 10), (5, 60), strict=True):
        (line,) = ax.lines
        at = dict(zip((line.get_xdata() / unit).tolist(), line.get_ydata().tolist(), strict=True))
        assert at == pytest.approx({1.5: 0.2, 2: 0.2, 2.5: 0.4, 3: 0.4, 4: 0.5, end / unit: 0.5})
        (band,) = (c for c in ax.collections if isinstance(c, PolyCollection))
        corners = band.get_paths()[0].vertices
        assert corners[:, 1].min() == pytest.approx(0.2)
        assert corners[:, 1].max() == pytest.approx(0.9)
        last = corners[np.isclose(corners[:, 0], end), 1]
        assert (last.min(), last.max()) == pytest.approx((0.3, 0.9))
        assert ax.get_xlim() == (0, end)


def test_methods_can_be_told_apart_and_are_named_with_their_end(result):
    results = [replace(result, method=f"m{k}", objective=0.1 * k) for k in range(8)]
    fig = history_view(results)
    lines = fig.axes[0].lines
    assert len({(line.get_color(), str(line.get_linestyle())) for line in lines}) == 8
    assert len({line.get_color() for line in lines}) == 8
    words = [text.get_text() for text in fig.legends[0].get_texts()]
    assert words == [f"m{k}, {0.1 * k:.4f}" for k in range(8)]


def test_table_of_scores_before_and_after(result):
    text = printed(before_after_table(result))
    before, after = result.scores_before.coverage, result.scores.coverage
    change = f"{after - before:+.3f}"
    assert row(text, "coverage")[2:] == [f"{before:.3f}", f"{after:.3f}", change]
    assert row(text, "objective")[1:] == ["0.200", "0.400", "+0.200"]
    before, after = result.scores_before.surrogate, result.scores.surrogate
    same = replace(result, objective_before=before, objective=after)
    assert "objective" not in printed(before_after_table(same))
    paid = replace(same, objective_before=before - 0.01)  # for a new pole
    assert row(printed(before_after_table(paid)), "objective")[2] == f"{after:.3f}"


def test_table_of_moves(result):
    """By hand: 17 m south, from 6 m to 8 m above its foot, 50° clockwise past the west, 4° up."""
    text = printed(moves_table(result.start, result.layout))
    assert row(text, "1")[1:] == ["s0", "17.0", "8.0", "+2.0", "-50", "+4"]
    assert row(text, "2")[1:] == ["s1", "0.0", "5.0", "+0.0", "+0", "+0"]


def test_table_of_methods_has_the_best_first(result):
    rows = [("slow", 0.1), ("slow", 0.4), ("slow", 0.2), ("quick", 0.3)]
    text = printed(comparison_table([replace(result, method=m, objective=s) for m, s in rows]))
    assert row(text, "slow")[1:] == ["3", "0.2000", "0.1000", "0.4000", "12", "4"]
    assert text.index("quick") < text.index("slow")


# ── Cost against score ──


def mix_of(count, cost, objective, front):
    values = np.array([0.5, 0.4, 0.3])
    metrics = dict(zip(("coverage", "occlusion", "information_gain"), values, strict=True))
    scores = ManyScores(metrics, objective)
    result = SimpleNamespace(
        objective=objective, scores=scores, method="random", settings={"scenes": [{"name": "here"}]}
    )
    return DeviceMix({"device": count}, cost, result, front)


@pytest.fixture
def found():
    return [mix_of(1, 100, 0.2, True), mix_of(2, 150, 0.1, False), mix_of(3, 300, 0.6, True)]


def test_the_front_is_a_staircase_with_its_mixes_named(found):
    fig = pareto_view(found)
    (ax,) = fig.axes
    stairs, front, beaten = ax.lines
    assert stairs.get_drawstyle() == "steps-post"
    assert list(zip(*front.get_data(), strict=True)) == [(100, 0.2), (300, 0.6)]
    assert list(zip(*beaten.get_data(), strict=True)) == [(150, 0.1)]
    words = [text.get_text() for text in fig.texts]
    named = [text for text in words if " device: " in text]
    assert named == ["1 device: 100 US dollars, 0.2000", "3 device: 300 US dollars, 0.6000"]
    assert [text.get_text() for text in ax.texts] == ["1", "2"]
    assert "Cost against score at here" in words


def test_no_more_are_named_than_there_is_room_for():
    many = [mix_of(k, 100 * k, 1 - 0.5**k, True) for k in range(1, NAMED + 9)]
    fig = pareto_view(many)
    assert len(fig.axes[0].texts) == NAMED
    assert "1 device: 100 US dollars, 0.5000" in [text.get_text() for text in fig.texts]
    assert f"{NAMED + 8} device" not in " ".join([text.get_text() for text in fig.texts])


def test_one_mix_is_a_figure_too(found):
    (ax,) = pareto_view([replace(found[0], cost=0.0)]).axes
    assert ax.lines[1].get_data()[0].tolist() == [0.0]
