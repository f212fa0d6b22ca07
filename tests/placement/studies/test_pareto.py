"""Cost against score: which mixes are tried, which are on the front, what is written; and the
cheapest mix that reaches a target."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from drawn import printed
from worlds import SMALL

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import read_csv
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import optimise
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.studies import pareto as module
from inspe_jax.placement.studies.pareto import device_mixes, pareto, save_pareto, searched
from inspe_jax.report.tables import before_after_table
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import build_scene
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing.layout import load_layout

CAMERA, LIDAR = "paper-camera", "velodyne-vlp-16"
OTHER = "livox-mid-360"
PRICED = Objective(prices={CAMERA: 1000.0})


@pytest.fixture(scope="module")
def scene():
    return build_scene(built_in("four_way"), **SMALL, frames=4, density=10)


@pytest.fixture(scope="module")
def found(scene):
    """Each of two LiDARs alone, and both."""
    counts = {OTHER: (0, 1), LIDAR: (0, 1)}
    told = []
    mixed = pareto(
        scene, counts, method="random", evaluations=6, objective=Objective(prices={OTHER: 1000.0}),
        progress=lambda row, done, best: told.append((dict(row), done, best)),
    )  # fmt: skip
    return mixed, told


def test_every_mix_is_searched_cheapest_first(found):
    mixed, told = found
    assert [tuple(mix.counts.values()) for mix in mixed] == [(1, 0), (0, 1), (1, 1)]
    assert [mix.cost for mix in mixed] == [1000, 4000, 5000]
    assert mixed[2].name == f"1 {OTHER} + 1 {LIDAR}"
    shares = [done for _, done, _ in told]
    assert shares == sorted(shares)
    assert 0.7 < shares[-1] <= 1.0
    assert [row for row, _, _ in told][-1] == mixed[-1].counts


def test_the_front_is_what_no_other_mix_beats(found):
    """Against its definition: another is no dearer and no worse, and cheaper or better."""
    mixed, _ = found
    for mix in mixed:
        beaten = any(
            other.cost <= mix.cost and other.objective >= mix.objective
            for other in mixed
            if (other.cost, other.objective) != (mix.cost, mix.objective)
        )
        assert mix.front != beaten
        names = [sensor.spec.name for sensor in mix.result.layout.sensors]
        assert {name: names.count(name) for name in mix.counts} == dict(mix.counts)
    assert mixed[0].front


def test_it_is_saved(found, scene, tmp_path):
    mixed, _ = found
    save_pareto(mixed, tmp_path / "pareto")
    rows = read_csv(tmp_path / "pareto" / "pareto.csv")
    assert [float(row["cost_usd"]) for row in rows] == [mix.cost for mix in mixed]
    assert [float(row["objective"]) for row in rows] == [mix.result.objective for mix in mixed]
    for row, mix in zip(rows, mixed, strict=True):
        assert bool(int(row["front"])) == mix.front == bool(row["layout"])
        if mix.front:
            again = load_layout(tmp_path / "pareto" / row["layout"])
            assert len(again) == len(mix.result.layout)


def test_a_budget_leaves_out_what_costs_more():
    objective = Objective(prices={CAMERA: 1000.0}, budget=5000.0)
    costs = [cost for cost, _ in device_mixes({CAMERA: range(4), LIDAR: (0, 1)}, objective)]
    assert costs == [1000, 2000, 3000, 4000, 5000]
    rows = [row for _, row in device_mixes({LIDAR: range(4)}, Objective(failures=True))]
    assert rows == [{LIDAR: 2}, {LIDAR: 3}]  # one may fail


@pytest.mark.parametrize(
    ("ends", "count"),
    [
        ([0.1, 0.2, 0.3], 3),
        ([0.1, 0.9, 0.3], 2),  # enough
        ([0.1, "interrupted"], 2),
        ([0.1, KeyboardInterrupt], 1),  # before the first score
    ],
)
def test_mixes_are_searched_until_one_is_enough_or_ctrl_c(scene, monkeypatch, ends, count):
    wanted = [(4000.0 * n, {LIDAR: n}) for n in (1, 2, 3)]
    left, told = iter(ends), []

    def search(cases, start, progress, target):
        end = next(left)
        progress(0.5, 0.2)
        if end is KeyboardInterrupt:
            raise end
        status = end if isinstance(end, str) else "budget spent"
        of = dict(settings={"scenes": [{"name": "here"}]}, method="random", status=status)
        return SimpleNamespace(objective=0.2 if end == status else end, **of)

    monkeypatch.setattr(module, "optimise", search)
    found = searched(wanted, scene, None, lambda *at: told.append(at), target=0.9)
    assert [mix.counts for mix in found] == [{LIDAR: n} for n in range(1, count + 1)]
    assert told[0] == ({LIDAR: 1}, pytest.approx(0.5 / 3), 0.2)
    left = iter([KeyboardInterrupt])
    with pytest.raises(KeyboardInterrupt):
        searched(wanted, scene, None, None)


def test_a_mix_that_costs_its_budget_to_the_cent_is_searched(scene):
    """Seven times 1999.85 is 13998.95; in binary, added up or multiplied, it is not."""
    priced = Objective(prices={LIDAR: 1999.85}, budget=13998.95)
    assert [row for _, row in device_mixes({LIDAR: [7]}, priced)] == [{LIDAR: 7}]
    priced.check_cost(starting_layout(scene, {LIDAR: 7}))


def test_sensors_start_on_posts_of_their_own_lidars_first(scene):
    start = starting_layout(scene, {CAMERA: 3, LIDAR: 2})
    kinds = [sensor.spec.kind for sensor in start.sensors]
    assert kinds == ["lidar", "lidar", "camera", "camera", "camera"]
    assert len({unit.base[:2] for unit in start.units}) == len(start.units) == 5


def test_a_mix_on_few_poles_shares_them(scene):
    """As evenly as it can; cameras on one pole look apart. A search keeps to so many."""
    start = starting_layout(scene, {CAMERA: 4, LIDAR: 2}, poles=3)
    kinds = [[start.sensors[s].spec.kind for s in members] for members in start.members()]
    assert sorted(kinds) == [["camera", "camera"], ["lidar", "camera"], ["lidar", "camera"]]
    (pair,) = (list(members) for members, of in zip(start.members(), kinds, strict=True)
               if of == ["camera", "camera"])  # fmt: skip
    yaw = np.asarray(start.poses)[pair, 5]
    assert np.cos(yaw[1] - yaw[0]) == pytest.approx(0.5, abs=1e-6)
    both, priced = starting_layout(scene, {OTHER: 1, LIDAR: 1}, poles=1), Objective(pole_price=0.02)
    result = optimise(scene, both, "random", evaluations=3, objective=priced)
    (unit,) = result.layout.units
    poles = np.asarray(scene.intersection.poles)[:, :2]
    new = bool(np.hypot(*(poles - unit.base[:2]).T).min() > 1e-3)
    assert result.objective == pytest.approx(result.scores.surrogate - 0.02 * new, abs=1e-6)
    assert f"{new:d} of 1 units stand on new poles, which the objective pays" in result.notes[-1]
    with pytest.raises(InspeError, match="poles 0: a mix needs at least one"):
        starting_layout(scene, {CAMERA: 1}, poles=0)


@pytest.mark.parametrize(
    ("counts", "objective", "message"),
    [
        ({}, PRICED, "no devices to combine"),
        ({"no-such": [1]}, PRICED, "no device 'no-such'"),
        ({CAMERA: [1]}, Objective(), f"'{CAMERA}' has no list price"),
        ({CAMERA: []}, PRICED, "at least one number of it"),
        ({CAMERA: [-1, 2]}, PRICED, "each 0 or more"),
        ({CAMERA: [0]}, PRICED, "no mix is left: a mix needs at least one sensor"),
        ({CAMERA: [1]}, replace(PRICED, failures=True), "a mix needs at least two sensors"),
        (
            {LIDAR: [1]},
            Objective(prices={"hesai-xt": 1.0}),
            "price of 'hesai-xt', which is in no mix",
        ),
        ({CAMERA: range(100_000), LIDAR: range(100_000)}, PRICED, "10,000,000,000 mixes, and at"),
        ({CAMERA: [2]}, Objective(prices={CAMERA: 1000.0}, budget=1500.0), "cheapest costs 2,000"),
        ({CAMERA: range(300)}, PRICED, "299 mixes, and at most 200"),
        ({CAMERA: [99]}, PRICED, "99 sensors on poles of their own, but only"),
        ({CAMERA: [1]}, replace(PRICED, pole_price=1.0), "at least 0 and below 1"),
    ],
)
def test_bad_input(scene, counts, objective, message):
    with pytest.raises(InspeError, match=message):
        pareto(scene, counts, method="random", evaluations=2, objective=objective)


@pytest.fixture(scope="module")
def large():
    return build_scene(built_in("four_way"), radius=25, voxel=1.0, frames=3, density=20)


@pytest.mark.slow
def test_only_the_regions_that_are_named_count(large):
    start = starting_layout(large, {CAMERA: 1, LIDAR: 1})
    on = Objective(weights={"coverage": 1.0}, regions=("crosswalk",))
    problem = Problem(large, start, on)
    columns = inspe_jax.in_view(large, start).any(0).reshape(len(large.voxels.columns), -1).mean(1)
    expected = columns[large.voxels.region == Region.CROSSWALK].mean()
    assert problem.exact_of(start) == pytest.approx(expected, abs=1e-6)
    assert problem.rough(
        problem.space.start(start)[0][None], problem.sample(np.random.default_rng(0), 10**6, 10**6)
    )[0] == pytest.approx(problem.exact(problem.space.start(start)[0]), abs=1e-5)
    detected = Objective(weights={"detectability": 1.0}, regions=("crosswalk", "sidewalk"))
    result = optimise(large, start, "random", evaluations=3.0, objective=detected)
    assert result.scores.metrics["detectability"] == pytest.approx(result.objective, abs=1e-6)
    some = np.isin(large.voxels.region, (Region.CROSSWALK, Region.SIDEWALK))
    weight = np.where(some, large.voxels.column_weight, 0)
    careful = np.mean(
        [
            target_view(large, result.layout, name).detectability @ weight / weight.sum()
            for name in ("car", "truck", "cyclist", "pedestrian")
        ]
    )
    assert result.objective == pytest.approx(careful, abs=0.03)
    assert "(C and D of crosswalk, sidewalk only)" in printed(before_after_table(result))
