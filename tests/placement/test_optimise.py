"""A search from outside: budgets, starts, ends, checkpoints, and what is never handed on."""

import json
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from worlds import SMALL

from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.strategies import strategy
from inspe_jax.placement import checkpoint as files
from inspe_jax.placement import optimise as module
from inspe_jax.placement.checkpoint import FORMAT, load_checkpoint
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import METHODS, compare, optimise
from inspe_jax.placement.problem import Case, Problem
from inspe_jax.placement.run import AT_ONCE, BudgetSpent, Method, Run
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout

EVALUATIONS = 60
"""Enough for a random search on so small a scene."""


@pytest.fixture(scope="module")
def scene():
    return build_scene(built_in("four_way"), **SMALL, frames=4, density=10)


@pytest.fixture(scope="module")
def layout(scene):
    """Four cameras on two units: less than there is to see."""
    whole = strategy(scene, "Cam-d1")
    sensors = tuple(s for s in whole.sensors if s.unit < 2)
    return Layout(whole.poses[: len(sensors)], sensors, whole.units[:2], "two corners")


# ── The run, on a hill of its own ───────────────────────────────────────────


class Hill:
    """Highest, at 1, where x is 0."""

    def exact(self, x):
        return 1.0 - float((x**2).sum())

    def sample(self, rng, columns, frames):
        return SimpleNamespace(cost=0.25)

    def rough(self, x, sample):
        return 1.0 - (x**2).sum(-1)


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


def run_of(**options):
    return Run(Hill(), np.array([2.0, 0.0]), **options)


def test_a_run_counts_work_in_exact_scores():
    """And looks at its budget within a large generation."""
    run = run_of(evaluations=10)
    assert run.offer(run.start) == -3.0
    np.testing.assert_array_equal(run.rough(np.ones((8, 2)), 0), -np.ones(8))
    run.charge(0.5)
    assert run.evaluations == 1 + 8 * 0.25 + 0.5
    assert run.done == pytest.approx(0.35)
    run = run_of(evaluations=AT_ONCE * 0.25 * 2)
    with pytest.raises(BudgetSpent):
        run.rough(np.ones((3 * AT_ONCE, 2)), 0)
    assert run.evaluations == AT_ONCE * 0.25 * 2
    run = run_of(evaluations=AT_ONCE)
    x = np.linspace(0, 1, 2 * (AT_ONCE + 3)).reshape(-1, 2)
    np.testing.assert_array_equal(run.rough(x, 0), run.problem.rough(x, None))


def test_a_run_keeps_the_best_and_a_copy_of_it():
    told, found = [], []
    run = run_of(
        evaluations=10,
        progress=lambda *row: told.append(row),
        found=lambda x, score: found.append((x.tolist(), score)),
    )
    x = np.array([0.5, 0.0])
    for at in (run.start, x, np.array([1.0, 0.0])):
        run.offer(at)
    x[:] = 9.0
    assert run.best == 0.75
    np.testing.assert_array_equal(run.best_x, [0.5, 0.0])
    assert [x.tolist() for x in run.path] == [[2.0, 0.0], [0.5, 0.0]]
    assert found == [([2.0, 0.0], -3.0), ([0.5, 0.0], 0.75)]
    rows = [(row.evaluations, row.score, row.best) for row in run.history]
    assert rows == [(1, -3.0, -3.0), (2, 0.75, 0.75), (3, 0.0, 0.75)]
    assert told == [(pytest.approx(0.1 * count), best) for count, _, best in rows]


def test_a_run_has_two_budgets_and_a_clock_that_starts_with_its_first_score():
    """What comes before is not part of the budget, nor the time between a run and its next part."""
    clock = Clock()
    run = run_of(evaluations=10, seconds=100, clock=clock)
    clock.now += 30
    run.offer(run.start)
    assert (run.seconds, run.history[0].seconds, run.done) == (0, 0, pytest.approx(0.1))
    run.charge(4)
    clock.now += 20
    assert run.done == pytest.approx(0.5)
    clock.now += 60
    assert (run.seconds, run.done) == (80, pytest.approx(0.8))
    later = run_of(evaluations=10, seconds=100, clock=clock)
    clock.now += 1000
    later.take_up(40.0, 2.5, [], [])
    clock.now += 30
    assert (later.seconds, later.evaluations, later.done) == (70, 2.5, pytest.approx(0.7))


