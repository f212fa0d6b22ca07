"""Static bodies in recordings: they hide what they hide in scores, by Embree on triangles."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, body_triangles, place_sensors, street_bodies, world

from inspe_jax.scene.statics import tree, upright_box
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.embedded.road_users import parked_vehicles
from inspe_jax.simulation.embedded.static_bodies import Material, body_parts
from inspe_jax.simulation.embedded.static_world import build_static_world
from inspe_jax.simulation.recorder import Recording

pytest.importorskip("embreex.rtcore_scene")
SENSORS = [(0.0, 0.0, 5.5), (11.0, 12.0, 7.0), (-13.0, 9.6, 1.2), (9.6, -8.6, 1.4)]
NO_MASTS = np.zeros((0, 4))


@pytest.fixture(scope="module")
def street():
    scene = world(count=0, slope=0.03, center=(40.0, -20.0, 3.0))
    return scene.with_statics(street_bodies(scene.intersection))


def static(scene):
    return build_static_world(scene.intersection, 20.0, NO_MASTS, scene.statics)


def raised(found, *materials):
    """The triangles of a static world that are of some materials; all but ground and kerbs."""
    wanted = materials or {*Material} - {Material.GROUND, Material.KERB}
    return found.triangles[np.isin(found.material, [*wanted])]


def within(triangles, reach):
    """Without the houses and trees that stand around the region of interest."""
    return triangles[(np.abs(triangles[..., :2]) < reach).all((1, 2))]


def hidden(triangles, scene):
    """Whether triangles hide each voxel that is outside bodies from each of the sensors (S, V)."""
    caster, found = Caster(np.asarray(triangles, np.float32)), []
    centers = (scene.voxels.centers - scene.voxels.center)[~scene.inside_statics.ravel()]
    ground = scene.intersection.ground(np.array(SENSORS)[:, :2] + scene.voxels.center[:2])
    for (x, y, up), level in zip(SENSORS, ground - scene.voxels.center[2], strict=True):
        to = centers - [x, y, up + level]
        far = np.linalg.norm(to, axis=1)
        found.append(caster.meets(np.array([[x, y, up + level]]), to / far[:, None], far))
    return np.array(found)


def only(scene, *kinds):
    return replace(scene, statics=tuple(one for one in scene.statics if one.kind in kinds))


def test_what_is_solid_hides_the_same_in_recordings_and_scores(street):
    """Buildings, walls, hedges, poles and furniture, but for voxels at their edges."""
    some = only(street, "building", "wall", "hedge", "pole", "furniture")
    ours = hidden(within(raised(static(some)), 21), some)
    score = hidden(body_triangles(some) - some.voxels.center, some)
    assert 0.05 < score.mean() < 0.6
    assert (ours != score).mean() < 2e-4


@pytest.mark.parametrize(("kind", "least"), [("tree", 0.7), ("parked vehicle", 0.5)])
def test_what_has_a_shape_stays_within_its_body_and_fills_most_of_it(street, kind, least):
    some = only(street, kind)
    some = replace(some, statics=tuple(replace(one, transmittance=0.0) for one in some.statics))
    ours = hidden(within(raised(static(some)), 21), some)
    score = hidden(body_triangles(some) - some.voxels.center, some)
    assert (ours & ~score).mean() < 2e-4
    assert ours.sum() > least * score.sum()


def test_so_much_light_passes_between_leaves_as_the_crown_lets_through():
    """The mean of many crowns, by rays through their middle from all sides."""
    place = world(count=0).intersection
    for share in (0.05, 0.4):
        passed = []
        for k in range(40):
            crown = tree((9.0 + 0.1 * k, 9), radius=2, height=7, base=2.5, transmittance=share)
            parts = [part for part in body_parts(crown, place) if part.material == Material.CROWN]
            caster = Caster(np.concatenate([part.triangles for part in parts]))
            turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
            out = np.column_stack([np.cos(turn), np.sin(turn), np.full(60, 0.1)])
            middle = np.array([*crown.middle, 4.8])
            passed.append(~caster.meets(middle + 4 * out, -out, 8.0))
        assert np.mean(passed) == pytest.approx(share, abs=0.03)


def test_other_things_stay_where_they_were_and_keep_clear(street):
    place = street.intersection
    bare = build_static_world(place, 20.0, NO_MASTS)
    far = upright_box("building", np.array([300.0, 300.0]) + place.center[:2], (5, 5, 5))
    beside = build_static_world(place, 20.0, NO_MASTS, [far])
    assert (beside.triangles[: len(bare.triangles)] == bare.triangles).all()
    at = raised(bare, Material.BUILDING)[0].mean(0)[:2]
    wall = upright_box("wall", at + place.center[:2], (3, 3, 2))
    taken = build_static_world(place, 20.0, NO_MASTS, [wall])
    ours = Material.GROUND, Material.KERB, Material.WALL
    others = np.isin(taken.material, ours, invert=True)
    away = np.hypot(*np.moveaxis(taken.triangles[others][..., :2] - at, -1, 0))
    assert away.min() > 3.0


def test_bodies_are_in_pictures(street):
    layout = place_sensors((CAMERA, [38.0, -21.0, 9.0, 0.0, -0.2, np.arctan2(-11.0, 7.5)]))
    recording = Recording(layers=("semantic",), image_size=(200, 150))
    image, empty = (
        EmbeddedRecorder(scene, layout, recording=recording).frame(0).stations[0].images[0]
        for scene in (street, street.with_statics([]))
    )
    assert (empty.semantic != 14).all()
    assert (image.semantic == 14).sum() > 50  # the parked car
    assert (image.semantic == 9).sum() > 1.5 * (empty.semantic == 9).sum()  # crowns and hedges
    assert (image.rgb != empty.rgb).any(-1)[image.semantic == 14].all()


def test_a_parked_vehicle_in_the_region_is_a_road_user_that_stands_still():
    """It has a box, returns and pixels as a moving one has; one further out is scenery."""
    traffic = world(count=3, seed=2)
    away = np.array([[5.0, 0.0], [0.0, 9.0], [50.0, 0.0]]) + traffic.intersection.center[:2]
    sizes = (4.6, 1.8, 1.5), (9.0, 2.5, 3.2), (4.6, 1.8, 1.5)
    pairs = zip(away, sizes, strict=True)
    bodies = [upright_box("parked vehicle", at, size, 0.4) for at, size in pairs]
    scene = traffic.with_statics([*bodies, upright_box("wall", away[0] + 8, (3, 0.3, 2))])
    road_users, left = parked_vehicles(scene)
    assert [one.kind for one in left] == ["parked vehicle", "wall"]
    assert [CLASSES[kind] for kind in road_users.kind] == ["car", "truck"]

    poses = [-12.0, 3.0, 4.0, 0.0, 0.0, 0.0], [-8.0, 0.0, 7.0, 0.0, -0.3, 0.0]
    layout = place_sensors(*zip((LIDAR, CAMERA), poses, strict=True))
    frames = [EmbeddedRecorder(scene, layout).frame(t) for t in (0, 1)]
    (car, truck), (car_then, _) = (frame.boxes[-2:] for frame in frames)
    tracks = [box.track for box in frames[0].boxes]
    assert len(set(tracks)) == len(tracks)
    assert (car.track, car.name) == (car_then.track, car_then.name)
    level = scene.intersection.ground(away[:1])[0]
    np.testing.assert_allclose(car.center, [*away[0], level + 0.75], atol=1e-9)
    np.testing.assert_allclose(car.size, sizes[0])
    np.testing.assert_allclose([car.yaw, truck.yaw], 0.4)
    assert not np.any([car.velocity, truck.velocity])
    lidar, camera = frames[0].stations[0].scans[0], frames[0].stations[1].images[0]
    assert (lidar.returns[-2:] > 50).all()
    assert camera.pixels[-2] > 50
    assert camera.share[-2] == pytest.approx(1.0, abs=0.05)


def test_the_lights_of_parked_vehicles_are_off():
    place = world(count=0)
    car = upright_box("parked vehicle", place.voxels.center[:2] + [6.0, 0.0], (4.6, 1.8, 1.5), 0.4)
    layout = place_sensors((CAMERA, [-4.0, 0.0, 5.0, 0.0, -0.3, 0.0]))
    given = place.with_statics([car]), layout, Conditions("night"), Recording(image_size=(400, 300))
    recorder = EmbeddedRecorder(*given)
    (dark,) = recorder.frame(0).stations[0].images
    recorder.surroundings.parked = (replace(recorder.surroundings.parked[0], parked=False),)
    (lit,) = recorder.frame(0).stations[0].images
    assert dark.pixels[0] > 50
    assert ((lit.rgb.astype(int) - dark.rgb).max(-1) > 30).sum() > 10


def test_a_parked_vehicle_looks_the_same_in_any_traffic():
    empty, busy = world(count=0), world(count=9, seed=4)
    places = (empty.voxels.center[:2] + [x, 0.0] for x in (6.0, -6.0))
    car, other = (upright_box("parked vehicle", at, (4.6, 1.8, 1.5)) for at in places)
    alone, _ = parked_vehicles(empty.with_statics([car]))
    among, _ = parked_vehicles(busy.with_statics([other, car]))
    assert alone.track[0] == among.track[1]
