"""Scores on several devices: the same to the last bit."""

import json

import pytest
from processes import on_devices
from worlds import slow_but

import inspe_jax

OPTIONS = {3: {"visibility": "line_of_sight", "occlusion_reference": "covered"}, 8: {}}
"""By number of devices. 19 frames: 18 and 1 that is left over; 16 and 3. 3 does not divide the
tiles, 8 does."""

SCRIPT = """
import json
import jax
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from test_sharding import OPTIONS, scene_and_layout, scores

scene, layout = scene_and_layout()
found = scores(scene, layout, OPTIONS[jax.device_count()])
places = [len(share.prisms.top.sharding.device_set) for share in tiled_scene_of(scene).chunks]
print(json.dumps([max(places), found]))
"""


def scene_and_layout():
    scene = inspe_jax.build_scene(
        inspe_jax.built_in("t_junction"), radius=15, voxel=1.0, frames=19, density=8, seed=1
    )
    return scene, inspe_jax.strategy(scene, "Cam-c/L-c")


def scores(scene, layout, options) -> list:
    s = inspe_jax.evaluate(scene, layout, **options)
    found = [s.coverage, s.occlusion, s.information_gain, s.region_coverage]
    found += [[c.surrogate for c in s.contributions], s.seen_share.tolist()]
    poses = [layout.with_poses(layout.poses + [k, 0, 0, 0, 0, 0.1]).poses for k in range(3)]
    many = inspe_jax.evaluate_many(scene, layout, poses, **options)
    found += [many.surrogate.tolist(), inspe_jax.in_view(scene, layout).sum().item()]
    return json.loads(json.dumps(found))


@pytest.mark.parametrize("count", slow_but(OPTIONS, 3))
def test_scores_are_the_same_to_the_last_bit(count):
    """In a process of so many devices as in this one, which has one."""
    used, found = json.loads(on_devices(count, SCRIPT, __file__)[-1])
    on_one = scores(*scene_and_layout(), OPTIONS[count])
    assert used == count  # some frames are on all of them
    assert on_one[0] > 0.1
    assert found == on_one
