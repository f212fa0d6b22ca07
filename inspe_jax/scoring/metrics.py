"""The surrogate metrics of InSPE (arXiv 2504.08240), in the paper's order, and their registry.

Every score goes through these functions: exact or soft, of a scene or a sample of it. Sensors are
fused before a metric sees them, all of them and with each group of failures left out in turn; every
function keeps that leading axis of 1 + G rows.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.numerics import Groups, dot, leave_one_out
from inspe_jax.visibility.tiles import Tile

OCCLUSION_REFERENCES = ("roi", "covered", "targets")
"""Readings of V_orig, the voxels that occlusion is a share of; see :func:`occlusion_terms`."""


class Sets(Protocol):
    """Sets of a tile's voxels, exact or soft, as metrics count them.

    See :mod:`inspe_jax.scoring.reading`, which has both kinds and more operations.
    """

    def voxels(self, tile: Tile) -> Any:
        """The voxels that there are."""

    def both(self, a: Any, b: Any) -> Any:
        """Intersection of two sets."""

    def outside(self, a: Any, b: Any) -> Any:
        """The voxels of ``a`` that are not in ``b``, a part of ``a``."""

    def any_of(self, rows: Any, failures: Groups | None) -> Any:
        """Union of all rows (S, …), and of all but each group's: (1 + G, …)."""

    def count(self, found: Any) -> Num[Array, "..."]:
        """How many voxels a set has."""

    def count_both(self, rows: Any, found: Any) -> Num[Array, "1+G F"]:
        """How many voxels of each row are in a set, in each frame."""


class Evidence(NamedTuple):
    """What metrics are of: what is counted of a scene with T frames, L columns and V voxels.

    ``covered``: f, as the share of each column's levels that some sensor has in view; ``weight`` of
    the columns' regions. ``seen`` and ``original``: |V_orig| − |V_occ| and |V_orig| in each frame
    (:func:`occlusion_terms`). ``remaining`` and ``entropy``: H(Ω|P) and H(Ω)
    (:func:`entropy_terms`). ``terms``: what else the metrics of the registry ask for, by name,
    summed over the tiles.
    """

    covered: Float[Array, "1+G L"]
    weight: Float[Array, " L"]
    seen: Num[Array, "T 1+G"]
    original: Num[Array, "T 1+G"]
    remaining: Float[Array, " 1+G"]
    entropy: Float[Array, ""]
    terms: dict[str, Any]


def coverage(covered: Float[Array, "... L"], weight: Float[Array, " L"]) -> Float[Array, "..."]:
    """C = Σ w f / Σ w: the weighted share of voxels that some sensor ray passes through.

    ``covered`` is f fused over the sensors, of voxels or as a share of each column's; ``weight`` is
    that of their regions.
    """
    return dot(covered, weight) / dot(jnp.ones_like(covered), weight)


def occlusion_terms(
    reading: Sets, union: Any, covered: Any, free: Any, solid: Any, reference: str
) -> tuple[Num[Array, "1+G F"], Num[Array, "1+G F"]]:
    """(|V_orig| − |V_occ|, |V_orig|) of one tile in F frames.

    ``union`` is what is in view of some sensor and in its line of sight, ``covered`` what is in
    view of some sensor; ``free`` are the voxels outside every vehicle, ``solid`` those inside one:
    sets of ``reading``. The paper leaves V_orig open. ``roi``: every voxel of the region of
    interest, occluded unless some sensor sees it; the only reading that puts O below C throughout,
    as Table 2 has it. ``covered``: those that some sensor has in view. ``targets``: the vehicles'
    own voxels, which their own vehicle does not hide. Under the first two the solid voxels belong
    to neither set.
    """
    counted = solid if reference == "targets" else free
    seen = union.count(counted)
    if reference == "covered":
        return seen, reading.count_both(covered, counted)
    return seen, jnp.broadcast_to(reading.count(counted), seen.shape)


def unknown_reference(reference: str) -> InspeError:
    """The error of a reference that is none of :data:`OCCLUSION_REFERENCES`."""
    return InspeError(
        f"occlusion_reference '{reference}': one of {', '.join(OCCLUSION_REFERENCES)}"
    )


def occlusion(seen: Float[Array, "T ..."], original: Float[Array, "T ..."]) -> Float[Array, "..."]:
    """O = mean over frames of 1 − |V_occ| / |V_orig|; higher is better.

    Takes the terms of :func:`occlusion_terms`, a row a frame. A frame with no
    target has no share and is left out of the mean; with none at all O is 0.
    """
    has = original > 0
    share = jnp.where(has, seen / jnp.where(has, original, 1.0), 0.0)
    return share.sum(0) / jnp.maximum(has.astype(share.dtype).sum(0), 1.0)


