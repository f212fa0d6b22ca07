"""Static bodies and ground in the way: against Embree, walked rays, NumPy's counts, differences, by
hand, and the exact limit."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import raycast
import worlds
from worlds import CAMERA, LIDAR, embree_line_of_sight, place_sensors, street_bodies, world

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.height_field import ground_ceiling, ground_margin
from inspe_jax.core.numerics import Softness
from inspe_jax.placement.problem import Case, Problem
from inspe_jax.scene.statics import body, pole, tree, upright_box, wall
from inspe_jax.scene.terrain import Terrain
from inspe_jax.scoring.viewshed import viewshed
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.queries import in_view, line_of_sight
from inspe_jax.visibility.statics import past_statics_chance, past_statics_of_sensor
from inspe_jax.visibility.tiles import tiles_of

SIZE = dict(radius=20.0, voxel=0.5, frames=4, count=12)
chance = jax.jit(past_statics_chance)
slope_of_chance = jax.jit(jax.grad(lambda *given: past_statics_chance(*given).sum()))


@jax.jit
def chance_by_tile(sensor, statics, tiles, width):
    return jax.lax.map(lambda tile: past_statics_chance(sensor, statics, tile, width), tiles)


def chances(scene, sensor, width):
    """The chances (V,) that what stands leaves the line from a sensor to each voxel clear."""
    at = about_center(scene)
    tiles = tiles_of(at)
    found = chance_by_tile(np.float32(sensor), at.statics, tiles.tile, width)
    return tiles.of_voxels(np.asarray(found).swapaxes(1, 2))


# ── Bodies ──────────────────────────────────────────────────────────────────


def street(slope=0.0, center=(0, 0, 0), **size):
    scene = world(**{**SIZE, **size}, slope=slope, center=center)
    return scene.with_statics(street_bodies(scene.intersection))


def layout_in(scene):
    """Six sensors: on a roof, beneath a crown, behind a wall, beside a pole, and over the road."""
    x, y, _ = scene.voxels.center
    at = [(11.0, 12.0, 7.0), (9.6, -8.6, 1.6), (-13.0, 9.9, 1.2)]
    at += [(7.1, 7.4, 3.0), (-3.0, -2.0, 5.5), (-10.4, -8.0, 7.5)]
    ground = scene.intersection.ground(np.array([[dx + x, dy + y] for dx, dy, _ in at]))
    poses = [
        [x + dx, y + dy, g + up, 0.0, -0.3, np.arctan2(-dy, -dx)]
        for (dx, dy, up), g in zip(at, ground.tolist(), strict=True)
    ]
    return place_sensors(*zip([LIDAR, CAMERA] * 3, poses, strict=True))


@pytest.mark.parametrize(("slope", "center"), [(0.0, (0, 0, 0)), (-0.08, (1873.2, -951.7, 41.0))])
def test_line_of_sight_agrees_with_embree(slope, center):
    """At least 99.99 % of (sensor, voxel), with vehicles and without; crowns that let more than
    half of the light through hide nothing, and are no triangles."""
    scene = street(slope, center)
    layout = layout_in(scene)
    opaque = [one for one in scene.statics if one.transmittance < 0.5]
    bare = [one for one in scene.statics if one.transmittance >= 0.5]
    trunks = [pole(one.middle, radius=one.trunk, height=one.base) for one in bare]
    solid = scene.with_statics(opaque + trunks)
    differ = total = 0
    for frame in range(2):
        ours = line_of_sight(scene, layout, frame)
        embree = embree_line_of_sight(solid, layout, frame)
        assert 0.05 < embree.mean() < 0.95
        known = ~scene.inside_statics.ravel()  # in a thin crown is no part of the region either
        differ, total = differ + (ours != embree)[:, known].sum(), total + ours[:, known].size
    assert differ / total <= 1e-4
    open_ = scene.with_statics([])
    assert (line_of_sight(open_, layout, 0) & ~line_of_sight(scene, layout, 0)).mean() > 0.1
    assert not (line_of_sight(scene, layout, 0) & ~line_of_sight(open_, layout, 0)).any()


def test_in_view_agrees_with_rays_that_end_at_bodies():
    """C of all sensors within 0.006, and 98.5 % of the voxels of each but the first.

    By rays, a voxel is in view if one comes to it; here, if one would and the line to its centre is
    clear. They differ where the edge of a shadow crosses a voxel, of which some part is in view
    then: at 0.5 m, in 0.1 to 1 % of the voxels, and in 3.5 % for a sensor 1 m above a roof.
    """
    scene = street()
    layout = layout_in(scene)
    ours, walked = in_view(scene, layout), raycast.in_view(scene, layout, "exact")
    weight = scene.voxel_weight
    both = [weight @ found.any(0) / weight.sum() for found in (ours, walked)]
    assert both[0] == pytest.approx(both[1], abs=6e-3)
    assert (ours == walked).mean(1)[1:].min() > 0.985
    assert (ours == walked).mean(1)[0] > 0.96
    assert (ours & ~walked).mean() < 2e-3
    with pytest.raises(InspeError, match="only the walk 'exact' ends at them"):
        raycast.in_view(scene, layout)


def test_behind_a_house_by_hand():
    """From 5 m, a house of 3 m hides all lower than 5 − 2·x/12 behind it; one that begins at 2 m
    leaves the ground beneath and right behind it in sight."""
    scene, layout = world(count=0), place_sensors((LIDAR, [0.0, 0.0, 5.0, 0.0, 0.0, 0.0]))
    at = {tuple(c): v for v, c in enumerate(scene.voxels.centers.round(3).tolist())}

    def clear(base):
        house = upright_box("building", (10, 0), (4, 6, 3))
        raised = body("building", house.outline, 3.0, base=base)
        return line_of_sight(scene.with_statics([raised]), layout, 0)[0]

    solid, raised = clear(0.0), clear(2.0)
    for seen in (solid, raised):
        assert seen[at[(7.75, 0.25, 0.25)]]  # before it
        assert seen[at[(10.25, 0.25, 3.25)]]  # over it
        assert not seen[at[(14.25, 0.25, 2.25)]]  # 5 − 2·14.25/12 = 2.6
        assert seen[at[(14.25, 0.25, 2.75)]]
        assert seen[at[(14.25, 6.75, 0.25)]]  # beside its shadow
    assert not solid[at[(12.25, 0.25, 0.75)]]
    assert not raised[at[(10.25, 0.25, 2.25)]]  # in it
    assert not solid[at[(9.25, 0.25, 0.75)]]
    assert raised[at[(9.25, 0.25, 0.75)]]  # beneath it: at x = 8 the line is at 1.3 m


def test_scores_are_counts_of_voxels_outside_bodies():
    """C, O, the shares and the viewshed, by NumPy from what each sensor has in view and sight, past
    bodies and ground."""
    scene = hills(voxel=1.0)
    scene = scene.with_statics(street_bodies(scene.intersection))
    layout = layout_in(scene)
    inside = scene.inside_statics
    there, weight = ~inside.ravel(), scene.voxels.weight
    assert 0.005 < inside.mean() < 0.2
    f, scores = in_view(scene, layout), inspe_jax.evaluate(scene, layout)
    some = f.any(0)
    assert not f[:, ~there].any()
    assert scores.coverage == pytest.approx(
        (weight * some * there).sum() / (weight * there).sum(), abs=1e-6
    )
    t, share = scene.traffic, []
    for frame in range(t.frame_count):
        seen = (f & line_of_sight(scene, layout, frame)).any(0)
        free = there & ~worlds.solid_voxels(scene, frame)
        share.append((seen & free).sum() / free.sum())
    assert scores.occlusion == pytest.approx(np.mean(share), abs=1e-4)
    region = np.repeat(scene.voxels.region, scene.voxels.level_count)
    for key, value in scores.region_coverage.items():
        own = there & (region == inspe_jax.Region[key.upper()])
        assert value == pytest.approx(some[own].mean(), abs=1e-6)
    assert (viewshed(scene, layout).sensors == f.sum(0)).all()
    open_ = inspe_jax.evaluate(scene.with_statics([]), layout)
    assert scores.surrogate < open_.surrogate - 0.02


def test_soft_bodies_become_the_exact_ones():
    """With opaque bodies, on whose tops and faces some voxels of 1 m have their middles; what
    crowns let through is multiplied in the soft reading alone."""
    scene = street(voxel=1.0, seed=1)
    solid = scene.with_statics([one for one in scene.statics if one.transmittance == 0])
    layout = layout_in(scene)
    exact = inspe_jax.evaluate(solid, layout).surrogate
    wide, sharp = (
        inspe_jax.evaluate(solid, layout, softness=Softness(w, w, "exact")).surrogate
        for w in (0.3, 1e-4)
    )
    assert abs(wide - exact) > abs(sharp - exact) < 1e-5
    # Behind a crown of 0.4 lies 0.4 of a voxel, and behind two of them 0.16.
    crowns = [tree((x, 0), radius=2, height=8, base=1, transmittance=0.4) for x in (6.0, 12.0)]
    found = chances(scene.with_statics(crowns), [0.0, 0.0, 4.0], 0.01)
    for x, value in ((3.5, 1.0), (9.5, 0.4), (16.5, 0.16)):
        voxel = (scene.voxels.centers == [x, 0.5, 3.5]).all(1)
        assert found[voxel] == pytest.approx(value, abs=1e-6)


def test_a_sensor_in_a_body_is_refused_and_one_on_it_is_not():
    scene = street()
    layout = place_sensors((LIDAR, [11.0, 12.0, 3.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InspeError, match=r"sensor 's0' at .* is inside a body .* the building at"):
        inspe_jax.evaluate(scene, layout)
    in_view(scene, place_sensors((LIDAR, [11.0, 12.0, 6.5, 0.0, 0.0, 0.0])))
    with pytest.raises(InspeError, match=r"the tree at \(9\.1, -9\.6\)"):
        in_view(scene, place_sensors((LIDAR, [9.5, -9.6, 3.0, 0.0, 0.0, 0.0])))
    in_view(scene, place_sensors((LIDAR, [9.5, -9.6, 2.0, 0.0, 0.0, 0.0])))  # beneath its crown


@pytest.mark.parametrize("hilly", worlds.slow_but([False, True], True))
def test_a_real_block_agrees_with_embree(hilly):
    """A crossroads of Berlin-Neukölln from OpenStreetMap, level and on made-up slopes of 12 %."""
    pytest.importorskip("sumolib", reason="needs SUMO: extra [sumo]")
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    from inspe_jax.scene.maps.registry import list_junctions, read_map

    path = Path(__file__).parents[1] / "maps" / "neukoelln.osm.gz"
    (junction,) = [one.id for one in list_junctions(path) if one.signals]
    place = read_map(path, junction=junction, radius=40.0)
    if hilly:
        at = place.center[:2] + np.stack(np.meshgrid(*[np.arange(-70, 71, 2.0)] * 2), -1)
        x, y = (at - place.center[:2]).reshape(-1, 2).T
        place = place.standing_on(
            np.column_stack([at.reshape(-1, 2), 0.05 * x + 1.5 * np.sin(x / 15) * np.cos(y / 20)])
        )
    size = dict(radius=40, voxel=1.0, frames=2, density=20)
    scene = inspe_jax.build_scene(place, statics="map", terrain="ground", **size)
    assert (scene.terrain is not None) == hilly
    assert {one.kind for one in scene.statics} >= {"building", "tree", "pole"}
    layout = inspe_jax.strategy(scene, "Cam-d2/L-d2")
    ours, embree = line_of_sight(scene, layout, 0), embree_line_of_sight(scene, layout, 0)
    known = slice(None) if scene.inside_statics is None else ~scene.inside_statics.ravel()
    assert (ours != embree)[:, known].mean() <= 1e-4
    open_ = line_of_sight(scene.with_statics([]), layout, 0)
    assert (open_ & ~ours).mean() > 0.05


def test_a_raised_junction_of_a_town_agrees_with_embree(maps):
    """On the ground of a real map, from sensors near it, where it hides most."""
    from inspe_jax.scene.maps.registry import read_map

    place = read_map(maps / "Town03.xodr", junction="222", radius=40.0)
    size = dict(radius=40, voxel=1.0, frames=1, density="none")
    scene = inspe_jax.build_scene(place, **size, terrain="ground")
    layout = sensors_in(scene, 8)
    ours, embree = (of(scene, layout, 0) for of in (line_of_sight, embree_line_of_sight))
    assert (ours != embree).mean() <= 1e-4


def test_a_guard_rail_is_an_obstacle_without_code_of_its_own():
    """It hides what lies behind it where the line is below its 1 m: by similar triangles, with the
    soft reading as its limit, and with more to see for a higher sensor."""
    scene = world(radius=15.0, voxel=1.0, count=0)
    railed = scene.with_statics(wall(np.array([[0.0, -40.0], [0.0, 40.0]]), 1.0, width=0.02))
    at, sensor = about_center(railed), np.array([-5.3, 0.2, 1.3], np.float32)
    x, _, z = scene.voxels.centers.T
    over = z + (sensor[2] - z) * (x - 0.01) / (x - sensor[0]) > 1.0
    expected = np.where(x > 0, over, True)
    tiles = tiles_of(at)
    exact = past_statics_of_sensor(sensor, at.statics, tiles.tile, tiles.tile.there)
    assert (tiles.by_voxel(np.asarray(exact)) == expected).all()
    assert (~expected).sum() > 200
    np.testing.assert_allclose(chances(railed, sensor, 1e-5), expected, atol=1e-6)
    higher = sensor + np.float32([0, 0, 0.1])
    assert chances(railed, higher, 0.3).sum() > chances(railed, sensor, 0.3).sum()


# ── Ground ──────────────────────────────────────────────────────────────────


def hills(center=(0.0, 0.0, 0.0), **size):
    """The test crossing on rough ground, with slopes up to 55 %."""
    scene = world(**{**SIZE, **size}, center=center)
    x, y = (scene.intersection.ground_points[:, :2] - center[:2]).T
    height = 3.0 * np.sin(x / 6.0) * np.cos(y / 7.0) + 0.04 * x
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
def test_line_of_sight_over_ground_agrees_with_embree(center, bodies):
    """At least 99.99 % of (sensor, voxel), of which the ground hides a good part."""
    scene = hills(center)
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
        below, low = map(np.asarray, both(np.float32(pose[:3])))
        sure = np.abs(low) > 1e-3
        assert ((low > 0) == below)[sure].all()
        seen += below.sum()
    assert seen > 100


def test_soft_ground_becomes_the_exact_one():
    scene, half = hills(), 0
    layout = sensors_in(scene)
    exact = line_of_sight(worlds.emptied(scene), layout, 0)
    for s, pose in enumerate(np.asarray(layout.poses)):
        found = chances(scene, pose[:3], 1e-3)
        half += ((found > 0.01) & (found < 0.99)).sum()
        sure = (found < 0.01) | (found > 0.99)
        assert ((found > 0.5) == exact[s])[sure].all()
    assert half < 0.002 * exact.size


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


# ── Slopes of both ──────────────────────────────────────────────────────────


def behind_bodies():
    sensors = [14.13, 3.37, 5.0], [-16.21, 11.43, 2.4], [8.17, -13.29, 4.0]
    return street(radius=10.0, voxel=2.0), np.array(sensors), 0.7, dict(abs=1e-5)


def behind_knolls():
    scene = hills(voxel=1.0, frames=2, count=8)
    return scene, np.asarray(sensors_in(scene, 4).poses)[:, :3], 0.3, dict(rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("case", [behind_bodies, behind_knolls])
def test_gradients_are_differences(case):
    """In double precision, of the sum of chances over a tile, in x, y and z: behind every kind of
    body at once; and behind ground, where one crossing decides throughout."""
    with worlds.double_precision():
        scene, sensors, width, within = case()
        at, total = about_center(scene), 0.0
        tile = jax.tree.map(lambda leaf: np.asarray(leaf)[0], tiles_of(at).tile)
        for sensor in sensors:
            given = at.statics, tile, np.array(width)
            slope = np.asarray(slope_of_chance(sensor, *given))
            ends = [
                np.asarray(chance(sensor + step, *given)).sum()
                for step in 1e-5 * np.concatenate([np.eye(3), -np.eye(3)])
            ]
            differences = (np.array(ends[:3]) - ends[3:]) / 2e-5
            assert slope == pytest.approx(differences, **within)
            total += np.abs(slope).sum()
    assert total > 1.0
