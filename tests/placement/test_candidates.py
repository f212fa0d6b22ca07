"""Candidate poses: where they are, what each sees and adds, and greedy placement among them."""

from dataclasses import replace

import numpy as np
import pytest
from mounts import team
from worlds import random_traffic, slow_but

from inspe_jax.placement import candidate_table as tables
from inspe_jax.placement import candidates, greedy_placement
from inspe_jax.placement.candidates import of_unit
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.methods.local_search import finer, sights
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case, Problem
from inspe_jax.placement.sampled_objective import SampledObjective, rows_at
from inspe_jax.placement.space import Space
from inspe_jax.scene.statics import tree, upright_box
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.scoring.metrics import METRICS


@pytest.fixture(scope="module")
def problem(scene):
    return Problem(scene, team(scene))


@pytest.fixture(scope="module")
def start(problem):
    return problem.space.start(problem.layout)[0]


@pytest.fixture(scope="module", autouse=True)
def _small():
    """Few candidates, so that a test takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "FRAMES", 3)
        patch.setattr(tables, "YAWS", 4)
        patch.setattr(tables, "CHUNK", 64)
        patch.setattr(candidates, "SPACING", 12.0)
        yield


# ── Candidates ──────────────────────────────────────────────────────────────


def test_sensors_hang_where_they_are_asked_to(problem, start):
    space = problem.space
    asked = np.array([[3.0, 7.0], [12.0, 8.0], [3.0, 3.0], [9.5, 9.5]])
    x = candidates.set_heights(space, np.tile(start, (4, 1)), 1, (2, 3), asked)
    for row, heights in zip(x, asked, strict=True):
        assert np.allclose(candidates.above_ground(space, row)[2:4], heights, atol=1e-4)
        layout = space.layout(row)
        assert space.violations(layout) == []
        assert np.allclose(np.asarray(layout.poses)[2:4, 2], heights, atol=1e-3)


def test_few_layouts_are_projected_as_many_are(problem):
    """One or two by NumPy, more by what is compiled."""
    wild = problem.space.random(np.random.default_rng(3), 12)
    wild += np.random.default_rng(4).normal(size=wild.shape) * 5 * problem.space.scale
    many = candidates.project(problem.space, wild)
    few = np.concatenate([candidates.project(problem.space, wild[k : k + 2]) for k in (0, 2, 4)])
    assert np.abs(many - wild).max() > 1
    np.testing.assert_allclose(few, many[:6], atol=1e-4)


def test_few_feet_of_a_lattice_are_far_apart(problem, monkeypatch):
    monkeypatch.setattr(candidates, "SPACING", 3.0)
    every, few = candidates.lattice(problem.space, 10**6), candidates.lattice(problem.space, 12)
    assert len(few) == 12 < len(every)
    gaps = np.hypot(*np.moveaxis(few[:, None] - few, -1, 0)) + 99 * np.eye(12)
    assert gaps.min() > 5.0
    reach = np.hypot(*np.moveaxis(every[:, None] - few, -1, 0)).min(1)
    assert reach.max() <= gaps.min() + 1e-9  # none is left further out than the chosen stand apart


def test_units_that_must_stay_have_their_feet_among_the_candidates(scene):
    space = Space(scene, team(scene), Constraints(places="keep"))
    feet = candidates.lattice(space, 1)
    for u in range(3):
        assert space.can_stand(feet)[u].any()


# ── Scores of samples ───────────────────────────────────────────────────────


OBJECTIVES = {
    "default": Objective(),
    "targets, N−1, in sight": Objective(
        (0.2, 0.3, 0.5), "targets", visibility="line_of_sight", failures=True
    ),
    "targets, past others": Objective(occlusion_reference="targets", visibility="past_others"),
    "the worst of two scenes": Objective(over="worst"),
    "a place, in view": Objective({"localisation": 0.5, "occlusion": 0.5}, "covered"),
    "a place, whose metric says nothing of what it reads": Objective(
        {"localisation": 0.5, "detectability": 0.5}
    ),
    "detectability, N−1, in sight, two scenes": Objective(
        {"detectability": 0.6, "occlusion": 0.2, "information_gain": 0.2},
        "targets",
        visibility="line_of_sight",
        failures=True,
        detection=detection_curves().for_road_users(["pedestrian", "cyclist"]),
    ),
}


@pytest.mark.parametrize(
    "name",
    slow_but(OBJECTIVES, "the worst of two scenes", "detectability, N−1, in sight, two scenes"),
)
def test_bits_add_up_to_the_score(scene, name, monkeypatch):
    """The score from what each sensor sees is the rough score, of sets and of choices alike."""
    if "says nothing" in name:
        monkeypatch.setitem(METRICS, "localisation", replace(METRICS["localisation"], targets=None))
    traffic = random_traffic(scene.intersection, 5, 16, 20.0, seed=8)
    both = [scene, Case(replace(scene, traffic=traffic))]
    problem = Problem(both if name.endswith("two scenes") else scene, team(scene), OBJECTIVES[name])
    sample = problem.sample(np.random.default_rng(1), 96, 3)
    sampled, x = (
        SampledObjective(problem, sample),
        problem.space.random(np.random.default_rng(2), 3),
    )
    stand = candidates.poses(problem.space, x)
    bits = {s: sampled.views({s: stand[:, s]})[s] for s in range(5)}
    for m, score in enumerate(problem.rough(x, sample)):
        rows = {s: rows_at(of, m) for s, of in bits.items()}
        assert sampled.value(rows) == pytest.approx(score, abs=2e-6)
        for s in rows if problem.submodular else ():
            rest = {t: of for t, of in rows.items() if t != s}
            fewer = dict(list(rest.items())[::2])
            added, before = (
                sampled.value(some | {s: rows[s]}) - sampled.value(some) for some in (rest, fewer)
            )
            assert before >= added - 1e-6 >= -2e-6  # beside fewer others it adds at least as much
    rest = {s: rows_at(bits[s], 0) for s in (0, 1, 4)}
    together = sampled.scores(rest, np.tile([3, 2], (3, 1)), [bits[3], bits[2]])
    for m in range(3):
        both = rest | {s: rows_at(bits[s], m) for s in (2, 3)}
        assert together[m] == pytest.approx(sampled.value(both), abs=1e-6)


def test_samples_know_the_bodies(scene):
    """Of all columns and frames, a sample has the exact score, sensor by sensor too."""
    crown = tree((0.0, 10.0), radius=2.0, height=7.0, base=2.5)
    planted = scene.with_statics([upright_box("building", (14.0, 0.0), (6, 6, 9), 0.2), crown])
    problem = Problem(planted, team(scene))
    x = problem.space.start(problem.layout)[0]
    sample, exact = problem.sample(np.random.default_rng(0), 10**6, 10**6), problem.exact(x)
    assert exact < Problem(scene, problem.layout).exact(x) - 0.005
    assert problem.rough(x[None], sample)[0] == pytest.approx(exact, abs=1e-6)
    sampled, poses = SampledObjective(problem, sample), candidates.poses(problem.space, x[None])
    found = sampled.views({s: poses[:, s] for s in range(5)})
    rows = {s: rows_at(of, 0) for s, of in found.items()}
    assert sampled.value(rows) == pytest.approx(exact, abs=1e-6)


def test_what_is_found_of_one_does_not_depend_on_the_others(problem):
    """Of layouts and of poses, to the last bit."""
    sample = problem.sample(np.random.default_rng(3), 96, 3)
    x = problem.space.random(np.random.default_rng(4), 11)
    poses = candidates.poses(problem.space, x)[:, 0]
    sampled = SampledObjective(problem, sample)
    rough, seen = problem.rough(x, sample), sampled.views({0: poses})[0][0].seen
    assert len(rough) == len(seen) == len(x)
    for count in (1, 3):
        np.testing.assert_array_equal(problem.rough(x[:count], sample), rough[:count])
        few = sampled.views({0: poses[-count:]})[0][0].seen
        np.testing.assert_array_equal(few, seen[-count:])


# ── Greedy ──────────────────────────────────────────────────────────────────


def whole_table(problem):
    made = tables.Table.of(problem, np.random.default_rng(0), 96, 2)
    for part in range(len(made.parts)):
        made.look(part)
    return made


@pytest.fixture(scope="module")
def table(problem):
    return whole_table(problem)


@pytest.fixture(scope="module")
def finding(scene):
    """The same with most of the weight on detectability."""
    return whole_table(
        Problem(scene, team(scene), OBJECTIVES["detectability, N−1, in sight, two scenes"])
    )


def gain(table, picks, s, k):
    """What a candidate adds, from two values, less its share of the pole."""
    before, after = table.rows(picks), table.rows(picks | {s: int(k)})
    paid = table.share(s)[table.kind_of(s).foot[k]]
    return table.sampled.value(after) - table.sampled.value(before) - paid


def may_stand(table, picks, s, k):
    """The unit's rule, sensor by sensor."""
    layout, kind = table.problem.layout, table.kind_of(s)
    unit = layout.sensors[s].unit
    if not table.stand[unit, kind.foot[k]]:
        return False
    for t, j in picks.items():
        if t != s and layout.sensors[t].unit == unit:
            other = table.kind_of(t)
            apart = abs(other.height[j] - kind.height[k])
            if other.foot[j] != kind.foot[k] or apart > 4.0:
                return False
    return True


