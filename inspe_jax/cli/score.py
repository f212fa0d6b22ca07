"""Scores: `inspe score`, `targets`, `tolerance`, `metrics`, `devices` and `profiles`."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group

from inspe_jax.cli import common
from inspe_jax.cli.claims import claims
from inspe_jax.cli.options import DetectionOptions, ScoreOptions, command
from inspe_jax.core.errors import check_known
from inspe_jax.placement.problem import Case
from inspe_jax.placement.studies.tolerance import check_errors
from inspe_jax.placement.studies.tolerance import tolerance as installed
from inspe_jax.scene.profiles import profiles as known_profiles
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.detection import BANDS, EDITION
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing import catalogue


@command()
def score(
    source: str = common.DEFAULT_SCENE,
    sensors: str = common.DEFAULT_LAYOUT,
    *,
    record: str | None = None,
    plot: Path | None = None,
    force: bool = False,
    options: ScoreOptions,
) -> None:
    """Score a layout on a scene: every metric, and their weighted sum P_sm.

    Examples:

    - `inspe score`  (the built-in four-way with cameras at its corners)
    - `inspe score roundabout Cam-c/L-c --plot roundabout.png`
    - `inspe score j189.npz layout.yaml --light night --weather rain:10 --json -`
    - `inspe score four_way --weight coverage=0.3 --weight occlusion=0.7`
    - `inspe score four_way L-d1 --metrics detectability,localisation`
    - `inspe score four_way L-d1 --weight detectability=1 --region crosswalk --road-user pedestrian`

    A layout that a search found says what it was searched for; that is scored too.
    """
    from inspe_jax.report.tables import blind_spots_table, scores_of, scores_record, scores_table

    claims.outputs(plot, record, force=force)
    conditions, objective = options.conditions, options.objective()
    world, placed = common.scene_and_layout(source, sensors, options.profile)
    case = Case(objective.within(world), conditions)
    with common.busy("scoring"):
        scores = scores_of(case, placed, objective)
        sought = options.sought(case, placed)
    tables = Group(scores_table(scores, placed, sought), "", blind_spots_table(case.scene, scores))
    common.show(tables, scores_record(scores, case.scene, placed, sought), record)

    def figure() -> Any:
        from inspe_jax.report.figures import plan_view

        return plan_view(case.scene, placed, scores)

    common.draw(figure, plot, record)


@command()
def targets(
    source: str = common.DEFAULT_SCENE,
    sensors: str = common.DEFAULT_LAYOUT,
    *,
    road_user: str = "pedestrian",
    edition: str = EDITION,
    record: str | None = None,
    plot: Path | None = None,
    force: bool = False,
    options: DetectionOptions,
) -> None:
    """Show what a road user gets at each place: LiDAR returns, and pixels per metre of the cameras.

    Returns are expected numbers, behind traffic, mean over its frames. Pixels per metre are those
    of the best camera without traffic, with the bands of IEC 62676-4.

    Examples:

    - `inspe targets four_way Cam-d1/L-d1 --plot targets.png`
    - `inspe targets j189.npz layout.yaml --road-user cyclist --weather fog:100 --json -`

    Args:
        road_user: Who stands there: car, truck, cyclist or pedestrian.
        edition: Edition of IEC 62676-4 with the bands: 2025 (overview to scrutinise) or 2015
            (monitor to identify).
    """
    from inspe_jax.report.targets import targets_record, targets_table, targets_view

    claims.outputs(plot, record, force=force)
    conditions, curves = options.conditions, options.curves()
    check_known(road_user, CLASSES, "road user")
    check_known(edition, BANDS, "edition")
    world, placed = common.scene_and_layout(source, sensors, options.profile)
    with common.busy("counting rays"):
        view = target_view(world, placed, road_user, conditions=conditions, detection=curves)
    found = targets_record(world, placed, view, edition)
    common.show(targets_table(found), found, record)
    placed = conditions.layout(placed)
    how: dict[str, Any] = dict(conditions=conditions, edition=edition)
    common.draw(lambda: targets_view(world, placed, view, **how), plot, record)


@command()
def tolerance(
    source: str = common.DEFAULT_SCENE,
    sensors: str = common.DEFAULT_LAYOUT,
    *,
    position: float = 0.1,
    angle: float = 1.0,
    samples: int = 50,
    seed: int = 0,
    record: str | None = None,
    force: bool = False,
    options: ScoreOptions,
) -> None:
    """Show how installation errors change the score: a slope for each sensor, and random errors.

    A slope says how much P_sm gains when one sensor is moved by 10 cm or turned by 1°. The scores
    after random errors are exact.

    Examples:

    - `inspe tolerance`  (the built-in four-way with cameras at its corners)
    - `inspe tolerance j189.npz better/layout.yaml --position 0.2 --angle 2`

    Args:
        position: Standard deviation of each of x, y and z [m].
        angle: Standard deviation of yaw and of pitch [degrees].
        samples: Number of random installations.
        seed: Seed of the random errors.
    """
    from inspe_jax.report.tables import tolerance_record, tolerance_table

    claims.file(record, force=force)
    objective = options.objective()
    turn = float(np.radians(angle))
    errors = dict[str, Any](position=position, angle=turn, samples=samples, seed=seed)
    check_errors(**errors)
    conditions = options.conditions
    world, placed = common.scene_and_layout(source, sensors, options.profile)
    with common.progress("installations") as report:
        case = Case(world, conditions)
        found = installed(case, placed, **errors, objective=objective, progress=report)
    common.show(tolerance_table(found, placed), tolerance_record(found, world, placed), record)


@command()
def metrics() -> None:
    """List the metrics of a layout's score: name, symbol, usual weight in P_sm, and meaning.

    Those without a usual weight are computed where they are asked for.

    Example: `inspe metrics`; then `inspe score --metrics detectability`.
    """
    from inspe_jax.report.tables import metrics_table

    common.out.print(metrics_table())


@command()
def devices() -> None:
    """List the cameras, LiDARs and radars of the catalogue, with the sources of their data.

    Example: `inspe devices`; in a layout file write `device: hesai-xt32`.
    """
    from inspe_jax.report.scene_tables import devices_table

    common.out.print(devices_table(catalogue.devices()))


@command()
def profiles() -> None:
    """List the profiles for building scenes: every value, and the reason for it.

    Example: `inspe profiles`; then `inspe score four_way L-d1 --profile ideal`.
    """
    from inspe_jax.report.scene_tables import profile_table

    for profile in known_profiles().values():
        common.out.print(profile_table(profile))
