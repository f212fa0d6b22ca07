"""Calibrations of sensors that hang already, as a layout on a scene.

A file is YAML or JSON, in metres, degrees and pixels::

    frame: {crs: EPSG:25832, matrix: [[0, -1, 0, 695310.501], …]}  # 4 × 4, to the CRS
    sensors:
      - {name: south, width: 1920, height: 1200,
         camera_matrix: [[1315.2, 0, 962.7], [0, 1362.8, 580.6], [0, 0, 1]],
         frame_to_sensor: [[…], …]}    # 4 × 4, as OpenCV's extrinsics; or sensor_to_frame
      - {name: east, width: 1920, height: 1200, projection: [[…], […], […]]}  # frame to pixels
      - {name: roof, kind: lidar, device: ouster-os1-64, position: [1.5, 2.0, 7.5], yaw_deg: 165.6}
      - {name: mast, width: 1920, height: 1080, camera_matrix: […], pairs: [[u, v, x, y, z], …]}

``frame.crs`` is a code, a PROJ string, or ``LAT,LON``: then x is east and y true north of there.
Without a ``frame``, coordinates are the scene's own.
Cameras have optical axes, others a body's, unless ``convention`` says another; a radar needs a
``device``, as a LiDAR may have. ``lat``, ``lon``, ``z`` may be in place of a position, ``hfov_deg``
in place of a camera matrix. ``pairs`` are pixels and where they are; a ``position`` beside them is
held. ``distortion`` is OpenCV's, [k1, k2, p1, p2, k3, …], also of a ``model: fisheye``, which may
have an ``image_circle_deg``; each needs the camera matrix. ``unit`` names the unit of a sensor;
others within 2 m are one. Pixels are counted from the corner of the first, and taken as the file
has them: OpenCV's are from its middle, so add 0.5 to the cx and cy of its matrix. Files of others:
:mod:`inspe_jax.sensing.calibration_formats`.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, check_known, error_at
from inspe_jax.core.files import check_model
from inspe_jax.core.geometry import pose_matrix
from inspe_jax.core.rigid import array, pose_of, rigid
from inspe_jax.scene.geojson import known_georeference
from inspe_jax.scene.georeference import Georeference, about
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.calibration_formats import (
    ANGLES,
    FISHEYES,
    POSES,
    FileKeys,
    SensorKeys,
    read_entries,
)
from inspe_jax.sensing.catalogue import device, spec_of
from inspe_jax.sensing.kinds import focal_of
from inspe_jax.sensing.layout import (
    UNIT_HEIGHT,
    UNIT_PLAN,
    Layout,
    Sensor,
    Unit,
    make_layout,
    with_hfov,
)
from inspe_jax.sensing.lens import Lens, lens_of, split_projection
from inspe_jax.sensing.pose_solver import PoseFit, solve_pose
from inspe_jax.sensing.sensors import CameraSpec, Spec

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
HIGHEST = 150.0  # above the ground no roadside sensor is so high [m]
UPWARD, ROLLED = np.radians(30), np.radians(20)  # no camera looks up so far; few are rolled so far
OFF = 0.25  # a principal point so far off the middle, in picture sizes, has taken up another error
HEIGHTS = "scene", "ground"
CAMERAS = "camera", "thermal"  # kinds with optical axes


@dataclass(frozen=True)
class Imported:
    """A layout of calibrations; ``notes`` say what was left out or assumed, ``fits`` are of the
    sensors whose poses were solved from pairs, by name."""

    layout: Layout
    notes: tuple[str, ...]
    fits: dict[str, PoseFit]


def layouts_from(
    *files: str | os.PathLike[str],
    scene: Scene | None = None,
    transform: Any = None,
    crs: str | None = None,
    unit: str = "m",
    heights: str = "scene",
    size: tuple[int, int] | None = None,
    convention: str | None = None,
    camera: str = "paper-camera",
    lidar: str = "paper-lidar-64",
) -> Imported:
    """One layout of the sensors in calibration files.

    Args:
        files: Our own (:mod:`inspe_jax.sensing.calibrations`), with OpenCV's matrices or pairs of
            pixels and places; of TUMTraf, OpenLABEL, OPV2V, V2XSet, V2X-Real, or a list of sensors.
        scene: The scene to hang them in: by its projection where the files have a CRS, and with
            heights checked against its ground. Without one, poses are in the files' CRS or frame.
        transform: (4, 4) from the frame of the files to their CRS [m], or to the scene without one;
            or x, y, z [m] and yaw [degrees].
        crs: CRS of the files where they name none: a code, a PROJ string, or ``LAT,LON``.
        unit: Of lengths in the files: m, cm or mm.
        heights: Above what z is: "scene" (its zero) or "ground" (at the sensor's foot).
        size: Width and height of pictures [px] where the files have none.
        convention: What the angles of a list of sensors are from: "body", "azimuth" or "carla".
        camera: Device whose rays and reliability cameras get, which files do not have. Those with
            a lens see as far as there are 25 px per metre, unless the file names their device.
        lidar: Device of LiDARs for which the files name none.

    Returns:
        The layout, with notes and fits.

    Raises:
        InspeError: A file is none of these, or a matrix is no rotation, mirrored, transposed or in
            another unit, a lens does not fit its picture, a camera looks up, or a sensor is in the
            ground or too high; or the scene has no projection for the files' CRS.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp(), "pole.yaml")
    >>> _ = path.write_text('''sensors:
    ...   - {name: a, width: 1920, height: 1080, position: [4, 3, 6], yaw_deg: 90, pitch_deg: -20,
    ...      camera_matrix: [[1200, 0, 960], [0, 1200, 540], [0, 0, 1]]}''')
    >>> inspe_jax.layouts_from(path).layout.pose(0).z
    6.0
    """
    for name, value, known in (("unit", unit, UNITS), ("heights", heights, HEIGHTS)):
        check_known(value, known, name)
    if convention is not None:
        check_known(convention, ANGLES, "convention")
    if heights == "ground" and scene is None:
        raise InspeError("heights: those above the ground need a scene")
    usual = {"camera": device(camera).spec, "lidar": device(lidar).spec}
    for kind, spec in usual.items():
        if spec.kind != kind:
            raise InspeError(f"{kind}: '{spec.name}' is a {spec.kind}")
    rows: list[tuple[SensorKeys, np.ndarray, Spec]] = []
    notes: list[str] = []
    fits: dict[str, PoseFit] = {}
    shift, local = None if transform is None else _transform(transform), None
    if size is not None:
        array(size, "size", (2,))
    for path in map(Path, files):
        content, entries = read_entries(path, convention, notes)
        own = content if isinstance(content, dict) and "sensors" in content else {}
        file = check_model(FileKeys, own or dict(sensors=[]), str(path))
        specs = {key: spec_of(x, key, f"{path}: devices.{key}") for key, x in file.devices.items()}
        frame, system, at = file.frame.matrix, file.frame.crs or crs, f"{path}: frame.matrix"
        if frame is not None and shift is not None:
            raise InspeError(f"{at}: the file has one; leave out the transform")
        frame = np.eye(4) if frame is None and shift is None else rigid(frame or shift, at)
        ones = [(where, check_model(SensorKeys, entry, where)) for where, entry in entries]
        degrees = {one.lat is not None for _, one in ones}
        if system is None and len(degrees) == 2:
            raise InspeError(
                f"{path}: some of its sensors have lat and lon, and others are in a frame of no "
                "CRS: name frame.crs, or give the 'crs'"
            )
        for where, one in ones:
            earth = one.lat is not None or one.azimuth_deg is not None
            if earth and not (unit == "m" and np.array_equal(frame, np.eye(4))):
                raise InspeError(
                    f"{where}: lat, lon and azimuth_deg are of the Earth, and not of a frame: "
                    "leave out its matrix, the transform and the unit"
                )
            there = system
            if one.lat is not None and there is None:
                there = local = local or f"{one.lat},{one.lon}"
            lens, matrix = _read(one, where, there, UNITS[unit], notes, fits)
            pose = pose_of(frame @ matrix, "body", "sensor_to_world", where)
            if scene is not None and there is not None:
                with error_at(f"{where}: in '{there}'"):
                    pose = _in_scene(pose, projection_of(there), scene)
            level = 0.0 if scene is None else scene.intersection.ground(pose[None, :2])[0]
            pose[2] += level if heights == "ground" else 0.0
            _check(one, pose, None if scene is None else float(level), where, notes)
            with error_at(where):
                rows.append((one, pose, _spec(one, lens, specs, usual, size, where, notes)))
        nameless = system is None and ("frame" not in own or file.frame.matrix is not None)
        if scene is not None and transform is None and nameless and not any(degrees):
            notes.append(f"{path}: names no CRS: its frame is taken for the scene's own")
    if not rows:
        raise InspeError("calibrations: name a file")
    assumed = (spec for one, _, spec in rows if one.device is None and spec != usual["camera"])
    far = [f"{spec.name} {spec.grid.reach:.0f} m" for spec in assumed if spec.kind == "camera"]
    if far:
        most = f"{CameraSpec.pixels_per_metre:g} px per metre"
        notes.append(f"cameras see up to {most}: {', '.join(far)}")
    poses = np.array([pose for _, pose, _ in rows])
    units, of = _units([one.unit for one, _, _ in rows], poses, scene)
    sensors = [Sensor(one.name, spec, u) for (one, _, spec), u in zip(rows, of, strict=True)]
    layout = make_layout(sensors, units, poses, Path(files[0]).stem, str(files[0]))
    return Imported(layout, tuple(notes), fits)


def _transform(given: Any) -> list[list[float]]:
    found = array(given, "transform", (4, 4), (16,), (4,))
    if found.shape == (4,):
        found = pose_matrix([*found[:3], 0.0, 0.0, np.radians(found[3])])
    return rigid(found.reshape(4, 4), "transform").tolist()


def projection_of(crs: str) -> Georeference:
    """The projection of a code, a PROJ string, or ``LAT,LON``: the transverse Mercator there."""
    if place := re.fullmatch(r"\s*(-?[\d.]+)\s*,\s*(-?[\d.]+)\s*", crs):
        return about(place[1], place[2])
    return Georeference(crs)


# ── Poses of entries ─────────────────────────────────────────────


def _read(
    one: SensorKeys, where: str, crs: str | None, unit: float, notes: list[str],
    fits: dict[str, PoseFit],
) -> tuple[Lens | None, Float[np.ndarray, "4 4"]]:  # fmt: skip
    """The lens, and the matrix from our axes of a sensor to the frame [m], whose CRS and unit [m]
    are given."""
    given = [key for key in POSES if getattr(one, key) is not None]
    if len(given) != 1 and given != ["pairs", "position"]:
        had = ", ".join(given) or "none"
        raise InspeError(f"{where}: needs one of {', '.join(POSES)}; has {had}")
    lens, at = None, f"{where}.{given[0]}"
    one.check(where, given[0])
    if one.camera_matrix is not None:
        fisheye = one.model in FISHEYES
        lens = lens_of(one.camera_matrix, f"{where}.camera_matrix", notes, one.distortion, fisheye)
    elif one.device is None and one.hfov_deg is not None:
        if one.width is None or one.height is None:
            raise InspeError(f"{where}: width, height: missing keys: hfov_deg needs them")
        focal = focal_of(one.width, one.hfov_deg)
        lens = Lens(focal, focal, one.width / 2, one.height / 2)
    if given[0] in ("position", "lat"):
        matrix = _placed(one, where, crs)
        matrix[:3, 3] *= unit
        return lens, matrix
    if given[0] == "pairs":
        if lens is None:
            raise InspeError(f"{where}.camera_matrix: missing key: pairs need the lens")
        rows = array(one.pairs, at, (len(one.pairs) if isinstance(one.pairs, list) else 0, 5))
        with error_at(at):
            place = None if one.position is None else np.multiply(one.position, unit)
            fit = solve_pose(rows[:, :2], unit * rows[:, 2:], lens, place=place)
        fits[one.name] = fit
        notes.append(f"{at}: {fit.words}")
        return lens, pose_matrix(fit.pose)
    if given[0] == "projection":
        if lens is not None:
            raise InspeError(f"{where}.camera_matrix: leave it out: the projection has the lens")
        lens, matrix = split_projection(one.projection, at, notes)
    else:
        matrix = rigid(getattr(one, given[0]), at)
        matrix = np.linalg.inv(matrix) if given[0] == "frame_to_sensor" else matrix
    axes = one.convention or ("optical" if one.kind in CAMERAS else "body")
    matrix = pose_matrix(pose_of(matrix, axes, "sensor_to_world", at))
    matrix[:3, 3] *= unit
    return lens, matrix


def _placed(one: SensorKeys, where: str, crs: str | None) -> Float[np.ndarray, "4 4"]:
    """The matrix of a position, or of degrees in the CRS, and angles."""
    if (one.yaw_deg is None) == (one.azimuth_deg is None):
        raise InspeError(
            f"{where}: give either yaw_deg, counter-clockwise from x, or azimuth_deg, clockwise "
            "from true north"
        )
    at = np.array([0.0, 0.0, one.z] if one.position is None else one.position)
    if one.position is None:
        if one.lat is None or one.lon is None:
            raise InspeError(f"{where}.lon: missing key: lat and lon go together")
        assert crs is not None
        with error_at(where):
            at[:2] = projection_of(crs).from_degrees(np.array([[one.lon, one.lat]]))[0]
    array(at, f"{where}.position", (3,))
    yaw = np.radians(one.yaw_deg or 0.0)
    if one.azimuth_deg is not None:
        if crs is None:
            raise InspeError(f"{where}.azimuth_deg: needs a CRS, or yaw_deg in its place")
        with error_at(where):
            yaw = projection_of(crs).yaw(at[None, :2], np.array([one.azimuth_deg]))[0]
    return pose_matrix([*at, *np.radians([one.roll_deg, one.pitch_deg]), yaw])


# ── What hangs in the scene ─────────────────────────────────────────────────


def _in_scene(
    pose: Float[np.ndarray, "6"], here: Georeference, scene: Scene
) -> Float[np.ndarray, "6"]:
    """A pose of a projection in a scene, turned by what grid norths differ there."""
    there = known_georeference(scene.intersection)
    at = there.from_degrees(here.to_degrees(pose[None, :2]))
    if not np.isfinite(at).all():
        raise InspeError(f"({pose[0]:.1f}, {pose[1]:.1f}) is no place of that projection")
    yaw = there.yaw(at, here.azimuth(pose[None, :2], pose[5:]))
    return np.array([*at[0], *pose[2:5], yaw[0]])


def _check(
    one: SensorKeys, pose: np.ndarray, level: float | None, where: str, notes: list[str]
) -> None:
    """Raise InspeError where no roadside sensor hangs or looks so; note what is unusual. ``level``
    is the ground's [m]."""
    x, y, z, roll, pitch, _ = pose
    where = f"{where}: {one.name} at ({x:.2f}, {y:.2f})"
    if level is not None and z <= level:
        raise InspeError(
            f"{where} is in the ground, at {z:.2f} m where the ground is at {level:.2f} m: is the "
            "matrix of the other direction, or its height above the ground ('heights')?"
        )
    if z - (level or 0.0) > HIGHEST and (level is not None or z > 10 * HIGHEST):
        raise InspeError(
            f"{where} is {z - (level or 0.0):,.0f} m high, and {HIGHEST:g} m are the most: give "
            "the 'unit' if it is mm or cm, or a 'transform' if heights are above the sea"
        )
    if one.kind in CAMERAS and pitch > UPWARD:
        raise InspeError(
            f"{where} looks up by {np.degrees(pitch):.1f}° and is rolled by "
            f"{np.degrees(roll):.1f}°, as no roadside camera: the axes ('convention') or the "
            "direction are others, or the calibration is wrong"
        )
    if abs(roll) > ROLLED and abs(pitch) < np.pi / 2 - ROLLED:
        hung = f"{where} is rolled by {np.degrees(roll):.0f}° and {z - (level or 0.0):.1f} m high"
        notes.append(
            f"{hung}; if it does not hang so, its axes are others ('convention'), or its matrix is "
            "the inverse"
        )


def _spec(
    one: SensorKeys, lens: Lens | None, specs: dict[str, Spec], usual: dict[str, Spec],
    size: tuple[int, int] | None, where: str, notes: list[str],
) -> Spec:  # fmt: skip
    """What hangs there: the lens in a device, the device that is named, or the usual one."""
    own = None if one.device is None else specs.get(one.device) or device(one.device).spec
    if own is not None and own.kind != one.kind:
        raise InspeError(f"device: '{one.device}' is a {own.kind}, and the sensor a {one.kind}")
    if own is not None and one.hfov_deg is not None:
        own = with_hfov(own, one.hfov_deg)
    if own is None and one.kind not in usual:
        raise InspeError(f"device: missing key: a {one.kind} needs one, and none is usual")
    like = own or usual[one.kind]
    same = not isinstance(like, CameraSpec) or (
        one.width in (None, like.width) and one.height in (None, like.height)
    )
    if lens is None and not same:
        raise InspeError(
            f"width, height: '{like.name}' has {like.resolution}: give a camera_matrix, or hfov_deg"
        )
    if lens is None:
        if own is None:
            notes.append(f"{where}: names no device: taken as {like.name}")
        return like
    if not isinstance(like, CameraSpec):
        raise InspeError(f"camera_matrix: a {one.kind} has none")
    fx, fy, cx, cy, distortion, fisheye, _ = lens
    near = same and np.allclose(like.optics[:4], lens[:4], atol=1e-5)
    if one.image_circle_deg is not None:
        circle = float(np.degrees(like.image_circle or 0.0))
        near &= abs(circle - one.image_circle_deg) < 1e-6
    if own is not None and near and like.optics[4:6] == lens[4:6]:
        return own
    wide, high = (one.width, one.height) if one.width and one.height else size or (None, None)
    if wide is None or high is None:
        raise InspeError("width, height: missing keys: give the 'size' of its picture")
    if 0.5 >= (off := max(abs(cx / wide - 0.5), abs(cy / high - 0.5))) > OFF:
        notes.append(
            f"{where}: its principal point is {100 * off:.0f} % of the picture off the middle: in "
            "such a fit focal length, principal point and angles make up for each other"
        )
    return type(like).from_intrinsics(
        one.name, wide, high, fx=fx, fy=fy, cx=cx, cy=cy,
        depth=None if own is None else like.depth, downsample=like.downsample,
        reliability=like.reliability, distortion=distortion, fisheye=fisheye,
        image_circle_deg=one.image_circle_deg,
    )  # fmt: skip


def _units(
    named: list[str | None], poses: Float[np.ndarray, "S 6"], scene: Scene | None
) -> tuple[list[Unit], list[int]]:
    """Units, and the unit of each sensor: that which is named, or the first all of whose sensors
    are as near as those of one unit must be."""
    of: list[int] = []
    names: list[str | None] = []
    for s, name in enumerate(named):
        away = np.abs(poses[:s, :3] - poses[s, :3])
        far = (np.hypot(*away[:, :2].T) > UNIT_PLAN) | (away[:, 2] > UNIT_HEIGHT)
        own = [
            u
            for u, other in enumerate(names)
            if other == name and (name or not far[np.array(of) == u].any())
        ]
        of.append(own[0] if own else len(names))
        names += [] if own else [name]
    bases = [[*poses[of.index(u), :2].tolist(), 0.0] for u in range(len(names))]
    if scene is not None:
        for base in bases:
            base[2] = float(scene.intersection.ground(np.array([base[:2]]))[0])
    return [
        Unit(name or f"unit {u + 1}", (x, y, z))
        for u, (name, (x, y, z)) in enumerate(zip(names, bases, strict=True))
    ], of
