"""Cost against score for mixes of devices: the front, and the cheapest that is good enough."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import TypedDict, Unpack

from inspe_jax.core.errors import InspeError, nearest, or_usual
from inspe_jax.core.files import csv_text, prepare_folder, write_text
from inspe_jax.mounting.mixes import mix_name, starting_layout
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective, total_price
from inspe_jax.placement.optimise import optimise
from inspe_jax.placement.problem import AnyScene, cases_of
from inspe_jax.placement.result import Result
from inspe_jax.scoring.metrics import listed_in
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import save_layout

MOST = 200
"""Largest number of mixes that are searched."""
_ADVICE = f"at most {MOST} are searched; allow fewer counts, such as 0, 4 and 8"

MixProgress = Callable[[Mapping[str, int], float, float], None]
"""It is called with a mix, the fraction of all work that is done, and the mix's best score."""


class SearchOptions(TypedDict, total=False):
    """Options of each mix's search, as in :func:`~inspe_jax.placement.optimise.optimise`."""

    method: str
    seconds: float | None
    evaluations: float | None
    seed: int
    objective: Objective | None
    constraints: Constraints | None


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class DeviceMix:
    """A mix of devices: the number of each, the cost [US dollars], and the search that placed them.
    ``front``: whether no other mix is as good for less money, or better for no more."""

    counts: Mapping[str, int]
    cost: float
    result: Result
    front: bool = False

    @property
    def name(self) -> str:
        """Such as "4 hesai-xt32 + 2 paper-camera"."""
        return mix_name(self.counts)

    @property
    def objective(self) -> float:
        """The exact one."""
        return self.result.objective

    @property
    def method(self) -> str:
        """The method of the search."""
        return self.result.method

    @property
    def scene(self) -> str:
        """The scenes of the search."""
        return " and ".join(dict.fromkeys(row["name"] for row in self.result.settings["scenes"]))


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Cheapest:
    """Mixes by cost, up to the first of ``total`` that reaches the ``target``."""

    target: float
    searched: tuple[DeviceMix, ...]
    total: int

    @property
    def found(self) -> DeviceMix | None:
        """The mix that reaches the target; None if none does."""
        last = self.searched[-1]
        return last if last.objective >= self.target else None

    @property
    def best(self) -> DeviceMix:
        """The mix that reaches the target, or that which comes nearest to it."""
        return self.found or max(self.searched, key=lambda mix: mix.objective)


def layout_file(counts: Mapping[str, int]) -> str:
    """The name of the file of a mix's layout."""
    return "_".join(f"{n}_{name}" for name, n in counts.items() if n) + ".yaml"


def pareto(
    scene: AnyScene | Sequence[AnyScene],
    counts: Mapping[str, Sequence[int]],
    *,
    progress: MixProgress | None = None,
    conditions: Conditions | str | None = None,
    **options: Unpack[SearchOptions],
) -> list[DeviceMix]:
    """Search for the best layout of every mix of devices.

    Ctrl-C ends with the mixes so far; the last one has the best layout up to then.

    Args:
        scene, conditions: As in :func:`~inspe_jax.placement.optimise.optimise`.
        counts: Numbers of each device to try, such as ``{"hesai-xt32": range(5)}``.
        progress: Called with the mix, the share of its budget spent and its best score.
        options: Of each mix's search, see :class:`SearchOptions`. Mixes that cost more than the
            objective's ``budget`` are left out; its ``prices`` [US dollars] replace those of the
            catalogue; with its ``failures`` a mix has at least two sensors.

    Returns:
        The mixes, cheapest first.

    Raises:
        InspeError: Before the first search, if a device is unknown or has no price, a number is not
            valid, the place has too few posts, or no mix is left.

    >>> objective = inspe_jax.Objective(prices={"paper-camera": 500.0})
    >>> mixes = inspe_jax.pareto(
    ...     scene, {"paper-camera": [8]}, method="random", evaluations=2, objective=objective
    ... )
    >>> [(mix.name, mix.cost, mix.front) for mix in mixes]
    [('8 paper-camera', 4000.0, True)]
    """
    wanted = device_mixes(counts, options.get("objective"))
    found = searched(wanted, scene, conditions, progress, float("inf"), **options)
    return [replace(mix, front=_on_front(mix, found)) for mix in found]


