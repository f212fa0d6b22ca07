"""The embedded recorder, compared with rays and triangles by other code, and with the scores."""

from dataclasses import replace

import numpy as np
import opv2v_validator
import pytest
import raycast
import shapely
from shapely.geometry import MultiPoint
from worlds import CAMERA, crossing, place_sensors, with_boxes, world

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pixels, rotation
from inspe_jax.dataset import open as open_dataset
from inspe_jax.dataset import write_frame, write_protocol
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import build_scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Unit
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.embedded.camera import SHADOWED, SunlitPoints
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder, LiveSensor
from inspe_jax.simulation.embedded.road_users import FrameActors, boxes_of, pose_road_users
from inspe_jax.simulation.embedded.shapes import VARIANTS
from inspe_jax.simulation.embedded.static_bodies import Material
from inspe_jax.simulation.projection import corners as box_corners
from inspe_jax.simulation.recorder import LAYERS, Recording

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")

COARSE = LidarSpec(
    "coarse", tuple(np.radians(np.linspace(-25, 2, 24)).tolist()), 600, 2 * np.pi, 60.0
)
SMALL = replace(CAMERA, width=320, height=240, focal=140.0, principal=(160.0, 120.0))


def four_way(**options):
    settings = dict(radius=30, voxel=0.5, frames=3, step=0.1, density="medium") | options
    return build_scene(inspe_jax.built_in("four_way"), **settings)


def lidars(*at):
    return place_sensors(*((COARSE, [*p, 0.0, 0.0, 0.0]) for p in at))


@pytest.fixture(scope="module")
def scene():
    return four_way()


@pytest.fixture(scope="module")
def corners(scene):
    return lidars((9, 9, 6), (-9, 9, 6), (-9, -9, 6), (9, -9, 6))


