"""Checks every file of a data set against the rules of the public readers.

It follows the description of the format, not the writer: it imports nothing from the package, has
its own transforms and its own PCD parser, and fails with an AssertionError that names the file.
``check_set`` takes a folder of splits, ``check_scenario`` one scenario.
"""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

RANGE = (-140.8, -38.4, -8.0, 140.8, 38.4, 0.0)
"""The range that a reader uses, in the LiDAR's frame [m]: z −8…0, for a LiDAR some 6 m up."""

SPLITS = ("train", "validate", "test")
AGENT_KEYS = ("RSU", "ego_speed", "lidar_pose", "lidar_pose0", "predicted_ego_pos", "true_ego_pos")
THING_KEYS = {"angle", "center", "extent", "location", "obj_type", "speed"}
WORLD_KEYS = ("fixed_delta_seconds", "client_port", "seed", "weather", "town")
KINDS = {"cars": "car", "cyclists": "cyclist", "pedestrians": "pedestrian", "trucks": "truck"}
FILES = (
    r"(\d{6})(\.yaml|\.pcd|_lidar\d+\.pcd|_camera\d+\.png|_depth\d+\.png|_instance\d+\.png"
    r"|_semantic\d+\.png|_bev_visibility\.png)"
)
LAYERS = {"depth": ("I;16", "I"), "instance": ("I;16", "I"), "semantic": ("L",)}


@dataclass
class Report:
    """What a reader finds: counts over all agents and frames; ``ego`` is its first agent."""

    ego: str = ""
    agents: int = 0
    frames: int = 0
    points: int = 0
    points_in_range: int = 0
    boxes: int = 0
    boxes_in_range: int = 0
    boxes_hit: int = 0


def check_set(root, **options) -> dict[str, Report]:
    """Check every scenario of every split; gives the reports by ``split/scenario``."""
    reports = {}
    for split in SPLITS:
        for scenario in sorted((Path(root) / split).glob("*")):
            need(scenario.is_dir(), f"{scenario}: not a folder, which readers take it for")
            reports[f"{split}/{scenario.name}"] = check_scenario(scenario, **options)
    need(reports, f"{root}: no scenario")
    return reports


def check_scenario(scenario, attenuation=None, lidar_range=RANGE) -> Report:
    """Check every file of a scenario.

    ``attenuation`` [1/m]: intensities must be exp(−attenuation · distance), to 1/255.
    """
    scenario = Path(scenario)
    told = check_protocol(scenario / "data_protocol.yaml").get("lidar_range")
    agents = readers_order(scenario)
    report = Report(ego=agents[0], agents=len(agents))
    stamps = [p.stem for p in sorted((scenario / agents[0]).glob("*.yaml"))]
    need(stamps, f"{scenario / agents[0]}: no frame")
    for agent in agents:
        folder = scenario / agent
        there = {p.stem for p in folder.glob("*.yaml")}
        need(there == set(stamps), f"{folder}: its frames are not those of agent {agents[0]}")
        check_names(folder, stamps)
    for stamp in stamps:
        check_frame(scenario, agents, stamp, report, attenuation, lidar_range)
        if told:
            check_range(scenario, agents, stamp, told)
    return report


def readers_order(scenario: Path) -> list[str]:
    """Agents in the order of readers: sorted as text, and the first moved to the end if
    negative."""
    agents = sorted(p.name for p in scenario.iterdir() if p.is_dir() and p.name != ".frames")
    need(agents, f"{scenario}: no agent")
    for agent in agents:
        need(re.fullmatch(r"-[1-9]\d*", agent), f"{scenario / agent}: not the id of a unit")
    if int(agents[0]) < 0:
        agents = agents[1:] + agents[:1]
    return agents


def check_protocol(path: Path) -> dict:
    need(path.is_file(), f"{path}: missing")
    protocol = load(path)
    for key in WORLD_KEYS:
        need(key in protocol.get("world", {}), f"{path}: no world.{key}")
    return protocol


