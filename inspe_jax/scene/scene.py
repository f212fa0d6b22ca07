"""A scene: an intersection, its voxels and its traffic. Build, save and load it."""

import json
import operator
import os
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.errors import InspeError, check_known, error_at, nearest, wrong_kind
from inspe_jax.core.files import cached_by_file, check_kind, check_output, open_arrays, whole_file
from inspe_jax.core.pytree import pytree
from inspe_jax.core.records import Described, check_record
from inspe_jax.scene.geojson import SUFFIX as GEOJSON
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Arm, Intersection, Mesh, Route
from inspe_jax.scene.lines import distance_from
from inspe_jax.scene.maps.registry import is_map
from inspe_jax.scene.placed_bodies import inside_bodies
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.profiles import BEFORE_PROFILES, DEFAULT_PROFILE, Profile, profile_of
from inspe_jax.scene.regions import Region, weights_of_regions
from inspe_jax.scene.statics import StaticBody, pack_bodies, unpack_bodies
from inspe_jax.scene.street import STATICS, statics_of
from inspe_jax.scene.terrain import Terrain, check_terrain, terrain_of
from inspe_jax.scene.traffic.carla_log import LOG_SUFFIXES, load_log, log_traffic
from inspe_jax.scene.traffic.frames import DENSITIES, TrafficFrames, shortfall, traffic_model
from inspe_jax.scene.traffic.tracks import TRACK_SUFFIXES, load_tracks, tracks_traffic
from inspe_jax.scene.voxels import VoxelGrid, build_voxels

FORMAT = "inspe_jax scene 6"
OF_MAP = "map_bodies"  # how the names of arrays begin that hold the bodies of a place's map
SCENE_SUFFIXES = (".npz",)
AS_RECORDED = "as recorded"
RECORDED: dict[tuple[str, ...], tuple[Callable[..., Any], Callable[..., TrafficFrames]]] = {
    LOG_SUFFIXES: (load_log, log_traffic),
    TRACK_SUFFIXES: (load_tracks, tracks_traffic),
}
"""What reads a file of recorded traffic, and what makes frames of it, by how its name ends."""


def recorded(name: str) -> tuple[Callable[..., Any] | None, Callable[..., TrafficFrames] | None]:
    """The row of :data:`RECORDED` of a file's name; None of what is none."""
    own = (row for ends, row in RECORDED.items() if name.lower().endswith(ends))
    return next(own, (None, None))


@pytree
@dataclass(frozen=True, eq=False, repr=False)
class Scene(Described):
    """What the sensors look at, in world metres and radians. A scene is equal only to itself.

    ``settings`` are those of :func:`build_scene`. ``statics`` are the bodies that stand in every
    frame (:meth:`with_statics`). ``terrain`` is the surface of the ground where it hides what is
    behind it (:meth:`with_terrain`); None if it hides nothing.
    """

    voxels: VoxelGrid
    traffic: TrafficFrames
    intersection: Intersection = field(metadata={"static": True})
    settings: tuple[tuple[str, str], ...] = field(metadata={"static": True}, default=())
    statics: tuple[StaticBody, ...] = field(metadata={"static": True}, default=())
    terrain: Terrain | None = field(metadata={"static": True}, default=None)

    def _facts(self) -> dict[str, Any]:
        bodies = {"static bodies": len(self.statics)} if self.statics else {}
        own = {"name": self.name, "profile": self.profile.name}
        return own | self.voxels._facts() | self.traffic._facts() | bodies

    def check(self) -> "Scene":
        """This scene, checked once: shapes, kinds, and that values are finite and in range. Raises
        InspeError that names the part and the index of the first wrong value."""
        if "_checked" not in self.__dict__:
            check_record(self, getattr(self.intersection, "name", "scene"))
            self.__dict__["_checked"] = True
        return self

    def with_terrain(self) -> "Scene":
        """This scene with the ground of its map, on which all then stands, in the way: it hides
        what is behind its brows. Level ground leaves the scene as it is."""
        terrain = terrain_of(self.intersection, self.voxels.radius)
        if terrain is None:
            return self
        place = self.intersection.standing_on(terrain.points)
        grid = replace(self.voxels, ground=terrain.height(self.voxels.columns))
        center, there = np.array(self.traffic.center), self.traffic.valid
        at = center[there, :2]
        center[there, 2] += terrain.height(at) - self.intersection.ground(at)
        traffic = replace(self.traffic, center=center)
        return replace(self, voxels=grid, traffic=traffic, intersection=place, terrain=terrain)

    def with_statics(self, bodies: Sequence[StaticBody]) -> "Scene":
        """This scene with these bodies, or none, in place of its own; voxels inside them are no
        part of the region of interest. Raises InspeError where they leave nothing of it, or one
        alone swallows it."""
        scene = replace(self, statics=tuple(bodies))
        scene.inside_statics  # noqa: B018  # which checks them
        return scene

    @cached_property
    def inside_statics(self) -> Bool[np.ndarray, "L Z"] | None:
        """Whether each voxel is inside a body, by column and level; None where none is."""
        if not self.statics:
            return None
        found = inside_bodies(self.statics, self.intersection, self.voxels)
        return found if found.any() else None

    @property
    def voxel_weight(self) -> Float[np.ndarray, " V"]:
        """Region weight w of each voxel; 0 inside a body."""
        weight, inside = self.voxels.weight, self.inside_statics
        return weight if inside is None else np.where(inside.ravel(), 0.0, weight)

    @property
    def poles(self) -> Float[np.ndarray, "P 3"]:
        """Feet of the existing poles within the radius of the region of interest [m]."""
        poles = self.intersection.poles
        return poles[distance_from(poles, self.voxels.center) <= self.voxels.radius]

    @property
    def name(self) -> str:
        """The intersection's name."""
        return self.intersection.name

    @property
    def profile(self) -> Profile:
        """The profile that it was built under, which decides how it is scored."""
        return profile_of(dict(self.settings).get("profile", BEFORE_PROFILES))

    @property
    def shortfall(self) -> str:
        """What its traffic falls short of: :func:`~inspe_jax.scene.traffic.frames.shortfall`."""
        asked = dict(self.settings)
        density, mix = asked.get("density", AS_RECORDED), asked.get("mix", AS_RECORDED)
        if AS_RECORDED in (density, mix):
            return ""
        return shortfall(self.traffic, density_count(density), mix)


