"""The baselines on functions with a known optimum, and on a small crossing."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from checkpoints import Checkpoint
from worlds import CAMERA, LIDAR, random_traffic, slow_but, world

from inspe_jax.placement import candidate_table as tables
from inspe_jax.placement import candidate_views, candidates, sampled_scores
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.methods import (
    adam,
    batches,
    cma_es,
    greedy,
    greedy_adam,
    grid,
    lbfgsb,
    projected_gradient,
    random_layouts,
    registry,
    solver_rounds,
)
from inspe_jax.placement.methods.finer_moves import finer, of_unit, sights
from inspe_jax.placement.methods.registry import SEARCHES
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import _drive
from inspe_jax.placement.problem import Case, Problem
from inspe_jax.placement.run import BudgetSpent, Run
from inspe_jax.placement.sample_score import SampleScore, times
from inspe_jax.placement.space import Space
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.sensing.layout import Sensor, Unit, make_layout

METHODS = {method.name: method for method in SEARCHES}


class Heard(Run):
    """A run that remembers every score that it told."""

    def __init__(self, problem, start, evaluations, seed=0):
        super().__init__(problem, start, evaluations=evaluations, seed=seed)
        self.heard = []
        self.offer(self.start)

    def rough(self, x, sample):
        scores = super().rough(x, sample)
        self.heard.append(scores.tolist())
        return scores

    @property
    def offers(self):
        return [(round(row.evaluations, 9), row.score) for row in self.history]


def go(method, run, state=None, steps=10**9, seen=None):
    """Run a method; its state after some steps, or None when it stops or the budget is spent."""
    try:
        state = method.begin(run) if state is None else state
        for _ in range(steps):
            state = method.step(run, state)
            if state is None:
                return None
            if seen is not None:
                seen.append(Checkpoint.of(run, state))
    except BudgetSpent:
        return None
    return state


# ── Functions with a known optimum ──────────────────────────────────────────


class Box:
    """A space of numbers from −3 to 3, the last of them frozen."""

    def __init__(self, size=5):
        self.size, self.scale = size, np.array([1.0] * (size - 1) + [0.0])
        self.free = np.arange(size - 1)

    def project(self, x, xp=np):
        return x.clip(-3, 3)

    def poses(self, x):
        return x

    def random(self, rng, count):
        return np.column_stack([rng.uniform(-3, 3, (count, self.size - 1)), np.zeros(count)])


class Bowl:
    """A function with one summit; a sample shifts all of its values, and each a little."""

    def __init__(self, space, height, noise=0.0):
        self.space, self._height, self._noise = space, height, noise

    def exact(self, x):
        return float(self._height(np.asarray(x, float)[None])[0])

    def sample(self, rng, columns, frames):
        return SimpleNamespace(cost=0.02, seed=int(rng.integers(2**31)))

    def rough(self, x, sample):
        rng = np.random.default_rng(sample.seed)
        shift, tilt = rng.normal(), rng.normal(size=x.shape[1])
        return self._height(x) + shift + self._noise * (x @ tilt)


@pytest.mark.parametrize("summit", [(1.0, -2.0, 0.5, 2.0), (3.0, 3.0, -1.0, 9.0)])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_cma_climbs_to_the_summit_or_to_the_bound_before_it(summit, noise):
    problem = Bowl(Box(), lambda x: -((x[:, :4] - summit) ** 2).sum(1) / 10, noise)
    run = Heard(problem, np.zeros(5), evaluations=60)
    go(METHODS["cma-es"], run)
    nearest = np.clip(summit, -3, 3)
    assert np.abs(run.best_x[:4] - nearest).max() < (0.05 if noise == 0 else 0.3)
    assert run.best_x[4] == 0


def test_cma_restarts_with_twice_the_population_and_finds_the_higher_summit():
    def height(x):
        low = np.exp(-((x[:, :4]) ** 2).sum(1))
        return low + 3 * np.exp(-((x[:, :4] - 2) ** 2).sum(1))

    problem = Bowl(Box(), height)
    run = Heard(problem, np.zeros(5), evaluations=300)
    seen = []
    go(METHODS["cma-es"], run, seen=seen)
    sizes = [at.state["told"].shape[1] for at in seen if len(at.state["told"]) == 0]
    assert sizes[:2] == [16, 32]
    assert run.best == pytest.approx(height(np.full((1, 4), 2.0))[0], abs=0.02)


@pytest.mark.parametrize(("free", "size"), [(4, 8), (7, 9), (47, 15)])
def test_cma_begins_with_the_population_of_the_tutorial(free, size):
    """4 + ⌊3 ln n⌋, table 1 of Hansen's (arXiv 1604.00772)."""
    run = Heard(Bowl(Box(free + 1), lambda x: -x.sum(1)), np.zeros(free + 1), evaluations=1)
    assert METHODS["cma-es"].begin(run)["told"].shape[1] == size


