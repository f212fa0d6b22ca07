"""Scores on several devices: the same to the last bit."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCORES = """
import json, jax, inspe_jax
from inspe_jax.world import world_of
scene = inspe_jax.build_scene(
    inspe_jax.built_in("t_junction"), radius=15, voxel=1.0, frames=19, density=8, seed=1
)
layout = inspe_jax.strategy(scene, "Cam-c/L-c")
found = []
for options in (
    {}, {"visibility": "line_of_sight"}, {"occlusion_reference": "covered"},
):
    s = inspe_jax.evaluate(scene, layout, **options)
    found += [s.coverage, s.occlusion, s.information_gain, s.region_coverage, s.level_coverage]
    found += [[c.surrogate for c in s.contributions], s.seen_share.tolist()]
poses = [layout.with_poses(layout.poses + [k, 0, 0, 0, 0, 0.1]).poses for k in range(3)]
many = inspe_jax.evaluate_many(scene, layout, poses)
found += [many.surrogate.tolist(), inspe_jax.in_view(scene, layout).sum().item()]
shares = world_of(scene).shares
places = [len(share.prisms.top.sharding.device_set) for share in shares]
print(json.dumps([jax.device_count(), found, places]))
"""


def scores(count: int) -> list:
    """What the script above prints where there are so many devices."""
    flags = f"--xla_force_host_platform_device_count={count}"
    ran = subprocess.run(
        [sys.executable, "-c", SCORES],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    devices, found, places = json.loads(ran.stdout)
    assert devices == count
    assert max(places) == count  # some frames are on all of them
    return found


@pytest.fixture(scope="module")
def on_one():
    return scores(1)


# 19 frames: 16 and 3 that are left over; 18 and 1. 8 divides the tiles, 3 does not.
@pytest.mark.parametrize("count", [8, pytest.param(3, marks=pytest.mark.slow)])
def test_scores_are_the_same_to_the_last_bit(on_one, count):
    assert on_one[0] > 0.1
    assert scores(count) == on_one
