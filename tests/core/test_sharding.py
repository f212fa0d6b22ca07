"""Scores on several devices: the same to the last bit."""

import json

import pytest
from processes import on_devices
from worlds import slow_but

import inspe_jax

PLAIN, EVERY = {}, {"visibility": "line_of_sight", "occlusion_reference": "covered"}
CASES = [(3, EVERY)]
"""Devices and options. 19 frames: 18 and 1 that is left over; 16 and 3. 3 does not divide the
tiles, 8 does."""
OTHERS = [(8, PLAIN)]

SCRIPT = """
import json, sys
from functools import cache
import jax
import numpy as np
from inspe_jax.core import sharding
from inspe_jax.scoring import exact
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from test_sharding import scene_and_layout, scores

for count, options in json.loads(sys.argv[1]):
    mesh = jax.sharding.Mesh(np.array(jax.local_devices()[:count]), ("devices",))
    sharding.devices, sharding._mesh = lambda: count, lambda: mesh
    for kept in vars(exact).values():  # what was compiled for another number of devices
        getattr(kept, "cache_clear", int)()
    scene, layout = scene_and_layout()
    found = scores(scene, layout, options)
    places = [len(share.prisms.top.sharding.device_set) for share in tiled_scene_of(scene).chunks]
    print(json.dumps([jax.device_count(), max(places), found]))
"""


def scene_and_layout():
    scene = inspe_jax.build_scene(
        inspe_jax.built_in("t_junction"), radius=15, voxel=1.0, frames=19, density=8, seed=1
    )
    return scene, inspe_jax.strategy(scene, "Cam-c/L-c")


def scores(scene, layout, options) -> list:
    s = inspe_jax.evaluate(scene, layout, **options)
    found = [s.coverage, s.occlusion, s.information_gain, s.region_coverage, s.level_coverage]
    found += [[c.surrogate for c in s.contributions], s.seen_share.tolist()]
    poses = [layout.with_poses(layout.poses + [k, 0, 0, 0, 0, 0.1]).poses for k in range(3)]
    many = inspe_jax.evaluate_many(scene, layout, poses, **options)
    found += [many.surrogate.tolist(), inspe_jax.in_view(scene, layout).sum().item()]
    return json.loads(json.dumps(found))


def on_many(cases) -> list:
    """What the script above prints, a line a case: a process that has eight devices."""
    return [json.loads(line) for line in on_devices(8, SCRIPT, __file__, json.dumps(cases))]


@pytest.mark.parametrize("cases", slow_but([CASES, OTHERS], CASES), ids=["cases", "others"])
def test_scores_are_the_same_to_the_last_bit(cases):
    """As those of this process, which has one device."""
    for (count, options), (devices, used, found) in zip(cases, on_many(cases), strict=True):
        on_one = scores(*scene_and_layout(), options)
        assert (devices, used) == (8, count)  # some frames are on all of them
        assert on_one[0] > 0.1
        assert found == on_one