def nearest_triangle(origin, directions, triangles):
    """Möller–Trumbore in double precision, every ray with every triangle: distance and index."""
    a, b, c = (triangles[:, k].astype(float) for k in range(3))
    one, two = b - a, c - a
    best, index = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for r, d in enumerate(directions.astype(float)):
        p = np.cross(d, two)
        det = (one * p).sum(1)
        inv = 1 / np.where(np.abs(det) > 1e-12, det, 1.0)
        s = origin - a
        u = (s * p).sum(1) * inv
        q = np.cross(s, one)
        v = (q @ d) * inv
        t = (two * q).sum(1) * inv
        hit = (np.abs(det) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if hit.any():
            t = np.where(hit, t, np.inf)
            index[r] = t.argmin()
            best[r] = t.min()
    return best, index


def test_returns_agree_with_rays_and_triangles(scene, corners):
    """300 rays of one LiDAR: distances agree to a millimetre, and so do the road users."""
    recorder = EmbeddedRecorder(scene, corners)
    boxes = boxes_of(scene.traffic.at(0), 0)
    actors = FrameActors(boxes, recorder.surroundings.static_world.center)
    lidar = recorder.sensors[0]
    returns = lidar.cast(actors, 0.0)
    drawn = np.random.default_rng(0).choice(len(lidar.body), 200, replace=False)
    some = np.concatenate([drawn, np.flatnonzero(returns.box >= 0)[::20]])
    static = recorder.surroundings.static_world
    road_users = pose_road_users(boxes, static.center)
    everything = np.concatenate([static.triangles, road_users.triangles])
    distance, index = nearest_triangle(lidar.origin, lidar.directions[some], everything)
    distance = np.where(distance <= COARSE.reach, distance, np.inf)
    met = np.isfinite(distance)
    assert met.sum() > 100
    assert np.array_equal(met, np.isfinite(returns.distance[some]))
    assert np.abs(returns.distance[some][met] - distance[met]).max() < 1e-3
    own = index[met] - len(static.triangles)
    box = np.where(own >= 0, road_users.box[np.maximum(own, 0)], -1)
    assert (box == returns.box[some][met]).mean() > 0.99  # edges may go either way
    assert (box >= 0).sum() > 20


def test_no_ray_slips_through_between_two_faces():
    """Rays at edges that two faces of a thin tube share end at its near side."""
    rng = np.random.default_rng(0)
    turn = np.arange(8) * np.pi / 4
    ring = np.array([-10.3, -10.3]) + 0.08 * np.column_stack([np.cos(turn), np.sin(turn)])
    low, high = (np.column_stack([ring, np.full(8, z)]) for z in (0.0, 6.0))
    sides = zip(low, np.roll(low, -1, 0), np.roll(high, -1, 0), high, strict=True)
    caster = Caster(np.array([part for a, b, c, d in sides for part in ([a, b, c], [a, c, d])]))
    corner, share = rng.integers(8, size=20_000), rng.uniform(0.01, 0.99, (20_000, 1))
    other = (corner + rng.integers(2, size=20_000)) % 8  # an upright edge or a face's diagonal
    at = (1 - share) * low[corner] + share * high[other]
    origins = rng.uniform([5, 5, 4], [30, 30, 9], (20_000, 3))
    far = np.linalg.norm(at - origins, axis=1)
    facing = ((at - origins)[:, :2] * (at[:, :2] + 10.3)).sum(1) < -0.05 * far
    hits = caster.cast(origins, (at - origins) / far[:, None], 1e3)
    assert facing.sum() > 3000
    assert np.abs(hits.distance - far)[facing].max() < 0.02  # the far side is 0.1 m further


def test_points_lie_on_surfaces_within_the_noise_and_the_given_share_is_lost(scene, corners):
    recorder = EmbeddedRecorder(scene, corners)
    (lidar, *_), center = recorder.sensors, recorder.surroundings.static_world.center
    returns = lidar.cast(FrameActors((), center), 0.1)

    def points(**noise):
        return lidar.scan(returns, 0, LidarNoise(**noise), np.random.default_rng(1)).points

    every, back = points(range=0.03, lost=0.0, weakest_lost=0.0), np.isfinite(returns.distance)
    off = np.linalg.norm(every[:, :3], axis=1) - returns.distance[back]
    assert off.std() == pytest.approx(0.03, rel=0.05)
    assert abs(off.mean()) < 0.002
    # Rays that hit level ground have their points on it: the sign of the pitch is right.
    down = lidar.body[back][:, 2] < -0.2
    assert np.abs(every[down][:, 2] + 6.0).mean() < 0.3
    intensity = np.exp(-0.004 * np.linalg.norm(every[:, :3], axis=1))
    assert every[:, 3] == pytest.approx(intensity, abs=1e-6)
    assert len(points(lost=0.3, weakest_lost=0.0)) == pytest.approx(0.7 * len(every), rel=0.02)
    # At 60 m intensity is 0.79: with a limit of 1, up to a fifth of 0.4 is lost in addition.
    both = len(points(lost=0.3, weak=1.0, weakest_lost=0.4))
    assert 0.9 * 0.7 * len(every) < both < 0.995 * 0.7 * len(every)


def test_the_turn_takes_time():
    """A moving car is hit where it is when the ray is fired, up to half a turn from the frame."""
    moving = with_boxes(world(count=0, radius=40.0, voxel=2.0), (0, -12, 0, 4.6, 1.85, 1.5))
    velocity = np.broadcast_to([10.0, 0, 0], moving.traffic.center.shape)
    moving = replace(moving, traffic=replace(moving.traffic, velocity=velocity))
    recorder = EmbeddedRecorder(moving, place_sensors((COARSE, [0, 0, 3.0, 0, 0, 0])))
    actors, (lidar,), middle = recorder.surroundings.actors(0), recorder.sensors, []
    for turn in (0.0, 0.1):
        distance, box = lidar.cast(actors, turn)
        middle.append((lidar.body[box == 0, 0] * distance[box == 0]).mean())
    # The car is to the right, at −90°: a quarter of a turn before the middle, 25 ms early.
    assert middle[1] - middle[0] == pytest.approx(-0.25, abs=0.1)


@pytest.fixture(scope="module")
def partial():
    """20 road users (what meshes hide less than boxes, grows with their number); a LiDAR and a
    camera so low that much is hidden, with so short a reach that much is out of view."""
    short = replace(COARSE, reach=25.0)
    layout = place_sensors((short, [9, 9, 3.0, 0, 0, 0]), (SMALL, [-9, -9, 5.0, 0, -0.25, -2.3]))
    scene = four_way(density="low")
    return scene, layout, EmbeddedRecorder(scene, layout).surroundings


def test_rays_reach_as_many_voxels_as_coverage_says(partial):
    """Rays end on the ground, on kerbs and on poles, which the scores do not know."""
    crowded, layout, around = partial
    seen = np.zeros(crowded.voxels.count, bool)
    for s in range(len(layout)):
        origin, directions, reach = layout.rays(s)
        start = origin - around.static_world.center
        met = around.caster.cast(start, directions, reach).distance
        raycast.exact(crowded.voxels, origin, directions, np.minimum(met, reach), seen)
    share = seen @ crowded.voxels.weight / crowded.voxels.weight.sum()
    coverage = inspe_jax.evaluate(crowded, layout).coverage
    assert 0.6 < coverage < 0.95
    assert share == pytest.approx(coverage, abs=0.001)  # 0.02 is required


def test_lines_of_sight_reach_as_many_voxels_as_occlusion_says(partial):
    """Lines of sight to voxels' centres, with meshes where the scores have boxes: boxes hide a
    little more."""
    crowded, layout, around = partial
    static, in_view = around.static_world, inspe_jax.in_view(crowded, layout)
    centers, shares = crowded.voxels.centers, []
    for t in range(crowded.traffic.frame_count):
        boxes = boxes_of(crowded.traffic.at(t), 0)
        road_users = pose_road_users(boxes, static.center)
        caster = Caster(np.concatenate([static.triangles, road_users.triangles]))
        solid = np.zeros(len(centers), bool)
        for box in boxes:
            turn = rotation(np.array([0.0, 0.0, box.yaw]), np)
            solid |= (np.abs((centers - box.center) @ turn) <= box.size / 2).all(1)
        seen = np.zeros(len(centers), bool)
        for s, pose in enumerate(layout.poses):
            to = centers - pose[:3]
            far = np.linalg.norm(to, axis=1)
            start = pose[:3] - static.center
            seen |= in_view[s] & ~caster.meets(start, to / far[:, None], far - 0.01)
        shares.append(seen[~solid].mean())
    scores = inspe_jax.evaluate(crowded, layout)
    assert scores.occlusion < scores.coverage - 0.02
    assert np.mean(shares) == pytest.approx(scores.occlusion, abs=0.02)
    assert np.mean(shares) > scores.occlusion


def test_only_kerbs_and_poles_stand_within_the_radius():
    for name in ("four_way", "roundabout", "t_junction"):
        place = inspe_jax.built_in(name)
        scene = build_scene(place, radius=40, voxel=2.0, density="none", frames=1)
        static_world = EmbeddedRecorder(scene, lidars((9, 9, 6))).surroundings.static_world
        open_ = shapely.union_all(list(place.regions.values()))
        houses_and_trees = Material.BUILDING, Material.ROOF, Material.TRUNK, Material.CROWN
        tall = np.isin(static_world.material, houses_and_trees)
        at = (static_world.triangles[tall] + static_world.center).reshape(-1, 3)
        assert len(at) > 300
        assert shapely.distance(open_, shapely.points(at[:, :2])).min() > 0.1
        # None stands between two points inside the radius.
        assert np.hypot(*(at - static_world.center)[:, :2].T).min() > 40
        assert set(np.unique(static_world.material)) == set(range(7))


def test_units_over_the_road_or_without_sensors_have_no_mast(scene, corners):
    spare = replace(corners, units=(*corners.units, Unit("spare", (14.0, 0.0, 0.0))))
    given = corners, spare, lidars((0, 0, 6)), lidars((14, 14, 6))
    worlds = [EmbeddedRecorder(scene, of).surroundings.static_world for of in given]
    np.testing.assert_array_equal(worlds[0].triangles, worlds[1].triangles)
    over, beside = ((static.material == Material.POLE).sum() for static in worlds[2:])
    assert beside == over + 24  # a tube of eight sides with three triangles each


LOOKING = [0.0, 0.0, 5.0, 0.0, np.radians(-18), 0.0]


def picture(scene, pose=LOOKING, conditions=FAIR):
    """A recorder with one camera, and its first image with all layers."""
    layout, recording = place_sensors((SMALL, [*pose])), Recording(layers=LAYERS)
    recorder = EmbeddedRecorder(scene, layout, conditions, recording)
    return recorder, recorder.frame(0).stations[0].images[0]


def test_boxes_cover_cars_through_the_written_calibration(tmp_path):
    """From files: the IoU of a box's hull with the pixels of its instance is at least 0.7 for every
    car that nothing hides, also at the edge of the picture."""
    scene = four_way(frames=2, density="low")
    large = replace(SMALL, width=640, height=480, focal=280.0, principal=(320.0, 240.0))
    pose = [9.0, 9.0, 6.0, 0.0, np.radians(-15), np.radians(-135)]
    layout = place_sensors((large, pose), (COARSE, [9.0, 9.0, 6.0, 0.0, 0.0, 0.0]))
    recorder = EmbeddedRecorder(scene, layout, recording=Recording(layers=("instance", "depth")))
    folder = tmp_path / "train" / "one"
    facts = dict(fixed_delta_seconds=0.1, client_port=2000, seed=0, weather="clear", town="a")
    write_protocol(folder, {"world": facts})
    recorded = [recorder.frame(t) for t in range(2)]
    for frame in recorded:
        write_frame(folder, frame)
    reports = opv2v_validator.check_set(tmp_path, attenuation=0.004)
    assert reports["train/one"].points > 10_000
    overlaps = []
    v, u = np.indices((480, 640)) + 0.5
    for t in range(2):
        frame = open_dataset(folder).scenarios[0].frame(t)
        image, share = frame.stations[0].images[0], recorded[t].stations[0].images[0].share
        shares = {box.track: part for box, part in zip(recorded[t].boxes, share, strict=True)}
        for box in frame.boxes:
            column, row, depth = pixels(image, box_corners([box])[0]).T
            hull = MultiPoint(np.column_stack([column, row])).convex_hull
            hull = hull.intersection(shapely.box(0, 0, 640, 480))
            near = 1 <= depth.min() <= 45 and hull.area >= 400
            if box.kind == "car" and near and shares[box.track] >= 0.98:
                inside, seen = shapely.contains_xy(hull, u, v), image.instance == box.track + 1
                overlaps.append((inside & seen).sum() / (inside | seen).sum())
    assert len(overlaps) >= 5
    assert min(overlaps) >= 0.7


@pytest.mark.parametrize(("pose", "slope", "light"), [
    ([9.0, 9.0, 6.0, 0.0, -0.3, -2.3], 0.0, "midday"),
    ([0.0, -14.0, 4.0, 0.0, -0.3, 1.57], 0.0, "dusk"),  # beside a truck that is partly behind it
    ([-14.0, 0.0, 1.5, 0.4, 0.1, 0.0], 0.0, "midday"),  # a car at its left, one behind
    ([0.0, -9.0, 9.0, 0.0, -0.3, 0.2], -0.08, "dusk"),  # the ground falls like the shadows
    ([9.0, 9.0, 9.0, 0.0, -0.4, -2.3], 0.08, "midday"),
])  # fmt: skip
def test_no_road_user_or_shadow_is_missed(pose, slope, light):
    """All rays of pixels and of sunlit points give the same as those that the camera selects."""
    truck, car = (8, 2.5, 3.4), (4.6, 1.9, 1.5)
    boxes = [
        (2.5, -14, 1.57, *truck), (-14.5, 2.0, 0.1, *car), (-20, 0, 1.0, *car),
        (3, -2, 2.0, *truck), (-3, 6, 0.4, *car), (8, 4, 1.2, *car), (-30, -25, 0, *car),
        (-2, -6, 0.0, 0.6, 0.6, 1.8), (20, 2, 0.5, *car),
    ]  # fmt: skip
    crowd = with_boxes(world(count=0, radius=40.0, voxel=2.0, slope=slope), *boxes)
    recorder = EmbeddedRecorder(crowd, place_sensors((SMALL, pose)), Conditions.of(light))
    (camera,) = recorder.sensors
    actors = recorder.surroundings.actors(0)
    seen = camera._changes_at(actors, 0.0)
    road_users, caster = actors.at(0.0)
    background = camera.background
    hits = caster.cast(camera.origin, camera.directions, np.minimum(background.distance, 1000.0))
    box = np.where(hits.face >= 0, road_users.box[hits.face], -1)
    sunny = np.flatnonzero(background.in_sun & (box < 0))
    sunny = sunny[np.abs(background.point[sunny, :2]).max(1) < 150]
    dark = sunny[camera._in_shadow(caster, background.point[sunny], np.array([0.0, 0.0, 1.0]))]
    found = np.full(len(box), -1)
    found[seen.pixels] = seen.box
    assert np.array_equal(found, box)
    assert len(np.unique(box)) > 2  # close ones hide others
    assert np.array_equal(np.sort(seen.pixels[seen.box < 0]), dark)
    assert len(dark) > 100


def test_shadows_point_away_from_the_sun():
    """At midday the sun stands in the south-south-east: beside the car its north is darker."""
    scene = with_boxes(world(count=0, radius=40.0, voxel=2.0), (14, 0, 0, 6.0, 2.5, 3.4))
    _, image = picture(scene, [14.0, 0.0, 14.0, 0.0, -np.pi / 2, 0.0])
    # Straight down, nose to the east: columns run from north (left) to south (right).
    v, u = np.nonzero(image.instance > 0)
    rows = image.rgb.astype(float).mean(2)[int(v.mean()) - 5 : int(v.mean()) + 5]
    north, south = rows[:, u.min() - 12 : u.min() - 2], rows[:, u.max() + 3 : u.max() + 13]
    assert north.mean() < 0.7 * south.mean()


def test_points_at_the_rim_are_in_the_last_squares():
    """Their sums with half the width are the whole width, in single precision."""
    rim = np.nextafter(np.float32(SHADOWED), np.float32(0))
    assert rim + np.float32(SHADOWED) == 2 * SHADOWED
    point = np.array([[rim, 0.5, 0], [0.5, rim, 0], [-rim, 0.5, 0]], np.float32)
    cells = SunlitPoints(point, np.ones(3, bool), SHADOWED)
    for k, (x, y) in enumerate(point[:, :2]):
        assert cells.within(np.array([x, y]), np.array([x, y])).tolist() == [k]


def test_fog_hides_what_is_far():
    scene, pose = world(count=0, radius=40.0, voxel=2.0), [0.0, 0.0, 5.0, 0.0, -0.17, 0.0]
    lights = (Conditions.of("midday", weather) for weather in ("fog:40", "clear"))
    near, far = (picture(scene, pose, at)[1].rgb[60:120].astype(float).std() for at in lights)
    assert near < 0.6 * far


def test_the_same_seed_gives_the_same_frames_in_any_order(scene):
    """At dusk there are sun, shadows, lamps and headlights, and several moments to an exposure."""
    layout = place_sensors(
        (SMALL, [9.0, 9.0, 6.0, 0.0, -0.3, -2.3]), (COARSE, [9.0, 9.0, 6.0, 0.0, 0.0, 0.0])
    )
    given = (scene, layout, Conditions.of("dusk"), Recording(layers=LAYERS))
    one, two = EmbeddedRecorder(*given), EmbeddedRecorder(*given)
    first, again = [one.frame(t) for t in (0, 1)], [two.frame(t) for t in (1, 0)][::-1]

    def arrays(frame):
        image, scan = frame.stations[0].images[0], frame.stations[1].scans[0]
        return [image.rgb, scan.points, *(getattr(image, name) for name in LAYERS)]

    for a, b in zip(first, again, strict=True):
        for x, y in zip(arrays(a), arrays(b), strict=True):
            np.testing.assert_array_equal(x, y)
    other = arrays(EmbeddedRecorder(*given, seed=1).frame(0))
    for x, y in zip(arrays(first[0])[:2], other[:2], strict=True):
        assert not np.array_equal(x, y)


def test_boxes_are_where_the_traffic_has_them_and_keep_their_looks(scene):
    traffic, names = scene.traffic, {}
    for t in range(traffic.frame_count):
        boxes = boxes_of(traffic.at(t), 0)
        np.testing.assert_array_equal([box.center for box in boxes], traffic.at(t).center)
        np.testing.assert_array_equal([box.velocity for box in boxes], traffic.at(t).velocity)
        for box in boxes:
            assert names.setdefault(box.track, box.name) == box.name
            assert box.name in VARIANTS[box.kind]
    assert len(set(names.values())) > 4


@pytest.mark.parametrize("light", ["midday", "night"])
def test_layers_of_the_static_world(light):
    """The road where rays hit its plane; at night and without lamps only the sky lights it."""
    scene = world(count=0, radius=20.0, voxel=1.0)
    pose = np.array([0.0, 0.0, 6.0, 0.0, -0.3, -2.3])  # over the road: no mast
    recorder, image = picture(scene, pose, Conditions.of(light))
    assert not len(recorder.surroundings.static_world.poles)
    assert not image.instance.any()
    u, v = np.meshgrid(np.arange(SMALL.width) + 0.5, np.arange(SMALL.height) + 0.5)
    (cx, cy), f = SMALL.principal, SMALL.focal
    rays = np.stack([np.ones_like(u), (cx - u) / f, (cy - v) / f], -1) @ rotation(pose[3:], np).T
    depth = pose[2] / np.maximum(-rays[..., 2], 1e-9)  # of the plane z = 0
    at = pose[:2] + depth[..., None] * rays[..., :2]
    road = scene.intersection.regions[Region.DRIVEWAY].buffer(-0.5)
    on_road = shapely.contains_xy(road, *np.moveaxis(at, -1, 0)) & (depth < 15)
    assert on_road.mean() > 0.1
    np.testing.assert_allclose(image.depth[on_road], depth[on_road], atol=1e-3)
    assert set(np.unique(image.semantic[on_road])) <= {1, 24}  # CARLA's road, and its markings
    assert recorder.sensors[0].background.ambient[on_road.ravel()].min() > 0


def test_slopes_and_empty_roads_are_recorded():
    center = (1000.0, -400.0, 30.0)
    scene = world(count=0, slope=0.08, radius=20.0, voxel=1.0, center=center)
    above = [*center[:2], 36.0]
    layout = place_sensors((COARSE, [*above, 0, 0, 0]), (SMALL, [*above, 0, -0.3, 0]))
    points = EmbeddedRecorder(scene, layout).frame(0).stations[0].scans[0].points[:, :3]
    at = points[np.hypot(*points[:, :2].T) < 18] + above
    assert np.abs(at[:, 2] - crossing(0.08, center).ground(at[:, :2])).mean() < 0.1


def test_bad_input(scene, corners):
    for given, words in (
        (dict(rate=0), "rate 0 Hz"),
        (dict(image_size=(0, 9)), r"image_size .width, height.\[0\]: 0 is out of range"),
        (dict(layers=("dept",)), "layer 'dept': one of .*did you mean depth"),
    ):
        with pytest.raises(InspeError, match=words):
            EmbeddedRecorder(scene, corners, recording=Recording(**given))
    with pytest.raises(InspeError, match=r"backend 'embeded': one of .*did you mean embedded"):
        recorder_of("embeded", scene, corners)


POLE_LABEL = 6  # CARLA's


@pytest.fixture(scope="module")
def both():
    cameras = [12.0, 9.5, 5.0, 0.0, -0.3, -2.4], [-9.0, 9.0, 5.0, 0.0, -0.3, -0.8]
    lidar = COARSE, [-9.0, -9.0, 6.0, 0.0, 0.0, 0.0]
    return place_sensors((SMALL, cameras[0]), lidar, (SMALL, cameras[1]))


@pytest.mark.parametrize(("light", "s"), [("dusk", 1), ("night", 0)])
def test_a_live_sensor_records_at_its_place_what_the_recorder_does(scene, both, light, s):
    around, small = Conditions(light), Recording(image_size=(SMALL.width // 2, SMALL.height // 2))
    whole = EmbeddedRecorder(scene, both, around, small, seed=3)
    live = LiveSensor(scene, both, s, around, small, seed=3)
    live.record(0, np.array(both.poses[s]) + [0.5, 0, 0, 0, 0, 0.2])  # held, and put back
    for t in (2, 0):
        frame = whole.frame(t)
        boxes, found = live.record(t, np.array(both.poses[s]))
        station = frame.stations[both.sensors[s].unit]
        assert [box.track for box in boxes] == [box.track for box in frame.boxes]
        (same,) = (*station.images, *station.scans)
        for name in ("rgb", "pixels") if s == 0 else ("points", "returns"):
            np.testing.assert_array_equal(getattr(found, name), getattr(same, name))


def test_a_sensor_that_is_held_elsewhere_does_not_see_the_mast_it_left(scene, both):
    """Unlike that of another unit, which stands at the same place."""
    behind = np.array([16.0, 13.5, 2.0, 0.0, 0.0, -3 * np.pi / 4])  # looks back at its mast
    units, poses = list(both.units), np.array(both.poses, float)
    units[2] = replace(units[2], base=(12.0, 9.5, 0.0))
    poses[2] = [12.0, 9.5, 5.0, 0.0, 0.0, 0.0]
    other, recording = replace(both, units=tuple(units), poses=poses), Recording(layers=LAYERS)
    for layout, seen in ((both, False), (other, True)):
        _, image = LiveSensor(scene, layout, 0, recording=recording).record(0, behind)
        at_mast = image.semantic[124:156, 159:161]  # straight ahead, 5.7 m away
        assert (at_mast == POLE_LABEL).all() if seen else POLE_LABEL not in at_mast
