"""What a search maximises: the objective of a layout's coordinates, in three readings. *Exact*:
every voxel and frame, read hard, as results report it. *Rough*: read hard on a sample of columns
and frames. *Soft*: read softly on a sample, with gradients."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from inspe_jax.core.arrays import from_center, on_device, on_host, pad_rows
from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError, or_usual
from inspe_jax.core.numerics import Softness
from inspe_jax.core.parallel import Job, jit_job, run, shapes_of
from inspe_jax.placement.candidates import poses
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import COMBINATIONS, Objective
from inspe_jax.placement.space import Space
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring import metrics
from inspe_jax.scoring.driver import MetricValues, measure_tiles
from inspe_jax.scoring.evaluate import check_entropy, options_of
from inspe_jax.scoring.exact import measure_exactly
from inspe_jax.scoring.numbers import Numbers, Reading
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS
from inspe_jax.scoring.tiled_scene import SceneArrays, TiledScene, tiled_sample, tiled_scene_of
from inspe_jax.sensing.conditions import Case, Conditions, case_of, perceiving
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.named import check_layout
from inspe_jax.sensing.sensor_array import SensorArray, SensorSet, sensor_array
from inspe_jax.visibility.centered_scene import CenteredScene, about_center

_SAMPLE_COST = (0.05, 0.3, 1.9)
"""A rough score costs a + b·columns + c·columns·frames exact ones, by the sample's shares. Measured
on two cores with 8 cameras, 4 LiDARs and both, on 150,000 voxels and 100 frames: 0.04 to 0.21."""

GRADIENT_COST = (55.0, 2.75e3, 60e3)
"""A gradient costs a·(n + b)/(n + c) hard scores of its sample of n columns·frames, as that is
charged. So 384 × 3, 768 × 6, 1536 × 8 and 2048 × 8 cost 0.20, 0.42, 0.98 and 1.37 exact ones;
measured 0.17 to 0.22, 0.40 to 0.44, 0.93 to 1.14 and 1.22 to 1.49, on what the above is."""

AnyScene = Scene | Case | str
"""A scene as users give it: as such, in conditions, or by name."""


def cases_of(
    scenes: AnyScene | Sequence[AnyScene], conditions: Conditions | str | None = None
) -> tuple[Case, ...]:
    """One or several scenes as cases. Raises InspeError where the list is empty."""
    listed = scenes if isinstance(scenes, list | tuple) else [scenes]
    if not listed:
        raise InspeError("no scene to search on: give at least one")
    return tuple(case_of(scene, conditions) for scene in listed)


Drawn = tuple[tuple[Int[np.ndarray, " l"], Int[np.ndarray, " t"]], ...]
"""The numbers of the drawn columns and frames of every case."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Some columns and frames of every case; a score on them costs ``cost`` exact scores."""

    arrays: tuple[SceneArrays, ...]
    cost: float

    @cached_property
    def scenes(self) -> tuple[TiledScene, ...]:
        """The sample in tiles, with masks of solid voxels."""
        return tuple(tiled_sample(part) for part in self.arrays)


class ScoreTerms(NamedTuple):
    """What a score depends on besides poses and sample: ``sensors`` and edge of a ``voxel`` [m] of
    every case, ``weights`` by metric, and number of units left out in turn (``failures``), or 0."""

    sensors: tuple[SensorArray, ...]
    voxel: tuple[float, ...]
    weights: dict[str, Float[np.ndarray | Array, ""]]
    failures: Int[np.ndarray | Array, ""]


