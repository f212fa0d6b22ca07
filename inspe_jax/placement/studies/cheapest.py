"""The cheapest mix of devices that reaches a target: such as D of 0.95 on crosswalks.

Mixes are searched in the order of their cost, and the first that reaches the target ends the study.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import DEFAULT_METHOD, optimise
from inspe_jax.placement.problem import AnyScene, cases_of
from inspe_jax.placement.result import Result
from inspe_jax.placement.studies.pareto import DeviceMix, device_mixes, searched
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Cheapest:
    """Mixes of devices in the order of their cost, up to the first that reaches the ``target``.

    ``total`` mixes could have been searched.
    """

    target: float
    searched: tuple[DeviceMix, ...]
    total: int

    @property
    def found(self) -> DeviceMix | None:
        """The mix that reaches the target; None if none does."""
        last = self.searched[-1]
        return last if last.result.objective >= self.target else None

    @property
    def best(self) -> DeviceMix:
        """The mix that reaches the target, or that which comes nearest to it."""
        return self.found or max(self.searched, key=lambda mix: mix.result.objective)


def cheapest(
    scene: AnyScene | Sequence[AnyScene],
    counts: Mapping[str, Sequence[int]],
    target: float,
    *,
    method: str = DEFAULT_METHOD,
    seconds: float | None = None,
    evaluations: float | None = None,
    seed: int = 0,
    objective: Objective | None = None,
    constraints: Constraints | None = None,
    progress: Callable[[Mapping[str, int], float, float], None] | None = None,
    conditions: Conditions | str | None = None,
) -> Cheapest:
    """Search for the cheapest mix of devices whose objective is at least ``target``.

    ``counts`` are the numbers of each device to try, such as ``{"hesai-xt32": range(5)}``.
    ``scene`` and ``conditions`` are as in :func:`~inspe_jax.placement.optimise.optimise`.
    ``method``, ``seconds``, ``evaluations`` and ``seed`` are those of each mix's search, as in
    :func:`~inspe_jax.placement.optimise.optimise`; it ends once it reaches the target.
    ``objective`` is detectability if none is given. ``progress`` is called with (mix, share of all
    mixes, best score of the mix).

    Ctrl-C ends with the mixes so far. Raises InspeError as
    :func:`~inspe_jax.placement.studies.pareto.pareto` does, and where no score could be so high.
    """
    check_target(target)
    usual = Objective(weights={"detectability": 1.0})
    objective = usual if objective is None else objective
    wanted, cases = device_mixes(counts, objective), cases_of(scene, conditions)

    def search(start: Layout, told: Callable[..., None]) -> Result:
        return optimise(
            cases,
            start,
            method,
            seconds,
            evaluations,
            seed,
            objective,
            constraints,
            progress=told,
            target=target,
        )

    found = searched(wanted, cases[0].scene, search, progress, target)
    return Cheapest(target, tuple(found), len(wanted))


def check_target(target: float) -> None:
    """Raise InspeError where a target is not between 0 and 1."""
    if not 0 < target <= 1:
        raise InspeError(f"target {target:g}: scores are between 0 and 1, such as 0.95")
