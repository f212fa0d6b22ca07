"""The order in which frames are drawn. It is the same for the same seed and epoch."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int


def in_order(count: int) -> Int[np.ndarray, " D"]:
    """Every frame once, as stored."""
    return np.arange(count)


def shuffled(count: int, rng: np.random.Generator) -> Int[np.ndarray, " D"]:
    """Every frame once, at random."""
    return rng.permutation(count)


def balanced(
    members: Mapping[str, Sequence[int] | np.ndarray],
    shares: Mapping[str, float],
    count: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, " D"]:
    """``count`` frames at random, divided among classes in proportion to ``shares``.

    ``members`` are the frames that have a road user of each class; a frame may be in several, and
    is drawn again only when all others of the class were drawn as often. So frames with rare
    classes repeat in an epoch, and others are left out, as in class-balanced sampling for nuScenes
    (Zhu et al. 2019).
    """
    names = [name for name, share in shares.items() if share > 0]
    weights = np.array([shares[name] for name in names])
    exact = weights / weights.sum() * count
    draws = np.floor(exact + 1e-9).astype(int)
    for k in np.argsort(draws - exact, kind="stable")[: count - draws.sum()]:
        draws[k] += 1
    parts = []
    for name, needed in zip(names, draws, strict=True):
        own = np.asarray(members[name])
        rounds = [rng.permutation(own) for _ in range(-(-int(needed) // len(own)))]
        parts.append(np.concatenate([*rounds, own[:0]])[:needed])
    return rng.permutation(np.concatenate(parts))
