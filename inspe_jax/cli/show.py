"""What is handed on or shown: `inspe report`, `view` and `export`."""

import signal
import time
from dataclasses import replace
from pathlib import Path
from socket import gethostname
from typing import Annotated

import typer

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import ScoreOptions, WeightOptions, command, prices
from inspe_jax.core.files import check_output, write_text
from inspe_jax.placement.problem import Case
from inspe_jax.placement.result import load_result
from inspe_jax.scene.scene import load_scene
from inspe_jax.sensing.layout import layout_text
from inspe_jax.visibility.queries import check_frame


@command()
def report(
    source: str = common.DEFAULT_SCENE,
    sensors: list[str] | None = None,
    *,
    path: Path = Path("report.html"),
    frame: int = 0,
    price: list[str] | None = None,
    force: bool = False,
    options: ScoreOptions,
) -> None:
    """Write a page to hand on: what is mounted where and what it costs, scores side by side, blind
    spots, maps, and the scene in three dimensions.

    The page is one HTML file that needs no network, and prints on A4. Its numbers are those of
    `inspe score`.

    Examples:

    - `inspe report`  (the built-in four-way with cameras at its corners)
    - `inspe report j189.npz start.yaml better --out j189.html`  (`better` is a folder of
      `inspe optimise`)
    - `inspe report roundabout Cam-d1 L-d1 Cam-d1/L-d1 --light night`

    Args:
        sensors (LAYOUT): Layouts to show side by side: .yaml files, names of strategies, or
            folders of `inspe optimise`, for which the page also shows the search.
        path (--out FILE.html): File of the page.
        frame: Number of the frame of traffic that is drawn.
    """
    from inspe_jax.report.page import check_names, report_entry, report_page
    from inspe_jax.report.tables import goal_words
    from inspe_jax.viewer.page_views import VIEWS

    claims.file(path, (".html", ".htm"), force=force)
    conditions, objective = options.conditions, options.objective()
    priced = prices(price)
    wanted = sensors or [common.DEFAULT_LAYOUT]
    for given in wanted:
        if not Path(given).is_dir():
            common.check_layout(given)
    with common.busy(f"reading {source}"):
        world = objective.within(load_scene(source, options.profile))
        check_frame(world, frame)
        found = [load_result(given) if Path(given).is_dir() else None for given in wanted]
        placed = [
            (one.layout if one else common.layout_on(world, given), one)
            for given, one in zip(wanted, found, strict=True)
        ]
    case = Case(world, conditions)
    check_names([layout.name for layout, _ in placed])
    entries = []
    for layout, result in placed:
        with common.busy(f"scoring {layout.name}"):
            entry = report_entry(case, layout, objective, result)
            entry = replace(entry, sought=options.sought(case, layout))
        entries.append(entry)
    with common.progress("drawing") as tell:
        page = report_page(world, entries, prices=priced, frame=frame, views=VIEWS, progress=tell)
    path = claims.keep(lambda at: write_text(at, page), path)
    for entry in entries:
        common.out.print(goal_words(entry.layout, entry.scores, entry.sought))
    common.out.print(f"wrote {path}, {path.stat().st_size / 1e6:.1f} MB")


