"""A plan of many junctions: a front of device mixes for each, and one budget shared among them. The
study that searches the layouts knows no prices, so another budget only chooses again."""

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.files import csv_text
from inspe_jax.mounting.mixes import mix_name
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.maps.registry import list_junctions
from inspe_jax.scene.maps.road_map import MOST_LISTED, JunctionInfo
from inspe_jax.study.budget import Share, share_out
from inspe_jax.study.plan import Study, make_study
from inspe_jax.study.sweep import LAYOUTS, Row

SIGNALS, ALL = "signals", "all"  # words for junctions with signals, and for all


@dataclass(frozen=True)
class Option:
    """What one junction can get: a mix of devices, its cost [US dollars] and its score. ``key`` is
    that of the job that found its layout; for no devices at all it is empty."""

    mix: str
    cost: float
    score: float
    key: str = ""

    @property
    def layout(self) -> str:
        """The file of its layout, in the folder of the study; empty for no devices."""
        return f"{LAYOUTS}/{self.key}.yaml" if self.key else ""


NOTHING = Option("", 0.0, 0.0)  # no devices: nothing is seen, and every score is 0


@dataclass(frozen=True)
class JunctionFront:
    """A junction, its options, cheapest first from :data:`NOTHING` on unless a mix is free, and the
    errors of mixes that failed."""

    junction: JunctionInfo
    options: tuple[Option, ...]
    errors: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The junction's id as text."""
        return str(self.junction.id)

    @property
    def failed(self) -> bool:
        """Whether every mix failed."""
        return bool(self.errors) and not any(option.key for option in self.options)


@dataclass(frozen=True)
class CityPlan:
    """A budget [US dollars] shared among the junctions of ``fronts``, with the importance of each.
    ``share`` has the option of each; ``worst``: the least score is maximised; ``left_out`` are
    junctions where every mix failed, with the first error."""

    budget: float
    fronts: tuple[JunctionFront, ...]
    weights: tuple[float, ...]
    worst: bool
    share: Share
    left_out: Mapping[str, str]

    @cached_property
    def chosen(self) -> tuple[Option, ...]:
        """The option of each junction."""
        pairs = zip(self.fronts, self.share.options, strict=True)
        return tuple(front.options[k] for front, k in pairs)

    def text(self, georeference: Georeference | None) -> str:
        """The plan as CSV, a row for each junction; in degrees too if the projection is given."""
        rows: list[dict[str, Any]] = []
        for front, option, weight in zip(self.fronts, self.chosen, self.weights, strict=True):
            middle = np.array(front.junction.center[:2])
            row: dict[str, Any] = {"junction": front.name}
            if georeference is not None:  # to a centimetre
                longitude, latitude = georeference.to_degrees(middle[None])[0]
                row |= dict(latitude=f"{latitude:.7f}", longitude=f"{longitude:.7f}")
            row |= dict(x=f"{middle[0]:.2f}", y=f"{middle[1]:.2f}", importance=f"{weight:g}")
            row |= dict(mix=option.mix, cost_usd=f"{option.cost:.2f}", score=f"{option.score:.7f}")
            rows.append(row | dict(layout=option.layout))
        return csv_text(rows)


def choose_junctions(
    path: str | os.PathLike[str], wanted: str, driving_side: str | None = None
) -> tuple[JunctionInfo, ...]:
    """Junctions of a map: those with ``signals``, ``all``, or of ids with commas between."""
    known = list_junctions(path, driving_side)
    if not known:
        raise InspeError(f"{path}: the map has no junction")
    if wanted == ALL:
        return known
    if wanted == SIGNALS:
        found = tuple(one for one in known if one.signals)
        if not found:
            raise InspeError(
                f"{path}: none of its {len(known)} junctions has signals; `all` takes all of them"
            )
        return found
    by_id = {str(one.id): one for one in known}
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    check_ids(names, by_id, f"{path}: ")
    if not names or len(set(names)) < len(names):
        raise InspeError(
            f"{path}: junctions '{wanted}': write {SIGNALS}, {ALL}, or ids with commas between, "
            "each once"
        )
    return tuple(by_id[name] for name in names)