def test_lazy_greedy_takes_what_an_exhaustive_search_would(table):
    assert check_lazy(table) < 1 / 5


def test_lazy_greedy_is_right_for_detectability(finding):
    """The chance that some sensor finds a road user, 1 − ∏(1 − p), gains less and less, too: every
    candidate's gain is worked out anew beside every set of picks, and never grows."""
    assert check_lazy(finding) < 1 / 5
    picks, _ = greedy_placement.lazy_greedy(finding)
    so_far, bounds = {}, {}
    for s, k in picks.items():
        rows = finding.rows(so_far)
        for t in set(picks) - set(so_far):
            gains = finding.scores_of_all(rows, [t])[t] - finding.sampled.value(rows)
            assert (gains <= bounds.get(t, np.inf) + 1e-6).all()
            bounds[t] = gains
        so_far[s] = k
    first = finding.scores_of_all({}, [4])[4] - finding.sampled.value({})
    assert (first - bounds[4]).max() > 0.01  # it does fall
    chance = np.concatenate([rows[0].targets.chance for rows in finding.kind_of(1).rows])
    assert chance.min() >= 0
    assert chance.max() <= 1
    assert chance.mean() > 0.01


def check_lazy(table):
    """Every sensor placed is the one that adds most, at its best candidate, all worked out anew.
    Returns the share of gains that lazy greedy worked out again."""
    picks, again = greedy_placement.lazy_greedy(table)
    assert sorted(picks) == list(range(5))
    so_far, looked = {}, 0
    for s, k in picks.items():
        best = 0.0
        for t in set(picks) - set(so_far):
            kind = table.kind_of(t)
            used = {k for q, k in so_far.items() if table.kind_of(q) is kind}  # each only once
            free = set(range(len(kind.foot))) - used
            at = [j for j in sorted(free) if may_stand(table, so_far, t, j)]
            rows = table.rows(so_far)
            gains = table.scores_of_all(rows, [t])[t][at] - table.sampled.value(rows)
            best, looked = max(best, gains.max()), looked + len(at)
        assert gain(table, so_far, s, k) == pytest.approx(best, abs=2e-6)
        assert may_stand(table, so_far, s, k)
        so_far[s] = k
    return again / looked


