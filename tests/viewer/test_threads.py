"""What works beside the page: jobs in turn, scores of the newest layout, a search that stops."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import jax
import numpy as np
import pytest
from page_socket import wait_until

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.placement.space import Space
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.scoring.metrics import METRICS
from inspe_jax.scoring.viewshed import sight_in
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.viewer import workers
from inspe_jax.viewer.job_queue import DelayedAction, JobQueue
from inspe_jax.viewer.score_panel import cost_of, score_panel
from inspe_jax.viewer.workers import Scorer, Searcher

# ── The queue ──


def test_jobs_are_done_in_turn_and_only_the_newest_of_a_key():
    done, go = [], threading.Event()
    queue = JobQueue(lambda _: None)
    queue.submit(go.wait)
    for k in range(5):
        queue.submit(lambda k=k: done.append(("drag", k)), key="drag")
    queue.submit(lambda: done.append("end"))
    queue.submit(lambda: done.append("soon"), key="soon", first=True)
    go.set()
    queue.close()
    assert done == ["soon", ("drag", 4), "end"]


def test_of_what_is_to_be_done_later_the_last_is_done_once_and_can_be_done_now():
    done, later, told = [], DelayedAction(), threading.Event()
    for k in range(3):
        later.start(0.05, lambda k=k: (done.append(k), told.set()))
    assert told.wait(60)
    later.run_now()
    assert done == [2]
    later.start(60, lambda: done.append("never"))
    later.cancel()
    later.start(60, lambda: done.append("now"))
    later.run_now()
    later.run_now()
    assert done == [2, "now"]


def test_a_job_that_fails_does_not_end_the_others_and_the_end_comes_soon():
    """What waits for longer than the patience is dropped."""
    failed, done = [], []
    queue = JobQueue(failed.append)
    queue.submit(lambda: 1 / 0)
    queue.submit(lambda: (done.append(1), threading.Event().wait(1)))
    queue.submit(lambda: done.append("never"))
    began = time.monotonic()
    queue.close(0.1)
    assert time.monotonic() - began < 2
    assert isinstance(failed[0], ZeroDivisionError)
    assert done == [1]


# ── The scorer ──


class Listener(list):
    """What a thread has told."""

    def __call__(self, *told):
        self.append(told)

    def wait(self, count):
        wait_until(lambda: len(self) >= count)
        return self[:]


@pytest.fixture
def listening(scene, monkeypatch):
    """A scorer that scores two of three frames first."""
    monkeypatch.setattr(workers, "SHOWN", 2)
    scores, sights = Listener(), Listener()
    case = Case(scene, Conditions.of("night", "clear"))
    scorer = Scorer(case, Objective(), scores, sights)
    yield scorer, scores, sights
    scorer.close()


def test_a_few_frames_first_then_all_as_evaluate_has_them(scene, layout, listening):
    scorer, scores, sights = listening
    scorer.select_frame(2)
    scorer.score(layout, whole=True)
    few, whole = (told[0] for told in scores.wait(2))
    night = Conditions.of("night", "clear")
    assert (few.frames, whole.frames) == (2, 3)
    assert whole.scores.surrogate == evaluate(scene, layout, conditions=night).surrogate
    part = replace(scene, traffic=jax.tree.map(lambda leaf: leaf[::2], scene.traffic))
    assert few.scores.surrogate == evaluate(part, layout, conditions=night).surrogate
    frame, sight = sights.wait(1)[-1]
    assert frame == 2
    np.testing.assert_array_equal(sight, sight_in(scene, layout, 2, conditions=night))


def test_what_is_out_of_date_is_not_begun(layout, listening, monkeypatch):
    """While one layout is scored, ten more come: the last alone is scored after it. A scorer that
    is closed meanwhile without waiting goes on alone: compiling cannot be interrupted."""
    scorer, scores, _ = listening
    begun, go = [], [threading.Event(), threading.Event()]

    def slowly(case, of, _):
        begun.append((of.name, case.scene.traffic.frame_count))
        go[0].wait(60)
        if begun[-1] == ("last", 3):
            go[1].wait(60)
        raise InspeError("no scores")

    monkeypatch.setattr(workers, "scores_of", slowly)
    scorer.score(replace(layout, name="first"), whole=True)
    wait_until(lambda: begun)
    for k in range(10):
        scorer.score(replace(layout, name=f"dragged {k}"), whole=False)
    scorer.score(replace(layout, name="last"), whole=True)
    go[0].set()
    scores.wait(2)
    wait_until(lambda: begun[-1] == ("last", 3))
    scorer.close(wait=False)
    assert len(scores) == 2  # it has come back before the score
    go[1].set()
    scorer.close()
    assert begun == [("first", 2), ("last", 2), ("last", 3)]


def test_a_layout_that_cannot_be_scored_is_said(layout, listening, monkeypatch):
    """And the scorer goes on; also after a fault that is not the layout's."""
    scorer, scores, _ = listening
    away = replace(layout, poses=np.array(layout.poses) + [1e4, 0, 0, 0, 0, 0])
    scorer.score(away, whole=False)
    told = scores.wait(1)[-1][0]
    assert told.scores is None
    assert "is this layout for another scene" in told.wrong
    with monkeypatch.context() as short:
        short.setattr(workers, "scores_of", Mock(side_effect=MemoryError("too large")))
        scorer.score(layout, whole=False)
        assert "too large" in scores.wait(2)[-1][0].wrong
    scorer.score(layout, whole=False)
    assert scores.wait(3)[-1][0].scores.surrogate > 0


