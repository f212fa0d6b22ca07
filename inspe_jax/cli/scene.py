"""Scenes, and layouts by rule: `inspe scene` and `layout`."""

import gzip
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import SceneOptions, command, parts_of
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, whole_file
from inspe_jax.mounting import strategies
from inspe_jax.mounting.site import Site
from inspe_jax.scene.geojson import SUFFIX as GEOJSON
from inspe_jax.scene.maps.registry import is_map, junction_at, open_map, read_map
from inspe_jax.scene.maps.road_map import MARGIN
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.profiles import DEFAULT_PROFILE, profile_of
from inspe_jax.scene.scene import (
    SCENE_SUFFIXES,
    build_scene,
    check_scene_name,
    load_scene,
    recorded,
    save_scene,
)
from inspe_jax.scene.traffic.frames import traffic_model
from inspe_jax.sensing.calibrations import layouts_from
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import save_layout
from inspe_jax.sensing.named import check_places


@command()
def scene(
    source: str = common.DEFAULT_SCENE,
    *,
    list_: bool = False,
    junction: str | None = None,
    center: tuple[float, float] | None = None,
    at: str | None = None,
    driving_side: str | None = None,
    bodies: Path | None = None,
    options: SceneOptions,
    mesh: Path | None = None,
    elevation: Path | None = None,
    save: Path | None = None,
    plot: Path | None = None,
    force: bool = False,
) -> None:
    """Build a scene of one intersection: its region of interest, voxels and traffic.

    Examples:

    - `inspe scene roundabout --plot roundabout.png`
    - `inspe scene crossroads.xodr --junction 100 --radius 50 --density medium --out j100.npz`
    - `inspe scene town.net.xml --junction 189 --traffic sumo --out j189.npz`
    - `inspe scene city.osm --at 48.137,11.575 --statics map --out city.npz`
    - `inspe scene city.osm --at 48.137,11.575 --elevation dem.tif --terrain ground`
    - `inspe scene crossroads.xodr --junction 100 --traffic run.log --step 0.1 --frames 200`
    - `inspe scene crossroads.xodr --junction 100 --traffic tracks.csv --step 0.5`

    Args:
        source (SCENE): A built-in intersection, a map (.xodr, .net.xml, .osm), regions of your
            own (.geojson: polygons with a property region, lines with a route, points as poles), or
            a scene saved as .npz.
        list_ (--list): List the junctions of a map, or the built-in intersections.
        junction: Id of a junction on the map; see --list.
        center (X Y): Centre [m] in place of a junction id, for a place with several junctions.
        at (LAT,LON): The junction nearest to a latitude and longitude [degrees], on a map that
            has them.
        bodies (FILE.geojson|csv): Houses, walls, trees and poles of your own, besides
            those of the map: polygons, lines and points in degrees, with properties kind and
            height_m; points without a kind are poles. Poles can carry sensors; with --statics map
            all hide what is behind them.
        mesh (FILE.glb|ply|obj): Mesh of the place in the map's coordinates [m], a digital twin:
            its ground, and what stands on it; with --statics map and --terrain ground they hide
            what is behind them.
        elevation (FILE.tif|asc): Elevation model (GeoTIFF, ASCII grid) in place of the map's
            heights; with --terrain ground it hides what is behind it.
        save (--out FILE.npz): Save the scene.
    """
    from inspe_jax.report.figures import scene_view
    from inspe_jax.report.scene_tables import scene_table
    from inspe_jax.scene.maps.digital_twin import with_mesh
    from inspe_jax.scene.maps.elevation import with_elevation
    from inspe_jax.scene.maps.own_bodies import with_own_bodies

    if list_:
        _list_places(source)
        return
    claims.file(save, SCENE_SUFFIXES, force=force)
    claims.outputs(plot, force=force)
    settings = options.given
    traffic = options.traffic
    path, own = Path(source), list[np.ndarray]()
    places = dict(junction=junction, center=center, at=at, bodies=bodies)
    places |= dict(elevation=elevation, mesh=mesh, driving_side=driving_side)
    given = [name for name, value in places.items() if value is not None]
    if path.suffix == ".npz":
        _refuse(source, "a saved scene keeps the settings it was built with", [*settings, *given])
        built = load_scene(source)
    else:
        load, _ = recorded(traffic or "")
        if load is not None:
            ours = [name for name in ("density", "mix", "seed") if name in settings]
            _refuse(f"--traffic {traffic}", "what was recorded has all of this", ours)
            load(traffic)
        elif traffic is not None:
            traffic_model(traffic)
        if elevation is not None and mesh is not None:
            raise InspeError("--elevation and --mesh: each brings the ground; give one of them")
        if is_map(path):
            choose = "choose a place on the map with --junction ID, --at LAT,LON or --center X Y"
            open_ = [junction, center, at].count(None)
            if open_ != 2 and not (open_ == 3 and path.suffix.lower() == GEOJSON):
                raise InspeError(f"{source}: {choose}; --list shows the junctions")
            for file in filter(None, (bodies, elevation, mesh)):
                check_input(file)
            profile = profile_of(options.profile or DEFAULT_PROFILE)
            size = profile.of_scene(radius=options.radius)["radius"]
            with common.busy(f"reading {path.name}"):
                if open_ == 3:
                    known = open_map(path, driving_side).list_junctions()
                    if len(known) != 1:
                        raise InspeError(f"{source}: {choose}; --list shows the junctions")
                    junction = str(known[0].id)
                if at is not None:
                    form = "LAT,LON, such as 48.137,11.575"
                    lat, lon = parts_of("at", at, ",", float, (2,), form)
                    junction = str(junction_at(path, lat, lon, driving_side).id)
                named: dict[str, Any] = dict(junction=junction, center=center)
                place = read_map(path, **named, radius=size, driving_side=driving_side)
                place = place if elevation is None else with_elevation(place, elevation, size)
                place = place if mesh is None else with_mesh(place, mesh, size)
                before = place.poles
                place = place if bodies is None else with_own_bodies(place, bodies, size + MARGIN)
                there = {tuple(foot) for foot in before[:, :2].tolist()}
                own = [foot for foot in place.poles[:, :2] if tuple(foot.tolist()) not in there]
        else:
            check_scene_name(source)
            place = built_in(source)
            _refuse(source, "a built-in intersection is no map", given)
        with common.progress("traffic") as report:
            built = build_scene(place, **settings, progress=report)
    common.out.print(scene_table(built))
    if short := built.shortfall:
        common.note(f"road users: {short}; a larger radius holds more")
    site = Site(built.intersection, built.voxels.radius, depth=30.0, bodies=built.statics)
    for x, y in own:
        if why := site.why_none(np.array([x, y])):
            common.note(f"the pole at ({x:.1f}, {y:.1f}) carries no sensor: {why}")
    if save:
        save = claims.keep(partial(save_scene, built), save)
        common.out.print(f"saved {save}")
    common.draw(lambda: scene_view(built), plot)


