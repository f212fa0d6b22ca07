"""What a search maximises of scores: their weights, regions, failures and prices."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.regions import regions_of
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring import metrics
from inspe_jax.scoring.detection import DetectionCurves, detection_curves
from inspe_jax.scoring.evaluate import check_options
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Goal, Layout

COMBINATIONS: dict[str, Any] = {"mean": (jnp.mean, np.mean), "worst": (jnp.min, np.min)}
"""How the scores of several scenes become one, in JAX and in NumPy."""


@dataclass(frozen=True)
class Objective:
    """What is maximised: the mean or the worst P_sm of some scenes.

    ``weights``, ``occlusion_reference`` and ``visibility`` are as in :func:`inspe_jax.evaluate`.
    ``over`` says how the scores of several scenes are combined, "mean" or "worst". With
    ``failures`` a score is N−1: the mean over the units of the score without that unit.
    ``budget`` is the most that the layout may cost [US dollars]. ``prices`` of devices [US dollars]
    replace the catalogue's.
    ``pole_price`` is what each new pole costs the objective itself: how much it must gain. A unit
    that may move stands on a new pole unless on one of the map's.
    ``regions``, by name, are the only ones that count; all if none is given. ``metrics`` are also
    in the scores of results; they do not change what is found. ``detection`` has the curves of
    detectability, the usual ones if None.
    """

    weights: metrics.Weights = None
    occlusion_reference: str | None = None
    visibility: str | None = None
    over: str = "mean"
    failures: bool = False
    budget: float | None = None
    prices: Mapping[str, float] = field(default_factory=dict)
    pole_price: float = 0.0
    regions: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()
    detection: DetectionCurves | None = None

    @property
    def weights_by_name(self) -> dict[str, float]:
        """The weight of every metric in P_sm. Raises InspeError as :func:`metrics.weights_of`."""
        return metrics.weights_of(self.weights)

    @property
    def goal(self) -> Goal | None:
        """What is maximised, for the layouts that are found; None if it is the usual P_sm."""
        own, usual = (
            tuple((name, weight) for name, weight in of.items() if weight)
            for of in (self.weights_by_name, metrics.weights_of())
        )
        users = self.detection.road_users if self.detection else ()
        goal = Goal(own, self.regions, users, self.failures)
        return None if goal == Goal(usual) else goal

    @classmethod
    def of_goal(
        cls, goal: Goal, detection: DetectionCurves | None = None, **readings: Any
    ) -> "Objective":
        """The objective of a layout's goal, with these curves of detectability and readings."""
        if goal.road_users:
            detection = (detection or detection_curves()).for_road_users(goal.road_users)
        return cls(
            dict(goal.weights),
            regions=goal.regions,
            failures=goal.failures,
            detection=detection,
            **readings,
        )

    def check(self) -> None:
        """Raise InspeError where a setting is unknown or out of range."""
        reference, visibility = self.occlusion_reference or "roi", self.visibility or "in_view"
        check_options(self.weights, reference, visibility, detection=self.detection)
        metrics.chosen(self.metrics)
        regions_of(self.regions)
        for name, weight in self.weights_by_name.items():
            if self.regions and weight and not metrics.METRICS[name].by_region:
                some = [m.name for m in metrics.METRICS.values() if m.by_region]
                raise InspeError(
                    f"{name} counts every voxel, whatever its region; for some regions only, give "
                    f"all weight to {', '.join(some)}"
                )
        if self.over not in COMBINATIONS:
            raise InspeError(f"over '{self.over}': one of {', '.join(COMBINATIONS)}")
        for name, price in self.prices.items():
            if not 0 <= price < float("inf"):
                raise InspeError(f"price of {name} {price}: 0 or more, in US dollars")
        if not 0 <= self.pole_price < 1:
            raise InspeError(
                f"pole_price {self.pole_price:g}: what a new pole must gain, at least 0 and below 1"
            )

    def within(self, scene: Scene) -> Scene:
        """The scene with weight only in regions that count. Raises InspeError if it has none.

        >>> junction = inspe_jax.Objective(regions=("junction",)).within(scene)
        >>> round(float((junction.voxel_weight > 0).mean()), 2)
        0.95
        """
        if not self.regions:
            return scene
        some = regions_of(self.regions)
        counted = [region for region in some if scene.voxels.region_weight[region]]
        if not np.isin(scene.voxels.region, counted).any():
            words = " and no ".join(region.key for region in some)
            raise InspeError(f"{scene.name}: it has no {words}, or gives it no weight")
        weight = tuple(w * (k in some) for k, w in enumerate(scene.voxels.region_weight))
        return replace(scene, voxels=replace(scene.voxels, region_weight=weight))

    def price_of(self, name: str) -> float:
        """Price of a device [US dollars]. Raises InspeError where none is known.

        >>> inspe_jax.Objective(prices={"hesai-xt32": 4000.0}).price_of("hesai-xt32")
        4000.0
        """
        price = self.prices.get(name)
        if price is None:
            price = device(name).price_usd
        if price is None:
            raise InspeError(
                f"device '{name}' has no list price in the catalogue; give it one: "
                f"prices={{'{name}': …}}, on the command line --price {name}=USD"
            )
        return price

    def check_cost(self, layout: Layout) -> None:
        """Raise InspeError where the layout's sensors cost more than the budget.

        >>> prices = {"paper-camera": 500.0}
        >>> inspe_jax.Objective(budget=3000.0, prices=prices).check_cost(layout)
        Traceback (most recent call last):
            ...
        inspe_jax.core.errors.InspeError: Cam-d1: the sensors cost 4,000.00 US dollars, more ...
        """
        if self.budget is None:
            return
        names = [sensor.spec.name for sensor in layout.sensors]
        count = {name: names.count(name) for name in names}
        cost = total_price({name: self.price_of(name) for name in count}, count)
        if cost > self.budget:
            raise InspeError(
                f"{layout.name}: the sensors cost {cost:,.2f} US dollars, more than the budget of "
                f"{self.budget:,.2f}; use fewer or cheaper ones"
            )


def total_price(price: Mapping[str, float], count: Mapping[str, int]) -> float:
    """What ``count`` of each device cost at ``price`` [US dollars], to the cent."""
    return round(sum(price[name] * n for name, n in count.items()), 2)
