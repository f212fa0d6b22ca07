"""The surrogate metrics of InSPE (arXiv 2504.08240), in the paper's order, and their registry.

Every score uses these functions: exact or soft, of a scene or of a sample of it. Symbols are the
paper's. V_i is a voxel of the region of interest Ω, w_i the weight of its region, and f(V_i) = 1 if
some sensor ray passes through it, else 0:

- coverage C = Σ w_i f(V_i) / Σ w_i: :func:`coverage`;
- occlusion O = mean over frames of 1 − |V_occ| / |V_orig|: :func:`occlusion`;
- information gain IG = 1 − H(Ω|P) / H(Ω), of a placement P: :func:`information_gain`;
- the surrogate P_sm = 0.3 C + 0.5 O + 0.2 IG: :func:`surrogate`.

The sensors are fused before a metric is computed: once all of them, and once without each of G
groups of failures. So arrays have a leading axis of 1 + G rows, and functions keep it.
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
"""The three readings of V_orig, the denominator of occlusion; see :func:`occlusion_terms`."""


class Sets(Protocol):
    """The operations on sets of a tile's voxels that metrics use.

    :mod:`inspe_jax.scoring.reading` has both implementations, exact and soft.
    """

    def voxels(self, tile: Tile) -> Any:
        """The voxels that there are."""

    def both(self, a: Any, b: Any) -> Any:
        """Intersection of two sets."""

    def outside(self, a: Any, b: Any) -> Any:
        """The voxels of ``a`` that are not in ``b``, a subset of ``a``."""

    def any_of(self, rows: Any, failures: Groups | None) -> Any:
        """Union of all rows (S, …), and of all but each group's: (1 + G, …)."""

    def count(self, found: Any) -> Num[Array, "..."]:
        """How many voxels a set has."""

    def count_both(self, rows: Any, found: Any) -> Num[Array, "1+G F"]:
        """How many voxels of each row are in a set, in each frame."""


class Evidence(NamedTuple):
    """What metrics are computed from: the counts of a scene with T frames and L columns.

    ``covered`` is f, as the share of each column's levels that some sensor has in view; ``weight``
    is that of the columns' regions. ``seen`` and ``original`` are |V_orig| − |V_occ| and |V_orig|
    in each frame (:func:`occlusion_terms`). ``remaining`` and ``entropy`` are H(Ω|P) and H(Ω) in
    nats (:func:`entropy_terms`). ``terms`` holds the further terms of the registry's metrics by
    name, summed over the tiles.
    """

    covered: Float[Array, "1+G L"]
    weight: Float[Array, " L"]
    seen: Num[Array, "T 1+G"]
    original: Num[Array, "T 1+G"]
    remaining: Float[Array, " 1+G"]
    entropy: Float[Array, ""]
    terms: dict[str, Any]


def coverage(covered: Float[Array, "... L"], weight: Float[Array, " L"]) -> Float[Array, "..."]:
    """C = Σ w_i f(V_i) / Σ w_i: the weighted share of voxels that some sensor ray passes through.

    ``covered`` is f of all sensors together, for each of L voxels, or its mean over each of L
    columns. ``weight`` is the weight w of their regions.
    """
    return dot(covered, weight) / dot(jnp.ones_like(covered), weight)


def occlusion_terms(
    reading: Sets, union: Any, covered: Any, free: Any, solid: Any, reference: str
) -> tuple[Num[Array, "1+G F"], Num[Array, "1+G F"]]:
    """(|V_orig| − |V_occ|, |V_orig|) of one tile in F frames.

    Arguments are sets of ``reading``: ``union`` is what some sensor has in view and in line of
    sight, ``covered`` what some sensor has in view, ``free`` the voxels outside every vehicle, and
    ``solid`` those inside one. The paper leaves V_orig open. ``reference`` says which voxels it
    has:

    - ``roi``: every voxel of the region of interest. A voxel is occluded unless some sensor sees
      it. Only this reading puts O below C throughout, as in the paper's Table 2.
    - ``covered``: the voxels that some sensor has in view.
    - ``targets``: the voxels inside vehicles. A vehicle does not hide its own voxels.

    Under ``roi`` and ``covered``, voxels inside vehicles belong neither to V_orig nor to V_occ.
    """
    counted = counted_by_occlusion(free, solid, reference)
    seen = union.count(counted)
    if reference == "covered":
        return seen, reading.count_both(covered, counted)
    return seen, jnp.broadcast_to(reading.count(counted), seen.shape)


def counted_by_occlusion(free: Any, solid: Any, reference: str) -> Any:
    """The voxels that occlusion counts: those inside vehicles under ``targets``, else the others.

    ``free`` and ``solid`` are sets of any form, of the voxels outside and inside vehicles.
    """
    return solid if reference == "targets" else free


def unknown_reference(reference: str) -> InspeError:
    """The error of a reference that is none of :data:`OCCLUSION_REFERENCES`."""
    return InspeError(
        f"occlusion_reference '{reference}': one of {', '.join(OCCLUSION_REFERENCES)}"
    )


def occlusion(seen: Float[Array, "T ..."], original: Float[Array, "T ..."]) -> Float[Array, "..."]:
    """O = mean over frames of 1 − |V_occ| / |V_orig|; higher is better.

    ``seen`` and ``original`` are the terms of :func:`occlusion_terms`, one row a frame. A frame in
    which V_orig is empty is left out of the mean; if it is empty in all frames, O is 0.
    """
    has = original > 0
    share = jnp.where(has, seen / jnp.where(has, original, 1.0), 0.0)
    return share.sum(0) / jnp.maximum(has.astype(share.dtype).sum(0), 1.0)


