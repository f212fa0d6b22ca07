"""The search methods: one contract for all of them, and what is particular to some."""

import itertools
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dense_reference import measure
from mounts import SIDEWALK, assert_mountable, lanes_of, team
from worlds import CAMERA, LIDAR, place_sensors

from inspe_jax.core.arrays import from_center, on_host, pad_rows
from inspe_jax.core.numerics import Softness
from inspe_jax.placement import candidate_table, candidates
from inspe_jax.placement import run as runs
from inspe_jax.placement.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, state_of
from inspe_jax.placement.methods import (
    adam,
    cma_es,
    differences,
    greedy,
    grid,
    local_search,
    random_layouts,
    solver_rounds,
)
from inspe_jax.placement.methods.registry import METHODS
from inspe_jax.placement.optimise import _drive
from inspe_jax.placement.problem import Problem, case_scores
from inspe_jax.placement.run import BudgetSpent, Run
from inspe_jax.scoring.metrics import surrogate, weights_of
from inspe_jax.scoring.reading import BITS

SLOPES = ("adam", "lbfgsb", "projected-gradient")
"""Methods that need nothing but scores and slopes."""
SMALL = [
    ("COLUMNS", 96, (runs, greedy, local_search)),
    ("FRAMES", 3, (runs, candidate_table, local_search)),
    ("LARGER", 1, (adam,)),
    ("STEP_COLUMNS", 96, (adam,)),
    ("ROUND_COLUMNS", 96, (solver_rounds,)),
    ("ROUND_FRAMES", 3, (solver_rounds,)),
    ("SCREENED", 8, (adam, cma_es)),
    ("YAWS", 4, (candidate_table,)),
    ("HEIGHTS", 2, (greedy,)),
    ("CHUNK", 64, (candidate_table,)),
    ("BATCH", 8, (grid, random_layouts)),
    ("FINEST", 3, (grid,)),
    ("SPACING", 12.0, (candidates,)),
    ("LOOK", 3, (cma_es,)),
    ("PATIENCE", 2, (cma_es,)),
]
"""Small samples and few candidates: all gradients are of one compiled program."""


@pytest.fixture(scope="module", autouse=True)
def _small():
    with pytest.MonkeyPatch.context() as patch:
        for name, value, modules in SMALL:
            for module in modules:
                patch.setattr(module, name, value)
        yield


class Preferring(Problem):
    """It keeps what a method prefers: the best of all that it compared on the last sample."""

    def __init__(self, *given):
        super().__init__(*given)
        self.preferred, self.compared = [], (b"", [])

    def rough(self, x, sample):
        scores = super().rough(x, sample)
        key = np.asarray(sample.arrays[0].centered.columns).tobytes()
        pairs = self.compared[1] if self.compared[0] == key else []
        pairs += zip(scores.tolist(), x, strict=True)
        self.compared = key, pairs
        self.preferred.append(max(pairs, key=lambda pair: pair[0])[1])
        return scores


@pytest.fixture(scope="module")
def problem(scene):
    return Preferring(scene, team(scene, second=CAMERA))


def begun(problem, evaluations, seed=0):
    """A run that has scored its start."""
    run = Run(problem, problem.space.start(problem.layout)[0], evaluations=evaluations, seed=seed)
    run.offer(run.start)
    return run


def steps(run, method, state=None):
    """What a checkpoint holds before each step, until the method or the budget ends."""
    try:
        state = method.begin(run) if state is None else state
        while state is not None:
            yield Checkpoint.now(run, state, {})
            state = method.step(run, state)
    except BudgetSpent:
        pass


def offers(run):
    return [(round(row.evaluations, 9), row.score) for row in run.history]


# ── One contract for all methods ────────────────────────────────────────────

BUDGET = {"grid": 30.0, "random": 20.0, "greedy": 60.0, "cma-es": 25.0, "differences": 100.0}
BUDGET |= {"adam": 30.0, "greedy-adam": 90.0, "lbfgsb": 20.0, "projected-gradient": 30.0}
"""Evaluations in which each method comes through all of its kinds of step, but for restarts."""
PARTS = {
    name: {"Placing", "Exchanging", "LocalSearch"}
    for name in ("greedy-adam", "greedy", "differences")
}


