"""A metric that is not the paper's: one function and one row, and every score has it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import CAMERA, LIDAR, SMALL, random_layout, world

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.methods.greedy import GROWS
from inspe_jax.scoring import metrics
from inspe_jax.scoring.metrics import Metric


def watched_twice(found):
    """The share of voxels that at least two sensors have in view: with any one left out, some has
    it in view still."""
    number, everywhere = found.terms["watched_twice"]
    return number.sum(0) / everywhere.sum(0)


def twice(at):
    """(in view of two sensors, all voxels) of a tile; without a group, as if all were there."""
    reading, one = at.reading, at.views[0]
    seen, again = one, reading.outside(one, one)  # nothing
    for view in at.views[1:]:
        both = reading.both(seen, view)
        again = reading.any_of(jnp.stack([again, both]), None)[0]
        seen = reading.any_of(jnp.stack([seen, view]), None)[0]
    rows = 1 if at.failures is None else 1 + len(at.failures.first)
    number = reading.count(again).astype(float)
    return jnp.full(rows, number), reading.count(reading.voxels(at.tile)).astype(float)


TWICE = Metric("watched_twice", "W_2", 0.0, "seen by two", watched_twice, twice)
WORST = Metric(
    "worst_frame",
    "W",
    0.0,
    "the share that stays visible in the worst frame",
    lambda found: (found.seen / found.original).min(0),
)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(metrics.METRICS, "watched_twice", TWICE)
    monkeypatch.setitem(metrics.METRICS, "worst_frame", WORST)


@pytest.fixture(scope="module")
def scene():
    return world(**SMALL, seed=3)


@pytest.fixture(scope="module")
def layout(scene):
    return random_layout(scene, [LIDAR, CAMERA, CAMERA], seed=5)


def test_it_is_scored_exactly(scene, layout):
    scores = inspe_jax.evaluate(scene, layout)
    f = inspe_jax.in_view(scene, layout)
    assert 0.02 < scores.metrics["watched_twice"] < 0.98
    assert scores.metrics["watched_twice"] == pytest.approx((f.sum(0) >= 2).mean(), abs=1e-6)
    assert 0 < scores.metrics["worst_frame"] < scores.occlusion
    assert list(scores.metrics) == [m.name for m in metrics.listed()[:-1]]


def test_it_carries_weight_in_the_surrogate(scene, layout):
    weights = {"watched_twice": 0.25, "coverage": 0.75}
    scores = inspe_jax.evaluate(scene, layout, weights=weights)
    by_hand = 0.75 * scores.coverage + 0.25 * scores.metrics["watched_twice"]
    assert scores.surrogate == pytest.approx(by_hand, abs=1e-6)
    assert scores.settings["weights"]["watched_twice"] == 0.25
    with pytest.raises(InspeError, match="did you mean watched_twice"):
        inspe_jax.evaluate(scene, layout, weights={"watched_twce": 1})


@pytest.mark.parametrize(("name", "value", "terms", "words"), [
    ("mine", lambda _: 0.5, None, r"'mine': its value has the shape \(\), not .* = \(5,\)"),
    ("mine", lambda found: found.covered.mean(1), lambda tile: tile.visible, "say sight=True"),
    ("other", lambda found: found.covered.mean(1), None, r"METRICS\['mine'\] has the name 'other'"),
])  # fmt: skip
def test_a_row_that_is_wrong_is_told_of(scene, layout, monkeypatch, name, value, terms, words):
    row = Metric(name, "M", 0.0, "mine", value, terms)
    monkeypatch.setitem(metrics.METRICS, "mine", row)
    with pytest.raises(InspeError, match=words):
        inspe_jax.evaluate(scene, layout, visibility="in_view")


def test_softly_it_has_a_slope(scene, layout):
    def values(poses, width):
        softness = inspe_jax.Softness(width, width, "exact")
        found = inspe_jax.evaluate(scene, layout.with_poses(poses), softness=softness).metrics
        return found["watched_twice"], found["worst_frame"]

    poses = jnp.asarray(layout.poses, float)
    slope, worst = jax.grad(values, has_aux=True)(poses, 1.0)
    assert np.abs(np.asarray(slope)[:, :2]).max() > 1e-4
    assert 0 < float(worst) < 1
    sharp, exact = jax.vjp(lambda poses: values(poses, 1e-4), poses)[0], values(poses, None)
    assert np.asarray(sharp) == pytest.approx(np.asarray(exact), abs=2e-3)


def test_a_search_maximises_it(scene):
    layout = random_layout(scene, [LIDAR, CAMERA, CAMERA], seed=8)  # 0.07 of the voxels
    objective = inspe_jax.Objective(weights={"watched_twice": 1.0})
    found = inspe_jax.optimise(scene, layout, "greedy", evaluations=40, objective=objective)
    assert GROWS in found.notes  # beside none, a sensor adds nothing
    assert found.objective == pytest.approx(found.scores.metrics["watched_twice"], abs=1e-6)
    assert found.objective > found.objective_before
