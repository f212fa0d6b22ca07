"""Scenes, layouts by rule, and scores: `inspe scene`, `layout`, `score`, `metrics` and `devices`.

Imports are inside the commands: the map readers and matplotlib load slowly.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    LayoutArgument,
    LightOption,
    PlotOption,
    ProfileOption,
    RecordOption,
    SceneArgument,
    WeatherOption,
    app,
    busy,
    check_record,
    err,
    known,
    out,
    progress,
    scene_and_layout,
    show,
)
from inspe_jax.cli.options import DetectionOption, WeightOptions, takes
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
    save: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.npz", help="Save the scene.")
    ] = None,
    plot: PlotOption = None,
) -> None:
    """Build a scene of one intersection: its region of interest, voxels and traffic.

    Examples:

    - `inspe scene roundabout --plot roundabout.png`
    - `inspe scene MAP.xodr --list`
    - `inspe scene MAP.xodr --junction 189 --radius 50 --density medium --out j189.npz`
    - `inspe scene town.net.xml --junction 189 --traffic sumo --out j189.npz`
    - `inspe scene city.osm --junction 1 --statics map --out city.npz`
    - `inspe scene Town01.xodr --junction 54 --traffic run.log --step 0.1 --frames 200`
    - `inspe scene j189.npz --plot j189.png`
    """
    from inspe_jax.core.files import check_output
    from inspe_jax.report.figures import scene_view
    from inspe_jax.report.scene_tables import scene_table
    from inspe_jax.report.sheet import FORMATS, save_figure
    from inspe_jax.scene.maps.registry import is_map, read_map
    from inspe_jax.scene.procedural.built_ins import built_in
    from inspe_jax.scene.profiles import DEFAULT_PROFILE, profile_of
    from inspe_jax.scene.scene import (
        SCENE_SUFFIXES,
        build_scene,
        load_scene,
        save_scene,
    )
    from inspe_jax.scene.traffic.carla_log import LOG_SUFFIXES
    from inspe_jax.scene.traffic.registry import traffic_model

    if list_:
        _list_places(source)
        return
    check_output(save, SCENE_SUFFIXES)
    check_output(plot, FORMATS)
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
        ).items()
        if value is not None
    }
    path = Path(source)
    if path.suffix == ".npz":
        places = dict(junction=junction, center=center)
        given = [*options, *(name for name, value in places.items() if value is not None)]
        if given:
            raise InspeError(
                f"{source}: a saved scene keeps the settings it was built with; leave out "
                + ", ".join(f"--{name}" for name in given)
            )
        built = load_scene(source)
    else:
        if traffic is not None and traffic.endswith(LOG_SUFFIXES):
            own = [name for name in ("density", "mix", "seed") if name in options]
            if own:
                raise InspeError(
                    f"--traffic {traffic}: a log has traffic of its own; leave out "
                    + ", ".join(f"--{name}" for name in own)
                )
        elif traffic is not None:
            traffic_model(traffic)
        if is_map(path):
            if (junction is None) == (center is None):
                raise InspeError(
                    f"{source}: choose a place on the map with --junction ID or --center X Y; "
                    "--list shows the junctions"
                )
            size = profile_of(profile or DEFAULT_PROFILE).of_scene(radius=radius)["radius"]
            with busy(f"reading {path.name}"):
                place = read_map(path, junction=junction, center=center, radius=size)
        else:
            if junction is not None or center is not None:
                raise InspeError(f"{source}: --junction and --center are only for maps")
            place = built_in(known(source))
        with progress("traffic") as report:
            built = build_scene(place, **options, progress=report)
    out.print(scene_table(built))
    _warn_of_full_roads(built)
    if save:
        save_scene(built, save)
        out.print(f"saved {save}", highlight=False)
    if plot:
        save_figure(scene_view(built), plot)
        out.print(f"drew {plot}", highlight=False)


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
) -> None:
    """Place sensors on a scene by one of the paper's strategies.

    Examples:

    - `inspe layout four_way --strategy Cam-d1/L-d1 --out layout.yaml`
    - `inspe layout j189.npz --strategy L-c --lidar ouster-os1-128`
    """
    from inspe_jax.core.files import check_output
    from inspe_jax.placement.strategies import strategy as place
    from inspe_jax.report.scene_tables import layout_table
    from inspe_jax.scene.scene import load_scene
    from inspe_jax.sensing.layout import save_layout

    devices: dict[str, Any] = {
        k: v for k, v in dict(camera=camera, lidar=lidar).items() if v is not None
    }
    check_output(save, (".yaml", ".yml"))
    placed = place(load_scene(source, profile), strategy, **devices)
    out.print(layout_table(placed))
    if save:
        save_layout(placed, save)
        out.print(f"saved {save}", highlight=False)


@app.command()
@takes(WeightOptions)
def score(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    record: RecordOption = None,
    plot: PlotOption = None,
    occlusion_reference: Annotated[
        str | None,
        typer.Option(
            help="The voxels that occlusion is measured on: roi, covered or targets; the profile's "
            "if not given."
        ),
    ] = None,
    visibility: Annotated[
        str | None,
        typer.Option(
            help="What information gain takes as visible: in_view, line_of_sight or past_others; "
            "the profile's if not given."
        ),
    ] = None,
    light: LightOption = "midday",
    weather: WeatherOption = "clear",
    profile: ProfileOption = None,
    *,
    options: WeightOptions,
) -> None:
    """Score a layout on a scene: every metric, and their weighted sum P_sm.

    Examples:

    - `inspe score`  (the built-in four-way with cameras at its corners)
    - `inspe score roundabout Cam-c/L-c --plot roundabout.png`
    - `inspe score j189.npz layout.yaml --json -`
    - `inspe score j189.npz layout.yaml --light night --weather rain:10`
    - `inspe score four_way L-d1 --profile ideal`
    - `inspe score four_way --weight coverage=0.3 --weight occlusion=0.7`
    - `inspe score four_way L-d1 --metrics detectability,localisation`
    - `inspe score four_way L-d1 --metrics detectability --detection mine.toml`
    """
    from inspe_jax.core.files import check_output
    from inspe_jax.report.figures import plan_view
    from inspe_jax.report.sheet import FORMATS, save_figure
    from inspe_jax.report.tables import scores_record, scores_table
    from inspe_jax.scoring.evaluate import evaluate
    from inspe_jax.sensing.conditions import Conditions

    check_output(plot, FORMATS)
    check_record(record)
    conditions, weights = Conditions.of(light, weather), options.weights()
    further, curves = options.further(), options.curves()
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, profile)
    with busy("scoring"):
        scores = evaluate(
            world,
            placed,
            weights=weights,
            occlusion_reference=occlusion_reference,
            visibility=visibility,
            conditions=conditions,
            metrics=further,
            detection=curves,
        )
    show(scores_table(scores, placed), scores_record(scores, world, placed), record)
    if plot:
        save_figure(plan_view(world, placed, scores), plot)
        (err if record == "-" else out).print(f"drew {plot}", highlight=False)


@app.command()
def targets(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: LayoutArgument = DEFAULT_LAYOUT,
    road_user: Annotated[
        str, typer.Option(help="Who stands there: car, truck, cyclist or pedestrian.")
    ] = "pedestrian",
    record: RecordOption = None,
    plot: PlotOption = None,
    light: LightOption = "midday",
    weather: WeatherOption = "clear",
    profile: ProfileOption = None,
    detection: DetectionOption = None,
) -> None:
    """Show what a road user gets at each place: LiDAR returns, and pixels per metre of the cameras.

    Returns are expected numbers, behind traffic, mean over its frames. Pixels per metre are those
    of the best camera without traffic, with the bands of EN 62676-4.

    Examples:

    - `inspe targets four_way L-d1`
    - `inspe targets four_way Cam-d1/L-d1 --plot targets.png`
    - `inspe targets j189.npz layout.yaml --road-user cyclist --weather fog:100 --json -`
    """
    from inspe_jax.core.files import check_output
    from inspe_jax.report.sheet import FORMATS, save_figure
    from inspe_jax.report.targets import targets_record, targets_table, targets_view
    from inspe_jax.scoring.detection import load_detection
    from inspe_jax.scoring.targets import target_view
    from inspe_jax.sensing.conditions import Conditions

    check_output(plot, FORMATS)
    check_record(record)
    conditions = Conditions.of(light, weather)
    curves = None if detection is None else load_detection(detection)
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, profile)
    with busy("counting rays"):
        view = target_view(world, placed, road_user, conditions=conditions, detection=curves)
    show(targets_table(world, placed, view), targets_record(world, placed, view), record)
    if plot:
        save_figure(targets_view(world, conditions.layout(placed), view), plot)
        (err if record == "-" else out).print(f"drew {plot}", highlight=False)


@app.command()
def metrics() -> None:
    """List the metrics of a layout's score: name, symbol, usual weight in P_sm, and meaning.

    Those without a usual weight are computed where they are asked for.

    Example: `inspe metrics`; then `inspe score --metrics detectability`.
    """
    from inspe_jax.report.tables import metrics_table

    out.print(metrics_table())


@app.command()
def devices() -> None:
    """List the cameras and LiDARs of the catalogue, with the sources of their data.

    Example: `inspe devices`; in a layout file write `device: hesai-xt32`.
    """
    from inspe_jax.report.scene_tables import devices_table
    from inspe_jax.sensing.catalogue import devices as catalogue

    out.print(devices_table(catalogue()))


@app.command()
def profiles() -> None:
    """List the profiles for building scenes: every value, and the reason for it.

    Example: `inspe profiles`; then `inspe score four_way L-d1 --profile ideal`.
    """
    from inspe_jax.report.scene_tables import profile_table
    from inspe_jax.scene.profiles import profiles as known

    for profile in known().values():
        out.print(profile_table(profile))


def _warn_of_full_roads(built: "Scene") -> None:
    """Print a note if the traffic has less than was asked for."""
    if short := built.shortfall:
        err.print(f"[yellow]Note:[/] road users: {short}; a larger radius holds more")


def _list_places(source: str) -> None:
    from inspe_jax.report.scene_tables import built_ins_table, junctions_table
    from inspe_jax.scene.maps.registry import is_map, list_junctions

    if is_map(source):
        with busy(f"reading {source}"):
            found = list_junctions(source)
        out.print(junctions_table(found, Path(source).name))
        return
    known(source)
    out.print(built_ins_table())
