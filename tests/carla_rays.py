"""The sensors of the wire-level CARLA server: rays that hit the ground z = 0 and boxes.

CARLA's frame: x forward, y right, z up, left-handed; poses are (x, y, z, pitch, yaw, roll) in
metres and degrees, rotated roll first and yaw last. Everything is exact and without noise, so that
a test can calculate the expected values. Left out on purpose: drop-off and noise of the LiDAR, lens
effects, weather.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

SKY, GROUND = 11, 1
"""CARLA's semantic tags of sky and roads, which are not boxes."""

FAR = 1000.0
"""The largest depth of CARLA's depth camera [m]."""


@dataclass(frozen=True)
class Box:
    """A solid: the pose of its centre in the world as a matrix, half sizes [m], and its look."""

    matrix: np.ndarray  # (4, 4)
    extent: tuple[float, float, float]
    tag: int
    colour: tuple[int, int, int]


def matrix(pose: Sequence[float]) -> np.ndarray:
    """The (4, 4) matrix from an actor's frame to the world, as `carla.Transform.get_matrix`."""
    cp, cy, cr = np.cos(np.radians(pose[3:]))
    sp, sy, sr = np.sin(np.radians(pose[3:]))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, pose[0]],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, pose[1]],
            [sp, -cp * sr, cp * cr, pose[2]],
            [0, 0, 0, 1],
        ]
    )


def colour_of(actor: int) -> tuple[int, int, int]:
    """An actor's colour in RGB images: red differs for 191 actors in a row, and blue is lower than
    that of anything else."""
    return 64 + 37 * actor % 191, 64 + 53 * actor % 191, actor % 40


def cast(
    origin: np.ndarray, directions: np.ndarray, boxes: Sequence[Box]
) -> tuple[np.ndarray, np.ndarray]:
    """Which box rays in the world hit first (-1: the ground, -2: nothing), and the multiple of
    `directions` (R, 3); boxes around the origin are transparent."""
    nearest = np.full(len(directions), np.inf)
    which = np.full(len(directions), -2)
    with np.errstate(divide="ignore", invalid="ignore"):
        down = -origin[2] / directions[:, 2]
        hit = down > 0  # false for NaN
        nearest[hit], which[hit] = down[hit], -1
        for k, box in enumerate(boxes):
            turn = box.matrix[:3, :3]
            start, along = (origin - box.matrix[:3, 3]) @ turn, directions @ turn
            sides = np.stack(
                [(-e - start) / along for e in (np.array(box.extent), -np.array(box.extent))]
            )
            enter, leave = np.nanmax(sides.min(0), -1), np.nanmin(sides.max(0), -1)
            hit = (enter > 0) & (enter <= leave) & (enter < nearest)
            nearest[hit], which[hit] = enter[hit], k
    return nearest, which


def overlap(a: Box, b: Box) -> bool:
    """Whether two upright boxes may overlap: in height, and the circles around them in plan."""
    apart = np.abs(a.matrix[:3, 3] - b.matrix[:3, 3])
    reach = sum(np.hypot(*box.extent[:2]) for box in (a, b))
    return bool(apart[2] < a.extent[2] + b.extent[2] and np.hypot(*apart[:2]) < reach)


def scan(
    spec: Mapping[str, str], where: np.ndarray, boxes: Sequence[Box], seconds: float
) -> tuple[list[int], np.ndarray]:
    """Points per channel, from the upper one down, and all points (P, 4), float32, in the sensor's
    frame with intensity exp(-a d): `points_per_second` × `seconds` rays."""
    channels, span = int(spec["channels"]), float(spec["horizontal_fov"])
    upper, lower = float(spec["upper_fov"]), float(spec["lower_fov"])
    rays = int(np.floor(float(spec["points_per_second"]) * seconds / channels + 0.5))
    pitch = np.radians(np.linspace(upper, lower, channels))[:, None]  # (C, 1)
    swept = float(spec["rotation_frequency"]) * span * seconds
    yaw = np.radians(swept * np.arange(rays) / max(rays, 1) % span - span / 2)  # (H,)
    up = np.broadcast_to(np.sin(pitch), (channels, rays))
    own = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), up], -1)
    own = own.reshape(-1, 3)
    reach, _ = cast(where[:3, 3], own @ where[:3, :3].T, boxes)
    hit = reach <= float(spec["range"])
    intensity = np.exp(-float(spec["atmosphere_attenuation_rate"]) * reach[hit])
    points = np.column_stack([own[hit] * reach[hit, None], intensity]).astype("<f4")
    return hit.reshape(channels, rays).sum(1).tolist(), points


def sight(
    spec: Mapping[str, str], where: np.ndarray, boxes: Sequence[Box]
) -> tuple[np.ndarray, np.ndarray]:
    """The depth along the axis of a camera's pixels, row by row, and the index of the box."""
    width, height = int(spec["image_size_x"]), int(spec["image_size_y"])
    focal = width / (2 * np.tan(np.radians(float(spec["fov"])) / 2))
    right, below = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal
    )
    own = np.stack([np.ones_like(right), right, -below], -1).reshape(-1, 3)
    return cast(where[:3, 3], own @ where[:3, :3].T, boxes)


def picture(
    kind: str, spec: Mapping[str, str], where: np.ndarray, boxes: Sequence[Box], frame: int
) -> np.ndarray:
    """(H, W, 4) BGRA bytes of a picture; the blue of the ground encodes the frame."""
    depth, which = sight(spec, where, boxes)
    if kind == "depth":
        code = np.round(np.minimum(depth / FAR, 1) * (256**3 - 1)).astype(int)
        rgb = np.stack([code & 255, code >> 8 & 255, code >> 16], -1)
    else:
        # One row per box, then sky and ground, which -2 and -1 select.
        if kind == "rgb":
            rows = [*(box.colour for box in boxes), (150, 190, 230), (96, 96, 64 + frame % 128)]
        else:
            rows = [(tag, 0, 0) for tag in (*(box.tag for box in boxes), SKY, GROUND)]
        rgb = np.array(rows)[which]
    bgra = np.full((len(depth), 4), 255, np.uint8)
    bgra[:, :3] = rgb[:, ::-1]
    return bgra.reshape(int(spec["image_size_y"]), int(spec["image_size_x"]), 4)