@pytest.fixture(scope="module")
def ran(problem):
    """A method's run to the end of its budget, and its checkpoints."""

    @cache
    def of(name):
        run = begun(problem, BUDGET[name])
        with pytest.MonkeyPatch.context() as patch:
            if name in ("differences", "greedy"):  # no gradient is asked for
                patch.setattr(problem, "slope", None)
            return run, list(steps(run, METHODS[name]))

    return of


@pytest.mark.parametrize("name", METHODS)
def test_a_method_finds_better_layouts_that_can_be_mounted(name, problem, ran):
    run, seen = ran(name)
    assert run.best > run.history[0].score + 0.01
    layout = problem.space.layout(run.best_x)
    assert problem.space.violations(layout) == []
    assert problem.exact_of(layout) == pytest.approx(run.best, abs=1e-6)
    scene = problem.cases[0].scene
    assert_mountable(scene, layout, lanes_of(scene.intersection))
    assert PARTS.get(name, set()) <= {kept.state["class"] for kept in seen}


@pytest.mark.parametrize("name", METHODS)
def test_from_a_checkpoint_it_goes_on_as_if_nothing_had_come_between(name, problem, ran, tmp_path):
    """Through a file. So a seed repeats; and another does not."""
    first, seen = ran(name)
    half = len(seen) // 2
    save_checkpoint(seen[half], tmp_path / "kept.npz")
    kept, later = load_checkpoint(tmp_path / "kept.npz"), begun(problem, BUDGET[name])
    later.take_up(kept.seconds, kept.evaluations, kept.history, kept.path, *kept.held)
    for _ in steps(later, METHODS[name], state_of(METHODS[name].states, kept.state)):
        pass
    assert 1 <= len(kept.history) < len(first.history)
    assert offers(later) == offers(first)
    np.testing.assert_array_equal(later.best_x, first.best_x)
    other = list(itertools.islice(steps(begun(problem, BUDGET[name], 1), METHODS[name]), half + 1))
    mine, theirs = (np.concatenate([at.path[-1:], at.held]) for at in (seen[half], other[-1]))
    assert mine.tolist() != theirs.tolist()


ENDS = {"adam": 50, "greedy-adam": 90, "lbfgsb": 20, "projected-gradient": 20}
ENDS |= {"greedy": 90, "grid": 20, "random": 10, "cma-es": 20, "differences": 90}
"""Looks at the clock in which a method comes through its kinds of step."""


@pytest.mark.parametrize("name", METHODS)
def test_wherever_its_time_ends_it_is_not_below_what_it_preferred(name, problem, monkeypatch):
    """By a clock that ends a search at any of its looks. A method prefers what it would end with:
    the best of what it last compared on one sample; and greedy placement, from when it is made."""
    start = problem.space.start(problem.layout)[0]

    def watch(of, function, layout):
        inner = getattr(of, function)

        def watched(*given):
            found = inner(*given)
            problem.preferred.append(layout(found, *given))
            return found

        monkeypatch.setattr(of, function, watched)

    watch(candidate_table.Table, "layout", lambda found, *_: found)
    watch(adam, "advance", lambda found, *_: adam.layouts(problem, found)[0])
    watch(local_search, "_bursts", lambda found, *_: found[0][0])
    watch(local_search, "finer", lambda found, *_: found[0])
    inner = solver_rounds.charged

    def charged(run, drawn, score, layout):
        losses = []

        def heard(z):
            loss, slope = score(z)
            if losses and loss < min(losses):
                problem.preferred.append(layout(z))
            losses.append(loss)
            return loss, slope

        return inner(run, drawn, heard, layout)

    monkeypatch.setattr(solver_rounds, "charged", charged)
    unscored = 0
    for ends in np.unique(np.geomspace(4, ENDS[name], 3).astype(int)):
        problem.preferred, problem.compared = [start], (b"", [])
        run = Run(problem, start, seconds=float(ends), clock=itertools.count().__next__)
        assert _drive(run, METHODS[name]) in ("budget spent", "converged")
        unscored += problem.preferred[-1] is not start
        assert run.best >= problem.exact(problem.preferred[-1]) - 1e-9, ends
        assert run.held is None
    assert unscored > 1


