"""Whole searches by every method, and whether what they find can be mounted."""

import pytest
from mounts import assert_mountable, lanes_of

from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement.optimise import METHODS, compare
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene

SEEDS = 2
"""16 make 288 searches: for when something changes in how sensors may stand."""
MAPS = {
    "roundabout": tuple(METHODS),
    "t_junction": ("greedy-adam", "grid", "random", "greedy", "cma-es"),
}
"""Of the methods that only move within their charts one will do for the second map."""


@pytest.mark.slow
@pytest.mark.parametrize("name", MAPS)
def test_what_every_search_finds_can_be_mounted(name):
    """Every method from random starts. Units of a camera and a LiDAR, and of one sensor.

    The rules are read from the map's polygons by shapely, not by the search's own code.
    """
    scene = build_scene(built_in(name), radius=30, voxel=2.0, frames=2, density=10)
    layout = strategy(scene, "Cam-d1/L-d1")
    methods = MAPS[name]
    results = compare(scene, layout, methods, evaluations=60, seeds=SEEDS, start="random")
    assert len(results) == SEEDS * len(methods)
    lanes = lanes_of(scene.intersection)
    for result in results:
        assert_mountable(scene, result.start, lanes)
        assert_mountable(scene, result.layout, lanes)
        assert result.objective >= result.objective_before
    assert sum(result.objective > result.objective_before for result in results) > SEEDS
