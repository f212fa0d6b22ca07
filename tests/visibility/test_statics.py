"""Static bodies in the way: against Embree, NumPy's counts, differences, and the exact limit."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import raycast
from worlds import (
    CAMERA,
    LIDAR,
    double_precision,
    embree_line_of_sight,
    place_sensors,
    slow_but,
    solid_voxels,
    street_bodies,
    world,
)

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.numerics import Softness
from inspe_jax.scene.statics import body, pole, tree, upright_box, wall
from inspe_jax.scoring.viewshed import viewshed
from inspe_jax.visibility.centered_scene import about_center
from inspe_jax.visibility.queries import in_view, line_of_sight
from inspe_jax.visibility.statics import past_statics_chance, past_statics_of_sensor
from inspe_jax.visibility.tiles import tiles_of

SIZE = dict(radius=20.0, voxel=0.5, frames=4, count=12)
chance = jax.jit(past_statics_chance)
slope_of_chance = jax.jit(
    jax.grad(lambda sensor, *given: past_statics_chance(sensor, *given).sum())
)


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
    """C, O, the shares and the viewshed, by NumPy from what each sensor has in view and sight."""
    scene = street(count=12)
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
        free = there & ~solid_voxels(scene, frame)
        share.append((seen & free).sum() / free.sum())
    assert scores.occlusion == pytest.approx(np.mean(share), abs=1e-4)
    levels = (some.reshape(inside.shape) & ~inside).sum(0) / (~inside).sum(0)
    assert scores.level_coverage == pytest.approx(levels, abs=1e-6)
    region = np.repeat(scene.voxels.region, scene.voxels.level_count)
    for key, value in scores.region_coverage.items():
        own = there & (region == inspe_jax.Region[key.upper()])
        assert value == pytest.approx(some[own].mean(), abs=1e-6)
    assert (viewshed(scene, layout).sensors == f.sum(0)).all()
    open_ = inspe_jax.evaluate(scene.with_statics([]), layout)
    assert scores.surrogate < open_.surrogate - 0.02


def test_soft_reading_becomes_the_exact_one():
    """With opaque bodies, on whose tops and faces some voxels of 1 m have their middles; what
    crowns let through is multiplied in the soft reading alone."""
    scene = street(voxel=1.0, seed=1)
    solid = scene.with_statics([one for one in scene.statics if one.transmittance == 0])
    layout = layout_in(scene)
    exact = inspe_jax.evaluate(solid, layout)
    gaps = [
        abs(
            inspe_jax.evaluate(solid, layout, softness=Softness(w, w, "exact")).surrogate
            - exact.surrogate
        )
        for w in (0.3, 1e-4)
    ]
    assert gaps[0] > gaps[1] < 1e-5
    # Behind a crown of 0.4 lies 0.4 of a voxel, and behind two of them 0.16.
    crowns = [tree((x, 0), radius=2, height=8, base=1, transmittance=0.4) for x in (6.0, 12.0)]
    scene = world(count=0).with_statics(crowns)
    at = about_center(scene)
    tiles = tiles_of(at)
    each = [
        jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], tiles.tile)
        for k in range(len(tiles.last))
    ]
    found = np.concatenate(
        [
            np.asarray(chance(np.array([0.0, 0.0, 4.0], np.float32), at.statics, tile, 0.01)).T
            for tile in each
        ]
    )[np.asarray(tiles.place)]
    for x, level, value in ((3.25, 7, 1.0), (9.25, 7, 0.4), (16.25, 7, 0.16)):
        (row,) = np.flatnonzero((scene.voxels.columns == [x, 0.25]).all(1))
        assert found[row, level] == pytest.approx(value, abs=1e-6)


def test_gradient_past_the_corner_of_a_house():
    """Against differences in double precision, behind every kind of body at once; and away from
    the corner is where more comes into sight."""
    with double_precision():
        scene = street(radius=10.0, voxel=2.0)
        at = about_center(scene)
        tile = jax.tree.map(lambda leaf: np.asarray(leaf)[0], tiles_of(at).tile)
        for sensor in ([14.13, 3.37, 5.0], [-16.21, 11.43, 2.4], [8.17, -13.29, 4.0]):
            given = at.statics, tile, np.array(0.7)
            slope = np.asarray(slope_of_chance(np.array(sensor), *given))
            ends = [
                float(np.asarray(chance(sensor + step, *given)).sum())
                for step in 1e-5 * np.concatenate([np.eye(3), -np.eye(3)])
            ]
            differences = (np.array(ends[:3]) - ends[3:]) / 2e-5
            assert np.abs(slope).max() > 1e-2
            assert slope == pytest.approx(differences, abs=1e-5 * np.abs(slope).max())


@pytest.mark.slow
def test_a_search_walks_a_camera_out_from_behind_a_wall():
    """The soft score's slope points along the wall, where the exact score rises as well."""
    scene = world(count=0, radius=10.0, voxel=1.0)
    scene = scene.with_statics([upright_box("wall", (-6.0, -1.0), (0.4, 8.0, 4.5))])
    pose = np.array([[-9.0, 2.0, 3.0, 0.0, -0.2, 0.0]])
    layout = place_sensors((CAMERA, pose[0].tolist()))
    weights = {"coverage": 1.0}

    @jax.jit
    def slope(poses):
        def score(p):
            return inspe_jax.evaluate(
                scene, layout.with_poses(p), softness=1.0, weights=weights
            ).surrogate

        return jax.grad(score)(poses)

    start = inspe_jax.evaluate(scene, layout, weights=weights).surrogate
    for _ in range(8):
        move = np.asarray(slope(jnp.asarray(pose, float)))[0, :2]
        pose[0, :2] += 0.5 * move / np.hypot(*move)
    end = inspe_jax.evaluate(scene, layout.with_poses(pose), weights=weights).surrogate
    assert pose[0, 1] > 3.0
    assert end > 1.5 * start