class Problem:
    """One layout's sensors on one or more scenes, under constraints."""

    def __init__(
        self,
        scenes: AnyScene | Sequence[AnyScene],
        layout: Layout | str,
        objective: Objective | None = None,
        constraints: Constraints | None = None,
    ) -> None:
        """Raises InspeError where scenes do not fit together or an option is out of range."""
        wanted = or_usual("objective", objective, Objective)
        self._constraints = or_usual("constraints", constraints, Constraints)
        wanted.check()
        self.cases = tuple(
            replace(case, scene=wanted.within(case.scene)) for case in cases_of(scenes)
        )
        first = self.cases[0].scene
        self.readings = options_of(first, wanted.occlusion_reference, wanted.visibility)
        by_name = wanted.weights_by_name
        names = metrics.chosen(weights=by_name)
        self.options = ScoreOptions.of(**self.readings, names=names, detection=wanted.detection)
        self.objective = replace(
            wanted,
            weights={name: by_name[name] for name in names},
            occlusion_reference=self.readings["occlusion_reference"],
            visibility=self.readings["visibility"],
        )
        for case in self.cases[1:]:
            check_one_place(first, case.scene)
        _, layout, _ = check_layout(first, layout)
        self.layout = layout
        self.objective.check_cost(layout)
        self._failures = layout.members() if self.objective.failures else ()
        if self.objective.failures and len(layout.units) < 2:
            raise InspeError(f"{layout.name}: failures need at least two units, it has one")
        usual = [replace(sensor, spec=sensor.spec.with_lens(0.0)) for sensor in layout.sensors]
        self.sensor_sets = self._sets_of(replace(layout, sensors=tuple(usual)))
        self.terms = ScoreTerms(
            tuple(sensor_array(sensor_set) for sensor_set in self.sensor_sets),
            tuple(case.scene.voxels.size for case in self.cases),
            {name: np.array(weight) for name, weight in self.objective.weights_by_name.items()},
            np.array(len(self._failures), np.int32),
        )
        self.known: set[Hashable] = set()  # what is compiled already, for methods to note

    def _sets_of(self, layout: Layout) -> tuple[SensorSet, ...]:
        return tuple(
            SensorSet.of(perceiving(case.scene, layout, case.conditions), self._failures)
            for case in self.cases
        )

    @cached_property
    def space(self) -> Space:
        """Where sensors may be. Raises InspeError for bad constraints, or a unit without place."""
        return Space(self.cases[0].scene, self.layout, self._constraints)

    @property
    def submodular(self) -> bool:
        """Whether no sensor takes anything, and each adds the less the more others there are."""
        weights = self.objective.weights_by_name
        if self.objective.occlusion_reference == "covered" and weights["occlusion"]:
            return False  # the more is in view, the more counts
        if self.objective.over == "worst" and len(self.cases) > 1:
            return False
        return all(row.submodular for row in self.options.metrics if weights[row.name])

    @cached_property
    def arrays(self) -> tuple[SceneArrays, ...]:
        """Every case's arrays, of all columns and frames; information gain needs traffic."""
        found = []
        for case in self.cases:
            tiled = tiled_scene_of(case.scene)
            if self.objective.weights_by_name["information_gain"] > 0:
                check_entropy(case.scene, np.asarray(metrics.entropy(tiled.occupancy)).sum())
            arrays = case.scene.voxel_weight, tiled.voxel_occupancy
            found.append(
                SceneArrays(about_center(case.scene), *(on_device(x, float) for x in arrays))
            )
        return tuple(found)

    def exact(self, x: Float[np.ndarray, " N"]) -> float:
        """The exact objective of the layout at coordinates ``x``."""
        return self.exact_of(self.space.layout(np.asarray(x))) - float(self.pole_costs(x).sum())

    def chart(self, x: Float[np.ndarray, " N"]) -> tuple[np.ndarray, np.ndarray]:
        """:meth:`Space.chart`; where new poles have a price, units on poles stay there."""
        return self.space.chart(x, self.objective.pole_price > 0)

    def pole_costs(self, x: Float[np.ndarray, "*M N"]) -> Float[np.ndarray, "*M U"]:
        """What the objective pays for the new pole of each unit, if it stands on one."""
        feet = np.asarray(x)[..., self.space.index.base]
        return self.objective.pole_price * self.space.new_poles(feet)

    def poses_of(self, layout: Layout) -> Float[np.ndarray, "S p"]:
        """The poses of a layout of these sensors as of :meth:`Space.poses`."""
        found = from_center(self.cases[0].scene.voxels.center, layout.poses)
        lenses = [sensor.spec.lens for sensor in layout.sensors]
        return np.column_stack([found, lenses]) if layout.zooms else np.asarray(found)

    def exact_of(self, layout: Layout) -> float:
        """The exact objective of a layout of these sensors, without what its poles cost."""
        poses = from_center(self.cases[0].scene.voxels.center, layout.poses)
        measures, sets = [], self._sets_of(layout) if layout.zooms else self.sensor_sets
        for case, sensor_set in zip(self.cases, sets, strict=True):
            found = measure_exactly(
                tiled_scene_of(case.scene),
                poses,
                sensor_set,
                case.scene.voxels.size,
                self.options,
            )
            if self.objective.weights_by_name["information_gain"] > 0:
                check_entropy(case.scene, found.entropy)
            measures.append(found)
        return self._combined(scores(measures, self.terms.weights, self.terms.failures))

    def _combined(self, each: Float[Array, " N"]) -> float:
        """The objective, from P_sm of every case."""
        combine = COMBINATIONS[self.objective.over][1]
        return float(combine(np.asarray(each, float)))

    def draw(self, rng: np.random.Generator, columns: int, frames: int) -> Drawn:
        """Evenly spread columns and frames of each case, from a random first one; all if fewer.
        They estimate scores without bias, with less noise than columns drawn one by one."""
        return tuple(
            (
                _spread(rng, len(part.centered.columns), columns),
                _spread(rng, len(part.centered.prisms.top), frames),
            )
            for part in self.arrays
        )

    def sample_cost(self, drawn: Drawn) -> float:
        """The cost of a score on a sample, in exact scores."""
        fixed, by_column, by_sight = _SAMPLE_COST
        columns = sights = whole = 0.0
        for part, (at, when) in zip(self.arrays, drawn, strict=True):
            columns += len(at)
            sights += len(at) * len(when) / len(part.centered.prisms.top)
            whole += len(part.centered.columns)
        return fixed + (by_column * columns + by_sight * sights) / whole

    def gradient_cost(self, drawn: Drawn) -> float:
        """The cost of the gradient of one layout on a sample, in exact scores."""
        most, fixed, half = GRADIENT_COST
        sights = sum(len(at) * len(when) for at, when in drawn)
        return self.sample_cost(drawn) * most * (sights + fixed) / (sights + half)

    def sample(self, rng: np.random.Generator, columns: int = 2048, frames: int = 8) -> Sample:
        """A sample of every case; see :meth:`draw`."""
        drawn = self.draw(rng, columns, frames)
        return Sample(jax.device_put(self.take(drawn)), self.sample_cost(drawn))

    def take(self, drawn: Drawn) -> tuple[SceneArrays, ...]:
        """The drawn columns and frames of every case's arrays, in NumPy."""
        parts = []
        for part, (at, when) in zip(self._on_host, drawn, strict=True):
            centered, (count, levels) = part.centered, part.centered.heights.shape
            leaves: Any = (part.weight, part.occupancy)
            rows: list[Any] = [np.reshape(x, (count, levels))[at].ravel() for x in leaves]
            place = CenteredScene(
                centered.columns[at],
                centered.heights[at],
                centered.ground[at],
                jax.tree.map(lambda leaf: leaf[when], centered.prisms),  # noqa: B023
                None if centered.inside is None else centered.inside[at],
                centered.statics,
                jax.tree.map(lambda leaf: leaf[..., at], centered.motion),  # noqa: B023
            )
            parts.append(SceneArrays(place, *rows))
        return tuple(parts)

    @cached_property
    def _on_host(self) -> tuple[SceneArrays, ...]:
        return jax.tree.map(np.asarray, self.arrays)

    def rough(self, x: Float[np.ndarray, "M N"], sample: Sample) -> Float[np.ndarray, " M"]:
        """The objective of M layouts at coordinates ``x``, read hard on a sample, in parallel."""
        scenes = tuple(tiled.bucketed for tiled in sample.scenes)
        kinds = tuple(sensors.kinds for sensors in self.terms.sensors)
        key = (_hard_scores, self.options, kinds, shapes_of(scenes, self.terms.sensors))
        places = len(self.terms.sensors[0].kind)
        padded = [pad_rows(row, places) for row in on_host(poses(self.space, x), float)]
        jobs: list[Job] = [
            (key, partial(_hard_scores, BITS, row, scenes, self.terms, options=self.options))
            for row in padded
        ]
        scores = np.array([self._combined(row) for row in run(jobs)])
        return scores - self.pole_costs(x).sum(-1)

    def slope(
        self,
        poses: Float[Any, "S p"],
        on: tuple[SceneArrays, ...] | tuple[TiledScene, ...],
        softness: Float[Array, ""],
    ) -> tuple[float, Float[np.ndarray, "S p"]]:
        """The objective of poses as of :meth:`poses_of`, with ``softness`` [m], on samples or
        scenes ``on``, and its gradient."""
        tiled = (tiled_sample(x, masks=False) if isinstance(x, SceneArrays) else x for x in on)
        value, slope = soft_slope(
            pad_rows(on_host(poses, float), len(self.terms.sensors[0].kind)),
            tuple(scene.bucketed for scene in tiled),
            self.terms,
            softness,
            options=self.options,
            over=self.objective.over,
        )
        return float(value), np.asarray(slope)[: len(poses)]

    @cached_property
    def charted_loss(self) -> Callable[..., tuple[Any, Any]]:
        """The loss in typical steps ``z`` (N,) from an ``anchor`` (N,) in charts ``place`` (U,)."""
        space, scale = self.space, on_host(self.space.scale, float)
        return self._loss_through(
            lambda z, anchor, place: space.poses(space.from_chart(anchor + scale * z, place))
        )

    @cached_property
    def scaled_loss(self) -> Callable[..., tuple[Any, Any]]:
        """The loss in coordinates (N,) divided by :attr:`nonzero_scale`."""
        scale = on_host(self.nonzero_scale, float)
        return self._loss_through(lambda z: self.space.poses(scale * z))

    @property
    def nonzero_scale(self) -> Float[np.ndarray, " N"]:
        """A typical step of each coordinate, 1 for those that may not change."""
        return np.where(self.space.scale > 0, self.space.scale, 1.0)

    def _loss_through(self, poses: Callable[..., Any]) -> Callable[..., tuple[Any, Any]]:
        """A loss of what ``poses`` takes, then drawn columns and frames and softness [m], with its
        slope in the first, by :meth:`slope` or ``of``. What follows poses is compiled once."""
        forward = jax.jit(poses)

        @jax.jit
        def back(slope, z, *rest):  # type: ignore[no-untyped-def]
            return jax.vjp(lambda z: poses(z, *rest), z)[1](slope)[0]

        def loss(*at: Any, of: Callable[..., Any] | None = None) -> tuple[Any, Any]:
            *given, drawn, softness = at
            value, slope = (of or self.slope)(forward(*given), self.take(drawn), softness)
            return on_host(-value, float), back(-slope, *given)

        return loss


