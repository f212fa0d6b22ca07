"""Blind spots in words: worked out by hand on shares that are set, and of a real score."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, place_sensors, street_bodies, world

import inspe_jax
from inspe_jax.report.tables import blind_spots_table, scores_record
from inspe_jax.scene.regions import WEIGHTS, Region
from inspe_jax.scoring.blind_spots import LEAST_AREA, MIDDLE, blind_spots


def test_a_part_is_an_eighth_of_a_region_or_its_middle():
    """All is seen but for the sidewalk to the south-west, half of the time."""
    scene = world(radius=20.0, voxel=1.0, frames=2, count=4)
    offset = scene.voxels.columns - scene.voxels.center[:2]
    angle = np.degrees(np.arctan2(*offset.T[::-1]))
    own = (scene.voxels.region == Region.SIDEWALK) & (np.abs(angle + 135) < 22.4)
    spots = blind_spots(scene, np.where(own, 0.5, 1.0))
    first = spots[0]
    assert (first.name, first.region, first.direction) == (
        "south-west sidewalk", "sidewalk", "south-west",
    )  # fmt: skip
    assert first.unseen == pytest.approx(0.5, abs=0.01)
    assert first.loss == pytest.approx(1.0)
    assert first.area == pytest.approx(own.sum(), abs=3)
    middle = scene.voxels.columns[own].mean(0)
    nearest = min(scene.voxels.columns[own].tolist(), key=lambda at: np.hypot(*(at - middle)))
    assert first.at == pytest.approx(nearest, abs=1.5)  # an eighth is a little wider
    there = {tuple(at): region for at, region in zip(scene.voxels.columns.tolist(),
                                                     scene.voxels.region, strict=True)}  # fmt: skip
    assert all(there[spot.at] == Region[spot.region.upper()] for spot in spots)
    assert all(spot.unseen == 0 for spot in spots[1:])
    assert sum(spot.area for spot in spots) == pytest.approx(len(offset), abs=9 * LEAST_AREA)
    inner = [spot for spot in spots if spot.direction == "middle"]
    assert [spot.name for spot in inner] == ["junction, in the middle"]
    assert inner[0].area == pytest.approx(np.pi * MIDDLE**2, rel=0.1)


def test_losses_go_by_the_weights_of_regions():
    scene = world(radius=20.0, voxel=1.0, frames=2, count=4)
    spots = blind_spots(scene, np.full(len(scene.voxels.columns), 0.25))
    assert [spot.loss for spot in spots] == sorted((s.loss for s in spots), reverse=True)
    assert sum(spot.loss for spot in spots) == pytest.approx(1.0, abs=0.01)
    by_area = {s.region: s.loss / s.area for s in spots}
    for region, rate in by_area.items():
        weight = WEIGHTS[Region[region.upper()]] / WEIGHTS[Region.SIDEWALK]
        assert rate / by_area["sidewalk"] == pytest.approx(weight, rel=1e-3)
    assert all(spot.unseen == pytest.approx(0.75) for spot in spots)
    some = replace(scene, voxels=replace(scene.voxels, counted=(int(Region.SIDEWALK),)))
    shares = np.full(len(scene.voxels.columns), 0.25)
    assert {spot.region for spot in blind_spots(some, shares)} == {"sidewalk"}
    assert blind_spots(scene, np.zeros(0)) == ()


def test_of_a_score():
    """A camera that looks east leaves the west unseen; what is inside bodies is not counted."""
    scene = world(radius=20.0, voxel=1.0, frames=4, count=6)
    scene = scene.with_statics(street_bodies(scene.intersection))
    layout = place_sensors((CAMERA, [0.0, 8.5, 5.0, 0.0, -0.3, 0.0]))
    scores = inspe_jax.evaluate(scene, layout)
    spots = blind_spots(scene, scores.seen_share)
    by_name = {spot.name: spot for spot in spots}
    assert by_name["west driveway"].unseen == 1.0
    assert by_name["east driveway"].unseen < 0.9
    record = scores_record(scores, scene, layout)
    assert [row["name"] for row in record["blind_spots"]] == [spot.name for spot in spots]
    assert record["blind_spots"][0]["unseen"] == spots[0].unseen
    table = blind_spots_table(scene, scores)
    assert list(table.columns[0].cells) == [spot.name for spot in spots[:5]]