# ── The search ──


@pytest.fixture
def heard():
    return SimpleNamespace(progress=Listener(), found=Listener(), ended=Listener())


@pytest.fixture
def searcher(scene, heard):
    found = Searcher(Case(scene), Objective(), Constraints(), **vars(heard))
    yield found
    found.close()


def test_searches_end_or_are_stopped_with_their_best(scene, layout, searcher, heard):
    """One at a time; what a search that is stopped still computes is not told."""

    def ended(*of, count):
        searcher.start(layout, "random", *of)
        return heard.ended.wait(count)[-1][0]

    first = ended(1.0, count=1)
    assert (first.reason, first.failed) == ("budget spent", False)
    assert first.gain >= 0
    target = evaluate(scene, layout).surrogate + 1e-4
    second = ended(600.0, target, count=2)  # long before its time
    assert second.reason == "target reached"
    assert evaluate(scene, second.layout).surrogate >= target
    heard.found.clear()
    searcher.start(layout, "random", 600.0)
    thread = searcher.thread
    searcher.start(layout, "random", 600.0)
    assert searcher.thread is thread
    heard.found.wait(2)
    began = time.monotonic()
    searcher.stop()
    ending = heard.ended.wait(3)[-1][0]
    assert time.monotonic() - began < 2
    assert ending.reason == "interrupted"
    assert (ending.failed, searcher.running) == (False, False)
    told = len(heard.progress), len(heard.found)
    thread.join(60)  # and takes up no core
    assert not thread.is_alive()
    assert (len(heard.progress), len(heard.found)) == told
    scores = [score for _, score in heard.found]
    assert scores == sorted(scores)
    gain = evaluate(scene, ending.layout).surrogate - scores[0]
    assert ending.gain == scores[-1] - scores[0] == pytest.approx(gain, abs=1e-6)
    np.testing.assert_array_equal(ending.layout.poses, heard.found[-1][0].poses)
    assert ending.layout.name.endswith(", optimised")
    assert Space(scene, layout).violations(ending.layout) == []


def test_a_search_is_stopped_while_it_compiles_or_fails_with_its_best(
    layout, searcher, heard, monkeypatch
):
    """Python cannot interrupt XLA: here it compiles until it is let go. A search that cannot begin
    says why."""
    compiles, go = threading.Event(), threading.Event()

    def compiling(*_, found, **__):
        compiles.set()
        go.wait(60)
        found(layout, 0.5)
        raise MemoryError("too large")

    with monkeypatch.context() as short:
        short.setattr("inspe_jax.viewer.workers.optimise", compiling)
        searcher.start(layout, "random", 600.0)
        left = searcher.thread
        assert compiles.wait(60)
        searcher.stop()
        searcher.start(layout, "random", 600.0)
        go.set()
        heard.ended.wait(2)
        left.join(60)
    searcher.constraints = Constraints(places="poles")  # there is none
    searcher.start(layout, "random", 5.0)
    stopped, failed, none = (ending for (ending,) in heard.ended.wait(3))
    assert (stopped.layout, stopped.failed) == (None, False)
    assert "before there was a score" in stopped.reason
    assert (failed.after, failed.failed, len(heard.found)) == (0.5, True, 1)
    assert "too large" in failed.reason
    assert (none.layout, none.failed) == (None, True)
    assert "nowhere to stand" in none.reason


# ── The score panel ──


def test_the_panel_says_scores_faults_and_cost(scene, layout):
    def panel(scored, of=layout, **further):
        return "".join(score_panel(of, scored, frames=50, **further))

    assert cost_of(layout) == "no list price for test-camera, test-lidar"
    scored = workers.ScoredLayout(layout, evaluate(scene, layout), 50, 0.25)
    scores, moved = scored.scores, replace(layout, name="moved")
    less = {name: value - 0.01 for name, value in scores.metrics.items()}
    opened = replace(scores, surrogate=0.1, metrics=less | {"coverage": scores.metrics["coverage"]})
    text = panel(scored, reference=opened, faults=["unit <x> floats"], notes=["so"])
    assert text.count("+0.010") == 2  # and none where nothing has changed
    marks = [round(100 * (value - 0.01), 1) for value in scores.metrics.values()]
    assert sum(f"left:calc({mark:.1f}%" in text for mark in marks) == 2  # the reference's
    for words in (
        METRICS["occlusion"].summary, f"{scores.surrogate:.4f}", "all frames",
        f"{scores.surrogate - 0.1:+.4f} against the reference", "unit &lt;x&gt; floats",
        f"{scores.region_coverage['driveway']:.3f}",
    ):  # fmt: skip
        assert words in text
    for value, words in ((0.99971, ">0.9997<"), (1.0, ">1.000<")):
        assert words in panel(replace(scored, scores=replace(scores, metrics={"coverage": value})))
    few, later = panel(replace(scored, frames=17)), panel(scored, moved, waiting="compiling: 3 s")
    assert "17 of 50 frames" in few
    assert "compiling: 3 s" in later  # what is known is of another layout
    for page, words in ((few, "against"), (few, "cannot be mounted"), (later, "all frames")):
        assert words not in page
    assert "target" not in text
    assert "target reached" in panel(scored, target=0.01)
    assert f"{1.0 - scores.surrogate:.4f} to the target" in panel(scored, target=1.0)
    assert "no &lt;traffic&gt;" in panel(replace(scored, scores=None, wrong="no <traffic>"))