def test_random_finds_the_summit_as_nearly_as_its_draws_do():
    """Of n even draws the nearest in a box of 4 dimensions is about n^(−1/4) of its width away."""
    summit = np.array([1.0, -2.0, 0.5, 2.0])
    problem = Bowl(Box(), lambda x: -np.abs(x[:, :4] - summit).max(1))
    run = Heard(problem, np.zeros(5), evaluations=40)
    go(METHODS["random"], run)
    draws = 0.9 * 40 / (batches.CHUNK * 0.02) * batches.CHUNK
    assert -run.best < 2 * 6 * draws**-0.25 / 2
    assert len(run.offers) < 15  # exact scores only for what beats the best so far


# ── A small crossing ────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def scene():
    return world(radius=20.0, voxel=1.0, frames=5, count=12, seed=3)


def team(scene):
    """A camera and a LiDAR on one pole, two cameras on another, one on a third; all look up."""
    c = scene.voxels.center
    units = [
        Unit(name, (c[0] + x, c[1] + y, c[2]))
        for name, x, y in (("a", 9, 9), ("b", -9, -9), ("c", -9, 9))
    ]
    members = [("ca", CAMERA, 0), ("la", LIDAR, 0), ("cb", CAMERA, 1), ("db", CAMERA, 1)]
    members += [("cc", CAMERA, 2)]
    sensors = [Sensor(*row) for row in members]
    poses = [[*units[u].base[:2], 4.0, 0.0, 0.15, 0.7 * s] for s, (_, _, u) in enumerate(members)]
    return make_layout(sensors, units, np.array(poses))


@pytest.fixture(scope="module")
def problem(scene):
    return Problem(scene, team(scene))


@pytest.fixture(scope="module")
def start(problem):
    return problem.space.start(problem.layout)[0]


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """Small samples and few candidates, so that a test takes a second."""
    for module in (cma_es, grid, random_layouts, greedy):
        monkeypatch.setattr(module, "COLUMNS", 96)
    for module in (cma_es, grid, random_layouts, greedy, tables):
        monkeypatch.setattr(module, "FRAMES", 3)
    monkeypatch.setattr(greedy, "HEIGHTS", 2)
    monkeypatch.setattr(tables, "YAWS", 4)
    monkeypatch.setattr(greedy, "TRIES", 8)
    monkeypatch.setattr(tables, "CHUNK", 64)
    monkeypatch.setattr(candidates, "SPACING", 12.0)
    monkeypatch.setattr(cma_es, "LOOK", 3)
    monkeypatch.setattr(cma_es, "PATIENCE", 2)


BUDGET = {"grid": 30.0, "random": 30.0, "greedy": 80.0, "cma-es": 40.0}
"""Evaluations in which each method comes through all of its kinds of step, but for restarts."""


@pytest.fixture(scope="module")
def runs():
    return {}


