"""Ground in the way: against Embree, by hand, differences, and the exact limit."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import (
    LIDAR,
    MAPS,
    double_precision,
    embree_line_of_sight,
    emptied,
    place_sensors,
    street_bodies,
    world,
)

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.height_field import ground_ceiling, ground_margin
from inspe_jax.placement.problem import Case, Problem
from inspe_jax.scene.terrain import Terrain
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.queries import in_view, line_of_sight
from inspe_jax.visibility.statics import past_statics_chance
from inspe_jax.visibility.tiles import tiles_of

SIZE = dict(radius=20.0, voxel=0.5, frames=2, count=8)
chance = jax.jit(past_statics_chance)
sum_of_chances = jax.jit(lambda *given: past_statics_chance(*given).sum())
slope_of_chances = jax.jit(jax.grad(lambda *given: past_statics_chance(*given).sum()))


def hills(kind="knolls", center=(0.0, 0.0, 0.0), **size):
    """The test crossing on ground that is not level.

    ``brow``: level up to x = 4 m, then down by 12 %. ``knolls``: rough, with slopes up to 55 %.
    """
    scene = world(**{**SIZE, **size}, center=center)
    x, y = (scene.intersection.ground_points[:, :2] - center[:2]).T
    height = {
        "brow": -0.12 * np.maximum(x - 4.0, 0.0),
        "knolls": 3.0 * np.sin(x / 6.0) * np.cos(y / 7.0) + 0.04 * x,
        "level": 0.0 * x,
    }[kind]
    points = np.column_stack([scene.intersection.ground_points[:, :2], center[2] + height])
    place = replace(scene.intersection, ground_points=points)
    t = scene.traffic
    ground = place.ground(t.center[..., :2].reshape(-1, 2)).reshape(t.center.shape[:2])
    stood = np.concatenate([t.center[..., :2], (ground + t.size[..., 2] / 2)[..., None]], -1)
    scene = replace(scene, intersection=place, traffic=replace(t, center=stood))
    return scene.with_terrain()


def sensors_in(scene, count=5, seed=0):
    """Sensors 1 to 6 m above the ground, in no road user of the first frame."""
    rng, t = np.random.default_rng(seed), scene.traffic
    xy = rng.uniform(-18, 18, (20 * count, 2)) + scene.voxels.center[:2]
    users = t.center[0, t.valid[0], :2]
    away = np.hypot(*(xy[:, None] - users[None]).transpose(2, 0, 1)).min(1, initial=np.inf)
    xy = xy[away > 8.0][:count]
    z = scene.intersection.ground(xy) + np.linspace(1.0, 6.0, count)
    poses = np.column_stack([xy, z, np.zeros((count, 3))])
    return place_sensors(*[(LIDAR, pose) for pose in poses.tolist()])


@pytest.mark.parametrize(
    ("center", "bodies"), [((0.0, 0.0, 0.0), False), ((1873.2, -951.7, 41.0), True)]
)
def test_line_of_sight_agrees_with_embree(center, bodies):
    """At least 99.99 % of (sensor, voxel), of which the ground hides a good part."""
    scene = hills("knolls", center)
    if bodies:
        scene = scene.with_statics(street_bodies(scene.intersection))
        scene = scene.with_statics([b for b in scene.statics if b.transmittance < 0.5])
    layout = sensors_in(scene)
    ours, embree = (of(scene, layout, 0) for of in (line_of_sight, embree_line_of_sight))
    known = slice(None) if scene.inside_statics is None else ~scene.inside_statics.ravel()
    assert (ours != embree)[:, known].mean() <= 1e-4
    open_ = line_of_sight(replace(scene, terrain=None), layout, 0)
    assert (open_ & ~ours).mean() > 0.03
    assert not (ours & ~open_).any()


@pytest.mark.parametrize(
    ("town", "junction"), [("Town03", "222"), ("Town04", "1082"), ("Town07", "725")]
)
def test_towns_agree_with_embree(town, junction):
    """On real maps, from sensors near the ground, where it hides most."""
    if not (path := MAPS / f"{town}.xodr").is_file():
        pytest.skip("the town maps are not beside the checkout")
    from inspe_jax.scene.maps.registry import read_map

    place = read_map(path, junction=junction, radius=40.0)
    size = dict(radius=40, voxel=1.0, frames=1, density="none")
    scene = inspe_jax.build_scene(place, **size, terrain="ground")
    layout = sensors_in(scene, 8)
    ours, embree = (of(scene, layout, 0) for of in (line_of_sight, embree_line_of_sight))
    assert (ours != embree).mean() <= 1e-4
    assert not (ours & ~line_of_sight(replace(scene, terrain=None), layout, 0)).any()


def test_behind_a_brow_by_hand():
    """From 1 m above level ground that falls by 12 % from x = 4 m on.

    A line from (−6, 1) over the brow at (4, 0) falls by 10 %, so the ground beyond is 0.02·(x − 4)
    below it. The lattice has its points on whole metres: the brow is one.
    """
    scene = hills("brow", voxel=0.1, radius=16.0, count=0)
    layout = place_sensors((LIDAR, [-6.0, 0.05, 1.0, 0.0, 0.0, 0.0]))
    clear = line_of_sight(scene, layout, 0)[0]
    x, y, z = scene.voxels.centers.T
    row = (np.abs(y - 0.05) < 0.01) & (x > 5)
    # The map's points are 5 m apart: between them the surface is a chord from (0, 0) to (5, −0.12).
    surface = scene.terrain.height(np.column_stack([x, y]))
    crossings = np.arange(-5.0, 16.0)
    t = (crossings[:, None] + 6.0) / (x[row] + 6.0)
    at = np.column_stack([crossings, np.full(len(crossings), 0.05)])
    line = 1.0 + t * (z[row] - 1.0)
    hidden = ((scene.terrain.height(at)[:, None] > line) & (t < 1)).any(0)
    assert 0.002 < hidden.mean() < 0.5
    assert (clear[row] == ~hidden).mean() > 0.999
    assert (z[row][hidden] - surface[row][hidden] < 0.6).all()


def test_level_ground_hides_nothing():
    scene = world(**SIZE)
    assert scene.with_terrain() is scene
    slope = world(**SIZE, slope=-0.08).with_terrain()
    layout = sensors_in(slope)
    for of in (in_view, lambda *given: line_of_sight(*given, 0)):
        assert (of(slope, layout) == of(replace(slope, terrain=None), layout)).all()


def test_the_two_forms_agree():
    """A voxel is below the ceiling exactly where the sensor is too low for it."""
    scene = hills()
    centered = about_center(scene)
    ground, tiles = centered.statics.ground, tiles_of(centered).tile

    @jax.jit
    def both(at):
        def forms(tile):
            below = tile.heights < ground_ceiling(ground, at, tile.columns, tile.low)[None]
            given = tile.columns, tile.heights, tile.low, 1.5
            return below, ground_margin(ground, at, *given)

        return jax.lax.map(forms, tiles)

    seen = 0
    for pose in np.asarray(sensors_in(scene, 12).poses):
        below, low = both(jnp.asarray(pose[:3], float))
        below, low = np.asarray(below), np.asarray(low)
        sure = np.abs(low) > 1e-3
        assert ((low > 0) == below)[sure].all()
        seen += below.sum()
    assert seen > 100


def test_the_soft_reading_becomes_the_exact_one():
    scene, half = hills(), 0
    centered = about_center(scene)
    layout = sensors_in(scene)
    exact = line_of_sight(emptied(scene), layout, 0)
    tiles = tiles_of(centered)

    @jax.jit
    def chances(at):
        one = lambda tile: past_statics_chance(at, centered.statics, tile, 1e-3)  # noqa: E731
        return jax.lax.map(one, tiles.tile)

    for s, pose in enumerate(np.asarray(layout.poses)):
        soft = chances(jnp.asarray(pose[:3], float))
        found = tiles.of_voxels(np.asarray(soft).swapaxes(1, 2))
        half += ((found > 0.01) & (found < 0.99)).sum()
        sure = (found < 0.01) | (found > 0.99)
        assert ((found > 0.5) == exact[s])[sure].all()
    assert half < 0.002 * exact.size


def test_gradients_are_differences():
    """Of the sum of chances over a tile, in x, y and z, where one crossing decides throughout."""
    with double_precision():
        scene = hills(voxel=1.0)
        centered = about_center(scene)
        tile = jax.tree.map(lambda x: np.asarray(x)[0], tiles_of(centered).tile)
        found = 0.0
        for pose in np.asarray(sensors_in(scene, 4).poses):
            at, width = pose[:3], 0.3
            given = centered.statics, tile, width
            slope = np.asarray(slope_of_chances(at, *given))
            step = 1e-5
            ends = [
                [sum_of_chances(at + sign * step * np.eye(3)[n], *given) for sign in (1, -1)]
                for n in range(3)
            ]
            differences = np.array([(float(a) - float(b)) / (2 * step) for a, b in ends])
            assert slope == pytest.approx(differences, rel=1e-3, abs=1e-4)
            found += np.abs(slope).sum()
    assert found > 1.0


def test_a_higher_sensor_sees_more():
    """A LiDAR behind a brow."""
    scene = hills("knolls")
    layout = sensors_in(scene, 1)
    higher = layout.with_poses(np.asarray(layout.poses) + np.array([0, 0, 2.0, 0, 0, 0]))
    scores = [inspe_jax.evaluate(scene, of).occlusion for of in (layout, higher)]
    assert scores[1] > scores[0]


def test_a_surface_by_hand():
    """A cell is cut from its first point to the opposite one, and each half is a plane."""
    terrain = Terrain(np.array([10.0, 20.0]), 2.0, np.array([[0.0, 1.0], [4.0, 2.0]]))
    at = np.array([[10, 20], [12, 20], [10, 22], [12, 22], [11, 21], [11.5, 20.5], [10.5, 21.5]])
    assert terrain.height(at) == pytest.approx([0, 4, 1, 2, 1, 2.5, 1.0])
    assert terrain.height(np.array([[0.0, 0.0], [99.0, 99.0]])) == pytest.approx([0, 2])
    assert terrain.steepest == pytest.approx(np.hypot(4, 2) / 2)
    normal = np.cross(*np.diff(terrain.points[terrain.faces], axis=1).swapaxes(0, 1))
    assert (normal[:, 2] > 0).all()


def test_scenes_with_terrain_reload(tmp_path):
    scene, layout = hills(), sensors_in(hills())
    inspe_jax.save_scene(scene, tmp_path / "hills.npz")
    again = inspe_jax.load_scene(tmp_path / "hills.npz")
    assert (again.terrain.heights == scene.terrain.heights).all()
    assert (line_of_sight(again, layout, 0) == line_of_sight(scene, layout, 0)).all()
    with pytest.raises(InspeError, match="none or ground"):
        inspe_jax.build_scene(scene.intersection, radius=12, terrain="groud")


def test_recordings_have_the_same_ground():
    """The triangles of a scene's terrain are those of the recorded world there."""
    pytest.importorskip("embreex", reason="recordings need Embree: extra [dataset]")
    from inspe_jax.simulation.embedded.static_bodies import Material
    from inspe_jax.simulation.embedded.static_world import build_static_world

    scene = hills(center=(1873.2, -951.7, 41.0))
    place, radius = scene.intersection, scene.voxels.radius
    world = build_static_world(place, radius, np.zeros((0, 4)))
    recorded = world.triangles[world.material == Material.GROUND] + place.center
    own = scene.terrain.points[scene.terrain.faces]
    middle, corner = recorded.mean(1)[:, :2], scene.terrain.corner
    span = scene.terrain.step * (np.array(scene.terrain.heights.shape) - 1)
    near = ((middle > corner) & (middle < corner + span)).all(1)
    ordered = [faces[np.lexsort(faces.mean(1).round(2).T)] for faces in (recorded[near], own)]
    assert ordered[0] == pytest.approx(ordered[1], abs=1e-3)


def test_cases_of_a_search_have_the_same_terrain():
    scene, layout = hills(), sensors_in(hills(), 2)
    Problem(Case(scene), layout)
    with pytest.raises(InspeError, match="have other terrain"):
        Problem([Case(scene), Case(replace(scene, terrain=None))], layout)


def test_everything_stands_on_the_same_surface():
    """Road users, the check of sensors and the voxels: within 10 cm at slopes of 55 %, as the mean
    of four corners of a cell is not the height of its triangles."""
    scene = hills()
    t = scene.traffic
    users = t.center[t.valid]
    feet = users[:, 2] - t.size[t.valid][:, 2] / 2
    assert feet == pytest.approx(scene.terrain.height(users), abs=0.05)
    columns = scene.voxels.columns
    assert scene.intersection.ground(columns) == pytest.approx(scene.voxels.ground, abs=0.1)
    low = place_sensors((LIDAR, [3.3, 3.3, 0.0, 0, 0, 0]))
    pose = np.array(low.poses)
    pose[0, 2] = scene.terrain.height(pose[:, :2])[0] - 0.2
    with pytest.raises(InspeError, match="is in the ground"):
        line_of_sight(scene, replace(low, poses=pose), 0)
