"""A small data set for tests of the loader, written by hand: no recording is needed."""

from pathlib import Path

import numpy as np
from frames import WORLD

from inspe_jax.core.geometry import pixels, rotation
from inspe_jax.dataset import Frame, Image, RoadUserBox, Scan, Station, write_frame, write_protocol
from inspe_jax.simulation.frame import KINDS
from inspe_jax.simulation.projection import corners

MIDDLE = np.array([100.0, -50.0, 2.0])
"""Of the intersection, far from the world's origin."""

POSES = (
    np.array([88.0, -40.0, 8.0, 0.05, -0.3, -0.6]),
    np.array([115.0, -58.0, 7.0, -0.04, -0.25, 2.6]),
)
"""Of two units, which look at the middle, 6 m and 5 m above the ground, and are rolled."""

SIZES = ((4.2, 1.8, 1.5), (9.0, 2.5, 3.5), (1.8, 0.6, 1.7), (0.6, 0.6, 1.8))
WIDTH, HEIGHT = 64, 48
MARK = np.array([255, 0, 255], np.uint8)
"""The colour of the pixels around a corner of the first box."""


def boxes(kinds=KINDS, seed=0) -> tuple[RoadUserBox, ...]:
    """One road user of each kind, 3 to 15 m from the middle, which moves the way it faces."""
    rng = np.random.default_rng(seed)
    found = []
    for k, kind in enumerate(kinds):
        bearing = 2 * np.pi * (k + rng.uniform(0, 0.5)) / len(kinds)
        yaw, size = rng.uniform(-np.pi, np.pi), np.array(SIZES[KINDS.index(kind)])
        away = rng.uniform(5, 12) * np.array([np.cos(bearing), np.sin(bearing)])
        velocity = rng.uniform(1, 9) * np.array([np.cos(yaw), np.sin(yaw), 0.0])
        center = MIDDLE + [*away, size[2] / 2]
        found.append(RoadUserBox(k, kind, kind, center, yaw, size, velocity))
    return tuple(found)


def scan_of(pose, users, count: int, seed: int) -> Scan:
    """``count`` points on the ground about the middle, and 7 in each road user, 2 cm or more below
    its surface; a LiDAR's own points are in its frame."""
    rng = np.random.default_rng(seed)
    ground = MIDDLE + np.column_stack([rng.uniform(-40, 40, (count, 2)), np.zeros(count)])
    parts = [ground]
    for box in users:
        inner = rng.uniform(-1, 1, (7, 3)) * (np.asarray(box.size) / 2 - 0.02)
        parts.append(box.center + inner @ rotation(np.array([0, 0, box.yaw]), np).T)
    world = np.concatenate(parts)
    body = (world - pose[:3]) @ rotation(np.asarray(pose)[3:], np)
    intensity = rng.integers(0, 256, len(body)) / 255
    return Scan(np.asarray(pose), np.column_stack([body, intensity]).astype(np.float32))


def image_of(pose, users, seed: int) -> Image:
    """A dim picture of noise with :data:`MARK` around the pixel of the first box's first corner."""
    rng = np.random.default_rng(seed)
    intrinsic = np.array([[30.0, 0, 30.0], [0, 31.0, 22.0], [0, 0, 1]])
    rgb = rng.integers(0, 128, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    camera = Image(pose=np.asarray(pose), intrinsic=intrinsic, rgb=rgb)
    if users:
        column, row, depth = pixels(camera, corners(users[:1])[0, 0])
        if depth > 0 and 2 <= column < WIDTH - 2 and 2 <= row < HEIGHT - 2:
            rgb[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2] = MARK
    return camera


def frame_of(number: int, kinds=KINDS, cameras=True, lidars=True, points=60) -> Frame:
    """A frame of two units with a camera and a LiDAR each, or one of both."""
    users, stations = boxes(kinds, number), []
    for u, pose in enumerate(POSES):
        scans = [scan_of(pose, users, points + 10 * u, 10 * number + u)] if lidars else []
        images = [image_of(pose + [0, 0, 0.5, 0, 0, 0.1], users, number)] if cameras else []
        stations.append(Station(u + 1, f"mast {u}", pose, tuple(images), tuple(scans)))
    return Frame(number, 0.05 * number, users, tuple(stations))


def write_scenario(folder: Path, frames, **protocol) -> None:
    for frame in frames:
        write_frame(folder, frame)
    told = {"world": WORLD, "middle": MIDDLE.tolist(), **protocol}
    write_protocol(folder, told, frames[0].stations)


def write_set(root: Path) -> Path:
    """Two scenarios of 3 and 4 frames to train, of which one has no cyclist and no pedestrian, and
    one of 3 to test."""
    write_scenario(root / "train" / "a", [frame_of(n) for n in (0, 1, 2)])
    few = [frame_of(n, KINDS[:2], points=90) for n in (3, 4, 5, 6)]
    write_scenario(root / "train" / "b", few)
    write_scenario(root / "test" / "c", [frame_of(n) for n in (7, 8, 9)])
    return root