@command()
def view(
    source: str = common.DEFAULT_SCENE,
    sensors: str = common.DEFAULT_LAYOUT,
    *,
    path: Path = Path("viewed.yaml"),
    port: Annotated[int, typer.Option(min=0, max=65000)] = 8080,
    options: WeightOptions,
) -> None:
    """Serve a page on which you drag sensors and see the scores follow.

    A sensor snaps to the nearest place where it can be mounted. Unsaved changes are kept in a file
    beside the layout. A file of an earlier run is not replaced without asking. Only this machine
    can open the page; another one can through the tunnel that is printed. The address contains a
    secret: everyone on this machine who has it can change and save the layout. It stays the same
    for the same --out. Ctrl-C ends the server.

    Examples:

    - `inspe view`  (the built-in four-way with cameras at its corners)
    - `inspe view j189.npz layout.yaml --out better.yaml --light night`
    - `inspe view roundabout Cam-d1/L-d1 --port 9000`

    Args:
        path (--out FILE.yaml): File in which the layout is saved.
        port: Port; if it is taken, the next free one is used.
    """
    from inspe_jax.viewer.app import Viewer
    from inspe_jax.viewer.server import kept_token

    check_output(path, (".yaml", ".yml"))
    conditions, objective = options.conditions, options.objective()
    world, layout = common.scene_and_layout(source, sensors, options.profile, unit_rule=False)
    viewer = Viewer(
        Case(world, conditions),
        layout,
        path,
        objective=objective,
        token=kept_token(str(path.resolve())),  # a page that is open gets in to the next server
        port=port,
    )
    try:
        if port not in (0, viewer.port):
            common.note(f"port {port} is not available: using {viewer.port}")
        common.out.print(f"open {viewer.url}")
        tunnel = f"ssh -L {viewer.port}:localhost:{viewer.port} {gethostname()}"
        common.out.print(f"only this machine can open it; on another one, first {tunnel}")
        for earlier in viewer.store.earlier:
            words = "is of an earlier run: the page offers to open it, and does not replace it"
            common.note(f"{earlier} {words}")
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        common.out.print("Ctrl-C ends")
        while True:
            time.sleep(1)  # a signal that another thread gets is noticed only after it
    except KeyboardInterrupt:
        for again in (signal.SIGINT, signal.SIGTERM):
            signal.signal(again, lambda *_: common.leave_at_once(1))
        with common.busy("ending"):
            viewer.close(wait=False)
    except BaseException:
        viewer.close()
        raise
    if not viewer.store.holds(viewer.layout):
        common.out.print(viewer.store.words(viewer.layout))
        if viewer.store.kept(viewer.layout) is None:
            common.out.print("so it is printed here:", layout_text(viewer.layout), sep="\n")
            common.leave_at_once(1)
    common.leave_at_once(0)


@command()
def export(
    source: str,
    sensors: str,
    *,
    files: list[Path] | None = None,
    price: list[str] | None = None,
    force: bool = False,
) -> None:
    """Write a plan in coordinates of the Earth, for maps, surveyors and contractors.

    GeoJSON and KML need a scene of a map with a projection, as OpenStreetMap; JSON and CSV do not.
    Degrees are those of WGS 84; azimuths are clockwise from true north; heights are above the
    ground at the foot of the pole. The GeoJSON can be edited in a map and read back in place of a
    layout file.

    Examples:

    - `inspe export city.npz better/layout.yaml --out plan.geojson --out plan.kml`
    - `inspe export city.npz Cam-d1/L-d1 --out bill.csv --price paper-camera=900`
    - `inspe score city.npz plan.geojson`  (reads it back)
    - `inspe export city.npz better/layout.yaml --out calibration.json`

    Args:
        files (--out FILE.geojson|kml|json|csv): A file to write; repeat it for more. GeoJSON and
            KML: poles, sensors with height, azimuth and tilt, and what each looks at. JSON: a
            calibration, which `inspe layout --from` reads. CSV: a bill of materials. If not given,
            plan.geojson.
    """
    from inspe_jax.report.handover import PLAN_FORMATS

    given = prices(price)
    paths = files or [Path("plan.geojson")]
    for path in paths:
        claims.file(path, PLAN_FORMATS, force=force)
    world, placed = common.scene_and_layout(source, sensors, None)
    texts = [PLAN_FORMATS[p.suffix.lower()](placed, world.intersection, given) for p in paths]
    place = world.intersection
    if place.georeference and (doubt := place.georeference.doubt(place.center)):
        common.note(doubt)
    for path, text in zip(paths, texts, strict=True):
        write_text(path, text)
        common.out.print(f"wrote {path}")
