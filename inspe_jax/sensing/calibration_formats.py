"""The keys of our own calibration files (:mod:`inspe_jax.sensing.calibrations`), and files of
others in these words.

A reader gives the entries of sensors, each with where it is in the file. A new format is a row of
:data:`FORMATS`.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import scipy
from pydantic import AliasChoices, BaseModel, Field

from inspe_jax.core.carla_frame import between
from inspe_jax.core.carla_frame import matrix as carla_matrix
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import STRICT, YAML, check_input, parse_yaml, read_json
from inspe_jax.core.rigid import array, rigid

AGREE = 0.01  # a camera's two poses in one file may differ by so much
ANGLES = "body", "azimuth", "carla"
"""What the angles of a list of sensors are from: yaw counter-clockwise from x, yaw clockwise from
true north, or CARLA's left-handed axes."""

POSES = "sensor_to_frame", "frame_to_sensor", "projection", "pairs", "position", "lat"
"""Keys of which a sensor has one: how its pose is given. A position may go with pairs."""
ANGLED = "yaw_deg", "azimuth_deg", "pitch_deg", "roll_deg"
GOES_WITH = {"position": ANGLED, "lat": (*ANGLED, "lon", "z")}  # of lon, z and angles
FISHEYES = "fisheye", "equidistant"  # OpenCV's and ROS's names of one model

Entry = tuple[str, dict[str, Any]]
"""Where a sensor is in its file, and its entry as our own file has it."""

_Number = Annotated[float, Field(ge=-1e8, le=1e8)]
_Side = Annotated[int, Field(ge=1, le=100_000)]


def _or(name: str, other: str, usual: Any) -> Any:
    """A field that OpenCV or ROS names otherwise."""
    return Field(usual, validation_alias=AliasChoices(name, other))


class SensorKeys(BaseModel, **STRICT):
    """The keys of a sensor in our own file."""

    name: str = _or("name", "camera_name", "camera")
    kind: Literal["camera", "lidar", "radar", "thermal"] = "camera"
    device: str | None = None
    unit: str | None = None
    hfov_deg: Annotated[float, Field(gt=0, lt=180)] | None = None  # of a device, if it is varifocal
    width: _Side | None = _or("width", "image_width", None)
    height: _Side | None = _or("height", "image_height", None)
    camera_matrix: Any = None
    distortion: Any = _or("distortion", "distortion_coefficients", ())
    model: Literal["pinhole", "plumb_bob", "rational_polynomial", "fisheye", "equidistant"] = _or(
        "model", "distortion_model", "pinhole"
    )
    image_circle_deg: Annotated[float, Field(gt=0, le=220)] | None = None
    convention: Literal["optical", "body", "carla"] | None = None
    sensor_to_frame: Any = None
    frame_to_sensor: Any = None
    projection: Any = None
    pairs: Any = None
    position: list[_Number] | None = None
    lat: Annotated[float, Field(ge=-90, le=90)] | None = None
    lon: Annotated[float, Field(ge=-180, le=180)] | None = None
    z: _Number = 0.0
    yaw_deg: _Number | None = None
    azimuth_deg: _Number | None = None
    pitch_deg: _Number = 0.0
    roll_deg: _Number = 0.0
    rectification_matrix: Any = None  # of ROS: as the next one, no part of the pose
    projection_matrix: Any = None
    looks: Any = None  # what an export adds for those who look: place, azimuth, polygon

    def check(self, where: str, pose: str) -> None:
        """Raise InspeError for what is said of a lens or of a pose and cannot be used."""
        bends = dict(distortion=self.distortion, model=self.model in FISHEYES)
        bends |= dict(image_circle_deg=self.image_circle_deg)
        for key, value in bends.items():
            if value and self.camera_matrix is None:
                raise InspeError(f"{where}.{key}: goes with camera_matrix")
        if self.hfov_deg is not None and self.device is None and self.camera_matrix is not None:
            raise InspeError(f"{where}.hfov_deg: leave it out: the camera_matrix has the lens")
        unused = {*GOES_WITH["lat"]} - {*GOES_WITH.get(pose, ())}
        for key in sorted(unused & self.model_fields_set):
            with_ = " or ".join(name for name, keys in GOES_WITH.items() if key in keys)
            raise InspeError(f"{where}.{key}: goes with {with_}, not with {pose}")


