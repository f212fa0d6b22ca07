"""See it: `inspe report`.

Imports stay inside the commands, as of the browser's library and matplotlib.
"""

from pathlib import Path
from typing import Annotated

import typer

from inspe_jax.cli.common import (
    DEFAULT_LAYOUT,
    DEFAULT_SCENE,
    LightOption,
    SceneArgument,
    WeatherOption,
    app,
    busy,
    layout_on,
    out,
    progress,
)
from inspe_jax.cli.options import WeightsOption


@app.command()
def report(
    source: SceneArgument = DEFAULT_SCENE,
    sensors: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[LAYOUT]…", help="Layouts side by side: .yaml files, or strategies by name."
        ),
    ] = None,
    path: Annotated[
        Path, typer.Option("--out", metavar="FILE.html", help="The page that is written.")
    ] = Path("report.html"),
    pdf: Annotated[
        Path | None, typer.Option(metavar="FILE.pdf", help="Write the figures as a PDF, too.")
    ] = None,
    tolerance: Annotated[
        bool,
        typer.Option(help="Say how carefully to install each layout; compiles for half a minute."),
    ] = False,
    frame: Annotated[int, typer.Option(help="Frame of the traffic that is drawn.")] = 0,
    weights: WeightsOption = (0.3, 0.5, 0.2),
    light: LightOption = "midday",
    weather: WeatherOption = "clear",
) -> None:
    """Write a page to hand on: scores side by side, maps, the scene in three dimensions.

    One HTML file that opens without a network. The numbers are those of `inspe score`.

    Examples:

    - `inspe report`  (the built-in four-way with cameras at its corners)
    - `inspe report j189.npz start.yaml better/layout.yaml --tolerance --out j189.html`
    - `inspe report roundabout Cam-d1 L-d1 Cam-d1/L-d1 --light night --pdf roundabout.pdf`
    """
    from inspe_jax.evaluation import evaluate
    from inspe_jax.files import check_output, whole_file, write_text
    from inspe_jax.placement.problem import Case, Objective
    from inspe_jax.placement.tolerance import tolerance as installed
    from inspe_jax.report.page import Entry, check_names, report_page, report_sheets
    from inspe_jax.scene.scene import load_scene
    from inspe_jax.sensing.conditions import Conditions
    from inspe_jax.sensing.visibility import check_frame
    from inspe_jax.viewshed import viewshed

    check_output(path, (".html", ".htm"))
    check_output(pdf, (".pdf",))
    conditions = Conditions.of(light, weather)
    with busy(f"reading {source}"):
        world = load_scene(source)
        check_frame(world, frame)
        placed = [layout_on(world, given) for given in sensors or [DEFAULT_LAYOUT]]
    check_names([layout.name for layout in placed])
    entries = []
    for layout in placed:
        with busy(f"scoring {layout.name}"):
            scores = evaluate(world, layout, weights=weights, conditions=conditions)
            shed = viewshed(world, layout, conditions=conditions)
        slopes = None
        if tolerance:
            with progress(f"installations of {layout.name}") as tell:
                slopes = installed(
                    Case(world, conditions),
                    layout,
                    objective=Objective(weights=weights),
                    progress=tell,
                )
        entries.append(Entry(layout, scores, shed, slopes))
    with progress("drawing") as tell:
        page = report_page(world, entries, frame=frame, progress=tell)
    write_text(path, page)
    for entry in entries:
        out.print(f"{entry.layout.name}: P_sm {entry.scores.surrogate:.4f}", highlight=False)
    out.print(f"wrote {path}, {path.stat().st_size / 2**20:.1f} MB", highlight=False)
    if pdf:
        with busy("drawing"):
            sheets = report_sheets(world, entries, frame=frame)
        with whole_file(pdf) as f:
            f.write(sheets)
        out.print(f"drew {pdf}", highlight=False)
