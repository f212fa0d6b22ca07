"""Calibrations as layouts: poses of real deployments, round trips, and each bad file's message.

Numbers of deployments are read beside the checkout, with the poses that they have there.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import yaml
from worlds import DEPLOYMENTS, needs_deployments, world

from inspe_jax import CameraSpec, InspeError, layouts_from
from inspe_jax.core import carla_frame
from inspe_jax.core.geometry import pixels, pose_matrix
from inspe_jax.report.handover import calibration_json
from inspe_jax.sensing.calibrations import projection_of
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Sensor, Unit, make_layout

CM, CENTIDEGREE = 0.01, 0.01  # what importers may be off by, rounding of the expected included
LENS = [[1200, 0, 960], [0, 1210, 545], [0, 0, 1]]
CAMERA = dict(name="a", width=1920, height=1080, camera_matrix=LENS)
OPTICAL = np.array([[0, 0, 1, 4.0], [-1, 0, 0, 3], [0, -1, 0, 6], [0, 0, 0, 1]])  # looks along x
PLACE, TURN, UTM = ("east", "north", "height"), ("roll_deg", "pitch_deg", "yaw_deg"), "EPSG:32632"


def scene_at(lat=None, lon=None):
    """A small scene, also about a place on the Earth: x is east, y true north."""
    made = world(count=0)
    if lat is None:
        return made
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    place = replace(made.intersection, georeference=projection_of(f"{lat},{lon}"))
    return replace(made, intersection=place)


@cache
def deployment(name):
    return yaml.safe_load((DEPLOYMENTS / name).read_text())


def read(folder, content, *, name="in.json", **given):
    text = content if isinstance(content, str) else json.dumps(content, default=np.ndarray.tolist)
    (folder / name).write_text(text)
    return layouts_from(folder / name, **given)


def check(poses, *expected, cm=CM, centidegree=CENTIDEGREE):
    """Places, and roll, pitch and yaw, are those that are expected."""
    for pose, own in zip(poses, expected, strict=True):
        np.testing.assert_allclose(pose[:3], [own[f"{key}_m"] for key in PLACE], atol=cm)
        turn = np.degrees(pose[3:]) - [own[key] for key in TURN]
        np.testing.assert_allclose((turn + 180) % 360 - 180, 0, atol=centidegree)


def matrix_of(lens):
    return [[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]]


# ── Deployments ─────────────────────────────────────────────────────────────


def s110():
    """TUMTraf's S110, a scene there, and the matrix from its base, whose x is grid north."""
    given = deployment("tumtraf_s110.yaml")
    x, y = given["frame"]["base"]["base_utm32n"]
    place = scene_at(given["frame"]["centre_lat"], given["frame"]["centre_lon"])
    return given, place, np.array([[0, -1, 0, x], [1, 0, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


@needs_deployments
def test_s110_of_projections_and_matrices_over_a_grid_that_is_turned(tmp_path):
    given, place, base = s110()
    size = dict(width=1920, height=1200)
    sensors = [
        size | dict(name=own["name"], projection=own["raw"]["base_to_image"])
        for own in given["cameras"]
    ] + [
        dict(name=own["name"], kind="lidar", sensor_to_frame=own["raw"]["lidar_to_base"])
        for own in given["lidars"]
    ]
    content = dict(frame=dict(crs=UTM, matrix=base), sensors=sensors)
    found = read(tmp_path, content, scene=place, lidar="ouster-os1-64")
    check(found.layout.poses, *given["cameras"], *given["lidars"])
    for own, sensor in zip(given["cameras"], found.layout.sensors, strict=False):
        lens, spec = own["intrinsics"], sensor.spec
        numbers = [*spec.focals, *spec.principal, *np.degrees(spec.field_of_view)[:1]]
        wanted = [lens[key] for key in ("fx", "fy", "cx", "cy", "hfov_deg")]
        np.testing.assert_allclose(numbers, wanted, atol=0.01)
    assert [note.endswith("taken as ouster-os1-64") for note in found.notes] == [True, True, False]
    fx = given["cameras"][0]["intrinsics"]["fx"]
    assert f"up to 25 px per metre: {given['cameras'][0]['name']} {fx / 25:.0f} m" in found.notes[2]
    assert found.layout.sensors[0].spec.depth == pytest.approx(fx / 25, abs=0.06)
    assert len(found.layout.units) == 4  # of one gantry, 20 m long
    bases = {own["name"][18:]: np.array(own["raw"]["lidar_to_base"]) for own in given["lidars"]}
    for own in given["cameras"]:
        for other in own.get("other_calibrations", []):  # from a LiDAR, or the base, to pixels
            ((key, projection),) = other["raw"].items()
            frame = dict(crs=UTM, matrix=base @ bases.get(key.split("_")[1], np.eye(4)))
            content = dict(frame=frame, sensors=[size | dict(name="x", projection=projection)])
            check(read(tmp_path, content, scene=place).layout.poses, other)


@needs_deployments
def test_s110_as_openlabel_and_as_the_dev_kits_files(tmp_path):
    """The same sensors, by chains of coordinate systems, and a file each."""
    given, place, base = s110()
    camera, *lidars = given["cameras"][0], *given["lidars"]
    away = pose_matrix([1, 2, 3, 0, 0, 1])
    systems = dict(away=dict(parent="base", pose_wrt_parent=dict(matrix4x4=away.ravel())))
    streams = dict(radar=dict(type="radar"), lost=dict(type="camera"))
    for own in lidars:
        matrix = np.linalg.inv(away) @ own["raw"]["lidar_to_base"]
        systems[own["name"]] = dict(parent="away", pose_wrt_parent=dict(matrix4x4=matrix))
        streams[own["name"]] = dict(type="lidar")
    label = dict(openlabel=dict(coordinate_systems=systems, streams=streams))
    earth = dict(scene=place, crs=UTM, transform=base)
    found = read(tmp_path, label, **earth)
    check(found.layout.poses, *lidars)
    for what, note in zip(("is a radar", "has no coordinate system"), found.notes, strict=False):
        assert f"{what}, and is left out" in note
    key, size = "transformation_matrix_x_to_s110_base", dict(image_width=1920, image_height=1200)
    for own, name, raw in (
        (camera, "projection_matrix", "base_to_image"),
        (lidars[0], key, "lidar_to_base"),
    ):
        kit = size | {"intrinsic_camera_matrix": [], name: own["raw"][raw]}
        check(read(tmp_path, kit, **earth).layout.poses, own)


@needs_deployments
def test_a9s_two_calibrations_of_each_camera(tmp_path):
    """Its camera matrices are not triangles: their products with the extrinsics are read."""
    given = deployment("a9_s040_s050.yaml")
    frame, road, origin = given["frame"], np.eye(4), np.eye(4)
    road[:3, :3], road[:3, 3] = frame["road_Rm"], frame["road_t"]
    origin[:2, 3] = frame["map_origin_utm32n"]
    place = scene_at(frame["centre_lat"], frame["centre_lon"])
    to = dict(crs=UTM, matrix=origin @ np.linalg.inv(road))
    for own in (one for camera in given["cameras"] for one in camera["calibrated"]):
        projection = np.array(own["raw"]["matrix"]) @ np.array(own["raw"]["road_to_camera"])[:3]
        sensor = dict(name="x", width=1920, height=1200, projection=projection)
        found = read(tmp_path, dict(frame=to, sensors=[sensor]), scene=place).layout
        at = place.intersection.georeference.to_degrees(found.poses[:, :2])[0]
        np.testing.assert_allclose(at, [own["lon"], own["lat"]], atol=1e-7)  # 1 cm
        here = dict(
            east_m=found.poses[0, 0], north_m=found.poses[0, 1], yaw_deg=90 - own["azimuth_deg"]
        )
        check(found.poses, own | here | dict(height_m=own["height_over_road_m"]))
        np.testing.assert_allclose(found.sensors[0].spec.focals, [own["fx"], own["fy"]], atol=0.06)


@needs_deployments
def test_v2x_reals_pole_in_the_lidars_frame_and_on_the_road(tmp_path):
    given = deployment("v2x_real_infra2.yaml")
    lidar, *cameras = given["sensors"]
    pose = lidar["raw"]["lidar_pose"]
    content = dict(infra=True, lidar_pose=pose, vehicles={})
    for own in cameras:
        about = dict(cords=own["raw"]["cords"], extrinsic=own["raw"]["camera_to_lidar"])
        content[own["name"]] = about | dict(intrinsic=matrix_of(own["intrinsics"]))
    size, to_lidar = dict(size=(1920, 1080)), np.linalg.inv(carla_frame.matrix(pose))
    found = read(tmp_path, content, transform=to_lidar, **size).layout
    np.testing.assert_allclose(found.poses[0], 0, atol=1e-9)
    local = [one["in_lidar_frame"] for one in cameras]
    names = dict(zip(PLACE, "xyz", strict=True))
    check(found.poses[1:], *(one | {f"{k}_m": one[x] for k, x in names.items()} for one in local))
    found = read(tmp_path, content, transform=given["frame"]["map_to_this"], **size).layout
    np.testing.assert_allclose(found.poses[0, :3], [0, 0, lidar["height_m"]], atol=CM)
    check(found.poses[1:], *cameras)
    with pytest.raises(InspeError, match=r"cam1: width, height: missing keys: give the 'size'"):
        read(tmp_path, content)


@needs_deployments
def test_inspes_frame_of_opv2v_is_left_handed(tmp_path):
    """Its ``extrinsic`` is as CARLA has it, and its pictures' size twice the principal point."""
    given = deployment("inspe_authors_frame.yaml")
    *units, last = given["units"]
    lidar = [*(last["carla"][key] for key in "xyz"), 0.0, 0.0, 0.0]
    content, expected = dict(RSU=True, lidar_pose0=lidar), []
    for k, unit in enumerate(units):
        own = unit["sensors"][0]
        cords = [unit["carla"][key] for key in "xyz"]
        cords += [0.0, own["carla"]["yaw"], own["carla"]["pitch"]]
        about = dict(cords=cords, extrinsic=carla_frame.between(lidar, cords))
        content[f"camera{k}"] = about | dict(intrinsic=matrix_of(own["intrinsics"]))
        content[f"radar_pose{k}"] = cords
        expected.append(unit | own)
    x, y = given["frame"]["origin_map"]
    found = read(tmp_path, content, transform=pose_matrix([-x, -y, 0, 0, 0, 0]))
    check(found.layout.poses, last | dict.fromkeys(TURN, 0.0), *expected)
    assert found.layout.sensors[0].name == "lidar0"
    assert {(s.spec.width, s.spec.height) for s in found.layout.sensors[1:]} == {(800, 600)}
    assert sum("is a radar, and is left out" in note for note in found.notes) == 4
    content["camera0"]["extrinsic"][0, 3] += 1
    with pytest.raises(InspeError, match=r"camera0.extrinsic: is neither OPV2V's, LiDAR to camera"):
        read(tmp_path, content)


@needs_deployments
def test_further_deployments(tmp_path):
    """ISC's second LiDAR; DAIR's camera, whose rotation is none, so that lens and extrinsics are
    given as a product; CARMA's and CDASim's lists."""
    given = deployment("more_deployments.yaml")
    isc = given["isc_tfhrc"]
    sensor = dict(name="1", kind="lidar", sensor_to_frame=isc["raw"]["lidar1_to_lidar2"])
    pose, own = read(tmp_path, dict(sensors=[sensor])).layout.poses[0], isc["lidars"][1]
    np.testing.assert_allclose(pose[:2], [own["x_m"], own["y_m"]], atol=CM)
    assert np.degrees(pose[5]) == pytest.approx(own["yaw_of_x_axis_deg"], abs=0.05)
    raw, own = given["dair_v2x_i"]["raw"], given["dair_v2x_i"]["camera"]
    extrinsic = np.column_stack([raw["virtuallidar_to_camera_rotation"], raw["translation"]])
    sensor = dict(name="x", width=1920, height=1080)
    bad = sensor | dict(camera_matrix=raw["cam_K"], frame_to_sensor=extrinsic)
    with pytest.raises(InspeError, match=r"rows have lengths 0.994, 0.827, 0.993.*'projection'"):
        read(tmp_path, dict(sensors=[bad]))
    good = sensor | dict(projection=np.array(raw["cam_K"]) @ extrinsic)
    found = read(tmp_path, dict(sensors=[good]))
    lens = [own["intrinsics"][key] for key in ("fx", "fy")]
    np.testing.assert_allclose(found.layout.sensors[0].spec.focals, lens, atol=0.06)
    at = dict(zip((f"{key}_m" for key in PLACE), (own[f"{x}_m"] for x in "xyz"), strict=True))
    check(found.layout.poses, own | at, centidegree=0.051)  # given to a tenth
    assert "its skew of 14.9 px is left out" in found.notes[0]
    (carma,), (cda,) = (given[key]["lidars"] for key in ("carma_tfhrc", "cdasim"))
    at = dict(lat=carma["lat"], lon=carma["lon"], elevation=carma["altitude_m"])
    entry = dict(sensorId="1", type="SemanticLidar", ref=dict(type="WGS84", location=at))
    found = read(tmp_path, [entry], scene=scene_at(carma["lat"] + 1e-4, carma["lon"]))
    np.testing.assert_allclose(found.layout.poses[0, :3], [0, -11.10, 5.5], atol=CM)
    at = cda["carla"]
    entry = dict(sensorId="1", type="lidar", location=at, orientation=dict(yaw=30, pitch=2, roll=0))
    pose = read(tmp_path, [entry], convention="carla").layout.poses[0]
    expected = [at["x"], -at["y"], at["z"], 0, *np.radians([2, -30])]
    np.testing.assert_allclose(pose, expected, atol=1e-9)


# ── Round trips, and our own file ───────────────────────────────────────────


@pytest.mark.parametrize("earth", [(), (48.25, 11.63)])
def test_an_exported_calibration_is_read_back_as_the_same_layout(tmp_path, earth):
    """Also on another grid: then azimuths and places on the Earth are the same."""
    place, usual = scene_at(*earth), device("paper-camera").spec
    zoom = replace(usual, name="zoom", focal_range=(300.0, 900.0), focal=500.0)
    lens = CameraSpec.from_intrinsics("own", 1920, 1200, fx=1345.6, fy=1500, cx=975.9, depth=70.0)
    poses = [[3, 4, 6, 0.1, -0.4, 2.0], [3.5, 4, 7, 0, -0.5, -3], [-9, 8, 5, 0, -0.2, 1],
             [-9, 8, 6, 0.01, 0.02, -1], [-9, 8, 4, 0, -0.1, 2]]  # fmt: skip
    specs = usual, lens, zoom, device("ouster-os1-64").spec, device("continental-ars408-near").spec
    sensors = [Sensor(f"s{k}", spec, min(k // 2, 1)) for k, spec in enumerate(specs)]
    made = make_layout(sensors, [Unit("a", (3, 4, 0)), Unit("b", (-9, 8, 0))], np.array(poses))
    text = calibration_json(made, place.intersection)
    again = read(tmp_path, text, scene=place)
    np.testing.assert_allclose(again.layout.poses, made.poses, atol=1e-6)
    specs = [[one.spec for one in layout.sensors] for layout in (again.layout, made)]
    for one, other in zip(*specs, strict=True):
        assert one.with_lens(0.0) == other.with_lens(0.0)
        assert one.lens == pytest.approx(other.lens, abs=1e-6)
    assert again.layout.members() == made.members()
    for one, other in zip(again.layout.units, made.units, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.base, other.base, atol=1e-6)
    assert again.notes == ()
    looks = json.loads(text)["sensors"][0]["looks"]
    assert len(looks["polygon"]) > 3
    if not earth:
        return
    there = projection_of(UTM)
    moved = replace(place, intersection=replace(place.intersection, georeference=there))
    poses = read(tmp_path, text, scene=moved).layout.poses
    assert looks["azimuth_deg"] == pytest.approx(450 - np.degrees(2.0), abs=1e-3)
    azimuth = there.azimuth(poses[:1, :2], poses[:1, 5])[0]
    assert azimuth == pytest.approx(looks["azimuth_deg"], abs=1e-4)
    degrees = there.to_degrees(poses[:1, :2])[0]
    np.testing.assert_allclose(degrees, [looks["lon"], looks["lat"]], atol=1e-8)
    assert abs(poses[0, 5] - 2.0) > np.radians(1.9)  # the convergence of the grid there


def test_a_file_of_opencv_with_one_camera(tmp_path):
    text = """%YAML:1.0
---
image_width: 1920
image_height: 1080
camera_matrix: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [12, 0, 9, 0, 13, 5, 0, 0, 0.01]}
distortion_coefficients: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.1, 0, 0, 0, 0]}
frame_to_sensor: [[0, -1, 0, 3], [0, 0, -1, 6], [1, 0, 0, -4], [0, 0, 0, 1]]
"""
    found = read(tmp_path, text, name="camera.yaml")
    np.testing.assert_allclose(found.layout.poses, [[4, 3, 6, 0, 0, 0]], atol=1e-12)
    spec = found.layout.sensors[0].spec
    assert spec.focals == (1200, 1300)
    assert (spec.distortion, spec.fisheye) == ((-0.1, 0, 0, 0, 0), None)


def test_pairs_give_a_pose_and_say_how_well_they_fit(tmp_path):
    at = np.array([[20, -5, 0], [20, 5, 0], [40, -8, 0], [40, 8, 0], [30, 0, 2], [25, 3, 1]], float)
    pose = np.array([4, 3, 6, 0.02, -0.2, 0.1])
    camera = type("Image", (), dict(pose=pose, intrinsic=np.array(LENS)))
    rows = np.column_stack([pixels(camera, at)[:, :2], at])
    for further in ({}, dict(position=[4, 3, 6])):
        found = read(tmp_path, dict(sensors=[CAMERA | dict(pairs=rows) | further]))
        np.testing.assert_allclose(found.layout.poses[0], pose, atol=1e-5)
        assert "6 pairs, 0.0 px rms" in found.notes[0]
        assert found.fits["a"].covariance.shape == (6, 6)


def one(**change):
    """Our own file with a camera at (4, 3, 6) that is changed."""
    own = CAMERA | dict(sensor_to_frame=OPTICAL) | change
    return dict(sensors=[{key: x for key, x in own.items() if x is not None}])


def posed(**change):
    return one(**dict(sensor_to_frame=None) | change)


def by_view(**change):
    return one(camera_matrix=None, hfov_deg=60.0, **change)


def projected(**change):
    matrix = LENS @ np.linalg.inv(OPTICAL)[:3]
    return posed(camera_matrix=None, projection=matrix, **change)


def named(**change):
    return one(**dict(camera_matrix=None, width=None, height=None, device="paper-camera") | change)


def mixed(first):
    """Two cameras, of which one is in degrees, in either order."""
    degrees, frame = posed(lat=48, lon=11, z=6, yaw_deg=3)["sensors"], one(name="b")["sensors"]
    return dict(sensors=frame + degrees if first else degrees + frame)


def listed(**change):
    place = dict(lat=48.0, lon=11.0, elevation=5.0)
    return [dict(sensorId="1", type="Camera", ref=dict(type="WGS84", location=place)) | change]


MM = OPTICAL.copy()
MM[:3, 3] *= 1000
UP = np.array([[0, -0.9, 0.5, 4], [-1, 0, 0, 3], [0, -0.5, 0.9, 6], [0, 0, 0, 1]]).round(1)
UP[:3, :3] = np.array([[0, 0.8, 0.6], [-1, 0, 0], [0, -0.6, 0.8]])
ANGLES = dict(yaw=10.0, pitch=0.0, roll=0.0)
BAD = [
    (one(sensor_to_frame=MM), {}, r"is 6,000 m high, and 150 m are the most: give the 'unit'"),
    (one(sensor_to_frame=OPTICAL @ np.diag([-1, 1, 1, 1])), {}, "sensor_to_frame: is mirrored"),
    (one(sensor_to_frame=OPTICAL.T), {}, "sensor_to_frame: is transposed"),
    (one(sensor_to_frame=UP), {}, "looks up by 53.1° and is rolled by 0.0°, as no roadside"),
    (one(width=1080, height=1920), {}, r"\(960, 545\) in a picture of 1080 × 1920: width and he"),
    (posed(frame_to_sensor=OPTICAL), {}, "in the ground, at -4.00 m .* of the other direction"),
    (posed(extrinsic=OPTICAL), {}, r"sensors\[0\].extrinsic: does not say its direction: name"),
    (posed(), {}, "needs one of sensor_to_frame, .*; has none"),
    (one(projection=OPTICAL[:3]), {}, "needs one of .*has sensor_to_frame, projection"),
    (posed(projection=OPTICAL[:3]), {}, "camera_matrix: leave it out: the projection has the lens"),
    (one(camera_matrix=[[9, 0, 9], [1, 9, 9], [0, 0, 1]]), {}, "is no camera matrix .*projection"),
    (one(camera_matrix=[[-9, 0, 9], [0, 9, 9], [0, 0, 1]]), {}, "the picture is mirrored"),
    (posed(camera_matrix=None, projection=-np.eye(4)[:3]), {}, "is mirrored: .*multiply it by −1"),
    (posed(camera_matrix=None, projection=np.zeros((3, 4))), {}, "projection: is singular"),
    (one(distortion=[0.0] * 8 + [0.1]), {}, "camera_matrix: distortion: only k1, k2, p1, p2, k3, "),
    (one(distortion=[-0.5]), {}, "distortion: folds the picture, .*image_circle_deg"),
    (one(image_circle_deg=180), {}, "image_circle_deg: only a 'lens: fisheye' sees 180° or more"),
    (one(width=None), {}, "width, height: missing keys: give the 'size'"),
    (one(width="1920"), {}, "width: must be a whole number .*got '1920'"),
    (one(wdith=1920), {}, "wdith: unknown key; did you mean width"),
    (one(device="paper-lidar-32"), {}, "device: 'paper-lidar-32' is a lidar, and the sensor a cam"),
    (posed(position=[1, 2, 3]), {}, "give either yaw_deg, .* or azimuth_deg"),
    (posed(position=[1, 2, 3], azimuth_deg=3), {}, "azimuth_deg: needs a CRS, or yaw_deg"),
    (posed(lat=48, lon=11, azimuth_deg=3), dict(unit="mm"), "are of the Earth, and not of a frame"),
    (one(z=3.0), {}, r"\[0\].z: goes with lat, not with sensor_to_frame"),
    (posed(pairs=[[0] * 5] * 4, yaw_deg=3), {}, "yaw_deg: goes with position or lat, not with pai"),
    (posed(position=[1, 2, 3], yaw_deg=3, z=9), {}, "z: goes with lat, not with position"),
    (by_view(distortion=[-0.1]), {}, r"distortion: goes with camera_matrix"),
    (by_view(model="fisheye"), {}, r"model: goes with camera_matrix"),
    (one(hfov_deg=60), {}, r"hfov_deg: leave it out: the camera_matrix has the lens"),
    (projected(distortion=[-0.1]), {}, r"distortion: goes with camera_matrix"),
    (named(distortion=[-0.1]), {}, r"distortion: goes with camera_matrix"),
    (named(width=640), {}, "width, height: 'paper-camera' has .*: give a camera_matrix"),
    (one(kind="radar", camera_matrix=None), {}, "device: missing key: a radar needs one"),
    (mixed(0), {}, "some of its sensors have lat and lon, .*: name frame.crs, or give the 'crs'"),
    (mixed(1), {}, "some of its sensors have lat and lon, .*: name frame.crs, or give the 'crs'"),
    (posed(pairs=[[1, 2, 3]]), {}, r"pairs: must be 1 × 5 numbers"),
    (one() | dict(frame=dict(crs=UTM)), {}, "has no coordinates on the Earth; build"),
    (one() | dict(frame=dict(matrix=np.diag([2, 2, 2, 1]))), {}, "frame.matrix: is not a rotation"),
    (one(), dict(unit="km"), "unit 'km': one of m, cm, mm"),
    (one(), dict(lidar="paper-camera"), "lidar: 'paper-camera' is a camera"),
    (one(), dict(heights="ground", scene=None), "heights: those above the ground need a scene"),
    (listed(), {}, r"\[0\].orientation: missing"),
    (listed(orientation=ANGLES), {}, "does not say what its angles are from: give a convention"),
    (listed(type="Radar"), {}, "has no camera or LiDAR with a pose"),
    (dict(intrinsic_camera_matrix=[], projection_matrix=[]), {}, "projection_matrix: is empty or"),
    (dict(openlabel=dict(streams=[])), {}, "is not OpenLABEL: AttributeError"),
    (dict(lidar_pose=[1, 2, 3]), {}, r"lidar_pose: must be 6 numbers, got shape \(3,\)"),
    (dict(x=1), {}, "is no calibration: it must be a list of sensors, OpenLABEL, OPV2V"),
    ("[", {}, "not JSON"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "given", "message"), BAD)
def test_each_bad_file_gets_one_clear_message(tmp_path, content, given, message):
    with pytest.raises(InspeError, match=message) as caught:
        read(tmp_path, content, **dict(scene=scene_at()) | given)
    assert given or "in.json" in str(caught.value)


def test_units_and_heights_are_as_said_and_what_is_unusual_is_noted(tmp_path):
    slope = world(slope=0.1, count=0)
    pose = read(tmp_path, one(sensor_to_frame=MM), unit="mm", scene=slope, heights="ground")
    ground = slope.intersection.ground(np.array([[4.0, 3.0]]))[0]
    np.testing.assert_allclose(pose.layout.poses[0], [4, 3, 6 + ground, 0, 0, 0], atol=1e-6)
    off = one(camera_matrix=[[1200, 0, 1500], [0, 1200, 540], [0, 0, 1]])
    assert "its principal point is 28 % of the picture off" in read(tmp_path, off).notes[0]
    by_view = read(tmp_path, one(camera_matrix=None, hfov_deg=90.0)).layout.sensors[0].spec
    assert (by_view.width, round(by_view.focal)) == (1920, 960)
    by_id = read(tmp_path, [dict(id="x", type="lidar", location=dict(x=1, y=2, z=5))])
    assert by_id.layout.sensors[0].name == "x"
    axes = read(tmp_path, one(convention="body")).notes[0]
    assert "is rolled by -90° and 6.0 m high; if it does not hang so, its axes are others" in axes


def test_cameras_in_degrees_without_a_crs_hang_in_one_frame(tmp_path):
    """Of which the first is the origin; in a scene they are where their degrees are. A file after
    them that names no CRS is still in the scene's own frame."""
    degrees = [posed(name=f"{k}", lat=48 + k / 3600, lon=11, z=6, yaw_deg=3)["sensors"][0]
               for k in (0, 1)]  # fmt: skip
    place = scene_at(48, 11)
    alone = read(tmp_path, dict(sensors=degrees)).layout.poses
    np.testing.assert_allclose(alone[:, :2], [[0, 0], [0, 30.89]], atol=0.01)
    (tmp_path / "own.json").write_text(json.dumps(one(), default=np.ndarray.tolist))
    for order in (degrees, degrees[::-1]):
        (tmp_path / "in.json").write_text(json.dumps(dict(sensors=order)))
        found = layouts_from(tmp_path / "in.json", tmp_path / "own.json", scene=place)
        poses, last = found.layout.poses, order.index(degrees[1])
        np.testing.assert_allclose(poses[last, :2], [0, 30.89], atol=0.01)
        np.testing.assert_allclose(poses[2, :3], [4, 3, 6], atol=1e-9)
        assert "own.json: names no CRS: its frame is taken for the" in "".join(found.notes)


def test_a_frame_with_a_matrix_and_no_crs_is_noted(tmp_path):
    content = one() | dict(frame=dict(matrix=np.eye(4)))
    assert "taken for the scene's own" in read(tmp_path, content, scene=scene_at()).notes[0]
    assert read(tmp_path, content).notes == ("cameras see up to 25 px per metre: a 48 m",)


def test_a_stream_of_openlabel_with_a_fisheye_is_left_out(tmp_path):
    eye = dict(type="camera", stream_properties=dict(intrinsics_fisheye=dict(width_px=9)))
    streams = dict(eye=eye, lidar=dict(type="lidar"))
    label = dict(coordinate_systems={name: dict(parent="") for name in streams}, streams=streams)
    found = read(tmp_path, dict(openlabel=label))
    assert [sensor.name for sensor in found.layout.sensors] == ["lidar"]
    assert "streams.eye: intrinsics_fisheye: only intrinsics_pinhole is read" in found.notes[0]
