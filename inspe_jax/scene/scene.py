"""Scene = intersection + voxels + traffic: build it, save it, load it."""

import json
import operator
import os
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np
import shapely

from inspe_jax.errors import InspeError, nearest
from inspe_jax.files import check_input, check_output, whole_file
from inspe_jax.scene.intersection import Arm, Intersection, Route
from inspe_jax.scene.procedural import BUILT_INS, built_in
from inspe_jax.scene.regions import Region
from inspe_jax.scene.traffic import DENSITIES, TrafficFrames, waypoint_traffic
from inspe_jax.scene.voxels import VoxelGrid, build_voxels

FORMAT = "inspe_jax scene 1"
SCENE_SUFFIXES = (".npz",)
# What reading a file that is something else can raise; a scene raises none of them.
_NOT_A_SCENE = (
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    OSError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
    shapely.errors.ShapelyError,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Scene:
    """What the sensors look at. Frozen; arrays in world metres and radians; equal only to itself.

    ``settings`` say how it was made (radius, voxel, density, frames, seed).
    """

    voxels: VoxelGrid
    traffic: TrafficFrames
    intersection: Intersection = field(metadata={"static": True})
    settings: tuple[tuple[str, str], ...] = field(metadata={"static": True}, default=())

    @property
    def name(self) -> str:
        """The intersection's name."""
        return self.intersection.name


def build_scene(
    intersection: Intersection,
    *,
    radius: float = 50.0,
    voxel: float = 0.5,
    density: str | int = "medium",
    frames: int = 100,
    mix: str = "mixed",
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Voxelise an intersection and fill it with waypoint traffic.

    ``radius`` and ``voxel`` in metres; ``density`` is ``none``, ``low``,
    ``medium``, ``high`` or a mean number of objects; ``mix`` as in
    :func:`~inspe_jax.scene.traffic.waypoint_traffic`; ``progress`` is called with
    (frames done, frames). Raises InspeError on a value out of range.
    """
    count = density_count(density)
    voxels = build_voxels(intersection, radius=radius, voxel=voxel)
    traffic = waypoint_traffic(
        intersection,
        radius=radius,
        count=count,
        frames=frames,
        mix=mix,
        seed=seed,
        progress=progress,
    )
    settings = dict(
        radius=f"{radius:g}",
        voxel=f"{voxel:g}",
        density=str(density),
        frames=str(frames),
        mix=mix,
        seed=str(seed),
    )
    return Scene(voxels, traffic, intersection, tuple(settings.items()))


def load_scene(source: str | os.PathLike[str]) -> Scene:
    """A built-in intersection by name, at default settings, or a saved ``.npz`` scene.

    Needs no map reader. Raises InspeError where there is no such built-in or
    file, or the file is not a scene.
    """
    if str(source) in BUILT_INS:
        return build_scene(built_in(str(source)))
    path = Path(source)
    if path.suffix == ".xodr":
        raise InspeError(
            f"{path}: a map is not a scene yet; build one: inspe scene {path} --junction ID "
            "--out scene.npz (--list shows the junctions)"
        )
    if path.suffix != ".npz":
        raise InspeError(
            f"no scene '{source}': a built-in ({', '.join(BUILT_INS)}) or a saved .npz file"
            + nearest(str(source), tuple(BUILT_INS))
        )
    check_input(path)
    with path.open("rb") as f:
        try:
            with np.load(f, allow_pickle=False) as data:
                return _unpack({k: data[k] for k in data.files})
        except _NOT_A_SCENE as e:
            raise InspeError(f"{path}: not a scene saved by this package") from e


def save_scene(scene: Scene, path: str | os.PathLike[str]) -> None:
    """Write a scene to a compressed ``.npz``; the file appears whole or not at all."""
    check_output(path, SCENE_SUFFIXES)
    with whole_file(path) as f:
        np.savez_compressed(f, **_pack(scene))  # type: ignore[arg-type]  # names are ours


def density_count(density: str | int) -> int:
    """Mean number of objects that a density means, by name or number.

    Raises InspeError for anything else.
    """
    if isinstance(density, str) and density in DENSITIES:
        return DENSITIES[density]
    try:
        count = int(density) if isinstance(density, str) else operator.index(density)
    except (TypeError, ValueError):
        count = -1
    if not 0 <= count <= 500:
        raise InspeError(
            f"density '{density}': {', '.join(DENSITIES)}, or a mean number of objects up to 500"
        )
    return count


_GRID = ("columns", "ground", "region", "center")
_TRAFFIC = ("center", "yaw", "size", "valid", "kind")


def _pack(scene: Scene) -> dict[str, np.ndarray]:
    """Plain arrays and one JSON text; polygons as WKB."""
    place, grid = scene.intersection, scene.voxels
    record = {
        "format": FORMAT,
        "name": place.name,
        "source": place.source,
        "notes": place.notes,
        "arms": [[*a.mouth, a.bearing, a.width] for a in place.arms],
        "routes": [[r.width, r.user, list(r.through)] for r in place.routes],
        "grid": [grid.size, grid.radius, grid.level_count],
        "settings": scene.settings,
        "regions": [r.key for r in place.regions],
    }
    shapes = [*place.regions.values(), place.mounting]
    arrays = {
        "record": np.array(json.dumps(record)),
        "place_center": np.asarray(place.center),
        "poles": place.poles,
        "ground_points": place.ground_points,
        "route_lengths": np.array([len(r.waypoints) for r in place.routes], int),
        "route_points": np.concatenate([np.zeros((0, 3)), *(r.waypoints for r in place.routes)]),
    }
    arrays |= {f"shape_{i}": np.frombuffer(shapely.to_wkb(s), "u1") for i, s in enumerate(shapes)}
    arrays |= {f"grid_{k}": np.asarray(getattr(grid, k)) for k in _GRID}
    arrays |= {f"traffic_{k}": np.asarray(getattr(scene.traffic, k)) for k in _TRAFFIC}
    return arrays


def _unpack(data: dict[str, np.ndarray]) -> Scene:
    record = json.loads(str(data["record"]))
    if record["format"] != FORMAT:
        raise ValueError(f"format '{record['format']}', expected '{FORMAT}'")
    shapes = [
        shapely.from_wkb(data[f"shape_{i}"].tobytes()) for i in range(len(record["regions"]) + 1)
    ]
    points = np.split(data["route_points"], np.cumsum(data["route_lengths"])[:-1])
    place = Intersection(
        name=record["name"],
        source=record["source"],
        center=data["place_center"],
        regions={Region[k.upper()]: s for k, s in zip(record["regions"], shapes, strict=False)},
        arms=tuple(Arm((x, y), bearing, width) for x, y, bearing, width in record["arms"]),
        routes=tuple(
            Route(p, width, user, (through[0], through[1]))
            for p, (width, user, through) in zip(points, record["routes"], strict=False)
        ),
        mounting=shapes[-1],
        poles=data["poles"],
        ground_points=data["ground_points"],
        notes=tuple(record["notes"]),
    )
    size, radius, level_count = record["grid"]
    grid = VoxelGrid(
        **{k: data[f"grid_{k}"] for k in _GRID}, size=size, radius=radius, level_count=level_count
    )
    traffic = TrafficFrames(**{k: data[f"traffic_{k}"] for k in _TRAFFIC})
    return Scene(grid, traffic, place, tuple((k, v) for k, v in record["settings"]))