@dataclass(frozen=True)
class CalibrationOptions:
    """Calibrations of sensors that hang already, in place of a strategy.

    Attributes:
        files (--from FILE): Calibration of sensors that hang there, in place of a strategy: camera
            matrices with extrinsics, projections or pairs of pixels and places (.yaml or .json);
            of TUMTraf, OpenLABEL, OPV2V or V2X-Real; or a list of sensors. Repeat it for more.
        crs: CRS of the calibrations where they name none: a code, a PROJ string, or LAT,LON.
        transform (NUMBERS): From the calibrations' frame to their CRS, or to the scene without one:
            X,Y,Z,YAW [m, degrees], or 16 numbers of a matrix, row by row.
        unit: Of lengths in the calibrations: m, cm or mm.
        heights: Above what heights in the calibrations are: scene (its zero) or ground.
        size (WxH): Size of pictures [px], where the calibrations have none.
        convention: What angles of a list of sensors are from: body, azimuth or carla.
    """

    files: list[Path] | None = None
    crs: str | None = None
    transform: str | None = None
    unit: str | None = None
    heights: str | None = None
    size: str | None = None
    convention: str | None = None

    def arguments(self) -> dict[str, Any]:
        """Those of :func:`inspe_jax.layouts_from` that are given, before a scene is read. Raises
        InspeError if a file is missing, or a transform or a size is written otherwise."""
        given = {key: x for key, x in asdict(self).items() if x is not None and key != "files"}
        for path in self.files or ():
            check_input(path)
        if self.transform is not None:
            form = "X,Y,Z,YAW, such as 12.5,-3,0,90, or 16 numbers"
            given["transform"] = parts_of("transform", self.transform, ",", float, (4, 16), form)
        if self.size is not None:
            form = "WIDTHxHEIGHT, such as 1920x1080"
            given["size"] = parts_of("size", self.size, "x", int, (2,), form)
        return given


