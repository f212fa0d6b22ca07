"""What LiDARs and cameras record of each road user, by day, at night and in rain."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from worlds import CAMERA, place_sensors, with_boxes, world

from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.points_in_boxes import count_inside
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.sensors import LidarSpec
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.simulation.embedded import headlights, light
from inspe_jax.simulation.embedded.headlights import GroundMap, on_road_users
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.embedded.road_users import FrameActors, boxes_of
from inspe_jax.simulation.recorder import Recording

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")

DENSE = LidarSpec(
    "dense", tuple(np.radians(np.linspace(-12, 4, 64)).tolist()), 900, 2 * np.pi, 40.0
)
SMALL = replace(CAMERA, width=320, height=240, focal=140.0, principal=(160.0, 120.0))
EXACT = Recording(noise=LidarNoise(range=0.0, lost=0.0, weak=0.0), turn=0.0)
SIZES = {
    "car": (4.6, 1.85, 1.5),
    "truck": (10.0, 2.5, 3.6),
    "cyclist": (1.8, 0.65, 1.75),
    "pedestrian": (0.6, 0.6, 1.75),
}


@pytest.fixture(scope="module")
def empty():
    return world(count=0, radius=80.0, voxel=2.0)


def standing(empty, kind, *at, velocity=(0.0, 0.0, 0.0)):
    """Road users of a class at (x, y) each, across the line of sight along x."""
    scene = with_boxes(empty, *((x, y, np.pi / 2, *SIZES[kind]) for x, y in at))
    kinds = np.full_like(scene.traffic.kind, CLASSES.index(kind))
    moving = np.broadcast_to(np.asarray(velocity, float), (*kinds.shape, 3)).copy()
    return replace(scene, traffic=replace(scene.traffic, kind=kinds, velocity=moving))


def lidar(height=1.5, spec=DENSE):
    return place_sensors((spec, [0.0, 0.0, height, 0.0, 0.0, 0.0]))


def scan_of(scene, layout, conditions="clear", recording=EXACT):
    around = Conditions.of("midday", conditions)
    recorder = EmbeddedRecorder(scene, layout, around, recording)
    return recorder.frame(0).stations[0].scans[0]


@pytest.mark.parametrize(("kind", "weather"), [
    ("car", "clear"), ("truck", "rain:50"), ("cyclist", "fog:50"), ("pedestrian", "rain:50"),
])  # fmt: skip
def test_road_users_beyond_the_reach_have_no_return(empty, kind, weather):
    """Rain and fog shorten the reach. The static world is as far away."""
    layout = lidar()
    reach = Conditions.of("midday", weather).layout(layout).sensors[0].spec.reach
    assert reach < 0.9 * DENSE.reach or weather == "clear"
    beyond = min(reach + 6.0, (reach + DENSE.reach) / 2 + SIZES[kind][1] / 2)
    beyond = reach + 6.0 if weather == "clear" else beyond
    scene = standing(empty, kind, (reach - 3.0, 0.0), (-beyond, 0.0))
    scan = scan_of(scene, layout, weather)
    assert scan.returns[0] > 3
    assert scan.returns[1] == 0
    assert np.linalg.norm(scan.points[:, :3], axis=1).max() <= reach + 1e-3
    if weather != "clear":
        assert (scan_of(scene, layout).returns > 3).all()


def test_the_seed_of_the_noise_leaves_shapes_and_colours(empty):
    scene = standing(empty, "car", *((x, y) for x in (8.0, 14.0, 20.0) for y in (-9.0, 0.0, 9.0)))
    layout = place_sensors((SMALL, [0.0, 0.0, 5.0, 0.0, -0.2, 0.0]))
    given = layout, Conditions.of("midday"), Recording(layers=("instance",))
    frames = [
        EmbeddedRecorder(scene, *given, seed=seed, appearance_seed=looks).frame(0)
        for seed, looks in ((0, 0), (1, 0), (0, 1))
    ]
    names = [[box.name for box in frame.boxes] for frame in frames]
    assert names[0] == names[1]
    assert names[0] != names[2]
    images = [frame.stations[0].images[0] for frame in frames]
    one, noisy, other = (image.rgb[images[0].instance > 0].astype(int) for image in images)
    assert not np.array_equal(images[0].rgb, images[1].rgb)
    assert np.abs(one - noisy).mean() < 4  # noise alone: no car has another colour
    assert np.abs(one - other).mean() > 15


def test_returns_are_counted_where_the_rays_end(empty):
    """A pedestrian close before a truck: points are its own, not those of the truck behind it."""
    scene = standing(empty, "truck", (20.0, 0.0), (17.0, 0.0))
    users = scene.traffic
    size, kind, center = (x.copy() for x in (users.size, users.kind, users.center))
    size[0, 1], kind[0, 1] = SIZES["pedestrian"], CLASSES.index("pedestrian")
    center[0, 1, 2] = size[0, 1, 2] / 2
    scene = replace(scene, traffic=replace(users, size=size, kind=kind, center=center))
    scan = scan_of(scene, lidar())
    assert scan.returns.min() > 10
    boxes = boxes_of(scene.traffic.at(0), 0)
    np.testing.assert_array_equal(scan.returns, count_inside([scan], boxes)[0])
    half = replace(EXACT, noise=LidarNoise(range=0.0, lost=0.5, weak=0.0))
    left = scan_of(scene, lidar(), recording=half).returns
    assert left.sum() == pytest.approx(scan.returns.sum() / 2, rel=0.1)


def test_pictures_of_any_size_show_the_same(empty):
    """As wide and as high a view, with other pixels: a road user covers the same share of it, and
    the calibration says where the middle of its box is."""
    scene = standing(empty, "truck", (18.0, 3.0))
    layout = place_sensors((SMALL, [0.0, 0.0, 5.0, 0.0, -0.2, 0.1]))
    shares, middles, conditions = [], [], Conditions.of("night", "rain")
    for given in ((320, 240), (37, 211)):
        recording = Recording(layers=("instance",), image_size=given)
        frame = EmbeddedRecorder(scene, layout, conditions, recording).frame(0)
        image, (box,) = frame.stations[0].images[0], frame.boxes
        assert image.rgb.shape == (given[1], given[0], 3)
        on = np.argwhere(image.instance > 0) + 0.5
        shares.append(len(on) / image.instance.size)
        middles.append(on.mean(0) / image.instance.shape)
        body = (box.center - image.pose[:3]) @ rotation(image.pose[3:], np)
        u, v, w = image.intrinsic @ [-body[1], -body[2], body[0]]
        assert np.abs(on[:, 1] - u / w).min() < 1
        assert np.abs(on[:, 0] - v / w).min() < 1
    assert shares[0] == pytest.approx(shares[1], rel=0.05)
    np.testing.assert_allclose(middles[0], middles[1], atol=0.005)


def test_pixels_and_visible_share_of_each_road_user(empty):
    """Two cars in a row, seen from the front one's height, and one behind the camera."""
    scene = standing(empty, "car", (10.0, 0.0), (16.0, 1.5), (-10.0, 0.0))
    layout = place_sensors((SMALL, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    recorder = EmbeddedRecorder(scene, layout, recording=Recording(layers=("instance",)))
    (image,) = recorder.frame(0).stations[0].images
    tracks = [box.track for box in recorder.frame(0).boxes]
    assert image.pixels.tolist() == [(image.instance == t + 1).sum() for t in tracks]
    front, behind, out = image.share
    assert front == 1.0
    assert out == 0.0
    alone = EmbeddedRecorder(standing(empty, "car", (16.0, 1.5)), layout)
    only = alone.frame(0).stations[0].images[0]
    assert only.share[0] == 1.0
    assert 0.05 < behind < 0.6
    assert behind == pytest.approx(image.pixels[1] / only.pixels[0], rel=0.15)  # another shape


NIGHT, RAIN = Conditions.of("night"), Conditions.of("midday", "rain:10")


def bare():
    """No road users, and no street lamps."""
    return world(count=0, radius=30.0, voxel=2.0)


def recorded(scene, pose, conditions):
    recording = Recording(layers=("instance", "semantic"))
    recorder = EmbeddedRecorder(scene, place_sensors((SMALL, pose)), conditions, recording)
    return recorder, recorder.frame(0).stations[0].images[0]


@pytest.mark.parametrize("brightness", [0.0, 0.01, 0.3])
def test_noise_is_that_of_electrons_that_are_counted(brightness):
    """Poisson's and the reading's, drawn as such: their deviations agree to 2 %."""
    rng = np.random.default_rng(0)
    drawn = rng.poisson(brightness * light.ELECTRONS, 200_000) + rng.normal(0, light.READ, 200_000)
    expected = light.REDUCED * drawn.std() / light.ELECTRONS
    assert float(light.grain(np.float32(brightness))) == pytest.approx(expected, rel=0.02)


def test_gain_follows_the_light_up_to_its_limit():
    night = light.LIGHTS["night"]
    for brightness, gain in ((1.0, 1.0), (night.target / 8, 8.0), (1e-5, night.most), (0, 32)):
        picture = np.full((700, 3), brightness, np.float32)
        assert light.metered_gain(picture, night) == pytest.approx(gain, rel=1e-3)


def test_an_unlit_car_stands_out_from_the_road_at_night():
    """At 15 m, from the side, without any lamp near: of twelve cars at least nine differ from the
    road by more than the noise of a pixel. Black cars are as dark as asphalt."""
    scene = with_boxes(bare(), (15, 0, np.pi / 2, *SIZES["car"]))
    recorder, _ = recorded(scene, [0.0, 0.0, 5.0, 0.0, np.radians(-18), 0.0], NIGHT)
    (camera,), clear = recorder.sensors, []
    assert camera.gain == light.LIGHTS["night"].most
    for seed in range(12):
        recorder.surroundings.appearance_seed = camera.appearance_seed = seed
        (image,) = recorder.frame(0).stations[0].images
        brightness = image.rgb.astype(float).mean(2)
        car = image.instance > 0
        rows = np.flatnonzero(car.any(1))
        road = (image.semantic == 1) & ~car
        road[: rows[-1] + 5] = False  # in front of the car, where no lamp reaches
        grain = np.diff(brightness, axis=1)[road[:, 1:] & road[:, :-1]].std() / np.sqrt(2)
        assert grain > 2  # there is grain
        clear.append(abs(brightness[car].mean() - brightness[road].mean()) / grain)
    assert (np.array(clear) > 1).sum() >= 9


def lights_of(*boxes):
    scene = with_boxes(bare(), *boxes)
    actors = FrameActors(boxes_of(scene.traffic.at(0), 0), scene.intersection.center)
    ground = GroundMap(scene.intersection, 30.0, light.LIGHTS["night"])
    return actors, ground, ground.lit(actors)


@pytest.fixture(scope="module")
def driver():
    return lights_of((0, 0, 0.0, *SIZES["car"]))


def at(ground, lit, x, y):
    return lit[np.abs(ground.points[:, :2] - [x, y]).sum(1).argmin()]


def test_headlights_light_the_road_ahead_and_not_behind(driver):
    _, ground, lit = driver
    assert at(ground, lit, 10, 0) > 5 * ground.faint
    x, y, _ = ground.points.T
    assert lit[x < 2.3].max() == 0
    assert lit[(x > 6) & (np.abs(y) > x)].max() == 0
    assert at(ground, lit, 10, 0) > at(ground, lit, 10, 4) > 0
    assert at(ground, lit, 10, 3) == pytest.approx(at(ground, lit, 10, -3))


def test_the_map_is_the_formula(driver):
    """E = I cos θ / r² by hand, 8 m ahead and 2 m aside."""
    _, ground, lit = driver
    front = np.array([2.35, 0.0, 0.6])
    to = np.array([8.0, 2.0, 0.0]) - front
    slope = 0.6 / to[0] - headlights.CUT_OFF
    side = (to[1] / to[0]) / np.tan(headlights.ASIDE)
    beam = headlights.PEAK * np.exp(-(side**2) - slope / headlights.BELOW)
    expected = beam * (0.6 / np.linalg.norm(to)) / (to @ to) - ground.faint
    assert at(ground, lit, 8, 2) == pytest.approx(expected, rel=0.01)
    # As far above the lamp there is only glare.
    up, glare = to * [1, 1, -1], headlights.GLARE * np.exp(-(side**2)) / (to @ to)
    found = headlights.dipped(up[None], np.array([1.0, 0.0]))
    assert found == pytest.approx(glare)


def test_the_fine_map_is_linear_between_the_points_of_the_grid(driver):
    """In the middle of cells of 12.5 cm, by SciPy."""
    actors, ground, lit = driver
    line = ground.points[: ground.size, 0]
    between = RegularGridInterpolator((line, line), lit.reshape(ground.size, ground.size))
    points = np.array([[5.0625, 0.3125, 0.0], [12.4375, -1.1875, 0.0], [9.9375, 2.0625, 0.0]])
    found = ground.fine(actors)[ground.cells(points.astype(np.float32))]
    assert found.min() > 0
    np.testing.assert_allclose(found, between(points[:, 1::-1]), rtol=1e-4)
    assert (ground.cells(np.array([[500.0, 0, 0]], np.float32)) == -1).all()


def test_what_stands_ahead_casts_a_shadow_and_is_lit():
    actors, ground, lit = lights_of((0, 0, 0.0, *SIZES["car"]), (8, 0, 0.0, 2.0, 1.85, 1.5))
    assert at(ground, lit, 6, 0) > 0
    behind = lit[(np.abs(ground.points[:, 0] - 8.25) < 0.6) & (ground.points[:, 1] == 0)]
    assert behind.max() == 0  # under it
    # Its rear is lit below the cut-off, its side and its own front are not.
    point = np.array([[7, 0, 0.4], [7, 0, 1.4], [9, 0, 0.4], [8, 0.9, 0.4]], np.float32)
    normal = np.array([[-1, 0, 0], [-1, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    own = on_road_users(actors, point, normal, np.full(4, 1), light.LIGHTS["night"])
    assert own[0] > 1
    assert own[1] < 0.1 * own[0]
    assert own[2] == own[3] == 0


def test_pictures_show_the_road_ahead_of_a_car_brighter():
    """From straight above, nose to the east: columns run from north to south, rows from east."""
    scene = with_boxes(bare(), (0, 0, 0.0, *SIZES["car"]))
    for name, conditions in (("day", Conditions()), ("night", NIGHT)):
        _, image = recorded(scene, [0.0, 0.0, 16.0, 0.0, -np.pi / 2, 0.0], conditions)
        brightness = image.rgb.astype(float).mean(2)
        v, u = np.nonzero(image.instance > 0)
        ahead = brightness[v.min() - 50 : v.min() - 15, u.min() : u.max()].mean()
        behind = brightness[v.max() + 15 : v.max() + 50, u.min() : u.max()].mean()
        assert (ahead > 1.3 * behind) == (name == "night"), (name, ahead, behind)


def test_wetness_is_of_rain_and_changes_only_the_road():
    """Between dry and wet roads in the same air: paved ground darkens where it mirrors little, and
    nothing else changes."""
    pose = [0.0, 0.0, 6.0, 0.0, -0.5, 0.3]
    wet, image = recorded(bare(), pose, RAIN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("inspe_jax.simulation.embedded.shading.wetness", lambda conditions: 0.0)
        dry, _ = recorded(bare(), pose, RAIN)
    one, other = (r.sensors[0].background.colour for r in (wet, dry))
    changed = (one != other).any(1)
    label = image.semantic.ravel()
    assert set(np.unique(label[changed])) <= {1, 2, 24, 25}
    point = wet.sensors[0].background.point
    road = np.isin(label, (1, 24)) & (np.hypot(*point[:, :2].T) < 100)
    assert changed[road].mean() > 0.99
    steep = road & (-wet.sensors[0].directions[:, 2] > 0.8)
    assert steep.sum() > 100
    assert np.median(one[steep] / other[steep]) < 0.75
    for weather, least, most in (("clear", 0, 0), ("fog:50", 0, 0), ("rain:1", 0.5, 0.7)):
        assert least <= light.wetness(Conditions.of("midday", weather)) <= most


def test_a_wet_road_mirrors_the_sky_most_at_grazing_angles():
    pose = [0.0, 0.0, 3.0, 0.0, -0.2, 0.0]
    ratios = []
    for conditions in (RAIN, Conditions()):
        recorder, image = recorded(bare(), pose, conditions)
        camera = recorder.sensors[0]
        road = image.semantic.ravel() == 1
        down = -camera.directions[:, 2]
        far, near = (road & part for part in (down < 0.12, down > 0.5))
        assert min(far.sum(), near.sum()) > 100
        ambient = camera.background.ambient.mean(1)
        ratios.append(ambient[far].mean() / ambient[near].mean())
    assert ratios[0] > 1.5 * ratios[1]
