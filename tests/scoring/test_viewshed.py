"""What is seen where: against line of sight asked frame by frame, and against the scores."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, no_traffic, random_layout, solid_voxels, world

from inspe_jax.core.errors import InspeError
from inspe_jax.scoring import tiled_scene as made
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.scoring.viewshed import Visibility, sight_in, viewshed
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.visibility.queries import in_view, line_of_sight


@pytest.fixture(scope="module")
def scene():
    return world(count=8, seed=2, slope=0.05)


@pytest.fixture(scope="module")
def layout(scene):
    return random_layout(scene, [CAMERA, LIDAR], seed=4, heights=(2.0, 5.0))


@pytest.fixture(scope="module")
def shed(scene, layout):
    return viewshed(scene, layout)


def test_counts_are_those_of_line_of_sight_in_every_frame(scene, layout, shed):
    view = in_view(scene, layout)
    seen = [
        (view & line_of_sight(scene, layout, k)).any(0) for k in range(scene.traffic.frame_count)
    ]
    assert shed.frame_count == scene.traffic.frame_count == 4
    np.testing.assert_array_equal(shed.sensors, view.sum(0))
    np.testing.assert_array_equal(shed.seen, np.sum(seen, 0))
    inside = np.sum([solid_voxels(scene, k) for k in range(4)], 0)
    assert (shed.occupied != inside).mean() < 1e-3  # centres on a face
    for k in (0, 3):
        sight = sight_in(scene, layout, k)
        occupied = sight == Visibility.OCCUPIED
        assert (occupied != solid_voxels(scene, k)).mean() < 1e-3
        np.testing.assert_array_equal((sight == Visibility.SEEN)[~occupied], seen[k][~occupied])
        np.testing.assert_array_equal(
            (sight == Visibility.OUT_OF_VIEW)[~occupied], ~view.any(0)[~occupied]
        )
        assert {*Visibility} == set(sight.tolist())


@pytest.mark.parametrize(
    ("around", "profile"), [(FAIR, "paper"), (Conditions.of("night", "fog:100"), "ideal")]
)
def test_scores_are_sums_over_it(scene, layout, around, profile):
    """Also of sensors that perceive less, and with the profile's visibility."""
    of = replace(scene, settings=(("profile", profile),))
    assert (of.profile.visibility == "past_others") == (profile == "paper")
    shed, scores = viewshed(of, layout, conditions=around), evaluate(of, layout, conditions=around)
    weight = scene.voxels.weight
    assert weight @ (shed.sensors > 0) / weight.sum() == pytest.approx(scores.coverage, abs=1e-6)
    by_column = shed.seen.reshape(-1, scene.voxels.level_count).mean(1) / shed.frame_count
    np.testing.assert_allclose(by_column, scores.seen_share, atol=1e-6)
    gain = shed.entropy @ shed.resolved / shed.entropy.sum()
    assert gain == pytest.approx(scores.information_gain, abs=1e-5)
    in_view_alone = evaluate(of, layout, conditions=around, visibility="in_view").information_gain
    assert (gain < in_view_alone - 0.01) == (profile == "paper")


def test_runs_of_frames_are_put_together(scene, layout, shed, monkeypatch):
    monkeypatch.setattr(made, "FRAMES", 2)
    again = replace(scene)  # a scene of its own, with a world of its own
    parts = viewshed(again, layout)
    np.testing.assert_array_equal(parts.seen, shed.seen)
    np.testing.assert_array_equal(parts.occupied, shed.occupied)
    for k in range(4):
        np.testing.assert_array_equal(sight_in(again, layout, k), sight_in(scene, layout, k))


def test_an_empty_road(scene, layout):
    empty = replace(scene, traffic=no_traffic())
    shed = viewshed(empty, layout)
    np.testing.assert_array_equal(shed.seen, shed.sensors > 0)
    assert not shed.entropy.any()
    assert set(sight_in(empty, layout, 0).tolist()) == {Visibility.OUT_OF_VIEW, Visibility.SEEN}


def test_no_such_frame_and_a_sensor_in_the_ground(scene, layout):
    with pytest.raises(InspeError, match="frame 4 is out of range"):
        sight_in(scene, layout, 4)
    buried = layout.with_poses(np.asarray(layout.poses) - [0, 0, 9, 0, 0, 0])
    with pytest.raises(InspeError, match="in the ground"):
        viewshed(scene, buried)
