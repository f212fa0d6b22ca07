"""The best k of given candidate poses, by an integer program: what a search can be measured by."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

from inspe_jax.core.errors import InspeError
from inspe_jax.scoring import metrics


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Subset:
    """The ``chosen`` candidates (k,), what they score, and the ``bound`` that none can exceed.

    Where ``value`` equals ``bound``, they are the optimum.
    """

    chosen: Int[np.ndarray, " k"]
    value: float
    bound: float


def best_subset(
    f: Bool[np.ndarray, "K V"],
    seen: Bool[np.ndarray, "K T V"],
    weight: Float[np.ndarray, " V"],
    entropy: Float[np.ndarray, " V"],
    free: Float[np.ndarray, "T V"],
    reliability: float,
    k: int,
    weights: metrics.Weights = None,
    *,
    seconds: float = 60.0,
) -> Subset:
    """The k of K candidates with the highest P_sm, each used once at most.

    ``f`` and ``seen`` as from :meth:`Problem.views`, ``weight``, ``entropy`` and ``free`` as from
    :meth:`Problem.voxel_weights`; one ``reliability`` ρ. Maximum coverage: y_j whether candidate
    j is chosen; z for each set of candidates that some voxels, or voxels of a frame, are seen by:
    z ≤ 1 and z ≤ Σ y over the set. Voxels of one set count together. With ρ < 1, IG is worth
    1 − (1 − ρ)ⁿ where n candidates see a voxel, concave in n: it has a z for the first, worth ρ,
    for the second, worth ρ(1 − ρ), and so on, together ≤ Σ y. HiGHS stops after ``seconds``,
    with the best it found and a bound.

    Raises InspeError where k is not 1 … K, the reliability not in 0 … 1, or nothing is found.
    """
    count = len(f)
    if not 1 <= k <= count:
        raise InspeError(f"k {k}: choose from 1 to {count}, the number of candidates")
    if not 0 <= reliability <= 1:
        raise InspeError(f"reliability {reliability:g}: from 0 to 1")
    given = metrics.weights_of(weights)
    c, o, ig = (given[name] for name in ("coverage", "occlusion", "information_gain"))
    ideal = reliability == 1  # then IG is a union too
    union = np.concatenate([c * weight + (ig * entropy if ideal else 0.0), o * np.ravel(free)])
    groups = [_together(np.concatenate([f, np.reshape(seen, (count, -1))], 1), union)]
    steps: list[np.ndarray] = [np.ones(1)]
    if not ideal:
        groups.append(_together(f, ig * np.asarray(entropy, float)))
        steps.append(reliability * (1 - reliability) ** np.arange(k))
    chosen, bound = _solve(groups, steps, count, k, seconds)

    missed = (1 - reliability) ** f[chosen].sum(0)
    covered, watched = f[chosen].any(0), seen[chosen].any(0)
    value = c * (weight @ covered) + o * (free * watched).sum() + ig * (entropy @ (1 - missed))
    return Subset(chosen, float(value), bound)


Group = tuple[Bool[np.ndarray, "K P"], Float[np.ndarray, " P"]]
"""Sets of candidates, one a column, and what is seen by just them."""


def _solve(
    groups: list[Group], steps: list[Float[np.ndarray, " n"]], count: int, k: int, seconds: float
) -> tuple[Int[np.ndarray, " k"], float]:
    """Maximise Σ worth · steps · z; the chosen candidates and the bound."""
    gain, blocks, links = [np.zeros(count)], [], []
    for (patterns, worth), step in zip(groups, steps, strict=True):
        # What only one candidate sees is that candidate's own.
        own = patterns.sum(0) == 1
        gain[0] += step[0] * (patterns[:, own] @ worth[own])
        shared, worth = patterns[:, ~own], worth[~own]
        gain.append(np.outer(worth, step).ravel())
        blocks.append(sparse.csr_array(-shared.T.astype(float)))
        links.append(sparse.kron(sparse.eye_array(len(worth)), np.ones((1, len(step)))))
    objective = np.concatenate(gain)
    seen_by = sparse.hstack([sparse.vstack(blocks), sparse.block_diag(links)], format="csr")
    number = sparse.csr_array(
        (np.ones(count), (np.zeros(count, int), np.arange(count))), shape=(1, len(objective))
    )
    found = milp(
        -objective,
        integrality=(np.arange(len(objective)) < count).astype(int),
        bounds=Bounds(0, 1),
        constraints=[LinearConstraint(seen_by, -np.inf, 0), LinearConstraint(number, k, k)],
        options=dict(time_limit=seconds, mip_rel_gap=1e-6),
    )
    if found.x is None:
        raise InspeError(
            f"no choice of {k} from {count} candidates found in {seconds:g} s ({found.message}); "
            "allow more seconds, or fewer candidates, voxels or frames"
        )
    chosen = np.sort(np.argsort(-found.x[:count], kind="stable")[:k])
    return chosen, float(-found.mip_dual_bound)


def _together(
    elements: Bool[np.ndarray, "K E"], worth: Float[np.ndarray, " E"]
) -> tuple[Bool[np.ndarray, "K P"], Float[np.ndarray, " P"]]:
    """Elements that the same candidates have become one, worth their sum; none that nobody has."""
    some = elements.any(0) & (worth > 0)
    packed = np.packbits(elements[:, some], axis=0).T
    _, first, back = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    total = np.bincount(back.ravel(), worth[some], minlength=len(first))
    return elements[:, some][:, first], total