class _Frame(BaseModel, **STRICT):
    crs: str | None = None
    matrix: Any = None


class FileKeys(BaseModel, **STRICT):
    """The keys of our own file."""

    name: str | None = None
    frame: _Frame = _Frame()
    devices: dict[str, Any] = {}
    sensors: list[Any]
    stations: Any = None  # what an export adds: perception regions of ETSI's messages


class Source(NamedTuple):
    """What a reader is given: the content, where it is from, what angles are from where it does not
    say, and the notes, to which it adds."""

    content: Any
    path: Path
    convention: str | None
    notes: list[str]

    def leave_out(self, where: str, why: str) -> None:
        """Note that a sensor is left out."""
        self.notes.append(
            f"{where}: {why}, and is left out: of such files cameras and LiDARs are read"
        )


def _own(given: Source) -> list[Entry]:
    """Our own file, or one camera of OpenCV or ROS."""
    several = "sensors" in given.content
    entries = given.content["sensors"] if several else [given.content]
    found = [
        (f"{given.path}: sensors[{k}]" if several else f"{given.path}", entry)
        for k, entry in enumerate(entries)
    ]
    for where, entry in found:
        for key in {"extrinsic", "extrinsics", "extrinsic_matrix"} & entry.keys():
            raise InspeError(
                f"{where}.{key}: does not say its direction: name it frame_to_sensor, as OpenCV's "
                "extrinsics are, or sensor_to_frame, the sensor's pose"
            )
    return found


def _opv2v(given: Source) -> list[Entry]:
    """OPV2V and V2XSet: cords of CARLA, and ``extrinsic`` from the LiDAR to the camera. V2X-Real:
    the LiDAR's matrix is OPV2V's, in a right-handed world, ``extrinsic`` is from the camera's
    optical axes to the LiDAR, and ``cords`` of cameras are not turned, and not used."""
    content, path = given.content, given.path
    names = [key for key in content if re.fullmatch(r"lidar_pose\d*", str(key))]
    lidars = [array(content[key], f"{path}: {key}", (6,)) for key in names]
    first, worlds, cameras = lidars[0], set[str](), list[Entry]()
    for name, own in content.items():
        where = f"{path}: {name}"
        if str(name).startswith("radar"):
            given.leave_out(where, "is a radar")
        if not (isinstance(own, dict) and "intrinsic" in own):
            continue
        cords = array(own.get("cords"), f"{where}.cords", (6,))
        extrinsic = rigid(own.get("extrinsic"), f"{where}.extrinsic")
        pose, axes = carla_matrix(cords), "carla"
        if (off := np.abs(between(first, cords) - extrinsic).max()) > AGREE:
            if np.abs(cords[:3] - first[:3] - extrinsic[:3, 3]).max() > AGREE:
                raise InspeError(
                    f"{where}.extrinsic: is neither OPV2V's, LiDAR to camera, which differs from "
                    f"the cords by {off:.2f}, nor V2X-Real's, camera to LiDAR: correct one of both"
                )
            pose, axes = carla_matrix(first) @ extrinsic, "optical"
        worlds.add(axes)
        about = dict(name=str(name), camera_matrix=own["intrinsic"], convention=axes)
        if axes == "carla":  # its principal point is the middle of the picture
            sides = 2 * array(own["intrinsic"], f"{where}.intrinsic", (3, 3))[:2, 2]
            about |= dict(zip(("width", "height"), map(round, sides), strict=True))
        cameras.append((where, about | dict(sensor_to_frame=pose)))
    if len(worlds) == 2:
        raise InspeError(f"{path}: some cameras' extrinsic is OPV2V's, and some V2X-Real's")
    real = worlds == {"optical"} or (not worlds and "infra" in content)
    about = dict(kind="lidar", convention="body" if real else "carla")
    return [
        (f"{path}: {key}", about | dict(name=key[:5] + key[10:], sensor_to_frame=carla_matrix(at)))
        for key, at in zip(names, lidars, strict=True)
    ] + cameras


