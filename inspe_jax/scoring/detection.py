"""How likely a detector finds a road user, by the LiDAR returns or the pixels on it, or by the
strength of its echo to a radar (:mod:`inspe_jax.scoring.radar_evidence`).

The chance is a logistic function of the logarithm of the number:

    g(n) = most / (1 + (half / n)^slope).

``detection.toml`` has the usual curves by kind of sensor and class of road user, with sources.
"""

import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float
from pydantic import BaseModel, create_model

from inspe_jax.core.errors import InspeError, check_known, error_at
from inspe_jax.core.files import STRICT, check_model, check_output, read_json, read_toml, write_text
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.sensing.kinds import SENSOR_KINDS

BANDS: dict[str, dict[str, float]] = {
    "2025": {
        "overview": 20.0,
        "outline": 40.0,
        "discern": 80.0,
        "perceive": 125.0,
        "characterise": 250.0,
        "validate": 500.0,
        "scrutinise": 1500.0,
    },
    "2015": {
        "monitor": 12.5,
        "detect": 25.0,
        "observe": 62.5,
        "recognise": 125.0,
        "identify": 250.0,
    },
}
"""Least pixels per metre across a target for each task of an operator, by edition of EN and IEC
62676-4: that of October 2025 and the one before it (jvsg.com/?p=11243 has the numbers of both)."""
EDITION = "2025"
DETECT = BANDS["2015"]["detect"]  # pixels per metre that the metric asks for

FEW = 5.0
"""Fewer LiDAR returns on a target than this are called few: a convention."""

NONE = 1e-6
"""Fewer returns or pixels than this are none."""
_FEWEST = 30  # boxes that three numbers are fitted to
_BOUNDS = (0.5, 0.9999), (0.1, 1e6), (0.2, 10.0)