def test_exchange_finds_the_best_replacement_there_is(table):
    """For a unit of one sensor: every candidate tried; for others: never worse, within the rule."""
    rng = np.random.default_rng(4)
    for _ in range(3):
        picks = {}
        for s in range(5):
            kind = table.kind_of(s)
            at = [k for k in rng.permutation(len(kind.foot)) if may_stand(table, picks, s, k)]
            picks[s] = int(at[0])
        before = table.sampled.value(table.rows(picks))
        rest = {s: k for s, k in picks.items() if s != 4}
        found = greedy_placement.exchange(table, picks, 2)
        assert found | rest == found
        best = max(gain(table, rest, 4, k) for k in range(len(table.kind_of(4).foot)))
        assert gain(table, rest, 4, found[4]) == pytest.approx(best, abs=2e-6)
        for u in (0, 1):
            found = greedy_placement.exchange(table, found, u)
            assert all(may_stand(table, found, s, k) for s, k in found.items())
        assert table.sampled.value(table.rows(found)) > before
    # For two sensors the bound leaves out no foot at which the greedy filling is better.
    picks, _ = greedy_placement.lazy_greedy(table)
    rest = {s: k for s, k in picks.items() if s not in (2, 3)}
    filled = [
        greedy_placement._fill(table, rest, (2, 3), int(foot))[0]
        for foot in np.flatnonzero(table.stand[1])
    ]
    best = max(table.sampled.value(table.rows(found)) for found in filled)
    assert (
        table.sampled.value(table.rows(greedy_placement.exchange(table, picks, 1))) >= best - 1e-6
    )