@command()
def layout(
    source: str = common.DEFAULT_SCENE,
    *,
    strategy: str | None = None,
    camera: str | None = None,
    lidar: str | None = None,
    profile: str | None = None,
    save: Path | None = None,
    force: bool = False,
    options: CalibrationOptions,
) -> None:
    """Place sensors on a scene by one of the paper's strategies, or as they hang there already.

    Examples:

    - `inspe layout four_way --strategy Cam-d1/L-d1 --out layout.yaml`
    - `inspe layout j189.npz --strategy L-c --lidar ouster-os1-128`
    - `inspe layout city.npz --from south.yaml --from lidar.json --crs EPSG:25832 --out now.yaml`

    Args:
        strategy: Cam-c, Cam-d1, Cam-d2, L-c, L-d1, L-d2, or a pair such as Cam-c/L-c; Cam-d1 if not
            given.
        camera: Camera device; see `inspe devices`. With --from, of cameras
            without a device: its rays and reliability; all of it without a lens.
        lidar: LiDAR device; see `inspe devices`. With --from, of LiDARs without a device.
        save (--out FILE.yaml): Save the layout.
    """
    from inspe_jax.report.scene_tables import layout_table

    named = dict(camera=camera, lidar=lidar)
    devices: dict[str, Any] = {key: name for key, name in named.items() if name is not None}
    claims.file(save, (".yaml", ".yml"), force=force)
    for name in devices.values():
        device(name)
    hung = options.arguments()
    if options.files is None:
        _refuse("--from", "these go with a calibration", [*hung])
        common.check_layout(strategy or common.DEFAULT_LAYOUT)
        world = load_scene(source, profile)
        placed = strategies.strategy(world, strategy or common.DEFAULT_LAYOUT, **devices)
    else:
        _refuse("--from", "sensors hang where they are", ["strategy"] if strategy else [])
        world = load_scene(source, profile)
        found = layouts_from(*options.files, scene=world, **hung, **devices)
        common.note(*found.notes)
        placed = found.layout
        try:
            check_places(world, placed)
        except InspeError as error:
            common.note(str(error))
    common.out.print(layout_table(placed))
    if save:
        save_layout(placed, save)
        common.out.print(f"saved {save}")


def _refuse(what: str, why: str, options: Sequence[str]) -> None:
    """Raise InspeError that names the options that are given and cannot be, if any."""
    if options:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in options)
        raise InspeError(f"{what}: {why}; leave out {names}")


@command()
def examples(folder: Path = Path()) -> None:
    """Write the example files of the guides: two maps, poles, and a log of traffic.

    Their places are made up. A file that is there already stays as it is.

    Examples:

    - `inspe examples`

    Args:
        folder (DIR): An existing folder for the files.
    """
    for item in sorted(files("inspe_jax.scene").joinpath("examples").iterdir(), key=str):
        path, content = folder / item.name.removesuffix(".gz"), item.read_bytes()
        if path.exists():
            common.out.print(f"kept {path}: it is there already")
            continue
        with whole_file(path) as file:
            file.write(gzip.decompress(content) if item.name.endswith(".gz") else content)
        common.out.print(f"wrote {path}")


def _list_places(source: str) -> None:
    from inspe_jax.report.scene_tables import built_ins_table, junctions_table

    if is_map(source):
        with common.busy(f"reading {source}"):
            place = open_map(source)
            found = place.list_junctions()
        common.out.print(junctions_table(found, Path(source).name, place.georeference))
        for note in place.notes:
            common.note(note)
        return
    check_scene_name(source)
    common.out.print(built_ins_table())