def _openlabel(given: Source) -> list[Entry]:
    """ASAM OpenLABEL 1.0: ``pose_wrt_parent`` takes a system's points to its parent's; chains are
    followed to their root, which is the frame. Cameras whose lens is no ``intrinsics_pinhole`` are
    left out."""
    label, path, found = given.content["openlabel"], given.path, list[Entry]()
    systems = label.get("coordinate_systems", {})
    for name, stream in label.get("streams", {}).items():
        where, kind = f"{path}: openlabel.streams.{name}", str(stream.get("type", ""))
        if kind not in ("camera", "lidar") or name not in systems:
            known = kind in ("camera", "lidar")
            given.leave_out(where, "has no coordinate system" if known else f"is a {kind}")
            continue
        lenses = {k for k in stream.get("stream_properties", {}) if k.startswith("intrinsics_")}
        if lenses and "intrinsics_pinhole" not in lenses:
            given.notes.append(
                f"{where}: {', '.join(sorted(lenses))}: only intrinsics_pinhole is read, and it is "
                "left out; give it as a sensor with camera_matrix, distortion and model"
            )
            continue
        matrix, system, seen = np.eye(4), name, {name}
        while parent := systems.get(system, {}).get("parent"):
            at = f"{path}: openlabel.coordinate_systems.{system}"
            matrix = _to_parent(systems[system].get("pose_wrt_parent"), at) @ matrix
            if parent in seen:
                raise InspeError(f"{at}.parent: '{parent}' is its own ancestor")
            system = parent
            seen.add(system)
        given.notes.append(f"{where}: its pose is in the frame '{system}'")
        entry = dict(name=name, kind=kind, sensor_to_frame=matrix)
        lens = stream.get("stream_properties", {}).get("intrinsics_pinhole")
        if lens:
            flat = np.ravel(lens.get("camera_matrix_3x4", lens.get("camera_matrix")))
            entry |= dict(width=lens.get("width_px"), height=lens.get("height_px"))
            entry |= dict(distortion=lens.get("distortion_coeffs_1xN", ()))
            entry |= dict(camera_matrix=flat.reshape(3, -1) if flat.size in (9, 12) else flat)
        found.append((where, entry))
    return found


def _to_parent(given: Any, where: str) -> np.ndarray:
    where += ".pose_wrt_parent"
    if isinstance(given, dict) and "quaternion" in given:
        quaternion = array(given["quaternion"], where, (4,))  # x, y, z, w
        turn = scipy.spatial.transform.Rotation.from_quat(quaternion)
        at = array(given.get("translation"), where, (3,))
        return rigid(np.column_stack([turn.as_matrix(), at]), where)
    flat = np.ravel(given["matrix4x4"] if isinstance(given, dict) else given)
    return rigid(flat.reshape(4, 4) if flat.size == 16 else flat, where)


def _tumtraf(given: Source) -> list[Entry]:
    """The dev kit's file of one sensor: a camera's ``projection_matrix`` from the base, or a
    LiDAR's ``transformation_matrix_…_to_…_base``."""
    content, name = given.content, given.path.stem
    for key, matrix in content.items():
        if re.fullmatch(r"transformation_matrix_.*_to_.*base", key):
            entry = dict(name=name, kind="lidar", sensor_to_frame=matrix)
            return [(f"{given.path}: {key}", entry)]
    where = f"{given.path}: projection_matrix"
    if not content.get("projection_matrix"):
        raise InspeError(
            f"{where}: is empty or missing, and other matrices of the file do not say their frame "
            "and unit; give a file that has it"
        )
    size = dict(width=content.get("image_width"), height=content.get("image_height"))
    return [(where, dict(name=name, projection=content["projection_matrix"]) | size)]