# ── Programs that are compiled for one problem and serve others ─────────────


@jax.jit
def scores(
    measures: list[MetricValues], weights: dict[str, Any], failures: Int[Any, ""]
) -> Float[Array, " N"]:
    """P_sm of N cases; with failures, the mean of P_sm without each unit in turn."""
    found = []
    for m in measures:
        kind = m.column_coverage.dtype
        named = {name: jnp.asarray(weight, kind) for name, weight in weights.items()}
        p = metrics.surrogate(m.values, named)  # (1 + G,)
        number = jnp.arange(len(p))
        real = (number > 0) & (number <= failures)
        without = jnp.where(real, p, 0.0).sum() / jnp.maximum(failures, 1).astype(p.dtype)
        found.append(jnp.where(failures > 0, without, p[0]))
    return jnp.stack(found)


def case_scores(
    reading: Reading,
    poses: Float[Array, "S p"],
    scenes: tuple[TiledScene, ...],
    terms: ScoreTerms,
    *,
    options: ScoreOptions,
) -> Float[Array, " N"]:
    """P_sm of N cases; ``poses`` are as of :meth:`Problem.poses_of`, and padded."""
    measures = [
        measure_tiles(reading, tiled, poses, sensors, voxel, options=options)
        for tiled, sensors, voxel in zip(scenes, terms.sensors, terms.voxel, strict=True)
    ]
    return scores(measures, terms.weights, terms.failures)


