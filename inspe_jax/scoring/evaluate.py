"""Score a layout on a scene: every metric, and their weighted sum P_sm."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.arrays import from_center, pad_rows
from inspe_jax.core.errors import InspeError, check_known, wrong_kind
from inspe_jax.core.numerics import Softness
from inspe_jax.core.parallel import check_memory
from inspe_jax.core.records import ByContent, Described, check_values
from inspe_jax.scene.regions import PAPER_WEIGHTS, Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.driver import MetricValues, measure_tiles
from inspe_jax.scoring.exact import ONE_MORE, count_exactly, measure_many
from inspe_jax.scoring.metrics import (
    OCCLUSION_REFERENCES,
    Weights,
    chosen,
    entropy,
    surrogate,
    weights_of,
)
from inspe_jax.scoring.numbers import Numbers
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.reading import BITS
from inspe_jax.scoring.soft import measure_softly
from inspe_jax.scoring.tiled_scene import TiledScene, tiled_scene_of
from inspe_jax.sensing.conditions import FAIR, Case, Conditions, perceiving
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.named import check_layout, check_places
from inspe_jax.sensing.sensor_array import SensorArray, SensorSet, sensor_array
from inspe_jax.visibility.tiles import CORE

VISIBILITIES = ("in_view", "line_of_sight", "past_others")
"""What visibility means in information gain. ``in_view``: f, as in the paper. ``line_of_sight``: f
× the share of frames in which no vehicle hides the voxel; ``past_others``: no other vehicle."""


class PaperMetrics:
    """The paper's three metrics as attributes of a record of all ``metrics`` by name."""

    metrics: dict[str, Any]
    surrogate: Any

    def value(self, name: str) -> Any:
        """A metric, or ``surrogate``, by name."""
        return self.surrogate if name == "surrogate" else self.metrics[name]

    @property
    def coverage(self) -> Any:
        """C, the share of voxels in view, weighted by region."""
        return self.metrics["coverage"]

    @property
    def occlusion(self) -> Any:
        """O, the share of voxels that stays visible behind traffic."""
        return self.metrics["occlusion"]

    @property
    def information_gain(self) -> Any:
        """IG, the share of the occupancy's entropy that is resolved."""
        return self.metrics["information_gain"]


@dataclass(frozen=True)
class Contribution(PaperMetrics):
    """What the layout loses without one sensor, in every metric and in P_sm."""

    sensor: str
    metrics: dict[str, float]
    surrogate: float


@dataclass(frozen=True, eq=False, repr=False)
class Scores(PaperMetrics, ByContent, Described):
    """The scores of one layout on one scene, each between 0 and 1, higher is better.

    ``metrics`` are by name, and ``surrogate`` is their weighted sum P_sm. They are numbers, or JAX
    arrays where the layout's poses are traced. ``region_coverage`` is the share in view,
    unweighted, of the voxels of each region.

    ``contributions`` has one row a sensor, in the layout's order; none where poses are traced. One
    can be negative only for occlusion with the reference ``covered``, whose voxels change with the
    sensors. ``seen_share`` (L,) is the share of frames and levels in which each column is seen. It
    is for pictures and has no gradient. ``settings`` are the options used.

    ``parts`` has the metrics and P_sm of the columns of the ``core``, within 30 m of the centre
    (paper, section 3), and of those ``outside``, by these names; it is empty where one of the two
    has no columns, and where scores are soft or poses traced.
    """

    metrics: dict[str, float]
    surrogate: float
    region_coverage: dict[str, float]
    contributions: tuple[Contribution, ...]
    seen_share: Float[np.ndarray, " L"]
    settings: dict[str, Any]
    parts: dict[str, dict[str, float]] = field(default_factory=dict)

    def _facts(self) -> dict[str, Any]:
        shown = {**self.metrics, "P_sm": self.surrogate}
        return {k: f"{x:.4f}" if isinstance(x, float) else x for k, x in shown.items()}

    @property
    def conditions(self) -> Conditions:
        """The light and weather that the scores are for."""
        return Conditions.of(**{k: self.settings.get(k, usual) for k, usual in FAIR.record.items()})


