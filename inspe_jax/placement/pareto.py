"""Cost against score over how many of which devices: which mix is worth its money."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from inspe_jax.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.optimise import optimise
from inspe_jax.placement.problem import Case, Objective
from inspe_jax.placement.result import Result
from inspe_jax.placement.site import Site
from inspe_jax.placement.strategies import join
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.devices import device
from inspe_jax.sensing.layout import Layout

MOST = 200
"""Mixes searched at most."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Mix:
    """So many of each device, what they cost [US dollars], and the search for their places.

    ``front``: no other mix scores as much for less, or more for as much.
    """

    counts: Mapping[str, int]
    cost: float
    result: Result
    front: bool = False

    @property
    def name(self) -> str:
        """Such as "4 hesai-xt32 + 2 paper-camera-midday"."""
        return " + ".join(f"{n} {name}" for name, n in self.counts.items() if n)


def around(scene: Scene, counts: Mapping[str, int]) -> Layout:
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
    return join("mix", scene.intersection, views)


def pareto(
    scene: Scene | Case | Sequence[Scene | Case],
    ranges: Mapping[str, tuple[int, int]],
    *,
    method: str = "greedy-adam",
    seconds: float | None = None,
    evaluations: float | None = None,
    seed: int = 0,
    objective: Objective | None = None,
    constraints: Constraints | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Mix]:
    """The best score found for every mix of devices, cheapest first.

    ``ranges`` gives the least and the most of each device; each mix gets a search of its own
    with the given budget. ``objective.budget`` leaves out what costs more; ``objective.prices``
    gives prices that the catalogue has not. ``progress(done, total)`` after each mix.

    Raises InspeError on an unknown device, one without a price, a bad range, or where no mix is
    left.
    """
    objective = objective or Objective()
    objective.check()
    price = {name: objective.price_of(name) for name in ranges}
    for name, (low, high) in ranges.items():
        if not 0 <= low <= high:
            raise InspeError(f"{name}: from {low} to {high}: the least, then the most, from 0")
    counts = [
        dict(zip(ranges, row, strict=True))
        for row in product(*(range(low, high + 1) for low, high in ranges.values()))
        if sum(row)
    ]
    costed = sorted(
        ((sum(price[name] * n for name, n in row.items()), row) for row in counts),
        key=lambda pair: pair[0],
    )
    limit = float("inf") if objective.budget is None else objective.budget
    costed = [(cost, row) for cost, row in costed if cost <= limit]
    if not costed:
        raise InspeError(f"no mix of {', '.join(ranges)} is within the budget, or all are empty")
    if len(costed) > MOST:
        raise InspeError(f"{len(costed)} mixes are more than the {MOST} that are searched at most")
    first = scene if isinstance(scene, Scene | Case) else scene[0]
    place = first.scene if isinstance(first, Case) else first
    found = []
    for cost, row in costed:
        result = optimise(
            scene,
            around(place, row),
            method,
            seconds=seconds,
            evaluations=evaluations,
            seed=seed,
            objective=objective,
            constraints=constraints,
        )
        found.append(Mix(row, cost, result))
        if progress:
            progress(len(found), len(costed))
    return [replace(mix, front=_on_front(mix, found)) for mix in found]


def _on_front(mix: Mix, others: Sequence[Mix]) -> bool:
    return not any(
        (other.cost <= mix.cost and other.result.objective > mix.result.objective)
        or (other.cost < mix.cost and other.result.objective >= mix.result.objective)
        for other in others
    )
