"""What is seen where: against line of sight asked frame by frame, and against the scores; and blind
spots in words, by hand on shares that are set, and of a score."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import (
    CAMERA,
    LIDAR,
    no_traffic,
    place_sensors,
    random_layout,
    solid_voxels,
    street_bodies,
    world,
)

from inspe_jax.core.errors import InspeError
from inspe_jax.report.tables import blind_spots_table, scores_record
from inspe_jax.scene.regions import PAPER_WEIGHTS, Region
from inspe_jax.scoring import tiled_scene as made
from inspe_jax.scoring.blind_spots import LEAST_AREA, MIDDLE, blind_spots
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


@pytest.mark.parametrize("around", [FAIR, Conditions.of("night", "fog:100")])
def test_scores_are_sums_over_it(scene, layout, around):
    """Also of sensors that perceive less."""
    shed = viewshed(scene, layout, conditions=around)
    scores = evaluate(scene, layout, conditions=around)
    weight = scene.voxels.weight
    assert weight @ (shed.sensors > 0) / weight.sum() == pytest.approx(scores.coverage, abs=1e-6)
    by_column = shed.seen.reshape(-1, scene.voxels.level_count).mean(1) / shed.frame_count
    np.testing.assert_allclose(by_column, scores.seen_share, atol=1e-6)


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
    assert not shed.occupied.any()
    assert set(sight_in(empty, layout, 0).tolist()) == {Visibility.OUT_OF_VIEW, Visibility.SEEN}


def test_no_such_frame_and_a_sensor_in_the_ground(scene, layout):
    with pytest.raises(InspeError, match="frame 4 is out of range"):
        sight_in(scene, layout, 4)
    buried = layout.with_poses(np.asarray(layout.poses) - [0, 0, 9, 0, 0, 0])
    with pytest.raises(InspeError, match="in the ground"):
        viewshed(scene, buried)


# ── Blind spots ─────────────────────────────────────────────────────────────


def test_a_part_is_an_eighth_of_a_region_or_its_middle(scene):
    """All is seen but for the sidewalk to the south-west, half of the time."""
    offset, cell = scene.voxels.columns - scene.voxels.center[:2], scene.voxels.size**2
    angle = np.degrees(np.arctan2(*offset.T[::-1]))
    own = (scene.voxels.region == Region.SIDEWALK) & (np.abs(angle + 135) < 22.4)
    spots = blind_spots(scene, np.where(own, 0.5, 1.0))
    first = spots[0]
    assert (first.name, first.region, first.direction) == (
        "south-west sidewalk", "sidewalk", "south-west",
    )  # fmt: skip
    assert first.unseen == pytest.approx(0.5, abs=0.01)
    assert first.loss == pytest.approx(1.0)
    assert first.area == pytest.approx(own.sum() * cell, abs=3)
    middle = scene.voxels.columns[own].mean(0)
    nearest = min(scene.voxels.columns[own].tolist(), key=lambda at: np.hypot(*(at - middle)))
    assert first.at == pytest.approx(nearest, abs=1.5)  # an eighth is a little wider
    there = {tuple(at): region for at, region in zip(scene.voxels.columns.tolist(),
                                                     scene.voxels.region, strict=True)}  # fmt: skip
    assert all(there[spot.at] == Region[spot.region.upper()] for spot in spots)
    assert all(spot.unseen == 0 for spot in spots[1:])
    assert sum(spot.area for spot in spots) == pytest.approx(len(offset) * cell, abs=9 * LEAST_AREA)
    inner = [spot for spot in spots if spot.direction == "middle"]
    assert [spot.name for spot in inner] == ["junction, in the middle"]
    assert inner[0].area == pytest.approx(np.pi * MIDDLE**2, rel=0.1)


def test_losses_go_by_the_weights_of_regions(scene):
    spots = blind_spots(scene, np.full(len(scene.voxels.columns), 0.25))
    assert [spot.loss for spot in spots] == sorted((s.loss for s in spots), reverse=True)
    assert sum(spot.loss for spot in spots) == pytest.approx(1.0, abs=0.01)
    by_area = {s.region: s.loss / s.area for s in spots}
    for region, rate in by_area.items():
        weight = PAPER_WEIGHTS[Region[region.upper()]] / PAPER_WEIGHTS[Region.SIDEWALK]
        assert rate / by_area["sidewalk"] == pytest.approx(weight, rel=1e-3)
    assert all(spot.unseen == pytest.approx(0.75) for spot in spots)
    some = replace(scene, voxels=replace(scene.voxels, region_weight=(0, 0, 0, 1.0, 0)))
    shares = np.full(len(scene.voxels.columns), 0.25)
    assert {spot.region for spot in blind_spots(some, shares)} == {"sidewalk"}
    assert blind_spots(scene, np.zeros(0)) == ()


def test_blind_spots_of_a_score(scene):
    """A camera that looks east leaves the west unseen; what is inside bodies is not counted."""
    scene = scene.with_statics(street_bodies(scene.intersection))
    layout = place_sensors((CAMERA, [0.0, 8.5, 5.0, 0.0, -0.3, 0.0]))
    scores = evaluate(scene, layout)
    spots = blind_spots(scene, scores.seen_share)
    by_name = {spot.name: spot for spot in spots}
    assert by_name["west driveway"].unseen == 1.0
    assert by_name["east driveway"].unseen < 0.9
    record = scores_record(scores, scene, layout)
    assert [row["name"] for row in record["blind_spots"]] == [spot.name for spot in spots]
    assert record["blind_spots"][0]["unseen"] == spots[0].unseen
    table = blind_spots_table(scene, scores)
    assert list(table.columns[0].cells) == [spot.name for spot in spots[:5]]