def evaluate(
    scene: Scene | Case | str,
    layout: Layout | str,
    *,
    weights: Weights = None,
    occlusion_reference: str | None = None,
    visibility: str | None = None,
    softness: Any = 0.0,
    conditions: Conditions | str | None = None,
    metrics: str | Sequence[str] = (),
    detection: DetectionCurves | None = None,
) -> Scores:
    """Scores of a layout on a scene: exact ones, or soft ones that have gradients.

    P_sm is the weighted sum of metrics, usually 0.3 C + 0.5 O + 0.2 IG. The scene's static bodies
    hide voxels in every frame, from every metric. Read exactly, a tree's crown hides if its
    transmittance is below 0.5; read softly, transmittances are multiplied.

    Args:
        scene: A scene, the name of a built-in or of a saved file; or a
            :class:`~inspe_jax.sensing.conditions.Case`.
        layout: A layout, or the name of a strategy or of a file.
        weights: Of the metrics in P_sm, by name, or three numbers for C, O and IG.
        occlusion_reference: As in :func:`~inspe_jax.scoring.metrics.occlusion_terms`; without it,
            the scene's profile decides.
        visibility: What information gain, and metrics that need line of sight, read:
            ``line_of_sight``; ``past_others``, where a vehicle does not hide its own voxels; or
            ``in_view``, without traffic, for which the others take ``past_others``. Without it, the
            profile decides.
        softness: 0 for the exact scores; or the width [m] with which fields of view and shadows are
            read, and then rays are read as a density; or a
            :class:`~inspe_jax.core.numerics.Softness`.
        conditions: Light and weather, also as text such as "night, rain:10".
        metrics: Those to compute besides the usual ones and those with weight, or "all".
        detection: Curves of detectability
            (:func:`~inspe_jax.scoring.detection.load_detection`), the usual ones if None.

    Returns:
        The scores. With traced poses P (S, 6), ``evaluate(scene, layout.with_poses(P),
        softness=0.5).surrogate`` is differentiable in P, once and in reverse mode. The exact score
        is a step function, with gradient 0. The gradient needs no ``jax.jit`` around it. On a CPU
        it runs on all cores either way, in compiled programs that serve other scenes and layouts;
        on one core, in double precision or on another device, with ``jax.jit`` the scene becomes a
        part of the program.

    Raises:
        InspeError: A sensor is in the ground or out of reach of the scene, an option is unknown, or
            the arrays would not fit in memory; or there is no traffic and so no entropy to resolve,
            unless information gain has weight 0, which is then 0.

    >>> scores = inspe_jax.evaluate(scene, layout)
    >>> {name: round(float(value), 3) for name, value in scores.metrics.items()}
    {'coverage': 0.952, 'occlusion': 0.916, 'information_gain': 0.438}
    >>> round(float(inspe_jax.evaluate(scene, layout, softness=0.5).surrogate), 2)
    0.84
    """
    scene, layout, conditions = check_layout(scene, layout, conditions)
    readings = options_of(scene, occlusion_reference, visibility)
    check_options(weights, **readings, detection=detection)
    by_name = weights_of(weights)
    options = ScoreOptions.of(**readings, names=chosen(metrics, by_name), detection=detection)
    width, layout = Softness.of(softness), perceiving(scene, layout, conditions)
    # Without each sensor in turn, but not where poses are traced.
    traced = isinstance(layout.poses, jax.core.Tracer)
    each = () if traced else tuple((s,) for s in range(len(layout)))
    sensors = sensor_array(SensorSet.of(layout, each), ONE_MORE if width.exact else 0)
    check_memory(scene.voxels.count, len(layout))
    # An exact score is a step function of the poses, and has no gradient.
    poses = jax.lax.stop_gradient(layout.poses) if traced and width.exact else layout.poses
    poses = from_center(scene.voxels.center, pad_rows(poses, len(sensors.kind)))
    tiled, found = _measured(scene, poses, sensors, width, options)
    if by_name["information_gain"] > 0:
        check_entropy(scene, found.entropy)
    found = found._replace(seen_share=jax.lax.stop_gradient(found.seen_share))
    regions = _by_region(scene, tiled, found.column_coverage)
    measured = jax.tree.map(lambda x: x if isinstance(x, jax.core.Tracer) else np.asarray(x), found)
    values = {of.name: measured.values[of.name][: 1 + len(each)] for of in options.metrics}
    rows = [*values.values(), surrogate(values, by_name)]
    total, *without = zip(*(_numbers(row) for row in rows), strict=True)
    return Scores(
        metrics=dict(zip(values, total[:-1], strict=True)),
        surrogate=total[-1],
        region_coverage={key: _numbers(share) for key, share in regions.items()},
        contributions=tuple(
            Contribution(
                sensor.name,
                {name: a - b for name, a, b in zip(values, total, left, strict=False)},
                total[-1] - left[-1],
            )
            for sensor, left in zip(layout.sensors, without, strict=False)
        ),
        seen_share=measured.seen_share[tiled.tiles.place],
        settings=dict(
            weights={name: by_name[name] for name in values},
            profile=scene.profile.name,
            **readings,
            softness=softness,
            **conditions.record,
            **_limits(scene, options.detection),
        ),
        parts=_by_part(scene, measured, tuple(values), by_name),
    )


