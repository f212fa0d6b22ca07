"""Scenes, and layouts by rule: `inspe scene` and `layout`.

Imports are inside the commands: the map readers and matplotlib load slowly.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from inspe_jax.cli.claims import ForceOption, claims
from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    PlotOption,
    ProfileOption,
    SceneArgument,
    app,
    busy,
    check_layout,
    err,
    known,
    note,
    out,
    progress,
)
from inspe_jax.core.errors import InspeError

if TYPE_CHECKING:
    from inspe_jax.scene.scene import Scene


@app.command()
def scene(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SCENE",
            help="A built-in intersection, a map (.xodr, .net.xml, .osm), or a scene saved as "
            ".npz.",
        ),
    ] = DEFAULT_SCENE,
    list_: Annotated[
        bool,
        typer.Option("--list", help="List the junctions of a map, or the built-in intersections."),
    ] = False,
    junction: Annotated[
        str | None, typer.Option(help="Id of a junction on the map; see --list.")
    ] = None,
    center: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="X Y",
            help="Centre [m] in place of a junction id, for a place with several junctions.",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON",
            help="The junction nearest to a latitude and longitude [degrees], on a map that has "
            "them.",
        ),
    ] = None,
    bodies: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.geojson|csv|poly.xml",
            help="Houses, walls, trees and poles of your own, besides those of the map: polygons, "
            "lines and points in degrees, with properties kind and height_m; points without a kind "
            "are poles. Or SUMO's polygons. Poles can carry sensors; with --statics map all hide "
            "what is behind them.",
        ),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Profile: it sets the options below that are not given, and how scores are read; "
            "paper if not given. See `inspe profiles`.",
        ),
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="Radius of the region of interest [m].")
    ] = None,
    voxel: Annotated[float | None, typer.Option(help="Edge of a voxel [m].")] = None,
    spacing: Annotated[
        float | None,
        typer.Option(
            help="Score one voxel in each cell of this edge [m]. If not given: the profile's value "
            "where --voxel is the profile's too, and otherwise every voxel."
        ),
    ] = None,
    density: Annotated[
        str | None,
        typer.Option(
            help="Traffic: none, low, medium, high (0, 20, 40, 60 road users), or a number."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Number of frames of traffic; 100 if not given.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(help="Time from one frame to the next [s]; 1 if not given.")
    ] = None,
    mix: Annotated[
        str | None,
        typer.Option(
            help="Road users: mixed, fleet (sizes as varied as real ones), or largest (only the "
            "paper's largest vehicle)."
        ),
    ] = None,
    traffic: Annotated[
        str | None,
        typer.Option(
            metavar="waypoints|sumo|LOG",
            help="Traffic model: waypoints (the paper's; used if not given), sumo (on maps), or a "
            ".log file of CARLA's recorder.",
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the traffic; 0 if not given.")] = None,
    statics: Annotated[
        str | None,
        typer.Option(
            metavar="none|map|street",
            help="Bodies that stand in every frame and hide what is behind them: none (if not "
            "given); map, the buildings, trees, walls and poles of an OpenStreetMap extract or "
            "of OpenDRIVE's objects; or street, made-up parked vehicles, trees, walls, posts and "
            "bus shelters.",
        ),
    ] = None,
    terrain: Annotated[
        str | None,
        typer.Option(
            metavar="none|ground",
            help="Whether the ground hides what is behind its brows: none (if not given) or "
            "ground.",
        ),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.glb|ply|obj",
            help="Mesh of the place in the map's coordinates [m], a digital twin: its ground, "
            "and what stands on it; with --statics map and --terrain ground they hide what is "
            "behind them.",
        ),
    ] = None,
    elevation: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.tif|asc",
            help="Elevation model (GeoTIFF, ASCII grid) in place of the map's heights; with "
            "--terrain ground it hides what is behind it.",
        ),
    ] = None,
    save: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.npz", help="Save the scene.")
    ] = None,
    plot: PlotOption = None,
    force: ForceOption = False,
) -> None:
    """Build a scene of one intersection: its region of interest, voxels and traffic.

    Examples:

    - `inspe scene roundabout --plot roundabout.png`
    - `inspe scene crossroads.xodr --list`
    - `inspe scene crossroads.xodr --junction 100 --radius 50 --density medium --out j100.npz`
    - `inspe scene town.net.xml --junction 189 --traffic sumo --out j189.npz`
    - `inspe scene city.osm --at 48.137,11.575 --statics map --out city.npz`
    - `inspe scene city.osm --at 48.137,11.575 --elevation dem.tif --terrain ground`
    - `inspe scene crossroads.xodr --junction 100 --traffic run.log --step 0.1 --frames 200`
    - `inspe scene j189.npz --plot j189.png`
    """
    from inspe_jax.core.files import check_input
    from inspe_jax.core.sheet import FORMATS, save_figure
    from inspe_jax.mounting.site import Site
    from inspe_jax.report.figures import scene_view
    from inspe_jax.report.scene_tables import scene_table
    from inspe_jax.scene.maps.digital_twin import with_mesh
    from inspe_jax.scene.maps.elevation import with_elevation
    from inspe_jax.scene.maps.own_bodies import with_own_bodies
    from inspe_jax.scene.maps.parts import MARGIN
    from inspe_jax.scene.maps.registry import is_map, junction_at, read_map
    from inspe_jax.scene.procedural.built_ins import built_in
    from inspe_jax.scene.profiles import DEFAULT_PROFILE, profile_of
    from inspe_jax.scene.scene import (
        SCENE_SUFFIXES,
        build_scene,
        load_scene,
        save_scene,
    )
    from inspe_jax.scene.traffic.carla_log import LOG_SUFFIXES, load_log
    from inspe_jax.scene.traffic.registry import traffic_model

    if list_:
        _list_places(source)
        return
    claims.file(save, SCENE_SUFFIXES, force=force)
    claims.file(plot, FORMATS, force=force)
    options: dict[str, Any] = {
        name: value
        for name, value in dict(
            profile=profile,
            radius=radius,
            voxel=voxel,
            spacing=spacing,
            density=density,
            frames=frames,
            step=step,
            mix=mix,
            traffic=traffic,
            seed=seed,
            statics=statics,
            terrain=terrain,
        ).items()
        if value is not None
    }
    path, own = Path(source), list[np.ndarray]()
    places = dict(junction=junction, center=center, at=at, bodies=bodies)
    places |= dict(elevation=elevation, mesh=mesh)
    given = [name for name, value in places.items() if value is not None]
    if path.suffix == ".npz":
        _refuse(source, "a saved scene keeps the settings it was built with", [*options, *given])
        built = load_scene(source)
    else:
        if traffic is not None and traffic.endswith(LOG_SUFFIXES):
            ours = [name for name in ("density", "mix", "seed") if name in options]
            _refuse(f"--traffic {traffic}", "a log has traffic of its own", ours)
            load_log(traffic)
        elif traffic is not None:
            traffic_model(traffic)
        if elevation is not None and mesh is not None:
            raise InspeError("--elevation and --mesh: each brings the ground; give one of them")
        if is_map(path):
            if [junction, center, at].count(None) != 2:
                raise InspeError(
                    f"{source}: choose a place on the map with --junction ID, --at LAT,LON or "
                    "--center X Y; --list shows the junctions"
                )
            for file in filter(None, (bodies, elevation, mesh)):
                check_input(file)
            size = profile_of(profile or DEFAULT_PROFILE).of_scene(radius=radius)["radius"]
            with busy(f"reading {path.name}"):
                if at is not None:
                    junction = str(junction_at(path, *_degrees(at)).id)
                place = read_map(path, junction=junction, center=center, radius=size)
                place = place if elevation is None else with_elevation(place, elevation, size)
                place = place if mesh is None else with_mesh(place, mesh, size)
                before = place.poles
                place = place if bodies is None else with_own_bodies(place, bodies, size + MARGIN)
                there = {tuple(foot) for foot in before[:, :2].tolist()}
                own = [foot for foot in place.poles[:, :2] if tuple(foot.tolist()) not in there]
        else:
            place = built_in(known(source))
            _refuse(source, "a built-in intersection is no map", given)
        with progress("traffic") as report:
            built = build_scene(place, **options, progress=report)
    out.print(scene_table(built))
    _warn_of_full_roads(built)
    site = Site(built.intersection, built.voxels.radius, depth=30.0, bodies=built.statics)
    note(
        f"the pole at ({x:.1f}, {y:.1f}) carries no sensor: {why}"
        for x, y in own
        if (why := site.why_none(np.array([x, y])))
    )
    if save:
        save = claims.keep(partial(save_scene, built), save)
        out.print(f"saved {save}")
    if plot:
        save_figure(scene_view(built), plot)
        out.print(f"drew {plot}")


@app.command()
def layout(
    source: SceneArgument = DEFAULT_SCENE,
    strategy: Annotated[
        str,
        typer.Option(help="Cam-c, Cam-d1, Cam-d2, L-c, L-d1, L-d2, or a pair such as Cam-c/L-c."),
    ] = DEFAULT_LAYOUT,
    camera: Annotated[str | None, typer.Option(help="Camera device; see `inspe devices`.")] = None,
    lidar: Annotated[str | None, typer.Option(help="LiDAR device; see `inspe devices`.")] = None,
    profile: ProfileOption = None,
    save: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.yaml", help="Save the layout.")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Place sensors on a scene by one of the paper's strategies.

    Examples:

    - `inspe layout four_way --strategy Cam-d1/L-d1 --out layout.yaml`
    - `inspe layout j189.npz --strategy L-c --lidar ouster-os1-128`
    """
    from inspe_jax.mounting.strategies import strategy as place
    from inspe_jax.report.scene_tables import layout_table
    from inspe_jax.scene.scene import load_scene
    from inspe_jax.sensing.catalogue import device
    from inspe_jax.sensing.layout import save_layout

    devices: dict[str, Any] = {
        k: v for k, v in dict(camera=camera, lidar=lidar).items() if v is not None
    }
    claims.file(save, (".yaml", ".yml"), force=force)
    check_layout(strategy)
    for name in devices.values():
        device(name)
    placed = place(load_scene(source, profile), strategy, **devices)
    out.print(layout_table(placed))
    if save:
        save_layout(placed, save)
        out.print(f"saved {save}")


