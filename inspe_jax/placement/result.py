"""The result of a search, also as files: the layout, its scores before and after, its history."""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import (
    check_input,
    csv_text,
    json_value,
    prepare_folder,
    read_csv,
    read_json,
    write_text,
)
from inspe_jax.core.records import Described
from inspe_jax.placement.run import Progress
from inspe_jax.scoring.evaluate import Contribution, Scores
from inspe_jax.sensing.layout import Layout, load_layout, save_layout

FORMAT = "inspe_jax result 4"
FILES = ("layout.yaml", "start.yaml", "result.json", "history.csv", "path.csv")
"""The files of a result: the layout that was found, the start, the record, all exact scores, and
the poses of every layout that was the best so far."""
STATUSES = {
    "converged": "the method could not improve the layout any more",
    "budget spent": "the budget in seconds or evaluations was used up",
    "interrupted": "it was stopped by hand",
    "target reached": "the layout is as good as was asked for",
}
"""How a search can end, and what that means."""


@dataclass(frozen=True, eq=False, repr=False)  # arrays inside: identity is equality
class Result(Described):
    """The outcome of a search.

    ``layout``: the best layout found; it is feasible, and never worse than the start.
    ``start``: the feasible layout that the search began with.
    ``scores_before``, ``scores``: exact scores of both on the first scene. Their ``surrogate`` is
    the objective if that is P_sm on one scene.
    ``objective_before``, ``objective``: the exact objective of both.
    ``history``: every exact score of the search.
    ``path`` (K, S, 6): world poses of every layout that was the best so far, from those of the
    start to those of ``layout``.
    ``evaluations``, ``seconds``: the work of the search in exact scores, and its wall time; both
    without the scores before and after.
    ``status``: one of :data:`STATUSES`.
    ``settings``, ``seed``, ``versions``: what is needed to repeat the search.
    ``notes``: what a person should know about it.
    """

    layout: Layout
    start: Layout
    scores_before: Scores
    scores: Scores
    objective_before: float
    objective: float
    history: tuple[Progress, ...]
    path: Float[np.ndarray, "K S 6"]
    evaluations: float
    seconds: float
    status: str
    method: str
    seed: int
    settings: dict[str, Any]
    versions: dict[str, str]
    notes: tuple[str, ...] = ()

    def _facts(self) -> dict[str, Any]:
        return {
            "layout": self.layout.name,
            "objective": f"{self.objective:.4f} after {self.objective_before:.4f}",
            "method": self.method,
            "status": self.status,
            "work": f"{self.evaluations:.0f} exact scores in {self.seconds:.1f} s",
        }


def save_result(result: Result, folder: str | os.PathLike[str]) -> None:
    """Write a result's files, :data:`FILES`. A file is never left incomplete.

    :func:`load_result` reads everything back except ``seen_share``. Raises InspeError if the folder
    cannot be written, or as :func:`~inspe_jax.sensing.layout.save_layout` does.

    >>> result = inspe_jax.optimise(scene, layout, "random", evaluations=2)
    >>> inspe_jax.save_result(result, "found")
    >>> inspe_jax.load_result("found").method
    'random'
    """
    place = prepare_folder(folder)
    save_layout(result.layout, place / "layout.yaml")
    save_layout(result.start, place / "start.yaml")
    record = {"format": FORMAT, **vars(result)}
    for name in ("layout", "start", "history", "path"):  # have files of their own
        del record[name]
    for name in _SCORES:
        record[name] = replace(record[name], seen_share=np.zeros(0))
    write_text(place / "result.json", json.dumps(json_value(record), indent=2) + "\n")
    write_text(place / "history.csv", csv_text([asdict(row) for row in result.history]))
    write_text(place / "path.csv", csv_text(_path_rows(result)))


def load_result(folder: str | os.PathLike[str]) -> Result:
    """Read what :func:`save_result` wrote.

    ``seen_share`` of the scores is not saved, and is empty; to have it, score the layout on its
    scene again. Raises InspeError if a file is missing, or is not a file of a result.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InspeError(f"{place}: no such folder")
    record = read_json(place / "result.json")
    other = f"{place}: not a result saved by this package"
    written = str(record.pop("format", "")) if isinstance(record, dict) else ""
    if written != FORMAT:  # first: a result of another version may lack other files
        if written.startswith(FORMAT.rstrip("0123456789")):
            other = f"{place}: a result of another version of inspe_jax; run the search again"
        raise InspeError(other)
    for name in FILES:
        check_input(place / name)
    layout, start = (load_layout(place / name) for name in FILES[:2])
    try:
        for key in _SCORES:
            of = record[key]
            of["contributions"] = tuple(Contribution(**row) for row in of["contributions"])
            record[key] = Scores(**of | {"seen_share": np.array(of["seen_share"], float)})
        record["notes"] = tuple(record["notes"])
        history = tuple(
            Progress(**{key: float(value) for key, value in row.items()})
            for row in read_csv(place / "history.csv")
        )
        poses = [[float(row[key]) for key in _POSE] for row in read_csv(place / "path.csv")]
        path = np.array(poses, float).reshape(-1, len(layout), 6)
        path[..., 3:] = np.radians(path[..., 3:])
        return Result(layout=layout, start=start, history=history, path=path, **record)
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise InspeError(other) from e


def save_comparison(results: Sequence[Result], folder: str | os.PathLike[str]) -> None:
    """Write the results of several searches, their histories, and the best layout.

    ``compare.csv`` has one row for each search, ``history.csv`` one for each exact score;
    ``layout.yaml`` is the best layout. Raises InspeError as :func:`save_result` does.
    """
    place = prepare_folder(folder)
    best = max(results, key=lambda result: result.objective)
    save_layout(best.layout, place / "layout.yaml")
    ends = ("status", "objective_before", "objective", "evaluations", "seconds")
    rows = [_of(result) | {name: getattr(result, name) for name in ends} for result in results]
    write_text(place / "compare.csv", csv_text(rows))
    steps = [_of(result) | asdict(row) for result in results for row in result.history]
    write_text(place / "history.csv", csv_text(steps))


_SCORES = ("scores_before", "scores")
_POSE = ("x", "y", "z", "roll_deg", "pitch_deg", "yaw_deg")


def _path_rows(result: Result) -> list[dict[str, Any]]:
    """One row for each sensor of every layout that was the best so far."""
    best = np.array([row.best for row in result.history])
    better = np.flatnonzero(np.diff(best, prepend=-np.inf) > 0)
    rows = []
    # Ctrl-C can come between a score and its row.
    for k, poses in zip(better, result.path, strict=False):
        at = {"seconds": result.history[k].seconds, "score": result.history[k].score}
        for sensor, pose in zip(result.layout.sensors, poses, strict=True):
            values = np.append(pose[:3], np.degrees(pose[3:])).round(9).tolist()
            rows.append(at | {"sensor": sensor.name} | dict(zip(_POSE, values, strict=True)))
    return rows


def _of(result: Result) -> dict[str, Any]:
    return {"method": result.method, "seed": result.seed}
