"""Writes frames as OPV2V files, which also have the keys of the Infra-Set variant.

SCENARIO/AGENT/ holds ``000068.yaml``, ``.pcd``, ``_lidar1.pcd`` …, ``_camera0.png`` …, layers as
``_depth0.png``, and ``_bev_visibility.png``. ``observed`` is what sensors recorded of each road
user.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.core.carla_frame import between, flip, to_carla
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import whole_file, write_text
from inspe_jax.dataset.formats import other_readers
from inspe_jax.dataset.formats.other_readers import DEFAULT_OPTIONS, FileOptions
from inspe_jax.dataset.formats.pcd import write_pcd
from inspe_jax.dataset.formats.pictures import SUFFIXES, write_picture
from inspe_jax.dataset.formats.protocol_file import dump_yaml, make_folder
from inspe_jax.simulation.frame import Boxes, Frame, Image, RoadUserBox, Scan, Station, check_frame
from inspe_jax.simulation.recorder import LAYERS

SECTIONS = {kind: f"{kind}s" for kind in ("car", "cyclist", "pedestrian", "truck")}
"""The Infra-Set variant's section for each kind, in addition to ``vehicles`` with all kinds."""
NO_LIDAR = "no LiDAR"  # the comment in the empty PCD file of a station without one
KMH = 3.6  # 1 m/s in km/h
DECIMALS = 7
"""Decimals of lengths [m], angles [°] and speeds [km/h]: values and sums are right to 1e-6."""
OBSERVED = (
    ("lidar_points", "scans", "returns", 0),
    ("camera_pixels", "images", "pixels", 0),
    ("visible_share", "images", "share", 3),
)
"""Keys of ``observed``: of which records of a station they are, the field, and the decimals."""
MATRIX_DECIMALS = 12
"""Decimals of the entries of matrices, which are multiplied by distances of up to kilometres."""


def write_frame(
    scenario: str | os.PathLike[str], frame: Frame, options: FileOptions = DEFAULT_OPTIONS
) -> tuple[Path, ...]:
    """Write a frame into the folder of each station, over an earlier frame of this number; gives
    the files. YAML files come last: without them a frame is not complete. Raises InspeError, before
    anything is written, if the frame is not valid, or has scans of a radar."""
    check_frame(frame)
    for station in frame.stations:
        if any(scan.speeds is not None for scan in station.scans):
            raise InspeError(
                f"frame {frame.number}: station {station.name} has scans of a radar, and OPV2V has "
                "no place for their speeds; generate the set of a layout without radars, and take "
                "their points from inspe_jax.simulation.embedded.recorder.EmbeddedRecorder"
            )
    stem = f"{frame.number:06d}"
    stations = other_readers.with_cameras(frame.stations, options.cameras_per_agent)
    boxes = dump_yaml(_sections(frame.boxes, stations))
    agents = [make_folder(Path(scenario) / str(-station.number)) for station in stations]
    files = list[Path]()
    for agent in agents:
        _clear(agent, stem)
    for station, agent in zip(stations, agents, strict=True):
        files += _write_scans(agent, stem, station.scans, options)
        for i, image in enumerate(station.images):
            files += _write_image(agent, stem, i, image, options)
        if options.visibility_maps:
            files.append(agent / f"{stem}_bev_visibility.png")
            write_picture(files[-1], "semantic", other_readers.visibility_map(station, frame.boxes))
    for station, agent in zip(stations, agents, strict=True):
        files.append(agent / f"{stem}.yaml")
        write_text(files[-1], dump_yaml(_sensors(station)) + boxes)
    return tuple(files)


def _clear(agent: Path, stem: str) -> None:
    """Delete the files of a frame: first the YAML file, and last the file that is written first."""
    last, first = agent / f"{stem}.yaml", agent / f"{stem}.pcd"
    if not (last.exists() or first.exists()):
        return
    last.unlink(missing_ok=True)
    for name in os.listdir(agent):
        if name.startswith((f"{stem}.", f"{stem}_", f".{stem}")) and name != first.name:
            (agent / name).unlink(missing_ok=True)
    first.unlink(missing_ok=True)