def _limits(scene: Scene, detection: DetectionCurves | None) -> dict[str, Any]:
    """The settings of a score that not all have: what alone counts, and curves of one's own."""
    found: dict[str, Any] = {}
    weights = scene.voxels.region_weight
    some = {region.key: weights[region] for region in Region if weights[region]}
    if len(some) < len(Region):
        found["regions"] = [*some]
    if any(w not in (0.0, usual) for w, usual in zip(weights, PAPER_WEIGHTS, strict=True)):
        found["region_weight"] = some
    if detection is not None:
        found["detection"] = detection.record
        if detection.road_users:
            found["road_users"] = list(detection.road_users)
    return found


def _measured(
    scene: Scene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    softness: Softness,
    options: ScoreOptions,
) -> tuple[TiledScene, MetricValues]:
    """The scene in tiles and its metrics, of columns of tiles; counted exactly or read softly."""
    voxel = scene.voxels.size
    if softness.exact and not isinstance(poses, jax.core.Tracer):
        tiled = tiled_scene_of(scene)
        return tiled, count_exactly(tiled, poses, sensors, voxel, options)
    tiled = tiled_scene_of(scene, whole=True, masks=softness.exact)
    if not softness.exact:
        return tiled, measure_softly(Numbers(softness), tiled, poses, sensors, voxel, options)
    return tiled, measure_tiles(BITS, tiled.bucketed, poses, sensors, voxel, options=options)


@dataclass(frozen=True, eq=False)
class ManyScores(PaperMetrics, ByContent):
    """The exact scores of M layouts: ``metrics`` by name and ``surrogate``, P_sm, each (M,)."""

    metrics: dict[str, Float[np.ndarray, " M"]]
    surrogate: Float[np.ndarray, " M"]


def evaluate_many(
    scene: Scene | Case | str,
    layout: Layout | str,
    poses: Float[np.ndarray, "M S 6"],
    *,
    weights: Weights = None,
    occlusion_reference: str | None = None,
    visibility: str | None = None,
    conditions: Conditions | str | None = None,
    metrics: str | Sequence[str] = (),
    detection: DetectionCurves | None = None,
) -> ManyScores:
    """Exact scores of one layout's sensors at M sets of S poses: the metrics and P_sm only.

    Layouts are scored in parallel, on all cores or devices.

    Args:
        scene, layout, weights, occlusion_reference, visibility, conditions, metrics, detection: As
            in :func:`evaluate`.
        poses: (M, S, 6) x, y, z [m], roll, pitch, yaw [rad].

    Returns:
        The scores; but for the last digits of sums, those of :func:`evaluate`.

    Raises:
        InspeError: As :func:`evaluate`, and for traced poses or another shape.

    >>> poses = np.stack([layout.poses, layout.poses + [0, 0, 2.0, 0, 0, 0]])  # and 2 m up
    >>> found = inspe_jax.evaluate_many(scene, layout, poses)
    >>> [round(float(value), 2) for value in found.surrogate]
    [0.83, 0.8]
    """
    scene, layout, conditions = check_layout(scene, layout, conditions)
    readings = options_of(scene, occlusion_reference, visibility)
    check_options(weights, **readings, detection=detection)
    try:
        poses = np.asarray(poses, float)
    except (TypeError, ValueError):  # a traced array's error is a TypeError
        raise InspeError(
            f"poses: numbers (M, {len(layout)}, 6) are needed, as of "
            "[layout.poses for layout in layouts]; for gradients, use evaluate"
        ) from None
    if poses.ndim != 3 or poses.shape[1:] != (len(layout), 6) or not len(poses):
        raise InspeError(
            f"poses of shape {poses.shape}: (M, {len(layout)}, 6) for M times the sensors of "
            f"{layout.name}, x, y, z, roll, pitch, yaw each"
        )
    check_values(poses, "poses")
    check_memory(scene.voxels.count, len(layout))
    for number, row in enumerate(poses):
        check_places(scene, replace(layout.with_poses(row), name=f"poses[{number}]"))
    layout = perceiving(scene, layout, conditions)
    tiled = tiled_scene_of(scene, whole=True)
    by_name = weights_of(weights)
    if by_name["information_gain"] > 0:
        check_entropy(scene, np.asarray(entropy(tiled.occupancy)).sum())
    found = measure_many(
        tiled,
        from_center(scene.voxels.center, poses),
        SensorSet.of(layout),
        scene.voxels.size,
        ScoreOptions.of(**readings, names=chosen(metrics, by_name), detection=detection),
    )
    return ManyScores(found, np.asarray(surrogate(found, by_name)))