@pytest.fixture
def whole(problem, start, runs):
    """A method's run to the end of its budget, and all that a checkpoint holds after each step."""

    def of(name):
        if name not in runs:
            run, seen = Heard(problem, start, BUDGET[name]), []
            go(METHODS[name], run, seen=seen)
            runs[name] = run, seen
        return runs[name]

    return of


@pytest.mark.parametrize("name", METHODS)
def test_a_method_finds_better_layouts_that_can_be_mounted(name, problem, whole):
    run, _ = whole(name)
    assert run.best > run.offers[0][1] + 0.01
    layout = problem.space.layout(run.best_x)
    assert problem.space.violations(layout) == []
    assert problem.exact_of(layout) == pytest.approx(run.best, abs=1e-6)


@pytest.mark.parametrize("name", METHODS)
def test_a_seed_repeats_and_another_does_not(name, problem, start, whole):
    first, _ = whole(name)
    again, other = (Heard(problem, start, BUDGET[name], seed) for seed in (0, 1))
    go(METHODS[name], again)
    state = None
    while len(other.offers) + len(other.heard) < 3:
        state = go(METHODS[name], other, state, steps=1)
    assert first.offers == again.offers
    assert first.heard == again.heard
    # A grid is no game of chance, but what it hears is of other samples.
    told = len(other.offers), len(other.heard)
    assert (first.offers[: told[0]], first.heard[: told[1]]) != (other.offers, other.heard)


