"""What is compiled once serves other traffic, lights, junctions, layouts and devices."""

from functools import cache

import jax
import numpy as np
import pytest
from worlds import CAMERA, LIDAR, SMALL, random_layout

import inspe_jax
from inspe_jax.core.compiling import compiled
from inspe_jax.scoring.viewshed import sight_in, viewshed
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec

FOG = Conditions.of("night", "fog:100")
OTHER_LIDAR = LidarSpec(
    "other-lidar", tuple(np.radians(np.linspace(-30, 5, 40)).tolist()), 900, 2 * np.pi, 70.0
)
OTHER_CAMERA = CameraSpec("other-camera", 640, 480, 500.0, (320.0, 240.0), 0.1, 40.0, 0.8)


@cache
def scene_of(name="t_junction", density=10, seed=0):
    return inspe_jax.build_scene(
        inspe_jax.built_in(name), **SMALL, frames=4, density=density, seed=seed
    )


def exact(scene, layout, conditions):
    return inspe_jax.evaluate(scene, layout, conditions=conditions).surrogate


def soft(scene, layout, conditions):
    return inspe_jax.evaluate(scene, layout, softness=0.5, conditions=conditions).surrogate


def slope(scene, layout, conditions):
    """Of the soft score, by a grad that is not compiled itself."""

    def score(poses):
        return soft(scene, layout.with_poses(poses), conditions)

    found = jax.grad(score)(jax.device_put(np.asarray(layout.poses, np.float32)))
    assert found.shape == (len(layout), 6)
    assert np.isfinite(found).all()
    assert np.abs(found).max() > 0
    return found


def many(scene, layout, conditions):
    poses = np.stack([layout.poses, layout.poses])
    return inspe_jax.evaluate_many(scene, layout, poses, conditions=conditions).surrogate


def seen(scene, layout, conditions):
    return viewshed(scene, layout, conditions=conditions).seen


def sight(scene, layout, conditions):
    return [sight_in(scene, layout, frame, conditions=conditions) for frame in (0, 2)]


SPECS = [LIDAR, CAMERA]
CASES = {
    "another seed": lambda: (scene_of(seed=1), SPECS),
    "fog": lambda: (scene_of(), SPECS, FOG),
    "more vehicles": lambda: (scene_of(density=12), SPECS),
    "another junction": lambda: (scene_of("four_way"), SPECS),
    "one more sensor": lambda: (scene_of(), [*SPECS, CAMERA]),
    "other devices": lambda: (scene_of(), [OTHER_LIDAR, OTHER_CAMERA]),
}


def layout_on(scene, specs) -> Layout:
    return random_layout(scene, specs, seed=3, heights=(3.0, 6.0))


@pytest.mark.parametrize("what", [exact, soft, slope, many, seen, sight])
def test_a_second_one_of_similar_size_compiles_nothing(what):
    """The first compiles; then other scenes, lights and layouts of the same buckets do not."""
    scene = scene_of()
    what(scene, layout_on(scene, SPECS), Conditions())
    for name, case in CASES.items():
        scene, specs, *conditions = case()
        layout = layout_on(scene, specs)
        before = compiled().programs
        what(scene, layout, *(conditions or [Conditions()]))
        assert compiled().programs == before, name


def test_buckets_hold_what_they_are_for():
    """At most twice the least, or half as much again as is needed."""
    from inspe_jax.core.arrays import bucket

    for count in range(1, 1000):
        held = bucket(count, 4)
        assert count <= held < max(5, 1.5 * count + 1)
    assert bucket(0, 4) == 0