def test_units_as_they_are_stand_beside_candidates(priced):
    """They stay to the bit, are scored as they stand, pay for their poles, and are exchanged only
    for what is better."""
    problem = priced(0.02)
    table, space, rng = whole_table(problem), problem.space, np.random.default_rng(7)
    kept = np.concatenate([of_unit(space, u) for u in (0, 2)])
    x = space.random(rng, 64) + 0.1 * rng.normal(size=(64, space.size)) * space.scale
    each = candidates.project(space, x)  # as moves are; one by one they round otherwise
    x = next(row for row in each if (space.project(row, np) != row)[kept].any())
    rows, table.paid = sights(table.sampled, x), problem.pole_costs(x)
    table.own = {s: rows[s] for s in (0, 1, 4)}
    picks, _ = greedy_placement.lazy_greedy(table)
    assert {s for s, k in picks.items() if k == tables.AS_IT_IS} == {0, 1, 4}
    mixed = table.layout(x, picks)
    np.testing.assert_array_equal(mixed[kept], x[kept])
    rough = problem.rough(mixed[None], table.sampled.sample)[0]
    paid = problem.pole_costs(mixed)
    assert paid[0] > 0
    assert table.value(picks, 0) == pytest.approx(rough + paid[1:].sum(), abs=2e-3)
    found = greedy_placement.exchange(table, picks, 2)
    best = max(table.value(picks | {4: k}, 2) for k in range(table.kind_of(4).looked))
    assert table.value(found, 2) == pytest.approx(max(best, table.value(picks, 2)), abs=2e-6)
    assert greedy_placement.exchange(table, found, 2) == found
    assert table.value(greedy_placement.exchange(table, found, 0), 0) >= table.value(found, 0)


def test_where_gains_may_grow_all_candidates_and_feet_are_tried(scene):
    """As under the reference that counts what is in view; and one unit may not stand everywhere."""
    found = whole_table(Problem(scene, team(scene), Objective(occlusion_reference="covered")))
    assert not found.problem.submodular
    found.stand[1, ::2] = False
    check_lazy(found)
    picks, _ = greedy_placement.lazy_greedy(found)
    for u, s in ((2, 4), (1, 2), (0, 0)):
        rest = {t: k for t, k in picks.items() if t not in found.problem.layout.members()[u]}
        new = greedy_placement.exchange(found, picks, u)
        assert all(may_stand(found, new, t, k) for t, k in new.items())
        before, after = (found.value(which, u) for which in (picks, new))
        assert after >= before - 1e-7
        if len(new) == len(rest) + 1:
            feet = [k for k in range(found.kind_of(s).looked) if may_stand(found, rest, s, k)]
            best = max(found.value(rest | {s: k}, u) for k in feet)
            assert max(before, best) == pytest.approx(after, abs=2e-6)
        picks = new


