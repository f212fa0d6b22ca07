"""Layouts and feasible sets on the built-in scenes, and the rules of mounting from the raw map."""

from itertools import combinations

import numpy as np
import pytest
from shapely.geometry import LineString, Point
from shapely.ops import unary_union
from worlds import CAMERA, LIDAR

from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.space import Space
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import Scene, build_scene
from inspe_jax.sensing.layout import Layout, Sensor, Unit, make_layout
from inspe_jax.sensing.sensors import Spec

SCENES: dict[str, Scene] = {}


def scene_named(name: str) -> Scene:
    if name not in SCENES:
        place = built_in(name)
        SCENES[name] = build_scene(
            place, profile="ideal", radius=40.0, voxel=2.0, density="none", frames=1
        )
    return SCENES[name]


def space_of(scene="four_way", layout="Cam-d1/L-d1", **options) -> Space:
    scene = scene_named(scene) if isinstance(scene, str) else scene
    layout = strategy(scene, layout) if isinstance(layout, str) else layout
    return Space(scene, layout, Constraints(**options))


def lanes_of(place: Intersection):
    lines = [r for r in place.routes if r.user == "vehicle" and len(r.waypoints) > 1]
    return unary_union(
        [LineString(r.waypoints[:, :2]).buffer(r.width / 2, cap_style="flat") for r in lines]
    )


def assert_mountable(scene: Scene, layout: Layout, lanes, *, central: bool = False) -> None:
    """The rules, once more and from the raw map."""
    place, radius = scene.intersection, scene.voxels.radius
    center = scene.voxels.center[:2]
    for unit in layout.units:
        foot = Point(unit.base[:2])
        on_pole = any(foot.distance(Point(p[:2])) <= 1e-3 for p in place.poles)
        on_area = place.mounting.distance(foot) <= 1e-3
        assert on_pole or on_area or (central and foot.distance(Point(center)) < 1.5)
        assert foot.distance(Point(center)) <= radius + 1e-3
        if not central:
            # Mitred joins reach a little further on the outside of a bend, never less far.
            assert not lanes.buffer(-1e-3).contains(foot)
        assert unit.base[2] == pytest.approx(place.ground(np.array(unit.base[:2]))[0], abs=1e-9)
    for sensor, pose in zip(layout.sensors, layout.poses, strict=True):
        base = np.array(layout.units[sensor.unit].base)
        above = pose[2] - base[2]
        assert (5.0 if central else 3.0) - 1e-3 <= above <= 12.0 + 1e-3
        assert np.hypot(*(pose[:2] - base[:2])) <= 2.0 + 1e-3
        if above < 5.0 - 1e-3:
            assert not lanes.contains(Point(pose[:2]))
        low, high = np.radians({"camera": (-80, 10), "lidar": (-30, 30)}[sensor.spec.kind])
        assert low - 1e-3 <= pose[4] <= high + 1e-3
        assert -np.pi <= pose[5] <= np.pi
    for a, b in combinations(range(len(layout)), 2):
        if layout.sensors[a].unit == layout.sensors[b].unit:
            apart = np.abs(layout.poses[a] - layout.poses[b])
            assert np.hypot(*apart[:2]) <= 2.0 + 1e-3
            assert apart[2] <= 4.0 + 1e-3


def team(scene: Scene, second: Spec = LIDAR) -> Layout:
    """A camera and a LiDAR on one pole, two cameras on another, one on a third; all look up."""
    c = scene.voxels.center
    units = [
        Unit(name, (c[0] + x, c[1] + y, c[2]))
        for name, x, y in (("a", 9, 9), ("b", -9, -9), ("c", -9, 9))
    ]
    members = [("ca", CAMERA, 0), ("la", second, 0), ("cb", CAMERA, 1), ("db", CAMERA, 1)]
    members += [("cc", CAMERA, 2)]
    poses = [[*units[u].base[:2], 4.0, 0.0, 0.15, 0.7 * s] for s, (_, _, u) in enumerate(members)]
    return make_layout([Sensor(*row) for row in members], units, np.array(poses))


def two_sensors(scene: Scene, foot, *hung, pitch=-0.3) -> Layout:
    """One unit at ``foot``; sensors at (x, y) from it and heights above the ground there."""
    ground = float(scene.intersection.ground(np.array(foot, float))[0])
    poses = [[foot[0] + x, foot[1] + y, ground + z, 0, pitch, 0.5] for x, y, z in hung]
    sensors = [Sensor(f"s{i}", CAMERA, 0) for i in range(len(poses))]
    return make_layout(sensors, [Unit("u", (*foot, ground))], np.array(poses), "by hand")


SIDEWALK = (14.0, 9.5)
"""In the middle of a sidewalk of worlds.crossing, whose roads are 14 m wide."""


def anywhere(space: Space, count: int, seed: int = 0) -> np.ndarray:
    """Coordinates that are hardly ever feasible."""
    rng = np.random.default_rng(seed)
    x = space.random(rng, count)
    return x + rng.normal(size=x.shape) * np.maximum(space.scale, 0.1) * 3