def check_names(folder: Path, stamps: list[str]) -> None:
    for path in folder.iterdir():
        match = re.fullmatch(FILES, path.name)
        need(match, f"{path}: not a file of the format")
        need(match[1] in stamps, f"{path}: of a frame without its YAML")


def check_frame(scenario, agents, stamp, report, attenuation, lidar_range) -> None:
    in_range, hit, listed = set(), set(), None
    report.frames += 1
    for agent in agents:
        path = scenario / agent / f"{stamp}.yaml"
        content = load(path)
        check_agent(path, content)
        check_cameras(path, content)
        things = check_things(path, content)
        need(listed in (None, things), f"{path}: other things than agent {agents[0]} lists")
        listed = things
        points = check_lidars(path, content, attenuation)
        report.points += len(points)
        if not len(points):
            continue
        near = inside_range(points[:, :3], lidar_range)
        need(near.any(), f"{path}: no point within the reader's range {lidar_range}")
        report.points_in_range += int(near.sum())
        for track, thing in things.items():
            to_box, middle = box_in_lidar(thing, content["lidar_pose"])
            if inside_range(middle[None], lidar_range)[0]:
                in_range.add(track)
                local = to_box[:3, :3] @ points[:, :3].T + to_box[:3, 3:]
                if (np.abs(local.T) <= np.array(thing["extent"]) + 0.05).all(1).any():
                    hit.add(track)
    report.boxes += len(listed)
    report.boxes_in_range += len(in_range)
    report.boxes_hit += len(hit)


def check_range(scenario: Path, agents: list[str], stamp: str, told) -> None:
    """Whether the range that the protocol tells readers to use keeps every box, as a whole, in the
    frame of any agent."""
    for agent in agents:
        path = scenario / agent / f"{stamp}.yaml"
        content = load(path)
        for track, thing in content["vehicles"].items():
            corners = corners_in_lidar(thing, content["lidar_pose"])
            need(inside_range(corners, told).all(), f"{path}: vehicles.{track} leaves {told}")


def check_agent(path: Path, content: dict) -> None:
    for key in (*AGENT_KEYS, "vehicles", *KINDS):
        need(key in content, f"{path}: no {key}")
    for key, value in content.items():
        if re.fullmatch(r"lidar_pose\d*|(true|predicted)_ego_pos", key):
            numbers(value, (6,), f"{path}: {key}")
    need(content["RSU"] is True, f"{path}: RSU is not true")
    need(content["ego_speed"] == 0, f"{path}: a unit that moves")
    need(content["lidar_pose"] == content["lidar_pose0"], f"{path}: two poses of one LiDAR")


def check_cameras(path: Path, content: dict) -> None:
    cameras = sorted(int(m[1]) for m in (re.fullmatch(r"camera(\d+)", k) for k in content) if m)
    need(cameras == list(range(len(cameras))), f"{path}: cameras {cameras} are not 0, 1, …")
    pictures = list(path.parent.glob(f"{path.stem}_camera*.png"))
    need(len(pictures) == len(cameras), f"{path}: {len(cameras)} cameras, {len(pictures)} pictures")
    lidar = to_world(content["lidar_pose"])
    for i in cameras:
        camera, where = content[f"camera{i}"], f"{path}: camera{i}"
        numbers(camera["cords"], (6,), f"{where}.cords")
        k = numbers(camera["intrinsic"], (3, 3), f"{where}.intrinsic")
        extrinsic = numbers(camera["extrinsic"], (4, 4), f"{where}.extrinsic")
        expected = np.linalg.inv(to_world(camera["cords"])) @ lidar
        off = np.abs(extrinsic - expected).max()
        need(off < 1e-9, f"{where}.extrinsic: off by {off:g} from inv(camera) · LiDAR")
        check_pictures(path, i, k)