def _refuse(what: str, why: str, options: Sequence[str]) -> None:
    """Raise InspeError that names the options that are given and cannot be, if any."""
    if options:
        names = ", ".join(f"--{name}" for name in options)
        raise InspeError(f"{what}: {why}; leave out {names}")


@app.command()
def examples(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="An existing folder for the files.")
    ] = Path(),
) -> None:
    """Write the example files of the README: two maps, poles, and a log of traffic.

    Their places are made up. A file that is there already stays as it is.

    Examples:

    - `inspe examples`
    """
    import gzip
    from importlib.resources import files

    from inspe_jax.core.files import whole_file

    for item in sorted(files("inspe_jax.scene").joinpath("examples").iterdir(), key=str):
        path, content = folder / item.name.removesuffix(".gz"), item.read_bytes()
        if path.exists():
            out.print(f"kept {path}: it is there already")
            continue
        with whole_file(path) as file:
            file.write(gzip.decompress(content) if item.name.endswith(".gz") else content)
        out.print(f"wrote {path}")


def _degrees(text: str) -> tuple[float, float]:
    """The latitude and longitude of ``--at``. Raises InspeError for any other text."""
    try:
        lat, lon = (float(part) for part in text.split(","))
    except ValueError:
        raise InspeError(f"--at {text}: write LAT,LON, such as 48.137,11.575") from None
    return lat, lon


def _warn_of_full_roads(built: "Scene") -> None:
    """Print a note if the traffic has less than was asked for."""
    if short := built.shortfall:
        err.print(f"[yellow]Note:[/] road users: {short}; a larger radius holds more")


def _list_places(source: str) -> None:
    from inspe_jax.report.scene_tables import built_ins_table, junctions_table
    from inspe_jax.scene.maps.registry import georeference_of, is_map, list_junctions

    if is_map(source):
        with busy(f"reading {source}"):
            found, georeference = list_junctions(source), georeference_of(source)
        out.print(junctions_table(found, Path(source).name, georeference))
        return
    known(source)
    out.print(built_ins_table())
