"""Reads frames from OPV2V files: of this package, and of other people, which may say less."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.carla_frame import flip, from_carla
from inspe_jax.core.errors import InspeError, brief
from inspe_jax.core.files import YAML, check_input, parse_yaml
from inspe_jax.dataset.formats.opv2v.writer import KMH, NO_LIDAR, OBSERVED, SECTIONS
from inspe_jax.dataset.formats.pcd import read_notes, read_pcd
from inspe_jax.dataset.formats.pictures import SUFFIXES, read_picture
from inspe_jax.dataset.formats.protocol_file import as_mapping, section_of
from inspe_jax.simulation.frame import Boxes, Frame, Image, RoadUserBox, Scan, Station
from inspe_jax.simulation.recorder import LAYERS

TICK = 0.05  # time from one frame number to the next [s], if no protocol says it

OBJ_TYPES: dict[str, str] = {
    **dict.fromkeys(("car", "van"), "car"),
    **dict.fromkeys(("truck", "bus"), "truck"),
    **dict.fromkeys(("cyclist", "bicycle", "motorcycle"), "cyclist"),
    **dict.fromkeys(("pedestrian", "walker"), "pedestrian"),
}
"""The kind of road user for each ``obj_type``, in lower case."""

_BOXES = b"\nvehicles:"


def agent_ids(scenario: Path) -> tuple[int, ...]:
    """Ids of a scenario's agents: infrastructure −1, −2, … first, then vehicles."""
    with os.scandir(scenario) as entries:
        names = [e.name for e in entries if re.fullmatch(r"0|-?[1-9]\d*", e.name) and e.is_dir()]
    return tuple(sorted(map(int, names), key=lambda agent: (agent > 0, abs(agent))))


def stems(agent: Path) -> dict[int, str]:
    """The stem of the file names of each frame that an agent has, by the frame's number."""
    found = [m[1] for m in (re.fullmatch(r"(\d+)\.yaml", name) for name in os.listdir(agent)) if m]
    return {int(stem): stem for stem in sorted(found)}


def frame_numbers(scenario: Path, agents: tuple[int, ...]) -> tuple[int, ...]:
    """Numbers of the frames that all ``agents`` have; a frame's YAML files are written last."""
    each = [set(stems(scenario / str(agent))) for agent in agents]
    return tuple(sorted(set.intersection(*each))) if each else ()


def frame_of(
    scenario: Path, number: int, agents: tuple[int, ...], protocol: Mapping[str, Any]
) -> Frame:
    """A frame of a scenario; pictures and points are read when they are first used. The first agent
    that lists a road user counts. One whose speed alone is given moves the way it faces. Cameras
    without a picture, or that only fill up an agent's, are left out. Raises InspeError where there
    is no such frame, or a file is broken."""
    if not agents:
        raise InspeError(f"{scenario}: not a scenario: it has no folder of an agent, as -1")
    files = [_frame_file(scenario / str(agent), number) for agent in agents]
    known: dict[bytes, dict[str, Any]] = {}
    contents = [_content(path, known) for path in files]
    boxes, names = _boxes(contents, files), section_of(protocol, "stations")
    tick = section_of(protocol, "world").get("fixed_delta_seconds")
    told = SUFFIXES.get(section_of(protocol, "recording").get("pictures", "png"))
    suffixes = sorted(SUFFIXES.values(), key=lambda suffix: suffix != told)
    return Frame(
        number=number,
        time=number * (float(tick) if isinstance(tick, int | float) and tick > 0 else TICK),
        boxes=boxes,
        stations=tuple(
            _station(agent, str(names.get(agent, agent)), content, path, boxes, suffixes)
            for agent, content, path in zip(agents, contents, files, strict=True)
        ),
    )


