"""Tables of what detectors find."""

from rich.table import Table

from inspe_jax.core.tables import table_of
from inspe_jax.perception.detections import Detections
from inspe_jax.perception.evaluation import Evaluation
from inspe_jax.perception.evaluation.metrics import DISTANCES
from inspe_jax.simulation.frame import KINDS

SHOWN = {"translation": "ATE [m]", "scale": "ASE", "orientation": "AOE [rad]"}
"""Errors in the table, by nuScenes' short names. One frame does not tell velocity."""


def evaluation_table(found: Evaluation, note: str = "") -> Table:
    """AP by class and distance, and the mean errors of what was found at 2 m; ``note`` ends the
    title."""
    table = table_of(
        f"mAP {found.mean_ap:.1%} of {found.frames:,} frames{note}",
        "class",
        "users",
        *(f"{distance:g} m" for distance in DISTANCES),
        "AP",
        *SHOWN.values(),
    )
    for row in found.rows():
        precisions = (row[f"ap_{distance:g}m"] for distance in DISTANCES)
        errors = (row[f"{name}_error"] for name in SHOWN)
        table.add_row(
            str(row["class"]),
            f"{row['road_users']:,}",
            *("–" if value == "" else f"{value:.1%}" for value in (*precisions, row["ap"])),
            *("–" if value == "" else f"{value:.2f}" for value in errors),
        )
    return table


def detections_table(found: Detections, least_score: float, note: str = "") -> Table:
    """The detections of a frame with at least a score, highest first; ``note`` ends the title."""
    columns = "class", "score", "x, y [m]", "length × width × height [m]"
    table = table_of(f"Detections{note}", *columns)
    for n in (-found.score).argsort(kind="stable"):
        if found.score[n] >= least_score:
            x, y, _, *size = found.boxes[n][:6]
            sides = " × ".join(f"{side:.1f}" for side in size)
            table.add_row(KINDS[found.kind[n]], f"{found.score[n]:.2f}", f"{x:.1f}, {y:.1f}", sides)
    return table