# ── Functions with a known optimum ──────────────────────────────────────────


class Box:
    """A space of four numbers from −3 to 3, and a frozen one."""

    scale, free = np.array([1.0, 1.0, 1.0, 1.0, 0.0]), np.arange(4)

    def project(self, x, xp=np):
        return x.clip(-3, 3)

    def poses(self, x):
        return x

    def start(self, layout):
        return np.zeros(5), ()

    def random(self, rng, count):
        return np.column_stack([rng.uniform(-3, 3, (count, 4)), np.zeros(count)])


class Bowl:
    """A function; a sample shifts all of its values."""

    def __init__(self, space, height):
        self.space, self._height, self.layout = space, height, None

    def exact(self, x):
        return float(self._height(np.asarray(x, float)[None])[0])

    def sample(self, rng, columns, frames):
        return SimpleNamespace(cost=0.02, seed=int(rng.integers(2**31)))

    def rough(self, x, sample):
        return self._height(x) + np.random.default_rng(sample.seed).normal()


def test_cma_restarts_with_twice_the_population_and_finds_the_higher_summit():
    def height(x):
        low = np.exp(-((x[:, :4]) ** 2).sum(1))
        return low + 3 * np.exp(-((x[:, :4] - 2) ** 2).sum(1))

    run = begun(Bowl(Box(), height), 300)
    losses = [kept.state["losses"] for kept in steps(run, METHODS["cma-es"])]
    assert [told.shape[1] for told in losses if len(told) == 0][1:3] == [16, 32]
    assert run.best == pytest.approx(height(np.full((1, 4), 2.0))[0], abs=0.02)