@pytest.mark.parametrize("units", [(1,), (0, 1, 2)])
def test_finer_moves_are_of_their_units_and_never_for_the_worse(table, problem, start, units):
    """Together they add what the sample says of the layout with all of them."""
    space, sampled = problem.space, table.sampled
    rows = sights(sampled, start)
    x, before = start, sampled.value(rows)
    for k in range(4):
        x, rows = finer(sampled, x, rows, units, 0.5, np.random.default_rng(k), 16)
        value = sampled.value(rows)
        assert value >= before - 1e-6
        assert value == pytest.approx(problem.rough(x[None], sampled.sample)[0], abs=2e-5)
        before = value
    assert not space.violations(space.layout(x))
    parts = [of_unit(problem.space, u) for u in range(3)]
    assert sorted(np.concatenate(parts)) == list(range(space.size))
    moved = [bool((np.abs(x - start)[part] > 1e-5).any()) for part in parts]
    assert moved == [u in units for u in range(3)]


# ── New poles at a price ────────────────────────────────────────────────────

POLES = np.array([[14.0, 9.5], [-9.5, 13.5], [-13.0, -9.5]])
"""From the centre [m]; on sidewalks."""


@pytest.fixture(scope="module")
def priced(scene):
    """A problem on a place that has poles, by the price of new ones."""
    at = np.column_stack([POLES + scene.voxels.center[:2], np.zeros(3)])
    place = replace(scene, intersection=replace(scene.intersection, poles=at))
    return lambda price: Problem(place, team(scene), Objective(pole_price=price))


def new_poles(space, x):
    away = space.split(x).base[:, None] - POLES
    return int((np.hypot(*np.moveaxis(away, -1, 0)).min(-1) > 1e-3).sum())


def test_a_new_pole_is_paid_once_by_its_unit(priced):
    """By exact and rough scores, and by what candidates add."""
    problem, table = priced(0.02), whole_table(priced(0.02))
    assert check_lazy(table) < 1 / 4
    space, x = problem.space, problem.space.random(np.random.default_rng(1), 4)
    paid = [0.02 * new_poles(space, row) for row in x]
    assert len({*paid}) > 1
    for row, of in zip(x[:2], paid, strict=False):
        assert problem.exact_of(space.layout(row)) - problem.exact(row) == pytest.approx(of)
    free, rough = (of.rough(x, table.sampled.sample) for of in (priced(0.0), problem))
    assert free - rough == pytest.approx(paid)


def test_where_new_poles_are_dear_units_go_to_poles_and_stay(priced):
    """By greedy placement, exchanges, finer moves and charts; where they cost nothing, not."""
    cheap, dear = (whole_table(priced(price)) for price in (0.0, 0.9))
    space = dear.problem.space
    given, _ = space.start(space.given)
    free, tied = (greedy_placement.lazy_greedy(table)[0] for table in (cheap, dear))
    x = dear.layout(given, tied)
    assert new_poles(space, x) == 0 < new_poles(space, cheap.layout(given, free))
    for u in range(3):
        free = greedy_placement.exchange(dear, free, u)
    assert new_poles(space, dear.layout(given, free)) == 0
    for table, stays in (dear, True), (cheap, False):
        at = x, sights(table.sampled, x)
        for k in range(4):
            at = finer(table.sampled, *at, range(3), 1.0, np.random.default_rng(k), 16)
        assert np.abs(at[0] - x).max() > 0.1
        assert (new_poles(space, at[0]) == 0) == stays
        v, place = space.chart(x, stays)
        assert (new_poles(space, space.from_chart(v + 0.3, place, np)) == 0) == stays