_hard_scores = jit_job(case_scores, static_argnames="options")


@partial(jit_job, static_argnames=("options", "over"))
def soft_slope(
    poses: Float[Array, "S p"],
    scenes: tuple[TiledScene, ...],
    terms: ScoreTerms,
    softness: Float[Array, ""],
    *,
    options: ScoreOptions,
    over: str,
) -> tuple[Float[Array, ""], Float[Array, "S p"]]:
    """The combined score of all cases with ``softness`` [m], and its gradient in the poses."""
    reading = Numbers(Softness.of(softness))

    def score(poses: Array) -> Array:
        return COMBINATIONS[over][0](case_scores(reading, poses, scenes, terms, options=options))

    return jax.value_and_grad(score)(poses)


def check_one_place(first: Scene, other: Scene) -> None:
    """Raise InspeError where two scenes are not of one intersection and profile."""
    profiles = f"the profiles {other.profile.name} and {first.profile.name}"
    for same, what in (
        (np.allclose(other.voxels.center, first.voxels.center, atol=1e-6), "other centres"),
        (other.profile == first.profile, profiles),
        (digest(other.terrain) == digest(first.terrain), "other terrain"),
        (digest(other.statics) == digest(first.statics), "other static bodies"),
    ):
        if not same:
            raise InspeError(
                f"{other.name} and {first.name} have {what}: scenes searched together are of one "
                "place and profile, with other traffic, light or weather"
            )


def _spread(rng: np.random.Generator, total: int, count: int) -> np.ndarray:
    """``count`` evenly spread indices of ``total``, from a random first one."""
    count = min(count, total)
    return ((rng.uniform() + np.arange(count)) * total / count).astype(int).clip(0, total - 1)