def test_a_generation_that_was_cut_short_is_asked_again(problem, ran, monkeypatch):
    """Ctrl-C in the middle of a step leaves no strategy that has asked and not been told."""
    cma, run = METHODS["cma-es"], begun(problem, BUDGET["cma-es"])
    state = cma.step(run, cma.step(run, cma.begin(run)))
    with monkeypatch.context() as patch:
        patch.setattr(run, "rough", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            cma.step(run, state)
    list(steps(run, cma, state))
    assert offers(run) == offers(ran("cma-es")[0])


class Known(Problem):
    """A score of which all is known: how near the sensors are to where they were asked to be.

    1 for the poses ``at``; a sample moves its optimum by up to 0.2 m, as samples of scenes do.
    """

    REACH = np.array([30.0, 30.0, 6.0, 2.0, 2.0, 2.0])  # of a sensor's near poses [m, rad]

    def __init__(self, scene, layout, at):
        super().__init__(scene, layout)
        self.at = np.asarray(from_center(scene.voxels.center, at.poses), float)

    def nearness(self, poses, at):
        """The mean over sensors, and its slope in their poses."""
        away = (np.asarray(poses, float) - at) / self.REACH
        each = np.exp(-0.5 * (away**2).sum(-1))
        return float(each.mean()), -each[:, None] * away / self.REACH / len(each)

    def moved(self, arrays):
        return self.at + 0.2 * np.sin(np.sum(np.asarray(arrays[0].centered.columns[0], float)))

    def exact_of(self, layout):
        center = self.cases[0].scene.voxels.center
        return self.nearness(from_center(center, layout.poses), self.at)[0]

    def rough(self, x, sample):
        at = self.moved(sample.arrays)
        return np.array([self.nearness(row, at)[0] for row in candidates.poses(self.space, x)])

    def slope(self, poses, on, softness):
        value, slope = self.nearness(poses, self.moved(on))
        return value, on_host(slope, float)


@pytest.fixture(scope="module")
def known(scene):
    layout = team(scene, second=CAMERA)
    turned = np.asarray(layout.poses) + [0, 0, 3.0, 0, -0.3, -2.0]
    return Known(scene, layout, layout.with_poses(turned))


@pytest.mark.parametrize(
    ("name", "budget", "score"),
    # L-BFGS-B ends where a unit is at the edge of its piece of ground.
    [
        ("adam", 1200, 0.999),
        ("lbfgsb", 240, 0.75),
        ("projected-gradient", 240, 0.99),
        ("grid", 4000, 0.99),
        ("cma-es", 800, 0.9),
    ],
)
def test_it_comes_to_the_optimum_of_a_known_score(known, name, budget, score):
    run = begun(known, budget)
    list(steps(run, METHODS[name]))
    assert run.history[0].score < 0.6
    assert run.best > score
    assert known.space.violations(known.space.layout(run.best_x)) == []


# ── Gradients ───────────────────────────────────────────────────────────────


@pytest.mark.parametrize("name", SLOPES)
def test_every_method_is_charged_that_for_every_gradient(known, name, monkeypatch):
    """And its hard scores for the rest; nothing else."""
    due, charged = [], []

    def spied(cls, does, price):
        inner = getattr(cls, does)

        def call(self, *given):
            found = inner(self, *given)
            price(self, *given)
            return found

        monkeypatch.setattr(cls, does, call)

    def gradient(problem, poses, on, softness):
        sizes = len(on[0].centered.columns), len(on[0].centered.prisms.top)
        due.append(problem.gradient_cost((tuple(map(np.arange, sizes)),)))

    spied(Known, "slope", gradient)
    spied(Known, "rough", lambda problem, x, sample: due.append(len(x) * sample.cost))
    spied(Run, "charge", lambda run, evaluations: charged.append(evaluations))
    list(steps(begun(known, BUDGET[name]), METHODS[name]))
    assert sum(due) == pytest.approx(sum(charged))
    assert len(due) > 10


def test_differences_that_redo_one_sensor_are_those_of_whole_layouts(problem):
    """To what two hard scores differ by when they are rounded apart, over the step."""
    x = problem.space.random(np.random.default_rng(2), 1)
    sample, poses = (
        problem.sample(np.random.default_rng(0), 96, 3),
        candidates.poses(problem.space, x)[0],
    )
    value, slope = differences.differences(problem, poses, sample.arrays, None)
    scenes = tuple(tiled.bucketed for tiled in sample.scenes)

    def score(moved):
        at = pad_rows(on_host(moved, float), len(problem.terms.sensors[0].kind))
        return float(case_scores(BITS, at, scenes, problem.terms, options=problem.options)[0])

    assert value == pytest.approx(score(poses), abs=2e-5)
    for s, axis in np.ndindex(poses.shape):
        step = np.zeros(poses.shape)
        step[s, axis] = half = differences.HALF[axis]
        expected = (score(poses + step) - score(poses - step)) / (2 * half) if half else 0.0
        assert slope[s, axis] == pytest.approx(expected, abs=2e-5 / half if half else 0.0)
    assert (np.abs(slope).max(0) > 1e-3).sum() == 5


@pytest.mark.slow
def test_a_slope_is_that_of_every_vehicle_against_every_column(problem):
    """What gradients are of, against the same measures in the open; to rounding."""
    space, x = problem.space, problem.space.random(np.random.default_rng(1), 1)[0]
    drawn, softness = problem.draw(np.random.default_rng(0), 96, 3), jnp.asarray(0.5, float)
    field = problem.take(drawn)[0]

    @jax.jit
    @jax.value_and_grad
    def expected(x):
        at = field, space.poses(x), problem.sensor_sets[0], 1.0, Softness.of(0.5)
        found = measure(*at, **problem.readings)
        return -surrogate(found.values, weights_of())[0]

    v, place = space.chart(x)
    v, still = on_host(v, float), on_host(np.zeros_like(v), float)
    value, slope = problem.charted_loss(still, v, place, drawn, softness)
    assert -0.99 < value < -0.1
    plain, slope_of_plain = expected(jnp.asarray(space.from_chart(v, place, np), float))
    slopes = np.asarray(slope_of_plain) @ jax.jacobian(space.from_chart)(v, place)
    assert value == pytest.approx(float(plain), abs=2e-6)
    np.testing.assert_allclose(slope, space.scale * slopes, atol=1e-5)


def test_with_a_larger_budget_it_goes_on_in_shares_of_that(known):
    """Adam looks at an exact score after each 0.15 of the budget, not of the one it had before."""
    part = begun(known, BUDGET["adam"])
    *_, kept = steps(part, METHODS["adam"])
    again = begun(known, 5 * BUDGET["adam"])
    again.take_up(part.seconds, part.evaluations, part.history, part.path)
    state = state_of(METHODS["adam"].states, kept.state)
    while len(again.history) == len(part.history):
        state = METHODS["adam"].step(again, state)
    assert again.evaluations < part.evaluations + 0.3 * again.limits[1]


# ── The default ─────────────────────────────────────────────────────────────


def test_bursts_and_moves_gain_what_greedy_placement_left(ran):
    """Bursts are taken, else each pass has one; and passes gain, judged together or one by one."""
    states = [kept.state for kept in ran("greedy-adam")[1]]
    improving = [state["class"] == "LocalSearch" for state in states]
    passes = [(a, b) for (a, b), both in zip(pairwise(states), pairwise(improving), strict=True)
              if all(both)]  # fmt: skip
    assert any(b["count"] > a["count"] + local_search.BURST for a, b in passes)
    assert any(b["value"] > a["value"] for a, b in passes)
    assert all(b["value"] >= a["value"] for a, b in passes)


def test_its_controls_have_bursts_by_differences_or_none(ran):
    def counts(name):
        kept = [at.state for at in ran(name)[1] if at.state["class"] == "LocalSearch"]
        return {state["count"] - local_search.STEPS * state["round"] for state in kept}

    assert max(counts("differences")) >= local_search.BURST
    assert counts("greedy") == {0}


def test_a_later_round_takes_some_units_out_of_the_best_layout_and_places_them(problem):
    """The others stay, to the bit, until an exchange moves them. Wherever it is stopped, it goes on
    as if nothing had come between: with the same candidates, for the same charge."""
    run, method = begun(problem, 10_000), METHODS["greedy"]

    def step(state):
        again = begun(problem, 10_000)
        again.take_up(0.0, run.evaluations, run.history, run.path, run.held)
        found, other = method.step(run, state), method.step(again, state)
        assert again.evaluations == run.evaluations
        for name, value in vars(found).items():
            np.testing.assert_array_equal(getattr(other, name), value)
        return found

    for number in range(1, 4):
        x = problem.space.random(run.rng(9, number), 4)
        x += 0.1 * problem.space.scale  # projected as moves are
        run.offer(candidates.project(problem.space, x)[0])
        state, best = greedy._again(run, number), run.best_x
        np.testing.assert_array_equal(state.x, best)
        assert 0 < state.out.sum() < len(state.out)
        while isinstance(state, greedy.Placing):
            out, state = state.out, step(state)
        for u, taken in enumerate(out):
            own = candidates.of_unit(problem.space, u)
            assert (state.x[own] != best[own]).any() == taken
        units = [sensor.unit for sensor in problem.layout.sensors]
        np.testing.assert_array_equal(state.picks == candidate_table.AS_IT_IS, ~out[units])
        assert problem.exact(state.x) == pytest.approx(state.value)
        step(step(state))


def test_a_round_ends_where_moves_of_all_widths_gained_little(problem, monkeypatch):
    monkeypatch.setattr(local_search, "finer", lambda sampled, x, rows, *_: (x, rows))
    run, width = begun(problem, 10_000), 1.1 * local_search.NARROW
    last = local_search.LocalSearch(0, run.start, run.best, 0, widest=run.best, width=width)
    assert local_search.improve(run, last, None) is None
    more = replace(last, widest=run.best - 1.1 * local_search.ENOUGH)
    again = local_search.improve(run, more, None)
    assert (again.width, again.widest) == (local_search.WIDTH, run.best)


def test_where_no_sensor_is_aimed_it_is_greedy(scene):
    """Score by score; and no gradient is compiled."""
    problem = Problem(scene, place_sensors((LIDAR, [*SIDEWALK, 5.0, 0.0, 0.0, 0.0])))
    runs = [begun(problem, 50) for _ in range(2)]
    for run, name in zip(runs, ("greedy-adam", "greedy"), strict=True):
        list(steps(run, METHODS[name]))
    assert offers(runs[0]) == offers(runs[1])
    assert runs[0].best > runs[0].history[0].score
    assert "slope" not in problem.known