def _write_scans(agent: Path, stem: str, scans: Sequence[Scan], options: FileOptions) -> list[Path]:
    """Write the scans. Infra-Set's name is a copy: where sets are copied, links become files."""
    first = agent / f"{stem}.pcd"
    files = [first, *(agent / f"{stem}_lidar{i}.pcd" for i in range(1, len(scans)))]
    if not scans:
        write_pcd(first, np.zeros((0, 4)), note=NO_LIDAR)
    for file, scan in zip(files, scans, strict=False):
        write_pcd(file, flip(scan.points))
    if options.infra_set_names:
        files.append(agent / f"{stem}_lidar0.pcd")
        with whole_file(files[-1]) as f:
            f.write(first.read_bytes())
    return files


def _write_image(agent: Path, stem: str, i: int, image: Image, options: FileOptions) -> list[Path]:
    files = [agent / f"{stem}_camera{i}{SUFFIXES[options.pictures]}"]
    write_picture(files[0], "rgb", image.rgb)
    for name in LAYERS:
        layer = getattr(image, name)
        if layer is not None:
            files.append(agent / f"{stem}_{name}{i}.png")
            write_picture(files[-1], name, layer)
    return files


def _sensors(station: Station) -> dict[str, Any]:
    unit = _rounded(to_carla(station.pose))
    lidars = [_rounded(to_carla(scan.pose)) for scan in station.scans] or [unit]
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
    """``extrinsic`` is inv(camera to world) · (LiDAR to world), from the rounded poses."""
    cords = _rounded(to_carla(image.pose))
    return {
        "cords": cords,
        "extrinsic": _rounded(between(lidar, cords), MATRIX_DECIMALS),
        "intrinsic": _rounded(image.intrinsic, MATRIX_DECIMALS),
        **({"blank": True} if other_readers.is_blank(image) else {}),
    }


def _sections(boxes: Boxes, stations: Sequence[Station]) -> dict[str, dict[int, Any]]:
    order = sorted(range(len(boxes)), key=lambda k: boxes[k].track)
    ordered = [boxes[k] for k in order]
    entries = {int(box.track): _entry(box) for box in ordered}
    sections: dict[str, dict[int, Any]] = {"vehicles": entries}
    for kind, section in SECTIONS.items():
        tracks = [int(box.track) for box in ordered if box.kind == kind]
        sections[section] = {track: entries[track] for track in tracks}
    observed = {int(boxes[k].track): _observed(k, stations) for k in order}
    return sections | ({"observed": observed} if any(observed.values()) else {})


def _observed(k: int, stations: Sequence[Station]) -> dict[str, Any]:
    """What each sensor recorded of road user ``k``: returns, pixels, and the visible share."""
    found: dict[str, Any] = {}
    for key, records, field, decimals in OBSERVED:
        each = {
            -station.number: [getattr(record, field) for record in getattr(station, records)]
            for station in stations
        }
        known = {
            agent: [_rounded(counts[k], decimals) for counts in own]
            for agent, own in each.items()
            if own and all(counts is not None for counts in own)
        }
        if known:
            found[key] = known
    if "lidar_points" in found:
        found = {"points": sum(map(sum, found["lidar_points"].values())), **found}
    return found


def _entry(box: RoadUserBox) -> dict[str, Any]:
    """A road user. ``center`` points straight up from ``location``: readers do not rotate it."""
    half = np.asarray(box.size, float) / 2
    x, y, z = np.asarray(box.center, float)
    cords = to_carla([x, y, z - half[2], 0.0, 0.0, box.yaw])
    velocity = _rounded(flip(np.asarray(box.velocity, float)))
    return {
        "angle": _rounded(cords[3:]),
        "center": _rounded([0.0, 0.0, half[2]]),
        "extent": _rounded(half),
        "location": _rounded(cords[:3]),
        "name": box.name,
        "obj_type": box.kind.capitalize(),
        "speed": _rounded(np.linalg.norm(velocity) * KMH),
        "velocity": velocity,
    }


def _rounded(values: Any, decimals: int = DECIMALS) -> Any:
    return (np.round(np.asarray(values, float), decimals) + 0.0).tolist()  # + 0.0: no −0.0