def check_pictures(path: Path, i: int, k: np.ndarray) -> None:
    size = (round(2 * k[0, 2]), round(2 * k[1, 2]))
    fixed = [k[0, 1], k[1, 0], k[2, 0], k[2, 1], k[2, 2] - 1]
    need(not np.any(fixed) and k[0, 0] > 0, f"{path}: camera{i}.intrinsic: not a pinhole's")
    for word, modes in {"camera": ("RGB",), **LAYERS}.items():
        file = path.with_name(f"{path.stem}_{word}{i}.png")
        if word != "camera" and not file.exists():
            continue
        with Image.open(file) as picture:
            picture.load()
            need(picture.format == "PNG", f"{file}: not a PNG")
            need(picture.mode in modes, f"{file}: mode {picture.mode}, not {modes[0]}")
            need(picture.size == size, f"{file}: {picture.size}, the intrinsic says {size}")


def check_things(path: Path, content: dict) -> dict:
    """The road users, by track; speeds must be those of their velocities, where these are given."""
    things = content["vehicles"]
    parts = {}
    for section, kind in KINDS.items():
        for track, thing in content[section].items():
            need(track not in parts, f"{path}: {track} is in two dictionaries")
            need(things.get(track) == thing, f"{path}: {section}.{track} is not vehicles.{track}")
            need(thing["obj_type"].lower() == kind, f"{path}: {section}.{track}: obj_type")
            need(isinstance(thing["name"], str), f"{path}: {section}.{track}: no name")
            parts[track] = thing
    need(parts.keys() == things.keys(), f"{path}: vehicles are not all of {', '.join(KINDS)}")
    for track, thing in things.items():
        where = f"{path}: vehicles.{track}"
        need(type(track) is int and track >= 0, f"{where}: the id is not a whole number")
        need(thing.keys() >= THING_KEYS, f"{where}: misses {THING_KEYS - thing.keys()}")
        for key in ("angle", "center", "extent", "location"):
            numbers(thing[key], (3,), f"{where}.{key}")
        need(min(thing["extent"]) > 0, f"{where}.extent: not above 0")
        half = [0, 0, thing["extent"][2]]
        need(thing["center"] == half, f"{where}.center: not straight up by half the height")
        need(numbers(thing["speed"], (), f"{where}.speed") >= 0, f"{where}.speed: below 0")
        if "velocity" in thing:
            fast = 3.6 * np.linalg.norm(numbers(thing["velocity"], (3,), f"{where}.velocity"))
            need(abs(fast - thing["speed"]) < 1e-5, f"{where}.velocity: {fast} km/h is not speed")
    return things


def check_lidars(path: Path, content: dict, attenuation) -> np.ndarray:
    """Points (N, 4) of the first LiDAR as in the file: x, y, z and intensity."""
    lidars = sorted(int(m[1]) for m in (re.fullmatch(r"lidar_pose(\d+)", k) for k in content) if m)
    need(lidars == list(range(len(lidars))), f"{path}: LiDARs {lidars} are not 0, 1, …")
    plain = path.with_suffix(".pcd")
    second = path.with_name(f"{path.stem}_lidar0.pcd")  # the Infra-Set variant's name of the first
    clouds = [plain, *(set(path.parent.glob(f"{path.stem}_lidar*.pcd")) - {second})]
    need(len(clouds) == len(lidars), f"{path}: {len(lidars)} LiDARs, {len(clouds)} point clouds")
    for i in lidars:
        file = path.with_name(f"{path.stem}_lidar{i}.pcd") if i else plain
        points = parse_pcd(file)
        if attenuation is not None:
            expected = np.exp(-attenuation * np.linalg.norm(points[:, :3], axis=1))
            off = np.abs(points[:, 3] - expected).max(initial=0)
            need(off <= 0.51 / 255, f"{file}: an intensity is off by {off:g}")
    same = not second.exists() or plain.read_bytes() == second.read_bytes()
    need(same, f"{second}: not the points of the first LiDAR")
    return parse_pcd(plain)


