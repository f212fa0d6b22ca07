"""Slopes against differences of the exact score; what random errors leave, by hand and by seed."""

from dataclasses import replace

import numpy as np
import pytest
from shapely import Polygon
from worlds import slow_but

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.studies.tolerance import tolerance


@pytest.fixture(scope="module")
def scene():
    size = dict(radius=30, voxel=0.5, frames=4, density="medium", profile="ideal")
    return inspe_jax.build_scene(inspe_jax.built_in("four_way"), **size)


@pytest.fixture
def _flat(monkeypatch):
    """No slopes, whose program takes long to compile."""
    slope = lambda _, poses, *__: (0.0, np.zeros((len(poses), 6)))  # noqa: E731
    monkeypatch.setattr(Problem, "slope", slope)


def of_one_unit(scene, name="Cam-d1"):
    """The first two sensors of a strategy."""
    whole = inspe_jax.strategy(scene, name)
    return inspe_jax.Layout(whole.poses[:2], whole.sensors[:2], whole.units[:1], "of one unit")


@pytest.mark.parametrize("name", slow_but(["Cam-d1", "L-c"], "Cam-d1"))
def test_slopes_are_differences_of_the_exact_score(scene, name):
    """Over ±20 cm and ±1°, over which the exact staircase is nearly even.

    Apart by a sixth of the largest slope of their kind, or less: the soft slope at a point is a
    mean over 20 cm, not over the difference's own stretch. The sensors are turned away from
    where the strategy aims them, near which the score is flat.
    """
    layout = of_one_unit(scene, name)
    layout = layout.with_poses(layout.poses + np.array([0, 0, 0, 0, -0.12, 0.3]))
    found = tolerance(scene, layout, samples=1)
    poses, kinds = np.asarray(layout.poses), dict(x=0, y=1, z=2, pitch=4, yaw=5)
    ours, steps, ends = [], [], []
    for s in range(len(layout)):
        for kind, column in kinds.items():
            h, unit = (0.2, 0.1) if column < 3 else (np.radians(1.0), np.radians(1.0))
            error = np.zeros_like(poses)
            error[s, column] = h
            ends += [poses + error, poses - error]
            steps.append(2 * h / unit)
            ours.append(getattr(found.slopes[s], kind))
    scores = inspe_jax.evaluate_many(scene, layout, np.stack(ends)).surrogate
    exact = (scores[::2] - scores[1::2]) / steps
    ours, exact = (np.reshape(values, (-1, 5)) for values in (ours, exact))
    for kind in (slice(0, 3), slice(3, 5)):
        largest = np.abs(exact[:, kind]).max()
        np.testing.assert_allclose(ours[:, kind], exact[:, kind], atol=largest / 6)


@pytest.mark.usefixtures("_flat")
def test_no_error_leaves_the_score_and_errors_repeat(scene):
    layout = of_one_unit(scene)
    still = tolerance(scene, layout, position=0.0, angle=0.0, samples=2)
    assert still.left.tolist() == [still.score] * 2
    assert still.score == pytest.approx(inspe_jax.evaluate(scene, layout).surrogate, abs=1e-6)
    rough = dict(position=0.5, angle=np.radians(8.0), samples=6)
    calls = []
    one = tolerance(scene, layout, **rough, progress=lambda *at: calls.append(at))
    assert calls[-1] == (6, 6)
    assert one.left.tolist() == tolerance(scene, layout, **rough).left.tolist()
    assert one.left.tolist() != tolerance(scene, layout, **rough, seed=1).left.tolist()
    assert one.low <= one.mean < one.score
    assert np.ptp(one.left) > 1e-4


@pytest.mark.usefixtures("_flat")
def test_the_objective_is_the_callers(scene):
    """Also where nothing may be mounted, what stands has its tolerance."""
    layout = of_one_unit(scene)
    bare = replace(scene, intersection=replace(scene.intersection, mounting=Polygon()))
    found = tolerance(bare, layout, samples=1, objective=Objective(weights=(1.0, 0.0, 0.0)))
    assert found.score == pytest.approx(inspe_jax.evaluate(scene, layout).coverage, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(position=-0.1), "position -0.1 m is out of range: between 0 m and 2 m"),
        (dict(angle=1.0), "angle 57.2958° is out of range: between 0° and 30°"),
        (dict(samples=0), "samples 0 is out of range: between 1 and 10000"),
        (dict(seed=-1), "seed -1: a whole number, 0 or more"),
    ],
)
def test_options_out_of_range(scene, options, message):
    with pytest.raises(InspeError, match=message):
        tolerance(scene, inspe_jax.strategy(scene, "L-c"), **options)