@dataclass(frozen=True)
class DetectionCurve:
    """The chance that a target is found, by the number of returns or pixels on it.

    ``most`` is the chance with very many, ``half`` the number at which it is half of that, and
    ``slope`` that of the logistic function.
    """

    most: float
    half: float
    slope: float

    def __post_init__(self) -> None:  # safe: it is not a pytree, so only users create it
        if not (0 < self.most <= 1 and self.half > 0 and self.slope > 0):
            raise InspeError(
                f"detection curve with most {self.most:g}, half {self.half:g} and slope "
                f"{self.slope:g}: most is in 0 … 1, and none is 0 or negative"
            )

    def chance(self, number: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """g(n), of expected numbers n ≥ 0. Its slope in n is finite everywhere, also at 0.

        >>> curve = inspe_jax.DetectionCurve(most=0.9, half=8.0, slope=1.5)
        >>> round(float(curve.chance(np.float32(8.0))), 2)
        0.45
        """
        share, some = jnp.maximum(number, NONE) / self.half, number > NONE
        if self.slope in (1.0, 1.5):  # without a logarithm
            power = share if self.slope == 1.0 else share * jnp.sqrt(share)
            return jnp.where(some, self.most * (power / (1.0 + power)), 0.0)
        return jnp.where(some, self.most * jax.nn.sigmoid(self.slope * jnp.log(share)), 0.0)


Fitted = Mapping[tuple[str, str], DetectionCurve]
"""Curves by kind of sensor and class of road user, such as ("lidar", "car")."""


@dataclass(frozen=True)
class DetectionCurves:
    """One curve for each kind of sensor and each class of road user.

    ``by_kind`` has the kinds' names with a curve for each of
    :data:`~inspe_jax.scene.traffic.frames.CLASSES`, in that order. Metrics of what a detector gets
    are means over the classes named in ``road_users``, all of them if it is empty. Scores are
    compiled for the curves, so they are compared by value.
    """

    by_kind: tuple[tuple[str, tuple[DetectionCurve, ...]], ...]
    road_users: tuple[str, ...] = ()

    def for_road_users(self, names: Iterable[str]) -> "DetectionCurves":
        """These curves, with only these classes counted; all if none is named.

        Raises InspeError where a class is unknown.
        """
        names = tuple(names)
        for name in names:
            check_known(name, CLASSES, "road user")
        return replace(self, road_users=tuple(name for name in CLASSES if name in names))

    @property
    def counted(self) -> list[int]:
        """The classes that count, as indices of :data:`~inspe_jax.scene.traffic.frames.CLASSES`."""
        return [CLASSES.index(name) for name in self.road_users or CLASSES]

    def of(self, kind: str) -> tuple[DetectionCurve, ...]:
        """The curves of one kind of sensor, a curve for each class.

        Raises InspeError where there are none.
        """
        if (curves := dict(self.by_kind).get(kind)) is not None:
            return curves
        raise InspeError(
            f"detection: there are no curves for sensors of kind '{kind}'; give one for each of "
            f"{', '.join(CLASSES)} with detection=, as inspe_jax.load_detection reads them"
        )

    def with_curves(self, fitted: Fitted) -> "DetectionCurves":
        """These curves, with those of ``fitted`` in place of the ones of the same kind and class.

        Raises InspeError where a kind or a class is unknown, or a further kind lacks a class.
        """
        new = {kind: dict(zip(CLASSES, curves, strict=True)) for kind, curves in self.by_kind}
        for (kind, road_user), curve in fitted.items():
            check_known(kind, SENSOR_KINDS, "kind of sensor")
            check_known(road_user, CLASSES, "road user")
            new.setdefault(kind, {})[road_user] = curve
        for kind, of in new.items():
            if missing := [name for name in CLASSES if name not in of]:
                raise InspeError(f"{kind}: it has no curve for {', '.join(missing)}")
        by_kind = ((kind, tuple(of[name] for name in CLASSES)) for kind, of in new.items())
        return replace(self, by_kind=tuple(by_kind))

    @property
    def record(self) -> dict[str, dict[str, dict[str, float]]]:
        """The numbers of every curve by kind and class: the content of a file of curves."""
        return {
            kind: {name: asdict(curve) for name, curve in zip(CLASSES, curves, strict=True)}
            for kind, curves in self.by_kind
        }


@cache
def detection_curves() -> DetectionCurves:
    """The usual curves, from ``detection.toml``."""
    text = files("inspe_jax.scoring").joinpath("detection.toml").read_text("utf-8")
    kinds = tomllib.loads(text).items()
    return DetectionCurves(()).with_curves(
        {(kind, name): DetectionCurve(**row) for kind, of in kinds for name, row in of.items()}
    )


def _table(name: str, keys: Iterable[str], entry: Any) -> type[BaseModel]:
    """A model of a table in which each of ``keys`` is as ``entry``: a type, and its default."""
    fields: dict[str, Any] = dict.fromkeys(keys, entry)
    return create_model(name, __config__=STRICT, **fields)


SUFFIXES = (".toml", ".json")
"""What the name of a file of curves ends in."""


def load_detection(path: str | os.PathLike[str]) -> DetectionCurves:
    """Curves from a TOML or JSON file: a table for each kind of sensor and class of road user.

    Its form is that of ``scoring/detection.toml``::

        [lidar.pedestrian]
        most = 0.93     # chance with very many returns or pixels, above 0 and at most 1
        half = 8.0      # number at which the chance is half of that
        slope = 1.5     # of the logistic function of its logarithm

    Where the file has no curve for a kind and class, the usual one stays. Raises InspeError, which
    names the file and the key, where the file is missing or holds anything else, or no curve.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InspeError(
            f"{path}: curves of detection are in a file ending {' or '.join(SUFFIXES)}"
        )
    curve = _table("_CurveEntry", DetectionCurve.__dataclass_fields__, (float, ...))
    of_kind = _table("_KindEntry", CLASSES, (curve | None, None))
    model = _table("_CurvesFile", SENSOR_KINDS, (of_kind | None, None))
    content = read_json(path) if path.suffix.lower() == ".json" else read_toml(path)
    given = check_model(model, content, str(path)).model_dump(exclude_none=True)
    fitted: dict[tuple[str, str], DetectionCurve] = {}
    for kind, of in given.items():
        for road_user, row in of.items():
            with error_at(f"{path}: {kind}.{road_user}"):
                fitted[kind, road_user] = DetectionCurve(**row)
    if not fitted:
        raise InspeError(
            f"{path}: it has no curve; give at least one, such as a table [lidar.car] with most, "
            "half and slope"
        )
    with error_at(f"{path}"):  # of a further kind that lacks a class
        return detection_curves().with_curves(fitted)


def save_detection(curves: DetectionCurves | Fitted, path: str | os.PathLike[str]) -> None:
    """Write curves to a JSON file that :func:`load_detection` reads.

    Curves of :func:`fit_detection` replace usual ones. Raises InspeError if it cannot be written.

    >>> curve = inspe_jax.DetectionCurve(most=0.9, half=8.0, slope=1.5)
    >>> inspe_jax.save_detection({("lidar", "pedestrian"): curve}, "mine.json")
    >>> inspe_jax.load_detection("mine.json").record["lidar"]["pedestrian"]
    {'most': 0.9, 'half': 8.0, 'slope': 1.5}
    """
    check_output(path, SUFFIXES[1:])
    if not isinstance(curves, DetectionCurves):
        curves = detection_curves().with_curves(curves)
    write_text(path, json.dumps(curves.record, indent=2) + "\n")


def fit_detection(boxes: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], DetectionCurve]:
    """Curves by kind of sensor and class, from a table of boxes that were matched to detections.

    Each row has ``sensor``, such as "lidar" or "camera"; ``road_user``, a class; ``number``, the
    returns or pixels on the box; and ``found``, whether a detection matches it (1 or 0, or "1" or
    "0" as in a CSV). The likelihood of the matches is maximised. Raises InspeError where a column
    is missing or a value is no such thing, and where a kind and class has fewer than 30 boxes, or
    only boxes that are all found or all missed.

    >>> boxes = [
    ...     dict(sensor="lidar", road_user="car", number=n, found=n > 10 + k)
    ...     for n in range(30) for k in range(-3, 4)
    ... ]
    >>> curves = inspe_jax.fit_detection(boxes)
    >>> round(curves["lidar", "car"].half)
    10
    """
    by: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line, row in enumerate(boxes, 1):
        try:
            number, found = float(row["number"]), float(row["found"])
            key = str(row["sensor"]), str(row["road_user"])
        except (KeyError, TypeError, ValueError):
            raise InspeError(
                f"box {line}: a row needs sensor, road_user, number and found, such as lidar, car, "
                "12, 1"
            ) from None
        for value, known in zip(key, (SENSOR_KINDS, CLASSES), strict=True):
            check_known(value, known, f"box {line}:")
        if not 0 <= number < float("inf") or found not in (0.0, 1.0):
            raise InspeError(f"box {line}: number is 0 or more and found 0 or 1, not {dict(row)}")
        by.setdefault(key, []).append((number, found))
    if not by:
        raise InspeError("no boxes to fit detection curves to")
    return {key: _fitted(key, *np.array(rows).T) for key, rows in by.items()}


def _fitted(
    key: tuple[str, str], number: Float[np.ndarray, " n"], found: Bool[np.ndarray, " n"]
) -> DetectionCurve:
    """The curve under which boxes of one kind and class are found and missed most likely."""
    some = number > NONE  # nothing on a box tells nothing about the curve
    number, found = number[some], found[some]
    if len(found) < _FEWEST or found.min() == found.max():
        raise InspeError(
            f"{' '.join(key)}: {len(found)} boxes with something on them, {int(found.sum())} of "
            f"them found; at least {_FEWEST} are needed, some found and some missed"
        )
    logs, expit, logit = np.log(number), scipy.special.expit, scipy.special.logit

    def unlikely(x: np.ndarray) -> float:
        chance = expit(x[0]) * expit(np.exp(x[2]) * (logs - x[1]))
        chance = np.clip(chance, 1e-9, 1 - 1e-9)
        return -float((found * np.log(chance) + (1 - found) * np.log1p(-chance)).mean())

    # A steep and a flat start: the likelihood has more than one peak on few boxes.
    starts = [np.array([logit(0.95), np.median(logs), np.log(slope)]) for slope in (0.7, 2.0)]
    bounds = [logit(_BOUNDS[0]), *np.log(_BOUNDS[1:])]
    how = dict(bounds=bounds, method="L-BFGS-B")
    ends = [scipy.optimize.minimize(unlikely, start, **how) for start in starts]
    best = min(ends, key=lambda end: end.fun).x
    return DetectionCurve(float(expit(best[0])), float(np.exp(best[1])), float(np.exp(best[2])))
