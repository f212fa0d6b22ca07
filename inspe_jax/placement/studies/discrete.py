"""The best k of given candidate poses, by an integer program: a reference for searches."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

from inspe_jax.core.errors import InspeError
from inspe_jax.scoring import metrics


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Subset:
    """The ``chosen`` candidates (k,), their score ``value``, and an upper ``bound`` of all scores.

    If ``value`` equals ``bound``, the choice is optimal.
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
    """The k of K candidates with the highest P_sm, each used at most once.

    ``f``, ``seen``: which voxels each candidate has in view, and sees in each frame.
    ``weight``, ``entropy``, ``free``: what each voxel counts for in C, IG and O; each sums to 1.
    ``reliability``: ρ, the same for all candidates.
    ``weights``: of coverage, occlusion and information gain in P_sm; there are no others.
    ``seconds``: time limit of the solver HiGHS, which then returns the best choice and a bound.

    The program is one of maximum coverage. y_j says whether candidate j is chosen. z says whether
    voxels are covered that one set of candidates sees: z ≤ 1 and z ≤ Σ y over the set. Voxels
    with the same set have one z. With ρ < 1, a voxel that n candidates see resolves 1 − (1 − ρ)ⁿ
    of its entropy, which is concave in n. So there is a z worth ρ for the first candidate, one
    worth ρ(1 − ρ) for the second, and so on, with sum ≤ Σ y.

    Raises InspeError if k is not in 1 … K, ρ is not in 0 … 1, another metric has weight, or no
    choice is found in time.
    """
    count = len(f)
    if not 1 <= k <= count:
        raise InspeError(f"k {k}: must be from 1 to {count}, the number of candidates")
    if not 0 <= reliability <= 1:
        raise InspeError(f"reliability {reliability:g}: must be from 0 to 1")
    given = metrics.weights_of(weights)
    c, o, ig = (given.pop(name) for name in ("coverage", "occlusion", "information_gain"))
    if any(given.values()):
        raise InspeError(
            f"weights on {', '.join(name for name in given if given[name])}: the integer program "
            "is of coverage, occlusion and information gain only"
        )
    ideal = reliability == 1  # then IG, too, depends on a union alone
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
"""Sets of candidates, one for each column, and the worth of what exactly they see."""


def _solve(
    groups: list[Group], steps: list[Float[np.ndarray, " n"]], count: int, k: int, seconds: float
) -> tuple[Int[np.ndarray, " k"], float]:
    """Maximise Σ worth · steps · z; returns the chosen candidates and the upper bound."""
    gain, blocks, links = [np.zeros(count)], [], []
    for (patterns, worth), step in zip(groups, steps, strict=True):
        # What only one candidate sees is added to that candidate.
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
            f"no choice of {k} from {count} candidates was found in {seconds:g} s "
            f"({found.message}); allow more seconds, or fewer candidates, voxels or frames"
        )
    chosen = np.sort(np.argsort(-found.x[:count], kind="stable")[:k])
    return chosen, float(-found.mip_dual_bound)


def _together(
    elements: Bool[np.ndarray, "K E"], worth: Float[np.ndarray, " E"]
) -> tuple[Bool[np.ndarray, "K P"], Float[np.ndarray, " P"]]:
    """Join elements that the same candidates see: one column for each set, worth their sum."""
    some = elements.any(0) & (worth > 0)
    packed = np.packbits(elements[:, some], axis=0).T
    _, first, back = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    total = np.bincount(back.ravel(), worth[some], minlength=len(first))
    return elements[:, some][:, first], total