def build_scene(
    intersection: Intersection | str,
    *,
    profile: str = DEFAULT_PROFILE,
    radius: float | None = None,
    voxel: float | None = None,
    spacing: float | None = None,
    density: str | int | None = None,
    frames: int = 100,
    step: float = 1.0,
    mix: str | None = None,
    traffic: str | os.PathLike[str] | Mapping[str, Any] = "waypoints",
    seed: int = 0,
    statics: str = "none",
    terrain: str = "none",
    region_weight: Mapping[str, float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Scene:
    """Voxelise an intersection, or the built-in one of a name, and fill it with traffic.

    Args:
        intersection: A place, or the name of a built-in.
        profile: One of :func:`~inspe_jax.scene.profiles.profiles`; gives the values that are None.
        radius: Of the region of interest [m].
        voxel: Edge of a voxel [m].
        spacing: Of voxels [m]: :func:`~inspe_jax.scene.voxels.build_voxels`.
        density: ``none``, ``low``, ``medium``, ``high`` or a mean number of objects.
        frames: Number of frames.
        step: Time between frames [s].
        mix: A key of :data:`~inspe_jax.scene.traffic.frames.MIXES`, also one that you added.
        traffic: A key of :data:`~inspe_jax.scene.traffic.frames.TRAFFIC_MODELS`: ``waypoints``, the
            paper's model; ``sumo``, for a place that was read from a map. Or recorded traffic,
            which has its own density and mix: tracks (.csv) or their columns by name
            (:mod:`inspe_jax.scene.traffic.tracks`), or a log of CARLA's recorder (.log).
        seed: Of the traffic.
        statics: One of :data:`~inspe_jax.scene.street.STATICS`.
        terrain: ``none``, or ``ground`` for :meth:`Scene.with_terrain`.
        region_weight: Weight w of each region by name, 0 where it is not named; the paper's if
            None.
        progress: Called with (steps done, steps).

    Raises:
        InspeError: A value is out of range; and as the model of the traffic does.

    >>> inspe_jax.build_scene("t_junction", radius=20, voxel=1.0, density="none").voxels.count
    3904
    """
    weights = weights_of_regions(region_weight)
    own = profile_of(profile).of_scene(
        radius=radius, voxel=voxel, spacing=spacing, density=density, mix=mix
    )
    check_known(statics, STATICS, "statics")
    check_terrain(terrain)
    if isinstance(intersection, str) and not is_map(intersection):
        intersection = built_in(intersection)
    if not isinstance(intersection, Intersection):
        wanted = "the name of a built-in, or an Intersection, as scene.maps.registry.read_map reads"
        raise wrong_kind("intersection", intersection, wanted)
    check_record(intersection, intersection.name)
    radius, density, mix = own["radius"], own["density"], own["mix"]
    voxels = build_voxels(intersection, radius=radius, voxel=own["voxel"], spacing=own["spacing"])
    voxels = replace(voxels, region_weight=weights)
    size: dict[str, Any] = dict(radius=radius, frames=frames, step=step)
    source, drawn = "tracks" if isinstance(traffic, Mapping) else str(traffic), str(seed)
    reader = recorded(source)[1]
    if isinstance(traffic, Mapping) or reader is not None:
        notes, path = [*intersection.notes], Path(source)
        given: Any = traffic if isinstance(traffic, Mapping) else path
        found = (reader or tracks_traffic)(intersection, given, **size, notes=notes)
        intersection = replace(intersection, notes=tuple(notes))
        density, mix, source, drawn = AS_RECORDED, AS_RECORDED, path.name, ""
    else:
        size |= dict(count=density_count(density), mix=mix, seed=seed, progress=progress)
        found = traffic_model(source)(intersection, **size)
    settings = dict(profile=profile, radius=f"{radius:g}", voxel=f"{voxels.size:g}")
    settings |= dict(spacing=f"{voxels.spacing:g}", density=str(density))
    settings |= dict(frames=str(found.frame_count), step=f"{step:g}", mix=mix, traffic=source)
    settings |= dict(seed=drawn, statics=statics, terrain=terrain)
    if region_weight is not None:
        settings |= dict(
            region_weight=" ".join(f"{name}={w:g}" for name, w in region_weight.items())
        )
    scene = Scene(voxels, found, intersection, tuple(settings.items()))
    scene = scene if terrain == "none" else scene.with_terrain()
    return scene.with_statics(statics_of(statics, intersection, radius, found)).check()


def load_scene(source: str | os.PathLike[str], profile: str | None = None) -> Scene:
    """A saved ``.npz`` scene, or a built-in intersection by name, built under a profile.

    Raises InspeError if there is no such built-in, profile or file, if the file is not a scene, or
    if the scene was built under another ``profile`` than the given one.
    """
    if profile is not None:
        profile_of(profile)
    if str(source) in BUILT_INS:
        return build_scene(built_in(str(source)), profile=profile or DEFAULT_PROFILE)
    path = Path(source)
    check_scene_name(path)
    with open_arrays(path, "not a scene saved by this package") as arrays, error_at(f"{path}"):
        scene = _unpack(arrays)
        own = scene.profile.name
        if profile not in (None, own):
            raise InspeError(
                f"built under the profile {own}, not {profile}; build it again: "
                f"inspe scene … --profile {profile}"
            )
        return scene.check()


def scene_of(given: Any) -> Scene:
    """A scene, or that of a built-in or a saved file; checked. Raises InspeError as these do."""
    if isinstance(given, Scene):
        return given.check()
    if not isinstance(given, str | os.PathLike):
        names = f"the name of a built-in ({', '.join(BUILT_INS)}) or of a saved .npz file"
        raise wrong_kind("scene", given, f"a Scene, or {names}")
    if given in BUILT_INS:
        return _built_in_scene(given)
    return _saved_scene(given) if os.path.isfile(given) else load_scene(given)  # says what is wrong


# Or each score in a loop would build or read it again.
_built_in_scene = lru_cache(maxsize=2)(load_scene)
_saved_scene = cached_by_file(2)(load_scene)


def check_scene_name(source: str | os.PathLike[str]) -> None:
    """Raise InspeError unless a name is that of a built-in, or can be that of a saved scene."""
    if str(source) in BUILT_INS or Path(source).suffix in SCENE_SUFFIXES:
        return
    if other := what_is(source):
        raise InspeError(f"{source}: {other}")
    if Path(source).is_file():
        check_kind(Path(source))
    raise InspeError(
        f"no scene '{source}': give a built-in ({', '.join(BUILT_INS)}), a saved .npz, or a map "
        f"(.xodr, .net.xml, .osm){nearest(str(source), tuple(BUILT_INS))}"
    )


def what_is(path: str | os.PathLike[str]) -> str:
    """What takes a folder, a map, a scene or a layout; otherwise ""."""
    path = Path(path)
    if path.is_dir():
        own = path / "layout.yaml"
        return f"is a folder; its layout is {own}" if own.is_file() else "is a folder; name a file"
    if path.suffix.lower() == GEOJSON:
        made = f"first inspe scene {path} --out scene.npz"
        return f"is a layout (inspe score SCENE {path}), or regions of a place ({made})"
    if is_map(path):
        build = f"inspe scene {path} --junction ID --out scene.npz (--list shows the junctions)"
        return f"a map is not a scene yet; build one: {build}"
    if path.suffix.lower() in SCENE_SUFFIXES:
        return f"is a scene, which comes before the layout: inspe score {path} LAYOUT"
    if path.suffix.lower() in (".yaml", ".yml"):
        takes = f"inspe score SCENE {path}, or inspe sweep {path}"
        return f"is a layout or a study, not a scene: {takes}"
    return ""


def save_scene(scene: Scene, path: str | os.PathLike[str]) -> None:
    """Write a scene to an ``.npz`` file, whole or not at all. Raises as :meth:`Scene.check`.

    >>> inspe_jax.save_scene(scene, "four_way.npz")
    >>> inspe_jax.load_scene("four_way.npz").voxels.count == scene.voxels.count
    True
    """
    if not isinstance(scene, Scene):
        raise wrong_kind("scene", scene, "a Scene")
    check_output(path, SCENE_SUFFIXES)
    with whole_file(path) as f:
        np.savez_compressed(f, **_pack(scene.check()))  # type: ignore[arg-type]  # names are ours


def density_count(density: str | int) -> int:
    """The mean number of objects of a density's name or number. Raises InspeError for others."""
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


_POLYGON, _COLLECTION, _HAS_Z = 3, 7, 0x80000000  # kinds of WKB, and a flag of theirs
_GRID = ("columns", "ground", "region", "center")


def _pack(scene: Scene) -> dict[str, np.ndarray]:
    """A scene as plain arrays and one JSON text, with polygons as WKB."""
    place, grid = scene.intersection, scene.voxels
    record = {
        "format": FORMAT,
        "name": place.name,
        "source": place.source,
        "notes": place.notes,
        "arms": [[*a.mouth, a.bearing, a.width] for a in place.arms],
        "routes": [[r.width, r.user, list(r.through)] for r in place.routes],
        "grid": [grid.size, grid.radius, grid.level_count, grid.spacing, grid.region_weight],
        "settings": scene.settings,
        "regions": [r.key for r in place.regions],
        "georeference": place.georeference and [place.georeference.crs, *place.georeference.shift],
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
    parts = {"mesh": place.mesh, "terrain": scene.terrain, "traffic": scene.traffic}
    for name, part in parts.items():
        if part is not None:
            arrays |= {f"{name}_{f.name}": np.asarray(getattr(part, f.name)) for f in fields(part)}
    return arrays | pack_bodies(place.bodies, OF_MAP) | pack_bodies(scene.statics)


def _shape(wkb: bytes) -> BaseGeometry:
    """The geometry of a WKB text, whose parts have no parts: deep ones overflow GEOS's stack."""
    order, kind, count = struct.unpack_from("<BII", wkb)
    at, own = 9, kind & ~_HAS_Z
    if order != 1 or own > _COLLECTION:
        raise ValueError("no geometry as shapely writes it")
    for _ in range(count if own > _POLYGON else 0):
        order, kind, count = struct.unpack_from("<BII", wkb, at)
        own, size = kind & ~_HAS_Z, 24 if kind & _HAS_Z else 16
        if order != 1 or not 0 < own <= _POLYGON:
            raise ValueError("a part has parts itself")
        at += 9
        if own < _POLYGON:
            at += count * size if own > 1 else size - 4  # a point has no count
        for _ in range(count if own == _POLYGON else 0):
            at += 4 + size * struct.unpack_from("<I", wkb, at)[0]
    return shapely.from_wkb(wkb)


def _unpack(data: Mapping[str, np.ndarray]) -> Scene:
    def saved(name: str, kind: Any) -> Any:
        own = [f"{name}_{f.name}" for f in fields(kind)]
        return kind(*(data[key] for key in own)) if any(key in data for key in own) else None

    record = json.loads(str(data["record"]))
    if record["format"] != FORMAT:
        if not str(record["format"]).startswith(FORMAT.rstrip("0123456789")):
            raise ValueError(f"format '{record['format']}', expected '{FORMAT}'")
        raise InspeError("saved by another version of this package; build it again: inspe scene")
    shapes = [_shape(data[f"shape_{i}"].tobytes()) for i in range(len(record["regions"]) + 1)]
    given = record["georeference"]
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
        bodies=unpack_bodies(data, OF_MAP),
        georeference=given and Georeference(given[0], (given[1], given[2])),
        mesh=saved("mesh", Mesh),
    )
    columns, ground, region, center = (data[f"grid_{k}"] for k in _GRID)
    *size, weights = record["grid"]
    grid = VoxelGrid(columns, ground, region, center, *size)
    grid = replace(grid, region_weight=tuple(weights))
    settings = tuple((k, v) for k, v in record["settings"])
    terrain = saved("terrain", Terrain)
    terrain = terrain and replace(terrain, step=float(terrain.step))
    traffic = TrafficFrames(*(data[f"traffic_{f.name}"] for f in fields(TrafficFrames)))
    return Scene(grid, traffic, place, settings, unpack_bodies(data), terrain)