@pytest.mark.parametrize(
    ("does", "budget"),
    [
        (lambda run: run.offer(run.start), dict(evaluations=2.0)),
        (lambda run: run.charge(1.0), dict(seconds=2.0)),
        # One evaluation is left for the best of these.
        (lambda run: run.rough(np.ones((4, 2)), 0), dict(evaluations=3.0)),
    ],
)
def test_no_work_begins_after_the_budget(does, budget):
    """Of evaluations, or of seconds by the clock; a piece of work that began is finished."""
    clock = Clock()
    run = run_of(**budget, clock=clock)
    for _ in range(2):
        does(run)
        clock.now += 1.0
    before = (run.evaluations, len(run.history))
    with pytest.raises(BudgetSpent):
        does(run)
    assert (run.evaluations, len(run.history)) == before


@pytest.mark.parametrize(
    ("budget", "message"),
    [
        (dict(seconds=0), "seconds 0: a budget must be more than 0"),
        (dict(evaluations=-3), "evaluations -3: a budget must be more than 0"),
        (dict(seconds=float("nan")), "seconds nan"),
        (dict(evaluations=float("inf")), "and finite"),
        (dict(), "no budget: give seconds, evaluations or both"),
    ],
)
def test_a_budget_of_nothing_is_refused(budget, message):
    with pytest.raises(InspeError, match=message):
        run_of(**budget)


# ── A search in full ────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def found(scene, layout):
    return optimise(scene, layout, "random", evaluations=EVALUATIONS)


def test_a_search_finds_better_places_that_can_be_mounted(scene, layout, found):
    assert found.objective > found.objective_before + 0.02
    assert found.layout.sensors == layout.sensors
    assert [unit.name for unit in found.layout.units] == [unit.name for unit in layout.units]
    assert found.layout.name == "two corners, optimised"
    assert found.notes == ()
    np.testing.assert_allclose(found.start.poses, layout.poses, atol=1e-5)
    for of, scores, objective in (
        (found.layout, found.scores, found.objective),
        (found.start, found.scores_before, found.objective_before),
    ):  # by the scoring itself; single precision sums in another order
        again = evaluate(scene, of).surrogate
        assert (scores.surrogate, objective) == pytest.approx((again, again), abs=1e-6)


def test_its_record_says_what_it_did_and_how_to_make_it_again(found):
    history = found.history
    assert history[0].score == found.objective_before
    assert history[-1].best == found.objective
    seconds, evaluations, scores, best = np.array([astuple(row) for row in history]).T
    np.testing.assert_array_equal(best, np.maximum.accumulate(scores))
    assert (np.diff(evaluations) >= 1).all()
    assert (np.diff(seconds) > 0).all()
    # The last may be of what it held when the budget was spent.
    assert found.evaluations >= EVALUATIONS > history[-2].evaluations - 1
    assert found.seconds >= history[-1].seconds
    assert (found.status, found.method, found.seed) == ("budget spent", "random", 0)
    settings = json.loads(json.dumps(found.settings))
    assert settings["budget"] == {"seconds": None, "evaluations": EVALUATIONS}
    assert settings["scenes"][0]["name"] == "four_way"
    assert settings["constraints"]["pitch_deg"]["camera"] == [-80, 10]
    assert {"inspe_jax", "python", "jax", "optax", "jaxopt", "cmaes"} <= set(found.versions)


# ── Ends, starts and faults, with methods made for it and scores made up ────


@dataclass(frozen=True)
class Count:
    """How many steps were done."""

    count: int = 0


@pytest.fixture
def quick(monkeypatch, scene, found):
    """Made-up scores, which nothing is compiled for: the nearer to 6 m the masts, the better."""

    def exact(self, x):
        self.space.layout(x)
        return 1.0 - float(np.abs(self.space.split(x).height - 6.0).mean()) / 10

    monkeypatch.setattr(Problem, "exact", exact)
    monkeypatch.setattr(module, "evaluate", lambda *_, **__: found.scores)

    def add(name, step):
        begin = lambda run: Count()  # noqa: E731
        monkeypatch.setitem(METHODS, name, Method(name, "made for a test", (Count,), begin, step))
        return partial(optimise, method=name)

    return add


