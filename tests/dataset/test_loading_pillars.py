"""Pillars, compared with a dictionary that is filled point by point."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from loading_sets import frame_of, write_scenario

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.loading import Loader, PillarGrid, pillar_features
from inspe_jax.dataset.loading.stored import woven

GRID = PillarGrid(half=8.0, cell=2.0, low=-1, high=3, most_points=40, most_pillars=64)


def cloud(count=500, seed=0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-10, -10, -2, 0], [10, 10, 4, 1], (count, 4)).astype(np.float32)


def by_hand(points, grid) -> dict[tuple[int, int], list[tuple[float, ...]]]:
    found = defaultdict(list)
    for point in points:
        x, y, z = point[:3]
        if abs(x) < grid.half and abs(y) < grid.half and grid.low <= z < grid.high:
            cell = (int((axis + grid.half) // grid.cell) for axis in (x, y))
            found[tuple(cell)].append(tuple(point))
    return found


def filled(points, grid, rng=None):
    out = grid.empty()
    grid.fill(points, out, rng)
    return out


@pytest.mark.parametrize("most", [40, 3])
def test_every_point_in_reach_is_in_its_pillar(most):
    """A full pillar keeps its first points: clouds are in random order."""
    grid = replace(GRID, most_points=most)
    found, expected = filled(cloud(), grid), by_hand(cloud(), grid)
    assert 40 < len(expected) <= 64
    assert (found.counts > 0).sum() == len(expected)
    assert most == 40 or found.counts.max() == most
    for p in np.flatnonzero(found.counts):
        rows = [tuple(row) for row in found.points[p, : found.counts[p]]]
        assert rows == expected[tuple(found.cells[p])][:most]
        assert not found.points[p, found.counts[p] :].any()
    assert not found.points[found.counts == 0].any()


def test_too_many_pillars():
    """Which are kept is drawn, and is the same where nothing is to be drawn."""
    grid = replace(GRID, most_pillars=10)
    expected = by_hand(cloud(), grid)
    seen = set()
    for seed in range(8):
        found = filled(cloud(), grid, np.random.default_rng(seed))
        cells = [tuple(cell) for cell in found.cells]
        assert len(set(cells)) == 10
        for p, cell in enumerate(cells):
            assert found.counts[p] == len(expected[cell])
        seen |= set(cells)
    assert len(seen) > 40
    np.testing.assert_array_equal(filled(cloud(), grid).cells, filled(cloud(), grid).cells)


def test_edges_of_the_grid_and_clouds_out_of_reach():
    edge = np.nextafter(np.float32(8), np.float32(0))
    points = np.array([[edge, edge, 0, 1], [-edge, -edge, 0, 1], [8, 0, 0, 1]], np.float32)
    found = filled(points, GRID)
    assert sorted(map(tuple, found.cells[found.counts > 0].tolist())) == [(0, 0), (7, 7)]
    for points in (np.zeros((0, 4), np.float32), cloud() + np.float32(100)):
        assert not any(part.any() for part in filled(points, GRID))


def test_features_are_those_of_pointpillars():
    found = filled(cloud(), GRID)
    features = pillar_features(found, GRID)
    assert features.shape == (64, 40, 9)
    for p in range(64):
        own = found.points[p, : found.counts[p]]
        if not len(own):
            assert not features[p].any()
            continue
        middle = (found.cells[p] + 0.5) * 2.0 - 8.0
        expected = np.hstack([own, own[:, :3] - own[:, :3].mean(0), own[:, :2] - middle])
        np.testing.assert_allclose(features[p, : len(own)], expected, atol=1e-5)
        assert not features[p, len(own) :].any()
        assert (np.abs(features[p, : len(own), 7:]) <= 1.0 + 1e-5).all()


def test_pillars_of_a_unit_have_the_points_of_all_its_lidars(tmp_path):
    frame = frame_of(0, cameras=False)
    first, second = frame.stations
    both = replace(second, scans=(second.scans[0], first.scans[0]))
    write_scenario(tmp_path / "set" / "train" / "a", [replace(frame, stations=(first, both))])
    found = dataset.cache(tmp_path / "set", tmp_path / "cache", pictures=None, workers=1)
    points = Loader(found, batch=1, shuffle=False, workers=0)[0].lidars
    grid = PillarGrid(half=16.0, cell=1.0, most_points=64, most_pillars=1024)
    lidars = Loader(found, batch=1, shuffle=False, points=grid, workers=0)[0].lidars
    assert lidars.points is lidars.mask is None
    assert lidars.pillars.points.shape == (1, 2, 1024, 64, 4)
    for g, members in enumerate([[0], [1, 2]]):
        own = np.concatenate([points.points[0, s][points.mask[0, s]] for s in members])
        expected = {cell: len(rows) for cell, rows in by_hand(own, grid).items()}
        counts = lidars.pillars.counts[0, g]
        cells = map(tuple, lidars.pillars.cells[0, g][counts > 0].tolist())
        assert dict(zip(cells, counts[counts > 0].tolist(), strict=True)) == expected


def test_clouds_are_woven_evenly():
    """Of the first tenth of a joint cloud, each cloud has a tenth of its own, in its order."""
    clouds = [np.full((n, 4), k, np.float32) for k, n in enumerate((1000, 3000, 10))]
    for part in clouds:
        part[:, 1] = np.arange(len(part))
    found = woven(clouds)
    assert len(found) == 4010
    for k, part in enumerate(clouds):
        own = found[found[:, 0] == k]
        np.testing.assert_array_equal(own, part)
        assert abs((found[:401, 0] == k).sum() - len(part) / 10) <= 1
    assert woven(clouds[:1]) is clouds[0]
    assert len(woven([clouds[0][:0], clouds[2]])) == 10


@pytest.mark.parametrize(("bad", "message"), [
    (dict(cell=0.3), r"not a whole number of cells of 0\.3 m: use half: 51\.15"),
    (dict(cell=0.0), "cell 0.0 m must be above 0"),
    (dict(low=3.0, high=3.0), "low 3.0 m must be below"),
    (dict(most_points=0), "most_points: 0 is out of range: at least 1"),
])  # fmt: skip
def test_bad_grids(bad, message):
    with pytest.raises(InspeError, match=message):
        PillarGrid(**bad).check()