def parse_pcd(path: Path) -> np.ndarray:
    """x, y, z and intensity by ``struct``; reads only the simplest form of the format."""
    head, mark, body = path.read_bytes().partition(b"DATA binary\n")
    lines = [line.split() for line in head.decode("ascii").splitlines() if line[0] != "#"]
    header = {key: values for key, *values in lines}
    need(mark, f"{path}: not binary")
    need(header["VERSION"] == ["0.7"], f"{path}: VERSION {header['VERSION']}")
    need(header["FIELDS"] == ["x", "y", "z", "rgb"], f"{path}: FIELDS {header['FIELDS']}")
    need(header["SIZE"] == ["4"] * 4, f"{path}: SIZE {header['SIZE']}")
    need(header["TYPE"] == ["F"] * 4, f"{path}: TYPE {header['TYPE']}")
    need(header["COUNT"] == ["1"] * 4, f"{path}: COUNT {header['COUNT']}")
    need(header["HEIGHT"] == ["1"], f"{path}: HEIGHT {header['HEIGHT']}")
    need(header["WIDTH"] == header["POINTS"], f"{path}: WIDTH is not POINTS")
    many = int(header["POINTS"][0])
    need(len(body) == 16 * many, f"{path}: {len(body)} bytes of {many} points")
    rows = [(x, y, z, r / 255, *rest) for x, y, z, *rest, r, _ in struct.iter_unpack("<3f4B", body)]
    table = np.array(rows).reshape(many, 6)
    need(np.isfinite(table).all(), f"{path}: a coordinate is not finite")
    need(not table[:, 4:].any(), f"{path}: more than the red byte is set")
    return table[:, :4]


def to_world(cords) -> np.ndarray:
    """Body to world (4, 4) of x, y, z, roll, yaw, pitch [m, °], in Unreal's left-handed axes."""
    x, y, z, roll, yaw, pitch = cords
    cr, cy, cp = np.cos(np.radians([roll, yaw, pitch]))
    sr, sy, sp = np.sin(np.radians([roll, yaw, pitch]))
    turn_yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    turn_pitch = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    turn_roll = np.array([[1, 0, 0], [0, cr, sr], [0, -sr, cr]])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn_yaw @ turn_pitch @ turn_roll, (x, y, z)
    return out


def box_in_lidar(thing: dict, lidar_pose) -> tuple[np.ndarray, np.ndarray]:
    """(LiDAR to box (4, 4), the box's middle in the LiDAR's frame): the middle is
    ``location + center``, the latter not rotated."""
    middle = np.array(thing["location"]) + np.array(thing["center"])
    box = to_world([*middle, *thing["angle"]])
    lidar = to_world(lidar_pose)
    return np.linalg.inv(box) @ lidar, (np.linalg.inv(lidar) @ box)[:3, 3]


def corners_in_lidar(thing: dict, lidar_pose) -> np.ndarray:
    """The corners (8, 3) of a box in the LiDAR's frame."""
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
    to_lidar = np.linalg.inv(box_in_lidar(thing, lidar_pose)[0])
    return (signs * thing["extent"]) @ to_lidar[:3, :3].T + to_lidar[:3, 3]


def inside_range(points: np.ndarray, limits) -> np.ndarray:
    low, high = np.array(limits[:3]), np.array(limits[3:])
    return ((points > low) & (points < high)).all(1)


def numbers(value, shape: tuple, where: str) -> np.ndarray:
    array = np.array(value)
    need(array.shape == shape and array.dtype.kind in "fi", f"{where}: not numbers {shape}")
    need(np.isfinite(array).all(), f"{where}: not finite")
    return array.astype(float)


def load(path: Path) -> dict:
    return yaml.load(path.read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def need(condition, message: str) -> None:
    if not condition:
        raise AssertionError(message)
