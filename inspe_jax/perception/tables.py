"""Tables of what detectors find."""

from rich.table import Table

from inspe_jax.core.tables import table_of
from inspe_jax.perception.detections import Detections
from inspe_jax.perception.evaluation import DISTANCES, Evaluation
from inspe_jax.simulation.frame import KINDS


def evaluation_table(found: Evaluation, note: str = "") -> Table:
    """AP by class and distance; ``note`` ends the title."""
    table = table_of(
        f"mAP {found.mean_ap:.1%} of {found.frames:,} frames{note}",
        "class",
        "users",
        *(f"{distance:g} m" for distance in DISTANCES),
        "AP",
    )
    for row in found.rows():
        precisions = (row[f"ap_{distance:g}m"] for distance in DISTANCES)
        table.add_row(
            str(row["class"]),
            f"{row['road_users']:,}",
            *("–" if value == "" else f"{value:.1%}" for value in (*precisions, row["ap"])),
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