def test_a_sensor_in_a_body_is_refused_and_one_on_it_is_not():
    scene = street()
    layout = place_sensors((LIDAR, [11.0, 12.0, 3.0, 0.0, 0.0, 0.0]))
    with pytest.raises(InspeError, match=r"sensor 's0' at .* is inside a body .* the building at"):
        inspe_jax.evaluate(scene, layout)
    in_view(scene, place_sensors((LIDAR, [11.0, 12.0, 6.5, 0.0, 0.0, 0.0])))
    with pytest.raises(InspeError, match=r"the tree at \(9\.1, -9\.6\)"):
        in_view(scene, place_sensors((LIDAR, [9.5, -9.6, 3.0, 0.0, 0.0, 0.0])))
    in_view(scene, place_sensors((LIDAR, [9.5, -9.6, 2.0, 0.0, 0.0, 0.0])))  # beneath its crown


@pytest.mark.parametrize("hilly", slow_but([False, True], True))
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


def test_a_guard_rail_is_an_obstacle_without_code_of_its_own():
    """It hides what lies behind it where the line is below its 1 m: by similar triangles, with the
    soft reading as its limit, and with more to see for a higher sensor."""
    scene = world(radius=15.0, voxel=1.0, count=0)
    railed = scene.with_statics(wall(np.array([[0.0, -40.0], [0.0, 40.0]]), 1.0, width=0.02))
    at, sensor = about_center(railed), np.array([-5.3, 0.2, 1.3], np.float32)
    x, z = at.centers[:, 0], at.centers[:, 2]
    over = z + (sensor[2] - z) * (x - 0.01) / (x - sensor[0]) > 1.0
    expected = np.where(x > 0, over, True)
    tiles = tiles_of(at)
    exact = past_statics_of_sensor(sensor, at.statics, tiles.tile, tiles.tile.there)
    assert (tiles.by_voxel(np.asarray(exact)) == expected).all()
    assert (~expected).sum() > 200
    soft, slope = [], 0.0
    for k in range(len(tiles.last)):
        tile = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], tiles.tile)
        soft.append(np.asarray(chance(sensor, at.statics, tile, 1e-5)).T)
        slope += slope_of_chance(sensor, at.statics, tile, 0.3)[2]
    np.testing.assert_allclose(tiles.of_voxels(np.array(soft)), expected, atol=1e-6)
    assert slope > 0