def cheapest(
    scene: AnyScene | Sequence[AnyScene],
    counts: Mapping[str, Sequence[int]],
    target: float,
    *,
    progress: MixProgress | None = None,
    conditions: Conditions | str | None = None,
    **options: Unpack[SearchOptions],
) -> Cheapest:
    """Search for the cheapest mix of devices whose objective is at least ``target``.

    Mixes are searched in the order of their cost. The first that reaches the target ends the study,
    and its own search. Ctrl-C ends with the mixes so far.

    Args:
        scene, counts, conditions, progress, options: As in :func:`pareto`; without an ``objective``
            it is detectability.
        target: The objective to reach, such as D of 0.95 on crosswalks.

    Returns:
        The mixes that were searched, and the one that reaches the target, if any.

    Raises:
        InspeError: As :func:`pareto`, and where no score could be so high.
    """
    check_target(target)
    objective = options.get("objective") or Objective(weights={"detectability": 1.0})
    wanted = device_mixes(counts, objective)
    options["objective"] = objective
    found = searched(wanted, scene, conditions, progress, target, **options)
    return Cheapest(target, tuple(found), len(wanted))


def check_target(target: float) -> None:
    """Raise InspeError where a target is not between 0 and 1."""
    if not 0 < target <= 1:
        raise InspeError(f"target {target:g}: scores are between 0 and 1, such as 0.95")


def searched(
    wanted: Sequence[tuple[float, dict[str, int]]],
    scene: AnyScene | Sequence[AnyScene],
    conditions: Conditions | str | None,
    progress: MixProgress | None,
    target: float = float("inf"),
    **options: Unpack[SearchOptions],
) -> list[DeviceMix]:
    """The mixes ``wanted``, one after another until one has the ``target`` or Ctrl-C."""
    if others := set(options) - set(SearchOptions.__annotations__):
        raise TypeError(f"unexpected options of a search of mixes: {', '.join(sorted(others))}")
    cases = cases_of(scene, conditions)
    starts = [starting_layout(cases[0].scene, row) for _, row in wanted]
    found: list[DeviceMix] = []
    for k, ((cost, row), start) in enumerate(zip(wanted, starts, strict=True)):

        def notify(done: float, best: float, row: Mapping[str, int] = row, k: int = k) -> None:
            if progress is not None:
                progress(row, (k + done) / len(wanted), best)

        try:
            result = optimise(cases, start, progress=notify, target=target, **options)
        except KeyboardInterrupt:
            if not found:
                raise
            break
        found.append(DeviceMix(row, cost, result))
        if result.objective >= target or result.status == "interrupted":
            break
    return found


def save_pareto(found: Sequence[DeviceMix], folder: str | os.PathLike[str]) -> None:
    """Write ``pareto.csv``, a row for each mix, and a layout file for each on the front."""
    place = prepare_folder(folder)
    rows, metrics = [], listed_in(*(mix.result.scores for mix in found))
    for mix in found:
        file = layout_file(mix.counts)
        if mix.front:
            save_layout(mix.result.layout, place / file)
        scores = {m.name: mix.result.scores.value(m.name) for m in metrics}
        head = {**mix.counts, "cost_usd": mix.cost, "objective": mix.objective}
        ends = {"front": int(mix.front), "layout": file if mix.front else ""}
        how = {"scene": mix.scene, "method": mix.method}
        rows.append({**head, **scores, "seconds": mix.result.seconds, **how, **ends})
    write_text(place / "pareto.csv", csv_text(rows))


def device_mixes(
    counts: Mapping[str, Sequence[int]], objective: Objective | None
) -> list[tuple[float, dict[str, int]]]:
    """Cost [US dollars] and counts of every mix within the budget, cheapest first."""
    objective = or_usual("objective", objective, Objective)
    objective.check()
    if not counts:
        raise InspeError("no devices to combine: name at least one, with the numbers of it to try")
    price = {name: objective.price_of(name) for name in counts}
    for name in objective.prices:
        if name not in counts:
            raise InspeError(
                f"price of '{name}', which is in no mix{nearest(name, tuple(counts))}; "
                f"the devices are {', '.join(counts)}"
            )
    for name, several in counts.items():
        if not len(several) or min(several) < 0:
            raise InspeError(f"{name}: give at least one number of it to try, each 0 or more")
    if (total := prod(len(set(several)) for several in counts.values())) > 100 * MOST:
        raise InspeError(f"{total:,} mixes, and {_ADVICE}")
    least = 2 if objective.failures else 1  # each sensor is a unit, and one unit may fail
    rows = [
        dict(zip(counts, row, strict=True))
        for row in product(*(sorted(set(several)) for several in counts.values()))
        if sum(row) >= least
    ]
    costed = sorted(((total_price(price, row), row) for row in rows), key=lambda pair: pair[0])
    if not costed:
        few = "two sensors, since one may fail" if least == 2 else "one sensor"
        raise InspeError(f"no mix is left: a mix needs at least {few}")
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


def _on_front(mix: DeviceMix, others: Sequence[DeviceMix]) -> bool:
    return not any(
        (other.cost <= mix.cost and other.objective > mix.objective)
        or (other.cost < mix.cost and other.objective >= mix.objective)
        for other in others
    )