@pytest.mark.parametrize("name", METHODS)
def test_from_any_checkpoint_a_run_goes_on_as_if_nothing_had_come_between(
    name, problem, start, whole
):
    first, seen = whole(name)
    if name == "greedy":
        assert {at.state["phase"] for at in seen} == {"look", "place", "exchange", "move"}
    for stop in {len(seen) // 2, len(seen) - 2}:
        later = Heard(problem, start, BUDGET[name])
        seen[stop - 1].take_up(later, first)
        go(METHODS[name], later, seen[stop - 1].state)
        assert later.offers == first.offers, stop


def test_a_generation_that_was_cut_short_is_asked_again(problem, start, whole):
    """Ctrl-C in the middle of a step leaves no strategy that has asked and not been told."""
    first, _ = whole("cma-es")
    run = Heard(problem, start, BUDGET["cma-es"])
    state = go(METHODS["cma-es"], run, steps=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "rough", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            METHODS["cma-es"].step(run, state)
    go(METHODS["cma-es"], run, state)
    assert run.offers == first.offers


# ── Ends, anywhere ──────────────────────────────────────────────────────────


class Pulled(Problem):
    """The soft score is how near all sensors are to the centre, to have a slope at no price.

    It keeps what a method prefers, in ``preferred``: the best of all that it compared on the last
    sample.
    """

    preferred: list
    compared: tuple

    def slope(self, poses, on, softness):
        away = np.array(poses, np.float32) / 30
        return 1 - float((away**2).sum()), -2 * away / 30

    def rough(self, x, sample):
        scores = super().rough(x, sample)
        key = np.asarray(sample.arrays[0].centered.columns).tobytes()
        pairs = self.compared[1] if self.compared[0] == key else []
        pairs += zip(scores.tolist(), x, strict=True)
        self.compared = key, pairs
        self.preferred.append(max(pairs, key=lambda pair: pair[0])[1])
        return scores


@pytest.fixture
def pulled(scene, start, monkeypatch):
    """The problem; what is preferred on a sample, before the method comes to hold or offer it."""
    problem = Pulled(scene, team(scene))

    def watch(of, name, layout):
        inner = getattr(of, name)

        def watched(*given):
            found = inner(*given)
            if (x := layout(found, *given)) is not None:
                problem.preferred.append(x)
            return found

        monkeypatch.setattr(of, name, watched)

    for module in (adam, solver_rounds):
        monkeypatch.setattr(module, "COLUMNS", 96)
        monkeypatch.setattr(module, "FRAMES", 3)
    monkeypatch.setattr(adam._ranked, "__defaults__", (1,))
    monkeypatch.setattr(Run, "compile_ahead", lambda run, method: None)
    watch(greedy, "lazy_greedy", lambda found, table: table.layout(start, found[0]))
    watch(greedy, "exchange", lambda found, table, *_: table.layout(start, found))
    watch(adam, "advance", lambda found, *_: adam.layouts(problem, found)[0])
    watch(greedy_adam, "_bursts", lambda found, *_: found[0][0])
    for module in (greedy, greedy_adam):
        watch(module, "finer", lambda found, *_: found[0])
    for module in (lbfgsb, projected_gradient):
        inner = module.charged

        def charged(run, drawn, score, layout, inner=inner):
            losses = []

            def heard(z):
                loss, slope = score(z)
                if losses and loss < min(losses):
                    problem.preferred.append(layout(z))
                losses.append(loss)
                return loss, slope

            return inner(run, drawn, heard, layout)

        monkeypatch.setattr(module, "charged", charged)
    return problem


ENDS = {"adam": 400, "greedy-adam": 150, "lbfgsb": 150, "projected-gradient": 150}
ENDS |= {"greedy": 150, "grid": 120, "random": 30, "cma-es": 90}
"""Looks at the clock in which a method comes through its kinds of step."""


@pytest.mark.parametrize("name", registry.METHODS)
def test_wherever_its_time_ends_it_is_not_below_what_it_preferred(name, pulled, start):
    """By a clock that ends a search at any of its looks. A method prefers what it would end with:
    the best of what it last compared on one sample; and greedy placement, from when it is made."""
    unscored = 0
    for ends in np.unique(np.geomspace(2, ENDS[name], 12).astype(int)):
        pulled.preferred, pulled.compared = [start], (b"", [])
        run = Run(pulled, start, seconds=float(ends), clock=itertools.count().__next__)
        assert _drive(run, registry.METHODS[name]) in ("budget spent", "converged")
        unscored += pulled.preferred[-1] is not start
        assert run.best >= pulled.exact(pulled.preferred[-1]) - 1e-9, ends
        assert run.held is None
    assert unscored > 4


# ── Grid ────────────────────────────────────────────────────────────────────


def test_grid_comes_as_near_to_a_summit_as_its_finest_step(problem, start):
    """Where coordinates do not depend on each other, one block at a time is enough."""
    space = problem.space
    target = space.random(np.random.default_rng(5), 1)[0]
    above, c = candidates.above_ground(space, target), space.split(target)

    def height(x):
        lost = []
        for row in x:
            r = space.split(row)
            turned = np.sin((r.yaw - c.yaw) / 2) ** 2
            lifted = (candidates.above_ground(space, row) - above) ** 2
            away = ((r.base - c.base) ** 2).sum(1)
            pitched = (r.pitch - c.pitch) ** 2
            lost.append(turned.sum() + lifted.sum() / 16 + away.sum() / 100 + 4 * pitched.sum())
        return -np.array(lost)

    run = Heard(Bowl(space, height), start, evaluations=4000)
    run.problem.layout = problem.layout
    assert go(METHODS["grid"], run) is None
    assert run.left > 0  # it stopped by itself
    found = space.split(run.best_x)
    finest = 2.0**-grid.FINEST
    assert np.hypot(*(found.base - c.base).T).max() < 2 * grid.SPACING * finest
    assert np.abs(np.sin((found.yaw - c.yaw) / 2)).max() < 2 * grid.STEPS["yaw"] * finest
    assert np.abs(found.pitch - c.pitch).max() < 2 * grid.STEPS["pitch"] * finest
    lifted = candidates.above_ground(space, run.best_x) - above
    assert np.abs(lifted).max() < 2 * grid.STEPS["height"] * finest


def test_grids_of_a_unit_leave_the_others_alone(problem, start):
    space, members = problem.space, problem.layout.members()
    index = candidates.coordinates(space)
    for block in grid._blocks(members):
        for level in (0, 2):
            x = grid._grid(space, start, block, level)
            assert np.array_equal(x[0], start)
            assert len(np.unique(x, axis=0)) == len(x) > 10
            others = [s for s in range(len(problem.layout)) if s not in block.sensors]
            for part in (index.yaw[others], index.pitch[others], index.rise[others]):
                assert np.allclose(x[:, part], start[part], atol=1e-6)
            assert np.allclose(candidates.project(space, x), x, atol=1e-4)


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


def test_limits_are_those_of_the_constraints(scene):
    constraints = Constraints(heights=(4.0, 9.0))
    space = Space(scene, team(scene), constraints)
    heights, pitches = candidates.limits(space, space.start(space.given)[0])
    assert np.allclose(heights, [[4.0, 9.0]] * 5, atol=1e-4)
    camera, lidar = (np.array(constraints.pitch[kind]) for kind in ("camera", "lidar"))
    assert np.allclose(pitches, [camera, lidar, camera, camera, camera], atol=1e-5)


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


# ── Scores of samples ───────────────────────────────────────────────────────────────────


def other_traffic(scene):
    traffic = random_traffic(scene.intersection, 5, 20, 20.0, seed=8)
    return Scene(scene.voxels, traffic, scene.intersection)


OBJECTIVES = {
    "default": (Objective(), False),
    "N−1, in sight, two scenes": (
        Objective((0.2, 0.3, 0.5), visibility="line_of_sight", failures=True),
        True,
    ),
    "targets": (Objective(occlusion_reference="targets"), False),
    "targets, in sight": (
        Objective(occlusion_reference="targets", visibility="line_of_sight"),
        False,
    ),
    "past others": (Objective(visibility="past_others"), False),
    "detectability, N−1": (
        Objective(
            {"detectability": 0.7, "occlusion": 0.3},
            failures=True,
            detection=detection_curves().for_road_users(["pedestrian", "cyclist"]),
        ),
        False,
    ),
    "detectability, two scenes": (
        Objective({"detectability": 0.6, "coverage": 0.2, "information_gain": 0.2}),
        True,
    ),
    "targets, past others": (
        Objective(occlusion_reference="targets", visibility="past_others"),
        False,
    ),
}


FAST = {"past others", "detectability, N−1"}


@pytest.mark.parametrize("name", slow_but(OBJECTIVES, *(set(OBJECTIVES) - FAST)))
def test_bits_add_up_to_the_score(scene, name):
    """The sum over what each sensor sees is the rough score; and gains are differences of it."""
    objective, two = OBJECTIVES[name]
    problem = Problem([scene, Case(other_traffic(scene))] if two else scene, team(scene), objective)
    sample = problem.sample(np.random.default_rng(1), 96, 3)
    tally, x = SampleScore(problem, sample), problem.space.random(np.random.default_rng(2), 3)
    stand = candidates.poses(problem.space, x)
    bits = {s: tally.views(problem, {s: stand[:, s]})[s] for s in range(5)}
    for m, score in enumerate(problem.rough(x, sample)):
        rows = {s: row[m] for s, row in bits.items()}
        assert tally.value(rows) == pytest.approx(score, abs=2e-5)
        for s in rows:
            rest = {t: row for t, row in rows.items() if t != s}
            added = tally.value(rows) - tally.value(rest)
            assert times(rows[s][None], tally.worth(rest, s))[0] == pytest.approx(added, abs=1e-6)
            assert tally.gains(rest, {s: rows[s][None]})[0] == pytest.approx(added, abs=1e-6)
            # Submodular: beside fewer others it adds at least as much.
            fewer = dict(list(rest.items())[::2])
            assert times(rows[s][None], tally.worth(fewer, s))[0] >= added - 1e-6
    rest = {s: bits[s][0] for s in (0, 1, 4)}
    together = tally.gains(rest, {s: bits[s] for s in (2, 3)})
    for m in range(3):
        both = rest | {s: bits[s][m] for s in (2, 3)}
        assert together[m] == pytest.approx(tally.value(both) - tally.value(rest), abs=1e-6)


def test_what_is_compiled_serves_any_number_of_layouts_and_poses(problem):
    """And what it gives of one does not depend on the others, to the last bit."""
    sample = problem.sample(np.random.default_rng(3), candidates.COLUMNS, candidates.FRAMES)
    x = problem.space.random(np.random.default_rng(4), 11)
    poses = candidates.poses(problem.space, x)[:, 0]
    rough, (views, seen, _) = problem.rough(x, sample), problem.views({0: poses}, sample)[0]
    compiled = sampled_scores.hard_scores._cache_size(), candidate_views._view._cache_size()
    assert len(rough) == len(views) == len(seen) == len(x)
    for count in (1, 3):
        np.testing.assert_array_equal(problem.rough(x[:count], sample), rough[:count])
        few = problem.views({0: poses[-count:]}, sample)[0]
        for part, whole in zip(few[:2], (views, seen), strict=True):
            np.testing.assert_array_equal(part, whole[-count:])
    assert (
        sampled_scores.hard_scores._cache_size(),
        candidate_views._view._cache_size(),
    ) == compiled


# ── Greedy ──────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def held():
    return {}


def whole_table(problem, held, name):
    if name not in held:
        made = tables.Table.of(problem, np.random.default_rng(0), 96, 2)
        for part in range(len(made.parts)):
            made.look(part)
        held[name] = made
    return held[name]


@pytest.fixture
def table(problem, held):
    return whole_table(problem, held, "full")


@pytest.fixture
def finding(scene, held):
    """The same with most of the weight on detectability."""
    objective = Objective({"detectability": 0.7, "occlusion": 0.3})
    return whole_table(Problem(scene, team(scene), objective), held, "finding")


def gain(table, picks, s, k):
    """What a candidate adds, from two values."""
    before, after = table.rows(picks), table.rows(picks | {s: int(k)})
    return table.tally.value(after) - table.tally.value(before)


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
    check_lazy(table)


def test_lazy_greedy_is_right_for_detectability(finding):
    """The chance that some sensor finds a road user, 1 − ∏(1 − p), gains less and less, too: every
    candidate's gain is worked out anew beside every set of picks, and never grows."""
    check_lazy(finding)
    picks, _ = greedy.lazy_greedy(finding)
    so_far, bounds = {}, {}
    for s, k in picks.items():
        rows = finding.rows(so_far)
        for t in set(picks) - set(so_far):
            gains = finding.gains(t, rows)
            assert (gains <= bounds.get(t, np.inf) + 1e-6).all()
            bounds[t] = gains
        so_far[s] = k
    first = finding.gains(4, {})
    assert (first - bounds[4]).max() > 0.01  # it does fall
    chance = np.concatenate([part.chance for part in finding.kind_of(1).rows])
    assert chance.min() >= 0
    assert chance.max() <= 1
    assert chance.mean() > 0.01


def check_lazy(table):
    """Every sensor placed is the one that adds most, at its best candidate, all worked out anew."""
    picks, again = greedy.lazy_greedy(table)
    assert sorted(picks) == list(range(5))
    so_far, looked = {}, 0
    for s, k in picks.items():
        best = 0.0
        for t in set(picks) - set(so_far):
            kind = table.kind_of(t)
            at = [j for j in range(len(kind.foot)) if may_stand(table, so_far, t, j)]
            gains = table.gains(t, table.rows(so_far))[at]
            best, looked = max(best, gains.max()), looked + len(at)
        assert gain(table, so_far, s, k) == pytest.approx(best, abs=2e-6)
        assert may_stand(table, so_far, s, k)
        so_far[s] = k
    assert again < looked / 5


def test_a_layout_of_picks_sees_what_their_candidates_see(table, problem, start):
    picks, _ = greedy.lazy_greedy(table)
    x = table.layout(start, picks)
    assert problem.space.violations(problem.space.layout(x)) == []
    score = problem.rough(x[None], table.tally.sample)[0]
    # Single precision may tip a voxel that a ray just touches.
    assert table.tally.value(table.rows(picks)) == pytest.approx(score, abs=2e-3)


def test_every_round_looks_at_candidates_of_its_own(problem, start):
    run = Heard(problem, start, 1.0)
    first, second, again = (greedy._table(run, number).kinds[0] for number in (0, 1, 0))
    assert set(first.yaw.round(6)).isdisjoint(second.yaw.round(6))
    np.testing.assert_array_equal(first.yaw, again.yaw)


def test_exchange_finds_the_best_replacement_there_is(table):
    """For a unit of one sensor: every candidate tried; for others: never worse, within the rule."""
    rng = np.random.default_rng(4)
    for _ in range(3):
        picks = {}
        for s in range(5):
            kind = table.kind_of(s)
            at = [k for k in rng.permutation(len(kind.foot)) if may_stand(table, picks, s, k)]
            picks[s] = int(at[0])
        before = table.tally.value(table.rows(picks))
        rest = {s: k for s, k in picks.items() if s != 4}
        found = greedy.exchange(table, picks, 2)
        assert found | rest == found
        best = max(gain(table, rest, 4, k) for k in range(len(table.kind_of(4).foot)))
        assert gain(table, rest, 4, found[4]) == pytest.approx(best, abs=2e-6)
        for u in (0, 1):
            found = greedy.exchange(table, found, u)
            assert all(may_stand(table, found, s, k) for s, k in found.items())
        assert table.tally.value(table.rows(found)) > before


def test_exchange_of_two_sensors_tries_every_foot(table):
    """The bound leaves out no foot at which the greedy filling is better."""
    picks, _ = greedy.lazy_greedy(table)
    rest = {s: k for s, k in picks.items() if s not in (2, 3)}
    values = [
        table.tally.value(table.rows(greedy._fill(table, rest, (2, 3), int(foot))))
        for foot in np.flatnonzero(table.stand[1])
    ]
    found = greedy.exchange(table, picks, 1)
    assert table.tally.value(table.rows(found)) >= max(values) - 1e-6


def test_finer_moves_of_several_units_are_judged_one_beside_another(table, problem, start):
    """Together they add what the sample says of the layout with all of them."""
    space, tally, units = problem.space, table.tally, range(len(problem.layout.units))
    rows = sights(problem, tally, start, range(5))
    x, before = start, tally.value(rows)
    for k in range(3):
        x, rows = finer(problem, tally, x, rows, units, 0.5, np.random.default_rng(k), 16)
        value = tally.value(rows)
        assert value >= before - 1e-6
        assert value == pytest.approx(problem.rough(x[None], tally.sample)[0], abs=2e-5)
        before = value
    assert not space.violations(space.layout(x))
    moved = [(x != start)[of_unit(problem, u)].any() for u in units]
    assert sum(moved) > 1
    parts = np.concatenate([of_unit(problem, u) for u in units])
    assert sorted(parts) == list(range(space.size))  # every coordinate is of one unit


def test_finer_moves_are_of_one_unit_and_never_for_the_worse(table, problem, start):
    space, tally = problem.space, table.tally
    stand = candidates.poses(space, start[None])[0]
    rows = {s: tally.views(problem, {s: stand[s][None]})[s][0] for s in range(5)}
    x, moved = start, 0
    for k in range(6):
        new, seen = finer(problem, tally, x, rows, (1,), 0.5, np.random.default_rng(k), 64)
        assert tally.value(seen) >= tally.value(rows)
        a, b = (candidates.poses(space, row[None])[0] for row in (x, new))
        assert np.allclose(a[[0, 1, 4]], b[[0, 1, 4]], atol=1e-5)
        if new is not x:
            moved += 1
            assert tally.value(seen) == pytest.approx(
                problem.rough(new[None], tally.sample)[0], abs=2e-5
            )
        x, rows = new, seen
    assert moved