def _by_part(
    scene: Scene, found: MetricValues, names: tuple[str, ...], weights: dict[str, float]
) -> dict[str, dict[str, Any]]:
    """:attr:`Scores.parts`."""
    grid = scene.voxels
    core = np.hypot(*(grid.columns - grid.center[:2]).T) <= CORE
    if found.parts is None or core.all() or not core.any():
        return {}
    rows = {name: found.parts[name] for name in names}
    rows["surrogate"] = surrogate(rows, weights)
    return {
        part: {name: _numbers(row[k]) for name, row in rows.items()}
        for k, part in enumerate(("core", "outside"))
    }


def _by_region(
    scene: Scene, tiled: TiledScene, columns: Float[Array, " MC"]
) -> dict[str, Float[Array | np.ndarray, ""]]:
    """The mean of a value per column over each region that the scene has."""
    place, label = np.asarray(tiled.tiles.place), scene.voxels.region
    weight = 1.0 if scene.inside_statics is None else 1.0 - scene.inside_statics.mean(1)
    there = [region for region in Region if (label == region).any()]
    if not isinstance(columns, jax.core.Tracer):
        share = np.asarray(columns)[place]
        if scene.inside_statics is None:
            return {region.key: share[label == region].mean() for region in there}
        each = np.array([(label == region) * weight for region in there])
        means = (each @ share) / np.maximum(each.sum(1), 1e-9)
        return {region.key: mean for region, mean in zip(there, means, strict=True)}
    belongs = np.zeros((len(Region), len(columns)), float)
    for region in there:
        belongs[region, place] = (label == region) * weight
    means = _means(columns, belongs)
    return {region.key: means[region] for region in there}


@jax.jit
def _means(x: Float[Array, " n"], rows: Float[Array, "R n"]) -> Float[Array, " R"]:
    """The mean of ``x`` weighted by each row; 0 where a row has no weight."""
    counted = rows.astype(x.dtype)
    return (counted * x[None]).sum(1) / jnp.maximum(counted.sum(1), 1e-6)


def _numbers(x: Any) -> Any:
    """Python numbers, nested as the array is; a traced row becomes a list of scalars."""
    if not isinstance(x, jax.core.Tracer):
        return np.asarray(x, float).tolist()
    return _scalars(x) if x.ndim else x


@jax.jit
def _scalars(row: Float[Array, " n"]) -> list[Float[Array, ""]]:
    return list(row)


def options_of(
    scene: Scene, occlusion_reference: str | None = None, visibility: str | None = None
) -> dict[str, Any]:
    """The two options by name; the scene's profile gives those that are None."""
    return dict(
        occlusion_reference=occlusion_reference or scene.profile.occlusion_reference,
        visibility=visibility or scene.profile.visibility,
    )


def check_options(
    weights: Weights,
    occlusion_reference: str,
    visibility: str,
    detection: DetectionCurves | None = None,
) -> None:
    """Raise InspeError where an option of :func:`evaluate` is unknown."""
    if not (detection is None or isinstance(detection, DetectionCurves)):
        raise wrong_kind("detection", detection, "curves, as inspe_jax.load_detection reads them")
    check_known(occlusion_reference, OCCLUSION_REFERENCES, "occlusion_reference")
    check_known(visibility, VISIBILITIES, "visibility")
    weights_of(weights)


def check_entropy(scene: Scene, entropy: Any) -> None:
    """Raise InspeError unless the entropy H(Ω) is more than 0; a traced one passes."""
    if isinstance(entropy, jax.core.Tracer):
        return
    if not float(entropy) > 0:
        raise InspeError(
            f"{scene.name}: information gain needs traffic: no voxel of the scene is occupied in "
            "some frames and free in others, so there is no entropy to resolve; build the scene "
            "with a density of low, medium or high and at least 2 frames, or give information gain "
            "weight 0"
        )
