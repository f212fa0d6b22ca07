"""The surrogate metrics of InSPE (arXiv 2504.08240), in the paper's order, and their registry.

Every score uses these functions: exact or soft, of a scene or of a sample of it. Symbols are the
paper's. V_i is a voxel of the region of interest Ω, w_i the weight of its region, and f(V_i) = 1 if
some sensor ray passes through it, else 0. P is a placement.

The sensors are fused before a metric is computed: once all of them, and once without each of G
groups of failures. So arrays have a leading axis of 1 + G rows, and functions keep it.
"""

from collections.abc import Container, Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.numerics import Groups, dot, leave_one_out, weighted_mean
from inspe_jax.scoring.metric import Metric, TileEvidence
from inspe_jax.scoring.numbers import Reading
from inspe_jax.scoring.reading import Union
from inspe_jax.scoring.target_metrics import ROWS

OCCLUSION_REFERENCES = ("roi", "covered", "targets")
"""The three readings of V_orig, the denominator of occlusion; see :func:`occlusion_terms`."""


def coverage(covered: Float[Array, "... L"], weight: Float[Array, " L"]) -> Float[Array, "..."]:
    """C = Σ w_i f(V_i) / Σ w_i: the weighted share of voxels that some sensor ray passes through.

    ``covered`` is f of all sensors together, for each of L voxels, or its mean over each of L
    columns. ``weight`` is the weight w of their regions. Traffic does not matter, but a ray that
    ends at a static body passes through no voxel behind it: f is 0 where a body cuts the line to
    the voxel's centre. Voxels inside bodies count nowhere.
    """
    return weighted_mean(covered, weight)


def occlusion_terms(
    reading: Reading, union: Union, covered: Any, free: Any, solid: Any, reference: str
) -> tuple[Num[Array, "1+G F"], Num[Array, "1+G F"]]:
    """(|V_orig| − |V_occ|, |V_orig|) of one tile in F frames.

    Arguments are sets of ``reading``: ``union`` is what some sensor has in view and in line of
    sight, ``covered`` what some sensor has in view, ``free`` the voxels outside every vehicle, and
    ``solid`` those inside one. The paper leaves V_orig open; it has, by ``reference``:

    - ``roi``: every voxel of the region of interest; one that no sensor sees is occluded. Only
      this reading puts O below C throughout, as in the paper's Table 2.
    - ``covered``: the voxels that some sensor has in view.
    - ``targets``: the voxels inside vehicles. A vehicle does not hide its own voxels.

    Under ``roi`` and ``covered``, voxels inside vehicles belong neither to V_orig nor to V_occ.
    """
    counted = counted_by_occlusion(free, solid, reference)
    seen = union.count(counted)
    if reference == "covered":
        return seen, reading.count_both(covered, counted)
    return seen, jnp.broadcast_to(reading.count(counted), seen.shape)


def occlusion_terms_within(
    reading: Reading, part: Any, seen: Any, covered: Any, free: Any, solid: Any, reference: str
) -> Num[Array, "2 F"]:
    """:func:`occlusion_terms` of all sensors together, in the columns of ``part`` alone."""
    counted = reading.both(counted_by_occlusion(free, solid, reference), part)
    whole = reading.both(counted, covered) if reference == "covered" else counted
    return jnp.stack([reading.count(reading.both(seen, counted)), reading.count(whole)])


def counted_by_occlusion(free: Any, solid: Any, reference: str) -> Any:
    """The voxels that occlusion counts: inside vehicles under ``targets``, else outside."""
    return solid if reference == "targets" else free


def occlusion(seen: Float[Array, "T ..."], original: Float[Array, "T ..."]) -> Float[Array, "..."]:
    """O = mean over frames of 1 − |V_occ| / |V_orig|; higher is better.

    ``seen`` and ``original`` are the terms of :func:`occlusion_terms`, one row a frame. A frame in
    which V_orig is empty is left out of the mean; if it is empty in all frames, O is 0.
    """
    has = original > 0
    share = jnp.where(has, seen / jnp.where(has, original, 1.0), 0.0)
    return share.sum(0) / jnp.maximum(has.astype(share.dtype).sum(0), 1.0)