def _frame_file(agent: Path, number: int) -> Path:
    path = agent / f"{number:06d}.yaml"
    if path.is_file():
        return path
    known = stems(agent)
    if number in known:  # a set with names of another length
        return agent / f"{known[number]}.yaml"
    span = f"there are {len(known)}, {min(known)} to {max(known)}" if known else "there are none"
    raise InspeError(f"{path}: no such frame; {span}")


def _content(path: Path, known: dict[bytes, dict[str, Any]]) -> dict[str, Any]:
    """A frame's YAML file. The text of road users, the same for all agents, is parsed once."""
    check_input(path, YAML)
    text = path.read_bytes()
    head, mark, tail = text.partition(_BOXES)
    if mark:
        try:
            if tail not in known:
                known[tail] = as_mapping(parse_yaml(mark + tail, str(path)), path)
            return {**as_mapping(parse_yaml(head, str(path)), path), **known[tail]}
        except InspeError:
            pass  # if the file is broken, parsing it as a whole says where
    return as_mapping(parse_yaml(text, str(path)), path)


def _numbers(
    content: Mapping[str, Any], key: str, shape: tuple[int, ...], where: object
) -> Float[np.ndarray, "..."]:
    """The numbers under a key. Raises InspeError if they are missing or not of this shape."""
    if key not in content:
        raise InspeError(f"{where}: {key}: missing key")
    try:
        array = np.array(content[key])
    except ValueError:  # rows of unequal length
        array = np.array(None)
    if array.shape != shape or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        many = " x ".join(map(str, shape)) or "1"
        raise InspeError(f"{where}: {key}: must be {many} numbers, got {brief(content[key])}")
    return array.astype(float)


def _boxes(contents: list[dict[str, Any]], files: list[Path]) -> Boxes:
    """The boxes that all agents list, each track once; ``vehicles`` say no kind, and come last."""
    found: dict[int, RoadUserBox] = {}
    places = [*((section, kind) for kind, section in SECTIONS.items()), ("vehicles", "car")]
    for content, path in zip(contents, files, strict=True):
        for section, kind in places:
            entries = as_mapping(content.get(section) or {}, f"{path}: {section}")
            for track, entry in entries.items():
                where = f"{path}: {section}.{track}"
                if not isinstance(track, int) or isinstance(track, bool):
                    raise InspeError(f"{where}: the id must be a whole number")
                if track not in found:
                    found[track] = _box(track, kind, as_mapping(entry, where), where)
    return tuple(found[track] for track in sorted(found))


def _box(track: int, kind: str, entry: Mapping[str, Any], where: str) -> RoadUserBox:
    if "obj_type" in entry:
        word = str(entry["obj_type"])
        if word.lower() not in OBJ_TYPES:
            raise InspeError(f"{where}: obj_type '{word}': one of {', '.join(OBJ_TYPES)}")
        kind = OBJ_TYPES[word.lower()]
    location, angle = (_numbers(entry, key, (3,), where) for key in ("location", "angle"))
    middle = _numbers(entry, "center", (3,), where) if "center" in entry else np.zeros(3)
    extent = _numbers(entry, "extent", (3,), where)
    speed = _numbers(entry, "speed", (), where) if "speed" in entry else np.zeros(())
    pose = from_carla([*(location + middle), *angle])
    ahead = np.array([np.cos(pose[5]), np.sin(pose[5]), 0.0])
    velocity = ahead * (speed / KMH)
    told = np.array(entry.get("velocity"), dtype=object)
    # Others may mean something else: ours is a vector in m/s, as long as the speed.
    if told.shape == (3,) and all(isinstance(x, int | float) for x in told):
        vector = told.astype(float)
        if abs(np.linalg.norm(vector) * KMH - speed) < 1e-5 * (1 + speed):
            velocity = flip(vector)
    name = str(entry.get("name", entry.get("bp_id", "")))
    return RoadUserBox(track, kind, name, pose[:3], float(pose[5]), 2 * extent, velocity)


