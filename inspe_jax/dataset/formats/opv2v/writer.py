"""Writes frames as OPV2V files, which also have the names and keys of the Infra-Set variant.

SCENARIO/AGENT/ holds ``000068.yaml``, ``.pcd``, ``_lidar0.pcd`` …, ``_camera0.png`` …, and, if they
were recorded, ``_depth0.png``, ``_instance0.png`` and ``_semantic0.png``. The YAML file has the
keys of both. Two things are in no file: the time of a frame, which is its number times the time
step in ``data_protocol.yaml``, and the direction in which a road user moves.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.core.carla_frame import between, flip, to_carla
from inspe_jax.core.files import whole_file, write_text
from inspe_jax.dataset.formats.pcd import write_pcd
from inspe_jax.dataset.formats.png import write_depth, write_instance, write_rgb, write_semantic
from inspe_jax.dataset.formats.protocol_file import dump_yaml, make_folder
from inspe_jax.simulation.frame import Frame, Image, RoadUserBox, Scan, Station, check_frame

SECTIONS: dict[str, str] = {
    "car": "cars",
    "cyclist": "cyclists",
    "pedestrian": "pedestrians",
    "truck": "trucks",
}
"""The Infra-Set variant's section for each kind, in addition to ``vehicles`` with all kinds."""

NO_LIDAR = "no LiDAR"
"""The comment in the empty PCD file of a station without one."""

KMH = 3.6
"""1 m/s in km/h."""

DECIMALS = 7
"""Decimals of lengths [m], angles [°] and speeds [km/h]: values are right to 1e-6, and so is the
sum of ``location`` and ``center``."""

MATRIX_DECIMALS = 12
"""Decimals of the entries of matrices, which are multiplied by distances of up to kilometres."""


def write_frame(scenario: str | os.PathLike[str], frame: Frame) -> None:
    """Write a frame into the folder of each station, over an earlier frame of this number.

    Every file appears when it is complete, and the YAML files come last: without them a frame does
    not count as complete. Every frame of a scenario should have the same stations. Raises
    InspeError, before anything is written, if the frame is not valid.
    """
    check_frame(frame)
    stem = f"{frame.number:06d}"
    boxes = dump_yaml(_sections(frame.boxes))
    agents = [make_folder(Path(scenario) / str(-station.number)) for station in frame.stations]
    for agent in agents:
        _clear(agent, stem)
    for station, agent in zip(frame.stations, agents, strict=True):
        _write_scans(agent, stem, station.scans)
        for i, image in enumerate(station.images):
            _write_image(agent, stem, i, image)
    for station, agent in zip(frame.stations, agents, strict=True):
        write_text(agent / f"{stem}.yaml", dump_yaml(_sensors(station)) + boxes)


def _clear(agent: Path, stem: str) -> None:
    """Delete the files of a frame: first the YAML file, and last the file that is written first.

    So a folder with many files is listed only if a frame of this number was begun before.
    """
    last, first = agent / f"{stem}.yaml", agent / f"{stem}_lidar0.pcd"
    if not (last.exists() or first.exists()):
        return
    last.unlink(missing_ok=True)
    for name in os.listdir(agent):
        if name.startswith((f"{stem}.", f"{stem}_", f".{stem}")) and name != first.name:
            (agent / name).unlink(missing_ok=True)
    first.unlink(missing_ok=True)


def _write_scans(agent: Path, stem: str, scans: Sequence[Scan]) -> None:
    """Write the scans. The first one gets two names: OPV2V's and the Infra-Set variant's."""
    first = agent / f"{stem}_lidar0.pcd"
    if not scans:
        write_pcd(first, np.zeros((0, 4)), note=NO_LIDAR)
    for i, scan in enumerate(scans):
        write_pcd(agent / f"{stem}_lidar{i}.pcd", flip(scan.points))
    second = agent / f"{stem}.pcd"
    try:
        os.link(first, second)  # most of a set is points: two names, but stored only once
    except OSError:
        with whole_file(second) as f:
            f.write(first.read_bytes())


def _write_image(agent: Path, stem: str, i: int, image: Image) -> None:
    write_rgb(agent / f"{stem}_camera{i}.png", image.rgb)
    if image.depth is not None:
        write_depth(agent / f"{stem}_depth{i}.png", image.depth)
    if image.instance is not None:
        write_instance(agent / f"{stem}_instance{i}.png", image.instance)
    if image.semantic is not None:
        write_semantic(agent / f"{stem}_semantic{i}.png", image.semantic)


def _sensors(station: Station) -> dict[str, Any]:
    """The part of the YAML file about a station and its sensors."""
    unit = _cords(station.pose)
    lidars = [_cords(scan.pose) for scan in station.scans] or [unit]
    return {
        "RSU": True,
        "ego_speed": 0.0,
        "true_ego_pos": unit,
        "predicted_ego_pos": unit,
        "lidar_pose": lidars[0],
        **{f"lidar_pose{i}": cords for i, cords in enumerate(lidars)},
        **{f"camera{i}": _camera(image, lidars[0]) for i, image in enumerate(station.images)},
    }


def _camera(image: Image, lidar: list[float]) -> dict[str, Any]:
    """A camera's entry. ``extrinsic`` is inv(camera to world) · (LiDAR to world), from the rounded
    poses."""
    cords = _cords(image.pose)
    return {
        "cords": cords,
        "extrinsic": _rounded(between(lidar, cords), MATRIX_DECIMALS),
        "intrinsic": _rounded(image.intrinsic, MATRIX_DECIMALS),
    }


def _sections(boxes: Sequence[RoadUserBox]) -> dict[str, dict[int, Any]]:
    """The part of the YAML file about road users: all in ``vehicles``, and again by kind."""
    ordered = sorted(boxes, key=lambda box: box.track)
    entries = {int(box.track): _entry(box) for box in ordered}
    sections: dict[str, dict[int, Any]] = {"vehicles": entries}
    for kind, section in SECTIONS.items():
        tracks = [int(box.track) for box in ordered if box.kind == kind]
        sections[section] = {track: entries[track] for track in tracks}
    return sections


def _entry(box: RoadUserBox) -> dict[str, Any]:
    """The entry of a road user. ``location`` is the middle of the bottom of the box, and ``center``
    points straight up from there, because readers add it without rotating it."""
    half = np.asarray(box.size, float) / 2
    x, y, z = np.asarray(box.center, float)
    cords = to_carla([x, y, z - half[2], 0.0, 0.0, box.yaw])
    speed = np.linalg.norm(np.asarray(box.velocity, float))
    return {
        "angle": _rounded(cords[3:]),
        "center": _rounded([0.0, 0.0, half[2]]),
        "extent": _rounded(half),
        "location": _rounded(cords[:3]),
        "name": box.name,
        "obj_type": box.kind.capitalize(),
        "speed": _rounded(speed * KMH),
    }


def _cords(pose: Any) -> list[float]:
    return _rounded(to_carla(pose))


def _rounded(values: Any, decimals: int = DECIMALS) -> Any:
    return (np.round(np.asarray(values, float), decimals) + 0.0).tolist()  # + 0.0: no −0.0