def entropy(p: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Binary entropy H(p) in nats; 0 at p = 0 and p = 1."""
    return -_x_log_x(p) - _x_log_x(1.0 - p)


def _x_log_x(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """x ln x, 0 at 0; the inner choice keeps the logarithm from ever seeing a 0."""
    return x * jnp.log(jnp.where(x > 0, x, 1.0))


def resolved(
    visible: Float[Array, "S V"], reliability: Float[Array, " S"], failures: Groups | None
) -> Float[Array, "1+G V"]:
    """q_i, the chance that the sensors resolve a voxel: 1 − ∏ (1 − reliability · visibility).

    ``visible`` is f, or the share of frames in which a sensor sees the voxel.
    """
    each = jnp.reshape(reliability, (-1,) + (1,) * (visible.ndim - 1))
    return leave_one_out(visible * each, failures)


def entropy_terms(
    resolved: Float[Array, "... V"], occupancy: Float[Array, " V"]
) -> tuple[Float[Array, "..."], Float[Array, ""]]:
    """(H(Ω|P), H(Ω)) of some voxels: what of their entropy remains, and all of it.

    ``resolved`` is q_i of :func:`resolved`; ``occupancy`` is p̂_i, the share of frames in which a
    voxel is occupied. H(Ω|P) is read as what remains, Σ (1 − q_i) H_i: for an erasure channel this
    makes IG the mutual information.
    """
    h = entropy(occupancy)
    return dot(1.0 - resolved, h), dot(jnp.ones_like(h), h)


def information_gain(
    remaining: Float[Array, "..."], total: Float[Array, ""]
) -> Float[Array, "..."]:
    """IG = 1 − H(Ω|P)/H(Ω), the share of the occupancy entropy that the sensors resolve.

    Takes the terms of :func:`entropy_terms`, summed over all voxels; 0 without entropy.
    As printed, with H(Ω|P) summed over the visible voxels, it would be 1 − IG, and fall
    as sensors see more.
    """
    some = total > 0  # without entropy nothing is resolved: 0, not NaN
    return jnp.where(some, 1.0 - remaining / jnp.where(some, total, 1.0), 0.0)


# ── The registry ────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Metric:
    """A row of the registry: a metric between 0 and 1, higher is better.

    ``name`` in records and options, ``symbol`` in tables, its usual ``weight`` in P_sm, and a
    line that says what it is. ``value`` takes the :class:`Evidence` of a scene and gives the metric
    (1 + G,). ``terms``, where it needs more than the evidence has: a function of a reading, a tile,
    what each sensor has in view of it and the failures, whose arrays are summed over the tiles and
    handed on as ``evidence.terms[name]``.
    """

    name: str
    symbol: str
    weight: float
    summary: str
    value: Callable[[Evidence], Float[Array, " 1+G"]]
    terms: Callable[[Sets, Tile, Any, Groups | None], Any] | None = None

    @property
    def words(self) -> str:
        """The name, for people."""
        return self.name.replace("_", " ")


METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "coverage",
            "C",
            0.3,
            "share of voxels that some sensor ray passes through, weighted by region",
            lambda found: coverage(found.covered, found.weight),
        ),
        Metric(
            "occlusion",
            "O",
            0.5,
            "share of voxels that stays visible behind traffic, a mean over frames",
            lambda found: occlusion(found.seen, found.original),
        ),
        Metric(
            "information_gain",
            "IG",
            0.2,
            "share of the occupancy's entropy that the sensors resolve",
            lambda found: information_gain(found.remaining, found.entropy),
        ),
    )
}
"""The metrics by name, in the paper's order. A further row is scored, listed, saved and searched
for wherever these are."""


def tile_terms(
    metrics: Sequence[Metric], reading: Sets, tile: Tile, views: Any, failures: Groups | None
) -> dict[str, Any]:
    """What metrics ask for beside the evidence of all, of one tile, by name."""
    return {
        metric.name: metric.terms(reading, tile, views, failures)
        for metric in metrics
        if metric.terms is not None
    }


def surrogate(scores: Mapping[str, Any], weights: Mapping[str, Any]) -> Any:
    """P_sm = 0.3 C + 0.5 O + 0.2 IG: the weighted sum of metrics by name.

    ``weights`` as :func:`weights_of` gives them; they may be traced.
    """
    terms = [weights[name] * scores[name] for name in METRICS]
    return sum(terms[1:], terms[0])


SURROGATE = Metric(
    "surrogate", "P_sm", 0.0, "the weighted sum of the metrics", lambda found: jnp.zeros(())
)
"""P_sm as a row of tables; :func:`surrogate` is what it is."""


def listed() -> tuple[Metric, ...]:
    """What tables of scores list: every metric, and P_sm after them."""
    return (*METRICS.values(), SURROGATE)


Weights = Mapping[str, float] | Sequence[float] | None
"""Weights by name of the metric; or numbers, those of the paper's three in their order."""


def weights_of(given: Weights = None) -> dict[str, float]:
    """The weight of every metric in P_sm: the usual ones, or those given and else 0.

    Raises InspeError where one is of no metric or negative, or they do not sum to 1.
    """
    if given is None:
        return {name: metric.weight for name, metric in METRICS.items()}
    if not isinstance(given, Mapping):
        paper = tuple(METRICS)[:3]
        if len(given) != len(paper):
            raise InspeError(
                f"weights {tuple(given)}: {len(paper)} numbers, of {', '.join(paper)}; or by name"
            )
        given = dict(zip(paper, given, strict=True))
    for name in given:
        if name not in METRICS:
            known = tuple(METRICS)
            raise InspeError(
                f"weight of '{name}': a metric is one of {', '.join(known)}{nearest(name, known)}"
            )
    weights = {name: float(given.get(name, 0.0)) for name in METRICS}
    if not abs(sum(weights.values()) - 1.0) < 1e-6 or min(weights.values()) < 0:
        words = ", ".join(f"{name} {value:g}" for name, value in weights.items())
        raise InspeError(f"weights {words}: none may be negative, and they must sum to 1")
    return weights
