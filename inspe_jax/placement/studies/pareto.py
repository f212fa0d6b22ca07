"""Cost against score over how many of which devices: which mix is worth its money."""

import csv
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from pathlib import Path

import numpy as np

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.files import check_input, prepare_folder, write_text
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.optimise import DEFAULT_METHOD, compare
from inspe_jax.placement.problem import Case, Objective, cases_of, total_price
from inspe_jax.placement.result import Result, csv_text
from inspe_jax.placement.site import Site
from inspe_jax.placement.strategies import join
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.metrics import listed
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Layout, save_layout

MOST = 200
"""Mixes searched at most."""
_ADVICE = f"at most {MOST} are searched; allow fewer counts, such as 0, 4 and 8"


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class DeviceMix:
    """So many of each device, what they cost [US dollars], and the search for their places.

    ``front``: no other mix scores as much for less, or more for as much.
    """

    counts: Mapping[str, int]
    cost: float
    result: Result
    front: bool = False

    @property
    def name(self) -> str:
        """Such as "4 hesai-xt32 + 2 paper-camera"."""
        return mix_name(self.counts)

    @property
    def point(self) -> "ParetoPoint":
        """What a front shows of it."""
        result = self.result
        scene = " and ".join(dict.fromkeys(row["name"] for row in result.settings["scenes"]))
        known = (self.cost, result.objective, self.front, scene, result.method)
        return ParetoPoint(dict(self.counts), *known)


@dataclass(frozen=True)
class ParetoPoint:
    """A mix on paper: what it costs [US dollars], what the search for its places came to, where
    and by which method, and whether it is on the front."""

    counts: Mapping[str, int]
    cost: float
    objective: float
    front: bool
    scene: str
    method: str

    @property
    def name(self) -> str:
        """Such as "4 hesai-xt32 + 2 paper-camera"."""
        return mix_name(self.counts)


def mix_name(counts: Mapping[str, int]) -> str:
    """A mix in words."""
    return " + ".join(f"{n} {name}" for name, n in counts.items() if n)


def starting_layout(scene: Scene, counts: Mapping[str, int]) -> Layout:
    """A start for so many of each device: round the junction's corners, then its roadsides.

    Each sensor is a unit of its own, LiDARs first; they go on to the next post in turn, so that
    neighbours differ, and look at the centre. Raises InspeError where there are more sensors than
    posts, none at all, or nowhere to put a pole.
    """
    wanted = [(name, device(name).spec) for name, n in counts.items() for _ in range(n)]
    if not wanted:
        raise InspeError("a layout needs at least one sensor")
    wanted.sort(key=lambda row: row[1].kind != "lidar")
    site = Site(scene.intersection, scene.voxels.radius, depth=30.0)
    feet = np.concatenate([site.corners, site.roadsides])
    posts = [f"corner {i + 1}" for i in range(len(site.corners))]
    posts += [f"roadside {i + 1}" for i in range(len(site.roadsides))]
    far = np.hypot(*(feet[:, None] - feet[None]).transpose(2, 0, 1))
    order = [0]  # the next post is the one furthest from those that are taken
    while len(order) < len(feet):
        away = far[:, order].min(1)
        away[order] = -1.0
        order.append(int(away.argmax()))
    if len(wanted) > len(order):
        raise InspeError(
            f"{scene.name}: {len(wanted)} sensors, and {len(order)} posts for them; start from a "
            "layout of your own"
        )
    views = []
    for (_, spec), at in zip(wanted, order, strict=False):
        post, foot = posts[at], feet[at]
        view = (
            site.lidar(post, foot) if spec.kind == "lidar" else site.camera(post, foot, site.center)
        )
        views.append((view, spec))
    return replace(join(mix_name(counts), scene.intersection, views), profile=scene.profile.name)


def pareto(
    scene: Scene | Case | Sequence[Scene | Case],
    counts: Mapping[str, Sequence[int]],
    *,
    method: str = DEFAULT_METHOD,
    seconds: float | None = None,
    evaluations: float | None = None,
    seed: int = 0,
    objective: Objective | None = None,
    constraints: Constraints | None = None,
    progress: Callable[[Mapping[str, int], float, float], None] | None = None,
) -> list[DeviceMix]:
    """The best score found for every mix of devices, cheapest first.

    ``counts`` says how many of each device to try, as ``{"hesai-xt32": range(5)}``; each mix gets
    a search of its own with the given budget, which compiling does not count against.
    ``objective.budget`` leaves out what costs more; ``objective.prices`` gives prices that the
    catalogue has not; with ``objective.failures`` a mix has two sensors or more. ``progress`` is
    called with the mix searched, the share of all work done and the best score of that mix.
    Ctrl-C ends with the mixes so far, the last one as it stands.

    Raises InspeError on an unknown device, one without a price, a bad count, too many sensors for
    the place, or where no mix is left; all before the first search.
    """
    objective = objective or Objective()
    wanted = device_mixes(counts, objective)
    cases = cases_of(scene)
    starts = [starting_layout(cases[0].scene, row) for _, row in wanted]
    found: list[DeviceMix] = []
    for k, ((cost, row), start) in enumerate(zip(wanted, starts, strict=True)):
        try:
            (result,) = compare(
                cases,
                start,
                (method,),
                seconds=seconds,
                evaluations=evaluations,
                seeds=(seed,),
                objective=objective,
                constraints=constraints,
                progress=_share(progress, row, k, len(wanted)),
            )
        except KeyboardInterrupt:
            if not found:
                raise
            break
        found.append(DeviceMix(row, cost, result))
        if result.status == "interrupted":
            break
    return [replace(mix, front=_on_front(mix, found)) for mix in found]