def _station(
    agent: int,
    name: str,
    content: dict[str, Any],
    path: Path,
    boxes: Boxes,
    suffixes: Sequence[str],
) -> Station:
    lidars = _numbered(content, "lidar_pose")
    if not lidars and "lidar_pose" in content:
        lidars = {0: "lidar_pose"}
    ego = next((key for key in ("true_ego_pos", *lidars.values()) if key in content), "lidar_pose")
    return Station(
        number=-agent,
        name=name,
        pose=from_carla(_numbers(content, ego, (6,), path)),
        images=tuple(_images(content, path, _observed(content, agent, "images", boxes), suffixes)),
        scans=tuple(_scans(content, lidars, path, _observed(content, agent, "scans", boxes))),
    )


Counts = Mapping[str, Float[np.ndarray, "K B"]]
"""Of K sensors and B road users, by the field of a scan or an image."""


def _observed(content: Mapping[str, Any], agent: int, records: str, boxes: Boxes) -> Counts:
    """What an agent's scans or images recorded of each road user; other shapes are left out."""
    observed = content.get("observed")
    found = dict[str, np.ndarray]()
    for key, of, field, decimals in OBSERVED:
        if of != records or not boxes or not isinstance(observed, dict):
            continue
        try:
            rows = np.array([observed[box.track][key][agent] for box in boxes]).T
        except (KeyError, TypeError, ValueError):  # not there, not a mapping, uneven
            continue
        if rows.ndim == 2 and rows.dtype.kind in "fi" and np.isfinite(rows).all():
            found[field] = rows if decimals else rows.astype(int)
    return found


def _of(counts: Counts, i: int) -> dict[str, Any]:
    return {field: rows[i] for field, rows in counts.items() if i < len(rows)}


def _numbered(content: Mapping[str, Any], word: str) -> dict[int, str]:
    found = (re.fullmatch(rf"{word}(\d+)", key) for key in content if isinstance(key, str))
    return dict(sorted((int(m[1]), m[0]) for m in found if m))


def _scans(
    content: dict[str, Any], lidars: dict[int, str], path: Path, counts: Counts
) -> Iterator[Scan]:
    """The scans of an agent, their points not yet read; none if the file says "no LiDAR"."""
    for i, key in lidars.items():
        points = path.with_name(f"{path.stem}_lidar{i}.pcd")
        if i == 0 and path.with_suffix(".pcd").is_file():
            points = path.with_suffix(".pcd")
        pose = from_carla(_numbers(content, key, (6,), path))
        if not points.is_file() or NO_LIDAR not in read_notes(points):
            yield Scan.deferred({"points": partial(_points, points)}, pose=pose, **_of(counts, i))


def _points(path: Path) -> Float[np.ndarray, "N 4"]:
    points: np.ndarray = flip(read_pcd(path))
    return points


def _images(
    content: dict[str, Any], path: Path, counts: Counts, suffixes: Sequence[str]
) -> Iterator[Image]:
    """The images of an agent, their pixels not yet read; cameras without a picture are left out."""
    for i, key in _numbered(content, "camera").items():
        where = f"{path}: {key}"
        camera = as_mapping(content[key], where)
        pose = from_carla(_numbers(camera, "cords", (6,), where))
        intrinsic = _numbers(camera, "intrinsic", (3, 3), where)
        files = {layer: path.with_name(f"{path.stem}_{layer}{i}.png") for layer in LAYERS}
        named = [path.with_name(f"{path.stem}_camera{i}{suffix}") for suffix in suffixes]
        files["rgb"] = next((file for file in named if file.is_file()), named[0])
        if files["rgb"].is_file() and not camera.get("blank"):
            there = {layer: file for layer, file in files.items() if file.is_file()}
            missing = dict.fromkeys(files.keys() - there.keys())
            later = {layer: partial(read_picture, file, layer) for layer, file in there.items()}
            yield Image.deferred(later, pose=pose, intrinsic=intrinsic, **missing, **_of(counts, i))