def entropy(p: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Binary entropy H(p) = −p ln p − (1 − p) ln(1 − p) in nats; 0 at p = 0 and p = 1."""
    return -_x_log_x(p) - _x_log_x(1.0 - p)


def _x_log_x(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """x ln x, and 0 at 0. The inner choice keeps ln 0 out of the gradient."""
    return x * jnp.log(jnp.where(x > 0, x, 1.0))


def resolved(
    visible: Float[Array, "S V"], reliability: Float[Array, " S"], failures: Groups | None
) -> Float[Array, "1+G V"]:
    """q_i = 1 − ∏_s (1 − ρ_s v_si), the chance that some sensor resolves voxel i.

    ``reliability`` is ρ. ``visible`` is v: f, or the share of frames in which sensor s sees voxel
    i.
    """
    each = jnp.reshape(reliability, (-1,) + (1,) * (visible.ndim - 1))
    return leave_one_out(visible * each, failures)


def entropy_terms(
    resolved: Float[Array, "... V"], occupancy: Float[Array, " V"]
) -> tuple[Float[Array, "..."], Float[Array, ""]]:
    """(H(Ω|P), H(Ω)) of some voxels in nats: the entropy that remains, and all of it.

    H(Ω) = Σ H(p̂_i) and H(Ω|P) = Σ (1 − q_i) H(p̂_i). ``occupancy`` is p̂_i, the share of frames in
    which voxel i is occupied; ``resolved`` is q_i of :func:`resolved`. The paper's H(Ω|P) is read
    here as the entropy that remains. For an erasure channel, IG is then the mutual information
    divided by H(Ω).
    """
    h = entropy(occupancy)
    return dot(1.0 - resolved, h), dot(jnp.ones_like(h), h)


def information_gain(
    remaining: Float[Array, "..."], total: Float[Array, ""]
) -> Float[Array, "..."]:
    """IG = 1 − H(Ω|P) / H(Ω), the share of the occupancy's entropy that the sensors resolve.

    ``remaining`` and ``total`` are the terms of :func:`entropy_terms`, summed over all voxels. IG
    is 0 where there is no entropy. The paper prints H(Ω|P) as a sum over the visible voxels. That
    would give 1 − IG, which falls as sensors see more, against Table 2.
    """
    some = total > 0  # without entropy nothing is resolved: 0, not NaN
    return jnp.where(some, 1.0 - remaining / jnp.where(some, total, 1.0), 0.0)


# ── The registry ────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Metric:
    """A row of the registry: a metric between 0 and 1, higher is better.

    ``name`` is used in records and options, ``symbol`` in tables. ``weight`` is the usual one in
    P_sm. ``summary`` says in one line what the metric is. ``value`` gives the metric (1 + G,) from
    the :class:`Evidence` of a scene. ``terms`` is for a metric that needs more than the evidence
    has: a function of (reading, tile, the sets that each sensor has in view, failures) that gives
    arrays. They are summed over the tiles and are then ``evidence.terms[name]``.
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
"""The metrics by name, in the paper's order. A further row appears in scores, tables and saved
results, and can have weight in P_sm, with no other change."""


def tile_terms(
    metrics: Sequence[Metric], reading: Sets, tile: Tile, views: Any, failures: Groups | None
) -> dict[str, Any]:
    """The further terms that metrics ask for, of one tile, by the metric's name."""
    return {
        metric.name: metric.terms(reading, tile, views, failures)
        for metric in metrics
        if metric.terms is not None
    }


def surrogate(scores: Mapping[str, Any], weights: Mapping[str, Any]) -> Any:
    """P_sm = Σ weight · metric; with the paper's weights, 0.3 C + 0.5 O + 0.2 IG.

    Both arguments are by the metric's name. ``weights`` have every metric, as :func:`weights_of`
    gives them; they may be traced.
    """
    terms = [weights[name] * scores[name] for name in METRICS]
    return sum(terms[1:], terms[0])


SURROGATE = Metric(
    "surrogate", "P_sm", 0.0, "the weighted sum of the metrics", lambda found: jnp.zeros(())
)
"""P_sm as a row of tables. Its value is that of :func:`surrogate`, not of the row."""


def listed() -> tuple[Metric, ...]:
    """The rows of a table of scores: every metric, then P_sm."""
    return (*METRICS.values(), SURROGATE)


Weights = Mapping[str, float] | Sequence[float] | None
"""Weights by the metric's name; or three numbers, for C, O and IG."""


def weights_of(given: Weights = None) -> dict[str, float]:
    """The weight of every metric in P_sm.

    None gives the usual weights; otherwise a metric that is not given has weight 0. Raises
    InspeError where a name is of no metric, a weight is negative, or they do not sum to 1.
    """
    if given is None:
        return {name: metric.weight for name, metric in METRICS.items()}
    if not isinstance(given, Mapping):
        paper = tuple(METRICS)[:3]
        if len(given) != len(paper):
            raise InspeError(
                f"weights {tuple(given)}: give {len(paper)} numbers, for {', '.join(paper)}; or "
                "weights by name"
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
        raise InspeError(f"weights {words}: no weight may be negative, and they must sum to 1")
    return weights
