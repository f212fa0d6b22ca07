"""Greedy placement of sensors among candidate poses, and the exchange of a unit's."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from inspe_jax.placement.candidate_table import AS_IT_IS, Picks, Table
from inspe_jax.placement.sampled_objective import LEAST

BATCH = 32
"""Candidates that are tried at once."""


def lazy_greedy(table: Table, before: Callable[[], None] = lambda: None) -> tuple[Picks, int]:
    """Place one sensor after the other, each time the one that adds most, at its best candidate.
    Returns the picks, and how many gains were computed again.

    Where the objective is submodular, an earlier gain bounds a later one (Minoux 1978): candidates
    are tried in that order until none can be better. The first sensor of a unit fixes its foot.
    ``before`` is called before each sensor; those that the table has as they are stay so.
    """
    picks, again, submodular = dict.fromkeys(table.own, AS_IT_IS), 0, table.problem.submodular
    looked = [table.kind_of(group[0]).looked for group in table.alike]
    at = [(g, k) for g, count in enumerate(looked) for k in range(count)]
    free, gain = np.ones(len(at), bool), np.full(len(at), np.inf)
    while len(picks) < len(table.problem.layout):
        before()
        rows, best, pick = table.rows(picks), -np.inf, None
        nothing = table.sampled.value(rows) if submodular else 0.0
        limit = np.where(free, gain, -np.inf)
        order = np.argsort(-limit, kind="stable")[: free.sum()]
        for part in np.split(order, range(BATCH, len(order), BATCH)):
            if nothing + limit[part].max(initial=-np.inf) <= best:
                break
            tried = [(i, s) for i in part for s in _may_stand(table, picks, *at[i])]
            free[part] = False  # for good where none may: units only ever take places
            if not tried:
                continue
            index = np.array([i for i, _ in tried])
            free[index] = True
            scores = table.scores(rows, [(s, at[i][1]) for i, s in tried])
            again += int(np.isfinite(gain[index]).sum())
            if submodular:
                gain[part] = -np.inf
                np.maximum.at(gain, index, scores - nothing)
            if pick is None or scores.max() > best:
                best, pick = scores.max(), tried[int(scores.argmax())]
        if pick is None:
            break
        i, s = pick
        picks[s], free[i] = at[i][1], False
    return picks, again


def _may_stand(table: Table, picks: Picks, g: int, k: int) -> list[int]:
    """Sensors of group ``g`` to try at candidate ``k``: one of each unit there, and a free one."""
    there, free = dict[int, int](), list[int]()
    for s in (s for s in table.alike[g] if s not in picks):
        unit, stands = table.problem.layout.sensors[s].unit, table.mast(picks, s)[0] >= 0
        if (unit in there if stands else free) or not table.fits(picks, s, k):
            continue
        if stands:
            there[unit] = s
        else:
            free.append(s)
    return [*there.values(), *free]


def exchange(table: Table, picks: Picks, u: int) -> Picks:
    """Unit ``u`` taken out and put back where it adds most, all else as it is. At a foot it is
    filled greedily; where the objective is submodular, what each sensor adds alone bounds the feet
    that are tried. Then each of its sensors chooses again, the others as they are."""
    members, submodular = table.problem.layout.members()[u], table.problem.submodular
    others = {s: k for s, k in picks.items() if s not in members}
    rows = table.rows(others)
    bound, alone = np.where(table.stand[u], 0.0, -np.inf), table.scores_of_all(rows, members)
    if submodular:
        nothing = table.sampled.value(rows)
        bound += nothing
        for s in members:
            most = np.full(len(bound), -np.inf)
            np.maximum.at(most, table.kind_of(s).foot, alone[s] - nothing)
            bound += most
    best, value = picks, table.value(picks, u) + LEAST
    for foot in np.argsort(-bound, kind="stable")[: (bound > -np.inf).sum()]:
        if submodular and bound[foot] <= value:
            break
        filled, score = _fill(table, others, members, int(foot), alone)
        if score > value:
            best, value = filled, score
    for s in members if best[members[0]] != AS_IT_IS else ():
        rest = {t: k for t, k in best.items() if t != s}
        again, score = _fill(table, rest, (s,), int(table.kind_of(s).foot[best[s]]))
        if score > value:
            best, value = again, score
    return best


def _fill(
    table: Table,
    picks: Picks,
    sensors: Sequence[int],
    foot: int,
    alone: Mapping[int, Float[np.ndarray, " K"]] | None = None,
) -> tuple[Picks, float]:
    """The sensors of a unit placed greedily at one foot, and the score less what the unit pays;
    ``alone`` are scores of each as the first at its candidates, if known."""
    picks, left, score = dict(picks), list(sensors), -np.inf
    while left:
        at = []
        for s in table.one_of_each(left):
            there = np.flatnonzero(table.kind_of(s).foot == foot)
            at += [(s, k) for k in there[table.fits(picks, s, there)].tolist()]
        scores = (
            table.scores(table.rows(picks), at) if alone is None else [alone[s][k] for s, k in at]
        )
        best, alone = int(np.argmax(scores)), None
        (s, k), score = at[best], float(scores[best])
        picks[s] = k
        left.remove(s)
    return picks, score + table.share(s)[foot] - table.price[
        table.problem.layout.sensors[s].unit, foot
    ]