def at_height(run, height):
    """The start with every mast as high [m]."""
    x = np.array(run.start)
    x[run.problem.space.split(np.arange(len(x))).height.astype(int)] = height
    return x


def climb(run, state, steps=5):
    """Every mast to a random height."""
    if state.count == steps:
        return None
    run.offer(at_height(run, run.rng(state.count).uniform(5, 10)))
    return Count(state.count + 1)


def test_a_method_that_is_done_has_converged(scene, layout, quick):
    result = quick("climb", climb)(scene, layout, evaluations=100)
    assert result.status == "converged"
    assert result.evaluations == 6
    other = quick("climb", climb)(scene, layout, evaluations=100, seed=1)
    assert other.history[-1].score != result.history[-1].score
    follow = lambda run, state: None if run.done >= 0.9 else climb(run, state, 99)  # noqa: E731
    spent = quick("follow", follow)(scene, layout, evaluations=20)
    assert (spent.status, spent.evaluations) == ("budget spent", 18)


def test_the_result_is_never_worse_than_its_start(scene, layout, quick):
    def fall(run, state):
        assert run.offer(at_height(run, 10.0)) < run.history[0].score

    result = quick("fall", fall)(scene, layout, evaluations=100)
    assert result.objective == result.objective_before
    assert result.notes == (
        "nothing better than the start was found; try a larger budget or start",
    )
    np.testing.assert_allclose(result.layout.poses, result.start.poses)


@pytest.mark.parametrize("end", [BudgetSpent, KeyboardInterrupt, None])
def test_what_a_method_holds_is_scored_however_the_search_ends(scene, layout, quick, tmp_path, end):
    """Also where it was held before a checkpoint that another search goes on from."""

    def keep(run, state):
        if state.count == 0:
            run.hold(at_height(run, 6.0))
            return Count(1)
        if end:
            raise end
        return None

    search = partial(quick("keep", keep), scene, layout, checkpoint=tmp_path / "c.npz")
    result = search(evaluations=100)
    assert result.objective == pytest.approx(1.0)
    assert result.objective_before < 0.99
    assert len(result.history) == 2
    if end is KeyboardInterrupt:
        assert result.status == "interrupted"
        assert len(load_checkpoint(tmp_path / "c.npz").history) == 1
        assert load_checkpoint(tmp_path / "c.npz").status == ""
        again = search(evaluations=100)
        assert (again.objective, len(again.history)) == (result.objective, 2)


def test_a_search_outlives_a_full_disk(scene, layout, quick, tmp_path, monkeypatch):
    def full(*_):
        raise InspeError("c.npz: No space left on device")

    monkeypatch.setattr(files, "save_checkpoint", full)
    result = quick("climb", climb)(scene, layout, evaluations=4, checkpoint=tmp_path / "c.npz")
    assert len(result.history) == 4
    assert "no checkpoint is written: c.npz: No space left on device" in result.notes


def test_what_cannot_be_mounted_is_not_handed_on(scene, layout, quick, monkeypatch):
    monkeypatch.setattr("inspe_jax.placement.space.Space.violations", lambda *_: ["floats"])
    with pytest.raises(AssertionError, match="not feasible: floats"):
        quick("climb", climb)(scene, layout, evaluations=100)


def test_an_interrupt_before_or_after_the_search(scene, layout, quick, found, monkeypatch):
    """Without a score it goes through; while the result is scored, the result is kept, once."""
    search, stops = quick("climb", climb), []

    def stop(*_, **__):
        if stops.pop():
            raise KeyboardInterrupt
        return found.scores

    monkeypatch.setattr(module, "evaluate", stop)
    stops += [False, False, True]
    result = search(scene, layout, evaluations=4)
    assert (result.status, len(result.history)) == ("interrupted", 4)
    stops += [True, True]
    with pytest.raises(KeyboardInterrupt):
        search(scene, layout, evaluations=4)
    stops += [True]
    monkeypatch.setattr(Problem, "exact", stop)
    with pytest.raises(KeyboardInterrupt):
        search(scene, layout, evaluations=100)


