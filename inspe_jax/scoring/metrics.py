"""The surrogate metrics of InSPE (arXiv 2504.08240), in the paper's order.

Sensors are fused before a metric sees them, all of them and with each left out in turn
(:func:`~inspe_jax.core.numerics.leave_one_out`); every function keeps that leading axis.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.numerics import dot

OCCLUSION_REFERENCES = ("roi", "covered", "targets")
"""Readings of V_orig, the voxels that occlusion is a share of; see :func:`occlusion_terms`."""


def coverage(covered: Float[Array, "... V"], weight: Float[Array, " V"]) -> Float[Array, "..."]:
    """C = Σ w f / Σ w: the weighted share of voxels that some sensor ray passes through.

    ``covered`` is f fused over the sensors, ``weight`` the voxel's region weight.
    """
    return dot(covered, weight) / dot(jnp.ones_like(covered), weight)


def occlusion_terms(
    visible: Float[Array, "... V"],
    covered: Float[Array, "... V"],
    free: Float[Array, " V"],
    solid: Float[Array, " V"],
    reference: str,
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """(|V_orig| − |V_occ|, |V_orig|) of one frame.

    ``visible``: in view of some sensor and in its line of sight; ``free``: outside
    every vehicle; ``solid``: inside one. The paper leaves V_orig open. ``roi``:
    every voxel of the region of interest, occluded unless some sensor sees it; the
    only reading that puts O below C throughout, as Table 2 has it. ``covered``:
    those that some sensor has in view. ``targets``: the vehicles' own voxels, which
    their own vehicle does not hide. Under the first two the solid voxels belong to
    neither set.
    """
    if reference == "roi":
        return visible @ free, jnp.ones_like(covered) @ free
    if reference == "covered":
        return visible @ free, covered @ free
    if reference == "targets":
        return visible @ solid, jnp.ones_like(covered) @ solid
    raise unknown_reference(reference)


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


def entropy_terms(
    resolved: Float[Array, "... V"], occupancy: Float[Array, " V"]
) -> tuple[Float[Array, "..."], Float[Array, ""]]:
    """(H(Ω|P), H(Ω)) of some voxels: what of their entropy remains, and all of it.

    ``resolved`` is q_i, reliability × visibility fused over the sensors; ``occupancy``
    is p̂_i, the share of frames in which a voxel is occupied. H(Ω|P) is read as what
    remains, Σ (1 − q_i) H_i: for an erasure channel this makes IG the mutual
    information.
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


def surrogate(scores: Mapping[str, Any], weights: Mapping[str, Any]) -> Any:
    """P_sm = 0.3 C + 0.5 O + 0.2 IG: the weighted sum of metrics by name.

    ``weights`` as :func:`weights_of` gives them; they may be traced.
    """
    terms = [weights[name] * scores[name] for name in METRICS]
    return sum(terms[1:], terms[0])


# ── The registry ────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Metric:
    """A row of the registry: a metric between 0 and 1, higher is better.

    ``name`` in records and options, ``symbol`` in tables, its usual ``weight`` in P_sm, and a
    line that says what it is.
    """

    name: str
    symbol: str
    weight: float
    summary: str

    @property
    def words(self) -> str:
        """The name, for people."""
        return self.name.replace("_", " ")


METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric(
            "coverage", "C", 0.3, "share of voxels that some sensor ray passes through, by region"
        ),
        Metric(
            "occlusion", "O", 0.5, "share that stays visible behind traffic, a mean over frames"
        ),
        Metric(
            "information_gain", "IG", 0.2, "share of the occupancy's entropy that sensors resolve"
        ),
    )
}
"""The metrics by name, in the paper's order."""


def listed() -> tuple[Metric, ...]:
    """What tables of scores list: every metric, and P_sm after them."""
    surrogate = Metric("surrogate", "P_sm", 0.0, "the weighted sum of the metrics")
    return (*METRICS.values(), surrogate)


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