@partial(jax.jit, inline=True)
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
    i. Sensors are taken as independent, though the same traffic hides a voxel from several: fused
    frame by frame, IG of the nine placements is 0 to 0.03 lower, most with many LiDARs.
    """
    each = jnp.reshape(reliability, (-1,) + (1,) * (visible.ndim - 1))
    return leave_one_out(visible * each, failures)


def entropy_terms(
    resolved: Float[Array, "... V"], occupancy: Float[Array, " V"]
) -> tuple[Float[Array, "..."], Float[Array, ""]]:
    """(H(Ω|P), H(Ω)) of some voxels in nats: the entropy that remains, and all of it.

    H(Ω) = Σ H(p̂_i) and H(Ω|P) = Σ (1 − q_i) H(p̂_i). ``occupancy`` is p̂_i, the share of frames in
    which voxel i is occupied; ``resolved`` is q_i of :func:`resolved`. The paper's H(Ω|P) is read
    here as the entropy that remains. Where q is of what is in view, each sensor is an erasure
    channel, and IG the mutual information divided by H(Ω); behind traffic it is not, as what is
    seen then depends on what is occupied.
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


METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "coverage",
            "C",
            0.3,
            "share of voxels that some sensor ray passes through, weighted by region",
            lambda found: coverage(found.covered, found.weight),
            by_region=True,
            submodular=True,
        ),
        Metric(
            "occlusion",
            "O",
            0.5,
            "share of voxels that stays visible behind traffic, a mean over frames",
            lambda found: occlusion(found.seen, found.original),
            submodular=True,
        ),
        Metric(
            "information_gain",
            "IG",
            0.2,
            "share of the occupancy's entropy that the sensors resolve",
            lambda found: information_gain(found.remaining, found.entropy),
            submodular=True,
        ),
        *ROWS,
    )
}
"""The metrics by name, the paper's first and in its order. A further row appears in scores, tables
and saved results, and can have weight in P_sm, with no other change."""


def tile_terms(metrics: Sequence[Metric], at: TileEvidence) -> dict[str, Any]:
    """The further terms that metrics ask for, of one tile, by the metric's name."""
    return {metric.name: metric.terms(at) for metric in metrics if metric.terms is not None}


def chosen(
    names: str | Sequence[str] = (), weights: Mapping[str, float] | None = None
) -> tuple[str, ...]:
    """The metrics of a score: the usual ones, those in ``names``, and those with weight.

    ``names`` may be a text, as of :func:`names_of`. In the registry's order. Raises InspeError
    where a name is of no metric.
    """
    names = names_of(names)
    for name in names:
        _check_name(name, f"metric '{name}'")
    weighted = {name for name, weight in (weights or {}).items() if weight}
    return tuple(
        name
        for name, metric in METRICS.items()
        if metric.usual or name in names or name in weighted
    )


def names_of(names: str | Sequence[str]) -> tuple[str, ...]:
    """Names that are given as such, as a text with commas between them, or as "all"."""
    if not isinstance(names, str):
        return tuple(names)
    several = METRICS if names.strip() == "all" else map(str.strip, names.split(","))
    return tuple(name for name in several if name)


def _check_name(name: str, what: str) -> None:
    """Raise InspeError where a name is of no metric; ``what`` says what it is of."""
    if name not in METRICS:
        known = tuple(METRICS)
        raise InspeError(f"{what}: a metric is one of {', '.join(known)}{nearest(name, known)}")


def surrogate(scores: Mapping[str, Any], weights: Mapping[str, Any]) -> Any:
    """P_sm = Σ weight · metric; with the paper's weights, 0.3 C + 0.5 O + 0.2 IG.

    Both arguments are by the metric's name. ``weights`` have every metric, as :func:`weights_of`
    gives them; they may be traced. ``scores`` have those with weight, at least.
    """
    terms = [weights[name] * scores[name] for name in METRICS if name in scores]
    return sum(terms[1:], terms[0])


SURROGATE = Metric(
    "surrogate", "P_sm", 0.0, "the weighted sum of the metrics", lambda found: jnp.zeros(())
)
"""P_sm as a row of tables. Its value is that of :func:`surrogate`, not of the row."""


def listed(names: Container[str] | None = None) -> tuple[Metric, ...]:
    """The rows of a table of scores: the metrics of these names, or the usual ones; then P_sm."""
    some = [m for m in METRICS.values() if (m.usual if names is None else m.name in names)]
    return (*some, SURROGATE)


def listed_in(*scores: Any) -> tuple[Metric, ...]:
    """The rows of a table of the metrics that every one of some records of ``scores`` has."""
    names = [set(record.metrics) for record in scores]
    return listed(set.intersection(*names) if names else None)


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
        _check_name(name, f"weight of '{name}'")
    weights = {name: float(given.get(name, 0.0)) for name in METRICS}
    if not abs(sum(weights.values()) - 1.0) < 1e-6 or min(weights.values()) < 0:
        words = ", ".join(f"{name} {value:g}" for name, value in weights.items())
        raise InspeError(f"weights {words}: no weight may be negative, and they must sum to 1")
    return weights