def test_any_start(scene, layout, quick):
    whole = strategy(scene, "Cam-d1")
    search = partial(quick("climb", climb), scene, whole, evaluations=1)
    np.testing.assert_allclose(search().start.poses, whole.poses, atol=1e-5)
    drawn = [search(start="random", seed=seed).start.poses for seed in (0, 0, 1)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert np.abs(drawn[0] - drawn[2]).max() > 1
    mine = search(start=whole.with_poses(whole.poses + np.array([0, 0, 0.5, 0, 0, 0])))
    np.testing.assert_allclose(mine.start.poses[:, 2], whole.poses[:, 2] + 0.5, atol=1e-5)


def test_several_scenes_and_the_worst(scene, layout, quick):
    dark = Case(scene, Conditions.of("night", "rain:5"))
    result = quick("climb", climb)(
        [scene, dark], layout, evaluations=2, objective=Objective(over="worst")
    )
    around = [(row["light"], row["weather"]) for row in result.settings["scenes"]]
    assert around == [("midday", "clear"), ("night", "rain:5")]
    assert result.settings["objective"]["over"] == "worst"
    apart = [evaluate(scene, layout, conditions=case.conditions) for case in (Case(scene), dark)]
    worst = min(scores.surrogate for scores in apart)
    problem = Problem([scene, dark], layout, Objective(over="worst"))
    assert problem.exact_of(layout) == pytest.approx(worst, abs=1e-6)
    assert apart[1].surrogate < apart[0].surrogate


def test_methods_are_compared_on_equal_terms(scene, layout, quick):
    quick("climb", climb)
    quick("short", partial(climb, steps=2))
    told, names = [], ("short", "climb")
    given = dict(evaluations=4, seeds=2, progress=lambda *row: told.append(row))
    results = compare(scene, layout, names, **given)
    assert [(r.method, r.seed) for r in results] == [*product(names, (0, 1))]
    assert [r.evaluations for r in results] == [3, 3, 4, 4]
    assert len({r.objective_before for r in results}) == 1
    assert ("climb", 1, 1.0, results[-1].objective) in told


def test_a_comparison_that_is_stopped_gives_what_it_has(scene, layout, quick):
    quick("climb", climb)

    def later(run, state):
        if run.seed == 1 and state.count == 2:
            raise KeyboardInterrupt
        return climb(run, state)

    quick("later", later)
    results = compare(scene, layout, ["later", "climb"], evaluations=10, seeds=3)
    found = [(r.method, r.seed, r.status, len(r.history)) for r in results]
    assert found == [("later", 0, "converged", 6), ("later", 1, "interrupted", 3)]


def test_a_budget_shorter_than_what_comes_before_it_gives_the_start(scene, layout):
    result = optimise(scene, layout, "random", seconds=1e-6)
    assert (result.status, result.objective) == ("budget spent", result.objective_before)
    assert result.notes == (
        "nothing was searched, only the start was scored: the budget in seconds or evaluations "
        "was used up; give a larger budget",
    )
    assert len(result.history) == 1


# ── Checkpoints ─────────────────────────────────────────────────────────────


@pytest.fixture
def kept(scene, layout, quick, tmp_path):
    """A checkpoint of a finished search, and a way to go on from it with other options."""
    search = partial(quick("climb", climb), evaluations=3, checkpoint=tmp_path / "c.npz")
    search(scene, layout)
    return search


def test_a_larger_budget_goes_further(scene, layout, kept):
    first = kept(scene, layout)
    assert "has ended (budget spent); delete it to start again, or give a larger" in first.notes[0]
    more = kept(scene, layout, evaluations=100)
    assert more.status == "converged"
    assert len(more.history) == 6
    assert more.history[:3] == first.history
    assert "went on from" in more.notes[0]
    done = kept(scene, layout, evaluations=200)
    assert (done.status, len(done.history)) == ("converged", 6)
    assert done.notes[0].endswith("has ended (converged); delete it to start again")


def test_a_target_ends_a_search_and_a_higher_one_goes_on(scene, layout, quick, tmp_path):
    search = partial(quick("climb", climb), scene, layout, checkpoint=tmp_path / "c.npz")
    for _ in range(2):
        first = search(evaluations=100, target=0.1)
        assert (first.status, first.evaluations) == ("target reached", 1)
    whole = search(evaluations=100)
    assert (whole.status, len(whole.history)) == ("converged", 6)
    assert whole.history[:1] == first.history


def test_a_checkpoint_of_another_search_names_what_differs(scene, layout, kept, quick):
    moved = layout.with_poses(np.asarray(layout.poses) + 0.01)
    quick("other", climb)
    box = built_in("four_way").mounting.envelope
    for differs, change in {
        "scene": dict(scene=replace(scene, settings=(*scene.settings, ("seed", "7")))),
        "layout": dict(layout=moved),
        "objective": dict(objective=Objective(failures=True)),
        "constraints": dict(constraints=Constraints(area=box)),
        r"start \(given, not random\)": dict(start="random"),
        r"method \(climb, not other\)": dict(method="other"),
        r"seed \(0, not 4\)": dict(seed=4),
    }.items():
        given = dict(scene=scene, layout=layout) | change
        with pytest.raises(InspeError, match=f"of another search, with another {differs}; name"):
            kept(**given)


def test_a_file_that_is_no_checkpoint_is_refused_and_left_alone(scene, layout, kept, tmp_path):
    for content in (b"", b"PK\x03\x04", (tmp_path / "c.npz").read_bytes()[:-200]):
        (tmp_path / "bad.npz").write_bytes(content)
        with pytest.raises(InspeError, match=r"bad\.npz: not a checkpoint of a search"):
            kept(scene, layout, checkpoint=tmp_path / "bad.npz")
        assert (tmp_path / "bad.npz").read_bytes() == content
    with np.load(tmp_path / "c.npz") as data:  # whole, but for an array that is a pickle
        whole = {name: data[name] for name in data.files}
    np.savez(tmp_path / "bad.npz", **whole, **{"state: x": np.array([None])})
    with pytest.raises(InspeError, match="not a checkpoint"):
        load_checkpoint(tmp_path / "bad.npz")
    older = str(whole["record"]).replace(FORMAT, "inspe_jax checkpoint 1")
    np.savez(tmp_path / "bad.npz", **whole | {"record": np.array(older)})
    with pytest.raises(InspeError, match=r"bad\.npz: written by another version"):
        load_checkpoint(tmp_path / "bad.npz")


def test_checkpoints_are_written_on_the_way(scene, layout, quick, tmp_path, monkeypatch):
    """Every 0 s here: what a killed search leaves is as of its last whole step."""
    path, seen = tmp_path / "c.npz", []

    def look(run, state):
        seen.append((load_checkpoint(path).state["count"], load_checkpoint(path).evaluations))
        return climb(run, state, 3)

    monkeypatch.setattr(files, "EVERY", 0.0)
    quick("look", look)(scene, layout, evaluations=100, checkpoint=path)
    assert seen == [(k, k + 1.0) for k in range(4)]


# ── Bad input ───────────────────────────────────────────────────────────────


BAD = [
    (dict(method="adm"), "method 'adm': one of adam, .*did you mean adam"),
    (dict(seed=-1), "seed -1: a whole number, 0 or more"),
    (dict(seed=0.5), "seed 0.5"),
    (dict(start="Cam-d1"), "start 'Cam-d1': one of given, random"),
    (dict(start=3), "start: got 3, of type int; give a Layout, or one of given, random"),
    (dict(checkpoint="c.txt"), r"must end in \.npz"),
    (dict(checkpoint="no/such/c.npz"), "no such folder"),
    (dict(checkpoint="/proc/c.npz"), "no file can be written there"),
    (dict(seconds="5"), "seconds: got '5', of type str; give a number above 0"),
    (dict(constraints=Constraints(places="nowhere")), "places 'nowhere'"),
    (dict(methods=[]), "no method to compare"),
    (dict(methods=["adam", "adam"]), "named twice"),
    (dict(methods=["adam"], seeds=0), "seeds 0: give at least 1"),
    (dict(methods=["adam", "gird"]), "did you mean grid"),
]


@pytest.mark.parametrize(("options", "message"), BAD)
def test_bad_options_are_refused(scene, layout, options, message):
    with pytest.raises(InspeError, match=message):
        (compare if "methods" in options else optimise)(scene, layout, **options)