def _list(given: Source) -> list[Entry]:
    """A list of sensors, as of CARMA Streets: id, type, WGS 84 or local place, angles [degrees]."""
    found: list[Entry] = []
    for k, one in enumerate(given.content):
        where, named = f"{given.path}: [{k}]", str(one["type"]).lower()
        kind = next((kind for kind in ("lidar", "camera") if kind in named), None)
        if kind is None:
            given.leave_out(where, f"is a {named}")
            continue
        reference = one.get("ref", one)
        place, turn = reference.get("location"), one.get("orientation")
        if place is None or (turn is None and kind == "camera"):
            raise InspeError(f"{where}.{'location' if place is None else 'orientation'}: missing")
        earth = reference.get("type") == "WGS84"
        names, keys = ("lat", "lon", "elevation") if earth else "xyz", ("yaw", "pitch", "roll")
        at = array([place[key] for key in names], f"{where}.location", (3,)).tolist()
        angles = [0.0] * 3 if turn is None else [turn[key] for key in keys]
        yaw, pitch, roll = array(angles, f"{where}.orientation", (3,)).tolist()
        if turn is None:
            given.notes.append(f"{where}: has no orientation: taken as level")
        elif given.convention is None and (earth or any(angles)):
            raise InspeError(
                f"{where}.orientation: does not say what its angles are from: give a convention, "
                f"one of {', '.join(ANGLES)}"
            )
        own: dict[str, Any] = dict(name=one.get("sensorId") or one["id"], kind=kind)
        if given.convention == "carla":
            if earth:
                raise InspeError(f"{where}.ref.type: CARLA's axes have no latitude; give another")
            matrix = carla_matrix([*at, roll, yaw, pitch])
            own |= dict(sensor_to_frame=matrix, convention="carla")
        else:
            clockwise = given.convention == "azimuth"
            own |= dict(zip(("lat", "lon", "z"), at, strict=True)) if earth else dict(position=at)
            own |= {"azimuth_deg" if clockwise else "yaw_deg": yaw}
            own |= dict(pitch_deg=pitch, roll_deg=roll)
        found.append((where, own))
    return found


FORMATS: dict[str, tuple[Callable[[Any], Any], Callable[[Source], list[Entry]]]] = {
    "a list of sensors": (lambda content: isinstance(content, list), _list),
    "OpenLABEL": (lambda content: "openlabel" in content, _openlabel),
    "OPV2V, V2XSet or V2X-Real": (
        lambda content: any(re.fullmatch(r"lidar_pose\d*", str(key)) for key in content),
        _opv2v,
    ),
    "TUMTraf": (
        lambda content: any(
            re.match("transformation_matrix_.*_to_|intrinsic_camera_matrix", str(key))
            for key in content
        ),
        _tumtraf,
    ),
    "a calibration": (
        lambda content: {"sensors", "camera_matrix", "projection"} & {*content},
        _own,
    ),
}
"""Every format by name: whether a content is of it, and its reader."""


def read_entries(path: Path, convention: str | None, notes: list[str]) -> tuple[Any, list[Entry]]:
    """The content of a file, and the entries of its sensors; adds to the ``notes``. Raises
    InspeError that names the file and the key."""
    if path.suffix.lower() == ".json":
        content = read_json(path)
    else:
        check_input(path, YAML)
        text = path.read_bytes().replace(b"!!opencv-matrix", b"").replace(b"%YAML:1.0", b"")
        content = parse_yaml(text, str(path))
    fits = isinstance(content, dict | list)
    known = next((name for name, (of, _) in FORMATS.items() if fits and of(content)), None)
    if known is None:
        raise InspeError(f"{path}: is no calibration: it must be {', '.join(FORMATS)}")
    try:
        found = FORMATS[known][1](Source(content, path, convention, notes))
    except InspeError:
        raise
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InspeError(f"{path}: is not {known}: {error!r}") from error
    if not found:
        raise InspeError(f"{path}: has no camera or LiDAR with a pose")
    return content, found