def save_pareto(found: Sequence[DeviceMix], folder: str | os.PathLike[str]) -> None:
    """Write what mixes came to, and the layouts of those on the front.

    ``pareto.csv`` has a row a mix, cheapest first, and names the layout's file where there is
    one; :func:`load_pareto` reads it. Raises InspeError as
    :func:`~inspe_jax.placement.result.save_result` does.
    """
    place = prepare_folder(folder)
    rows = []
    for mix in found:
        file = "_".join(f"{n}_{name}" for name, n in mix.counts.items() if n) + ".yaml"
        if mix.front:
            save_layout(mix.result.layout, place / file)
        scores = {m.name: mix.result.scores.value(m.name) for m in listed()}
        point = mix.point
        head = {**point.counts, "cost_usd": point.cost, "objective": point.objective}
        ends = {"front": int(mix.front), "layout": file if mix.front else ""}
        how = {"scene": point.scene, "method": point.method}
        rows.append({**head, **scores, "seconds": mix.result.seconds, **how, **ends})
    write_text(place / "pareto.csv", csv_text(rows))


def load_pareto(folder: str | os.PathLike[str]) -> list[ParetoPoint]:
    """Read what :func:`save_pareto` wrote of every mix.

    Raises InspeError where it is missing or is something else.
    """
    path = Path(folder) / "pareto.csv"
    check_input(path)
    try:
        with path.open(newline="", encoding="utf-8") as f:
            table = csv.DictReader(f)
            names = list(table.fieldnames or ())
            devices = names[: names.index("cost_usd")]
            return [
                ParetoPoint(
                    {name: int(row[name]) for name in devices},
                    float(row["cost_usd"]),
                    float(row["objective"]),
                    row["front"] == "1",
                    row["scene"],
                    row["method"],
                )
                for row in table
            ]
    except (KeyError, TypeError, ValueError) as e:
        raise InspeError(f"{path}: not a table that inspe pareto wrote") from e


def device_mixes(
    counts: Mapping[str, Sequence[int]], objective: Objective
) -> list[tuple[float, dict[str, int]]]:
    """Cost [US dollars] and counts of every mix within the budget, cheapest first.

    Raises InspeError as :func:`pareto` does.
    """
    objective.check()
    if not counts:
        raise InspeError("no device to choose from: name at least one, and how many of it")
    price = {name: objective.price_of(name) for name in counts}
    for name in objective.prices:
        if name not in counts:
            raise InspeError(
                f"price of '{name}', which no mix has{nearest(name, tuple(counts))}; "
                f"the devices are {', '.join(counts)}"
            )
    for name, several in counts.items():
        if not len(several) or min(several) < 0:
            raise InspeError(f"{name}: how many of it: numbers from 0, at least one of them")
    if (total := prod(len(set(several)) for several in counts.values())) > 100 * MOST:
        raise InspeError(f"{total:,} mixes, and {_ADVICE}")
    least = 2 if objective.failures else 1  # each sensor is a unit, and one of two may fail
    rows = [
        dict(zip(counts, row, strict=True))
        for row in product(*(sorted(set(several)) for several in counts.values()))
        if sum(row) >= least
    ]
    costed = sorted(((total_price(price, row), row) for row in rows), key=lambda pair: pair[0])
    if not costed:
        few = "at least two sensors, as one may fail" if least == 2 else "at least one sensor"
        raise InspeError(f"no mix is left: allow {few}")
    limit = float("inf") if objective.budget is None else objective.budget
    within = [(cost, row) for cost, row in costed if cost <= limit]
    if not within:
        raise InspeError(
            f"no mix is within the budget of {limit:,.0f} US dollars; the cheapest costs "
            f"{costed[0][0]:,.0f}"
        )
    if len(within) > MOST:
        raise InspeError(f"{len(within)} mixes, and {_ADVICE}")
    return within


def _share(
    progress: Callable[[Mapping[str, int], float, float], None] | None,
    row: Mapping[str, int],
    k: int,
    total: int,
) -> Callable[[str, int, float, float], None] | None:
    if progress is None:
        return None
    return lambda method, seed, done, best: progress(row, (k + done) / total, best)


def _on_front(mix: DeviceMix, others: Sequence[DeviceMix]) -> bool:
    return not any(
        (other.cost <= mix.cost and other.result.objective > mix.result.objective)
        or (other.cost < mix.cost and other.result.objective >= mix.result.objective)
        for other in others
    )
