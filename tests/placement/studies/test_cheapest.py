"""The cheapest mix that reaches a target, and objectives on some regions only."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import methods, optimise
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.studies.pareto import cheapest
from inspe_jax.report.tables import before_after_table
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import build_scene
from inspe_jax.scoring.targets import target_view

pytestmark = pytest.mark.slow  # many searches, each with programs of its own
CAMERA, LIDAR = "paper-camera", "velodyne-vlp-16"
COUNTS = {CAMERA: (0, 1, 2), LIDAR: (0, 1)}
FOUND = Objective(weights={"detectability": 1.0}, prices={CAMERA: 1000.0})


@pytest.fixture(scope="module")
def scene():
    return build_scene(built_in("four_way"), radius=25, voxel=1.0, frames=3, density=20)


def test_the_first_mix_that_reaches_the_target_ends_the_study(scene):
    """Two cameras reach less than one LiDAR; all mixes that are cheaper were searched."""
    told = []
    given = dict(method="random", evaluations=6, objective=FOUND)
    found = cheapest(
        scene, COUNTS, 0.72, **given, progress=lambda row, done, best: told.append((row, done))
    )
    assert [mix.cost for mix in found.searched] == [1000, 2000, 4000]
    assert found.found is found.best is found.searched[-1]
    assert found.found.counts == {CAMERA: 0, LIDAR: 1}
    assert found.found.result.status == "target reached"
    assert found.found.result.objective >= 0.72 > found.searched[1].result.objective
    assert found.total == 5
    shares = [done for _, done in told]
    assert shares == sorted(shares)
    assert shares[-1] <= 3 / 5
    short = replace(found, target=0.999)
    assert short.found is None
    assert short.best is found.searched[-1]  # what comes nearest
    with pytest.raises(InspeError, match="between 0 and 1"):
        cheapest(scene, COUNTS, 95)


def test_only_the_regions_that_are_named_count(scene):
    start = starting_layout(scene, {CAMERA: 1, LIDAR: 1})
    on = Objective(weights={"coverage": 1.0}, regions=("crosswalk",))
    problem = Problem(scene, start, on)
    columns = inspe_jax.in_view(scene, start).any(0).reshape(len(scene.voxels.columns), -1).mean(1)
    expected = columns[scene.voxels.region == Region.CROSSWALK].mean()
    assert problem.exact_of(start) == pytest.approx(expected, abs=1e-6)
    assert problem.rough(
        problem.space.start(start)[0][None], problem.sample(np.random.default_rng(0), 10**6, 10**6)
    )[0] == pytest.approx(problem.exact(problem.space.start(start)[0]), abs=1e-5)
    detected = Objective(weights={"detectability": 1.0}, regions=("crosswalk", "sidewalk"))
    result = optimise(scene, start, "random", evaluations=3.0, objective=detected)
    assert result.scores.metrics["detectability"] == pytest.approx(result.objective, abs=1e-6)
    some = np.isin(scene.voxels.region, (Region.CROSSWALK, Region.SIDEWALK))
    weight = np.where(some, scene.voxels.column_weight, 0)
    careful = np.mean(
        [
            target_view(scene, result.layout, name).detectability @ weight / weight.sum()
            for name in ("car", "truck", "cyclist", "pedestrian")
        ]
    )
    assert result.objective == pytest.approx(careful, abs=0.03)
    out = io.StringIO()
    Console(file=out, width=120).print(before_after_table(result))
    assert "(C and D of crosswalk, sidewalk only)" in out.getvalue()


def test_what_does_not_weigh_regions_is_refused(scene):
    with pytest.raises(InspeError, match="occlusion counts every voxel"):
        Objective(regions=("crosswalk",), weights={"occlusion": 1.0}).check()
    with pytest.raises(InspeError, match="did you mean crosswalk"):
        Objective(regions=("crosswalks",), weights={"coverage": 1.0}).check()


def test_greedy_says_what_it_does_not_know_and_the_default_does_without(scene):
    start = starting_layout(scene, {CAMERA: 2})
    local = Objective(weights={"detectability": 0.5, "localisation": 0.5})
    with pytest.raises(InspeError, match=r"does not know localisation, .*cma-es"):
        optimise(scene, start, "greedy", evaluations=5.0, objective=local)
    assert set(methods()) - set(methods(local)) == {"greedy"}
    assert set(methods()) == set(methods(FOUND))
    given = dict(evaluations=60.0, objective=FOUND)
    default, cma = (optimise(scene, start, name, **given) for name in ("greedy-adam", "cma-es"))
    spent = [[point.evaluations for point in of.history] for of in (default, cma)]
    assert spent[0] == spent[1]
    assert default.objective == cma.objective >= default.objective_before