def check_ids(names: Sequence[str], known: Mapping[str, Any], where: str = "") -> None:
    """Raise InspeError if a name is not the id of a junction."""
    for name in names:
        if name not in known:
            listed = ", ".join([*known][:MOST_LISTED]) + ", …" * (len(known) > MOST_LISTED)
            raise InspeError(f"{where}no junction '{name}' among {listed}{nearest(name, [*known])}")


def check_importance(given: Mapping[str, float], junctions: Sequence[JunctionInfo]) -> None:
    """Raise InspeError if an importance is not more than 0, or is of none of the junctions."""
    check_ids(list(given), {str(one.id): one for one in junctions}, "importance: ")
    for name, weight in given.items():
        if not 0 < weight < float("inf"):
            raise InspeError(f"importance {name}={weight:g}: more than 0")


def city_study(
    path: str | os.PathLike[str],
    junctions: Sequence[JunctionInfo],
    mixes: Sequence[Mapping[str, int]],
    settings: Mapping[str, Any],
    driving_side: str | None = None,
    **more: Any,
) -> Study:
    """The study of every mix at every junction of a map; options as in a study file."""
    place = Path(path)
    of_all = {"map": str(place.resolve()), "driving_side": driving_side}
    scenes = [{"name": str(one.id), "junction": one.id, **of_all} for one in junctions]
    layouts = [{"mix": {name: n for name, n in mix.items() if n}} for mix in mixes]
    content = dict(scenes=scenes, layouts=layouts, settings=dict(settings), **more)
    return make_study(content, place.parent, str(place), place.stem)


def fronts_of(
    study: Study, rows: Sequence[Row], junctions: Sequence[JunctionInfo], costs: Mapping[str, float]
) -> tuple[JunctionFront, ...]:
    """Each junction's front, from a study's rows and the costs of mixes by name."""
    by_key = {row["key"]: row for row in rows}
    options = defaultdict[str, list[Option]](lambda: [NOTHING])
    errors = defaultdict[str, list[str]](list)
    for job in study.jobs:
        row, name = by_key[job.key], job.source.name
        if row["status"] == "done":
            mix = mix_name(dict(job.layout.mix))
            options[name].append(Option(mix, costs[mix], float(row["surrogate"]), job.key))
        else:
            errors[name].append(f"{job.layout.name}: {row['error']}")
    fronts = []
    for junction in junctions:
        name, front = str(junction.id), list[Option]()
        for option in sorted(options[name], key=lambda one: (one.cost, -one.score)):
            if not front or option.score > front[-1].score:
                front.append(option)
        fronts.append(JunctionFront(junction, tuple(front), tuple(errors[name])))
    return tuple(fronts)


def plan_city(
    fronts: Sequence[JunctionFront],
    budget: float,
    *,
    worst: bool = False,
    importance: Mapping[str, float] | None = None,
) -> CityPlan:
    """Share a budget [US dollars] out among junctions, for the greatest weighted sum of scores, or
    with ``worst`` the least score first. ``importance``, by id, is 1 where it is not given.
    Junctions where every mix failed are left out; raises InspeError if all did."""
    given = importance or {}
    check_importance(given, [front.junction for front in fronts])
    left_out = {front.name: front.errors[0] for front in fronts if front.failed}
    able = tuple(front for front in fronts if not front.failed)
    if not able:
        name, reason = next(iter(left_out.items()), ("", "no junction is given"))
        raise InspeError(f"every search failed; at {name or 'the map'}: {reason}")
    weights = tuple(given.get(front.name, 1.0) for front in able)
    costs = [[option.cost for option in front.options] for front in able]
    scores = [[option.score for option in front.options] for front in able]
    share = share_out(costs, scores, budget, weights, worst=worst)
    return CityPlan(budget, able, weights, worst, share, left_out)


def close_pairs(junctions: Sequence[JunctionInfo], reach: float) -> int:
    """Number of pairs of junctions whose middles are nearer to each other than ``reach`` [m]."""
    from scipy.spatial import cKDTree

    middles = np.array([one.center[:2] for one in junctions])
    return len(cKDTree(middles).query_pairs(0.999 * reach))  # circles may touch
