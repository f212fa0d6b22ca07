"""How files are written, and what other people's readers need: as many cameras for each agent, the
range of points and boxes to keep, and maps of what cameras see, by whose pixels HEAL and CoAlign
keep boxes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image as Pillow
from PIL import ImageDraw

from inspe_jax.core.errors import check_known, error_at
from inspe_jax.core.geometry import rotation
from inspe_jax.core.records import check_values
from inspe_jax.dataset.formats.pictures import SUFFIXES
from inspe_jax.scene.voxels import VoxelGrid
from inspe_jax.simulation.frame import Image, RoadUserBox, Station
from inspe_jax.simulation.projection import corners

MOST_CAMERAS = 16


@dataclass(frozen=True)
class FileOptions:
    """How the files of a frame are written. JPEG ``pictures`` are a quarter of the size of PNG and
    are read four times as fast, but few other readers look for them. ``cameras_per_agent`` makes
    agents with as many each; 0 leaves them as they are. ``infra_set_names`` gives the first point
    cloud a second name, ``_lidar0.pcd``, and ``visibility_maps`` adds ``_bev_visibility.png``: the
    road users that the cameras of an agent see."""

    pictures: str = "png"
    cameras_per_agent: int = 0
    infra_set_names: bool = False
    visibility_maps: bool = False

    def check(self, where: str) -> None:
        """Raise InspeError where a value is out of range."""
        check_known(self.pictures, SUFFIXES, f"{where}: pictures:")
        with error_at(f"{where}: cameras_per_agent (0 for as many as there are)"):
            check_values(self.cameras_per_agent, "number", 0, MOST_CAMERAS)


DEFAULT_OPTIONS = FileOptions()

UP = np.array([0.0, np.pi / 2, 0.0])  # roll, pitch and yaw of a camera that looks straight up [rad]

HIGHEST = 5.0
"""No road user is higher [m]: vehicles are limited to 4 m in most of Europe, 4.9 m in Britain."""
BEYOND = 9.5
"""How far road users reach out of the region [m]: half the diagonal of a road train (18.75 m)."""
BELOW = 0.5
"""How far the ground out there may lie below the region's lowest [m]: 5 % over that length."""
STEP = 6.4
"""Limits along x and y are multiples of this [m]: 16 pillars of 0.4 m, to be halved four times."""

PIXELS = 256  # width and height of a map, as in OPV2V and these readers
PIXEL = 0.39  # size of a pixel [m]: they see 50 m ahead, back and aside
MIDDLE = 127  # row and column of the agent


def frame_of(agent: Station) -> Float[np.ndarray, "6"]:
    """The pose by which readers know an agent: its first LiDAR's, or its unit's if it has none."""
    return np.asarray(agent.scans[0].pose if agent.scans else agent.pose, float)


def with_cameras(stations: Sequence[Station], count: int) -> tuple[Station, ...]:
    """Agents with ``count`` cameras each, if not 0: further ones have new numbers and no LiDAR."""
    if not count or not any(station.images for station in stations):
        return tuple(stations)
    first, further = [], []
    number = max(station.number for station in stations)
    like = next(image for station in stations for image in station.images)
    for station in stations:
        images = list(station.images)
        first.append(replace(station, images=_filled(images[:count], count, station, like)))
        for start in range(count, len(images), count):
            number += 1
            own = _filled(images[start : start + count], count, station, like)
            name = f"{station.name} {start // count + 1}"
            further.append(replace(station, number=number, name=name, images=own, scans=()))
    return (*first, *further)


def is_blank(image: Image) -> bool:
    """Whether an image only fills up an agent's cameras."""
    return bool(np.allclose(image.pose[3:], UP, atol=1e-6)) and not np.any(image.rgb)


def _filled(images: list[Image], count: int, station: Station, like: Image) -> tuple[Image, ...]:
    if len(images) == count:
        return tuple(images)
    size = (images or [like])[0]
    layers = {name: getattr(size, name) for name in ("instance", "semantic", "pixels", "share")}
    black = Image(
        pose=np.array([*station.pose[:3], *UP]),
        intrinsic=size.intrinsic,
        rgb=np.zeros_like(size.rgb),
        depth=None if size.depth is None else np.full_like(size.depth, np.inf),
        **{k: None if layer is None else np.zeros_like(layer) for k, layer in layers.items()},
    )
    return (*images, *[black] * (count - len(images)))


def lidar_range(agents: Sequence[Station], voxels: VoxelGrid) -> list[float]:
    """The range that holds every road user of the region, seen from any agent: lower and upper x,
    y, z [m] in an agent's frame. Readers drop a box unless all of its corners lie inside."""
    ground = np.column_stack([voxels.columns, voxels.ground])
    around = np.concatenate([ground - [0.0, 0.0, BELOW], ground + [0.0, 0.0, HIGHEST]])
    side, low, high = 0.0, np.inf, -np.inf
    for agent in agents:
        pose = frame_of(agent)
        turn = rotation(pose[3:], np)
        at = (around - pose[:3]) @ turn  # (N, 3)
        tilted = BEYOND * float(np.hypot(*turn[:2, 2]))  # what BEYOND in plan is along z
        side = max(side, float(np.abs(at[:, :2]).max()) + BEYOND)
        low, high = min(low, at[:, 2].min() - tilted), max(high, at[:, 2].max() + tilted)
    side = round(float(np.ceil(side / STEP) * STEP), 1)
    return [-side, -side, float(np.floor(low)), side, side, float(np.ceil(high))]


def visibility_map(agent: Station, boxes: Sequence[RoadUserBox]) -> UInt8[np.ndarray, "256 256"]:
    """The map of an agent, ahead is up: road users that its cameras show, or did not count."""
    pose = frame_of(agent)
    turn = rotation(pose[3:], np)
    picture = Pillow.new("L", (PIXELS, PIXELS))
    draw = ImageDraw.Draw(picture)
    uncounted = any(image.pixels is None for image in agent.images)
    for k, box in enumerate(boxes):
        if uncounted or any(np.asarray(image.pixels)[k] > 0 for image in agent.images):
            sides = corners([box])[0].reshape(2, 4, 3).mean(0)  # half-way up
            at = (np.vstack([sides, box.center]) - pose[:3]) @ turn
            # Column and row; the readers round towards the agent, too.
            at = MIDDLE - np.trunc(at[:, 1::-1] / PIXEL).astype(int)
            draw.polygon([tuple(p) for p in at[:4].tolist()], fill=255)
            draw.point(tuple(at[4].tolist()), fill=255)
    return np.asarray(picture)
