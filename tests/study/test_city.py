"""A plan for the junctions of a map: its study, its fronts, its choice, and the command line."""

import json
import re
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from drawn import misplaced
from processes import cases, in_this_process, inspe_here, refused

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import read_csv
from inspe_jax.scene.maps.road_map import JunctionInfo
from inspe_jax.scene.maps.sumo.network import run
from inspe_jax.sensing.layout import load_layout
from inspe_jax.study import city
from inspe_jax.study.city_report import city_view

LIES = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
SMALL = ("--radius", 20, "--voxel", 2, "--frames", 2, "--density", 5, "--evaluations", 3)
MIXES = ("--device", "velodyne-vlp-16:1-2", "--device", "paper-camera:0,1",
         "--price", "paper-camera=850.5")  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A folder with a network of SUMO: four junctions with signals, at a place on the Earth."""
    pytest.importorskip("sumo", reason="needs SUMO: extra [sumo]")
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    path = tmp_path_factory.mktemp("city") / "grid.net.xml"
    size = ("--grid.number", 2, "--grid.length", 100, "--grid.attach-length", 100)
    how = ("--sidewalks.guess", "true", "--default-junction-type", "traffic_light", "--seed", 1)
    run("netgenerate", ["--grid", *map(str, (*size, *how, "-o", path))], "grid")
    text = path.read_text()
    text = re.sub(r'netOffset="[^"]*"', 'netOffset="-691000.00,-5334000.00"', text)
    path.write_text(re.sub(r'projParameter="[^"]*"', f'projParameter="{LIES}"', text))
    return path.parent


@pytest.fixture
def inspe(files, monkeypatch, capsys):
    return partial(inspe_here, files, monkeypatch, capsys)


def table(folder: Path) -> list[dict[str, str]]:
    return read_csv(folder / "plan.csv")


def test_a_plan_from_a_map_to_files_and_another_budget(inspe, files):
    """The plan is the best of all choices among the rows; other budgets search nothing."""
    there = files / "out"
    command = ("plan", "grid.net.xml", *SMALL, *MIXES, "--out", "out")
    with in_this_process() as running:
        status, text, error = inspe(
            *command, "--budget", 12_000, "--scheduler", running.scheduler_address
        )
    assert status == 0, error
    assert "latitude, longitude" in text
    assert "proved: of the mixes searched, no plan for this money has a greater sum" in text
    assert "wrote plan.csv, plan.png, plan.geojson into out" in text
    rows = table(there)
    searched = read_csv(there / "results.csv")
    assert len(searched) == 4 * 4
    assert {row["status"] for row in searched} == {"done"}
    prices = {"velodyne-vlp-16": 4000, "paper-camera": 850.5}
    options = [[(0.0, 0.0)] for _ in rows]
    for row in searched:
        parts = (part.split(" ", 1) for part in row["layout"].split(" + "))
        cost = sum(int(n) * prices[name] for n, name in parts)
        k = [one["junction"] for one in rows].index(row["scene"])
        options[k].append((cost, float(row["surrogate"])))
    best = max(
        sum(score for _, score in choice)
        for choice in product(*options)
        if sum(cost for cost, _ in choice) <= 12_000
    )
    assert sum(float(row["score"]) for row in rows) == pytest.approx(best, abs=1e-9)
    assert 0 < sum(float(row["cost_usd"]) for row in rows) <= 12_000
    for row in rows:
        assert (row["mix"] == "") == (row["layout"] == "") == (float(row["cost_usd"]) == 0)
        assert 48 < float(row["latitude"]) < 49
        assert 11 < float(row["longitude"]) < 12
        if row["layout"]:
            assert (there / row["layout"]).is_file()
    assert (there / "plan.png").read_bytes().startswith(b"\x89PNG")
    check_geojson(there, rows)

    kept, first = (there / "results.csv").read_bytes(), (there / "plan.csv").read_bytes()
    for more in (("--budget", 4_000), ("--budget", 20_000, "--worst"), ("--budget", 12_000)):
        assert inspe(*command, *more)[0] == 0  # no scheduler, and no worker starts
        assert (there / "results.csv").read_bytes() == kept
    assert (there / "plan.csv").read_bytes() == first
    status, text, _ = inspe(*command, "--budget", 20_000, "--worst")
    assert "no plan for this money has a greater least score, or then a greater sum" in text
    assert all(row["mix"] for row in table(there))
    dear = next(row["junction"] for row in table(there))
    inspe(*command, "--budget", 4_100, "--importance", f"{dear}=50")
    assert [row["junction"] for row in table(there) if row["mix"]] == [dear]
    assert table(there)[0]["importance"] == "50"
    status, _, error = inspe(*command, "--budget", 4_000, "--seed", 1)
    assert status == 2
    assert "are not jobs of this study" in error


def check_geojson(there: Path, rows: list[dict[str, str]]) -> None:
    """Every junction is a point; those with devices have their units, sensors and views."""
    content = json.loads((there / "plan.geojson").read_text())
    by: dict[str, dict[str, list]] = {}
    for feature in content["features"]:
        own = feature["properties"]
        by.setdefault(own["junction"], {}).setdefault(own["feature"], []).append(feature)
    assert set(by) == {row["junction"] for row in rows}
    for row in rows:
        (point,) = by[row["junction"]]["junction"]
        at = point["geometry"]["coordinates"]
        assert at == pytest.approx([float(row["longitude"]), float(row["latitude"])], abs=1e-7)
        assert point["properties"]["cost_usd"] == float(row["cost_usd"])
        if not row["layout"]:
            assert set(by[row["junction"]]) == {"junction"}
            continue
        layout = load_layout(there / row["layout"])
        for kind, count in (("unit", len(layout.units)), ("sensor", len(layout))):
            found = by[row["junction"]][kind]
            assert len(found) == count
            for one in found:  # within 40 m: a ten-thousandth of a degree is about 10 m
                away = np.subtract(one["geometry"]["coordinates"], at)
                assert np.abs(away).max() < 6e-4
        assert len(by[row["junction"]]["view"]) == len(layout)


def test_dry_runs(inspe, files):
    status, text, error = inspe(
        "plan", "grid.net.xml", *MIXES, "--budget", 1, "--dry-run", "--radius", 45
    )
    assert status == 0
    assert "grid.net.xml: 4 junctions, mixes of devices: 4, searches: 16" in text
    assert "are nearer to each other than twice the radius" not in error
    assert not (files / "plan").exists()
    status, _, error = inspe(
        "plan", "grid.net.xml", "--radius", 60, "--budget", 1, "--junctions", "A0,A1", "--dry-run"
    )
    assert "1 pair of junctions are nearer to each other than twice the radius" in error


@pytest.mark.parametrize(("arguments", "message"), cases(
    (("none.net.xml",), "none.net.xml: no such file"),
    (("grid.net.xml", "--junctions", "A0,B7"), "no junction 'B7' among A0, A1, B0, B1; did you"),
    (("grid.net.xml", "--junctions", ","), "junctions ',': write signals, all, or ids"),
    (("grid.net.xml", "--importance", "A9=2"), "importance: no junction 'A9' among"),
    (("grid.net.xml", "--importance", "A0=0"), "importance A0=0: more than 0"),
    (("grid.net.xml", "--budget", "-1"), "budget -1: 0 to 1e+10 US dollars"),
    (("grid.net.xml", "--method", "none"), "--method none: a plan needs a search"),
    (("grid.net.xml", "--method", "gready"), "settings.method: 'gready': one of"),
))  # fmt: skip
def test_bad_input_is_one_message(inspe, files, arguments, message):
    budget = () if "--budget" in arguments else ("--budget", 1)
    refused(inspe, files, ("plan", *arguments, *budget), message)


# ── From rows to a plan, without a search ───────────────────────────────────


def junction(name: str, signals: int = 1) -> JunctionInfo:
    return JunctionInfo(name, (0.0, 0.0, 0.0), 4, 20.0, 0, signals)


def rows_of(study, scores):
    """A row for each job: its score by (scene, layout), or its error."""
    found = []
    for job in study.jobs:
        value = scores[job.source.name, job.layout.name]
        done = dict(status="done", surrogate=str(value), error="")
        failed = dict(status="failed", surrogate="", error=value)
        found.append({"key": job.key} | (done if isinstance(value, float) else failed))
    return found


def test_fronts_have_no_mix_that_another_beats(files):
    places = [junction("A0"), junction("A1"), junction("B0")]
    mixes = [{"paper-camera": n, "paper-lidar-32": 0} for n in (1, 2, 3)]
    study = city.city_study(files / "grid.net.xml", places, mixes, dict(method="random"))
    names = [job.layout.name for job in study.jobs[:3]]
    assert names == ["1 paper-camera", "2 paper-camera", "3 paper-camera"]
    costs = dict(zip(names, (10.0, 20.0, 20.0), strict=True))
    values = [0.3, 0.2, 0.5, 0.3, "too many posts", 0.25, "no pole", "no pole", "no mast"]
    keys = [(place.id, name) for place in places for name in names]
    rows = rows_of(study, dict(zip(keys, values, strict=True)))
    first, second, third = city.fronts_of(study, rows, places, costs)
    assert [(one.cost, one.score) for one in first.options] == [(0, 0), (10, 0.3), (20, 0.5)]
    assert first.options[2].layout == f"layouts/{study.jobs[2].key}.yaml"
    assert [(one.cost, one.score) for one in second.options] == [(0, 0), (10, 0.3)]
    assert second.errors == ("2 paper-camera: too many posts",)
    assert not second.failed
    assert third.failed
    plan = city.plan_city([first, second, third], 30)
    assert plan.left_out == {"B0": "1 paper-camera: no pole"}
    assert [one.mix for one in plan.chosen] == ["3 paper-camera", "1 paper-camera"]
    assert plan.text(None).splitlines()[0] == "junction,x,y,importance,mix,cost_usd,score,layout"
    with pytest.raises(InspeError, match="every search failed; at B0: 1 paper-camera: no pole"):
        city.plan_city([third], 30)
    free = city.fronts_of(study, rows, places, costs | {"1 paper-camera": 0.0})
    assert free[0].options[0].score == 0.3


def test_what_failed_is_told_and_left_out(inspe, files, monkeypatch):
    """One junction has nowhere to put a pole, and at another one mix fails; the rest is planned."""

    def searched(study, folder, **more):
        Path(folder).mkdir(exist_ok=True)
        scores = {(job.source.name, job.layout.name): 0.5 for job in study.jobs}
        scores |= {key: "nowhere to put a pole" for key in scores if key[0] == "B0"}
        return rows_of(study, scores | {("A1", "2 velodyne-vlp-16"): "too many"})

    monkeypatch.setattr("inspe_jax.cli.study.run", searched)
    status, text, error = inspe("plan", "grid.net.xml", *MIXES, "--budget", 1, "--out", "failing")
    assert status == 0
    assert "0 of 1 US dollars, at 0 of 3 junctions" in text
    assert re.search("junction B0 is left out: .*: nowhere to put a pole", error)
    assert "junction A1: 2 velodyne-vlp-16: too many" in error
    assert [row["junction"] for row in table(files / "failing")] == ["A0", "A1", "B1"]


def synthetic(count: int, name: str = "{}") -> list[city.JunctionFront]:
    rng = np.random.default_rng(0)
    found = []
    for k in range(count):
        at = (*rng.uniform(0, 3000, 2).tolist(), 0.0)
        scores = np.sort(rng.uniform(0.1, 0.9, 3)).tolist()
        options = [city.Option(f"{n} x", 4000.0 * n, scores[n - 1], f"k{n}") for n in (1, 2, 3)]
        place = JunctionInfo(name.format(k), at, 4, 20.0, 0, 4)
        found.append(city.JunctionFront(place, (city.NOTHING, *options)))
    return found


@pytest.mark.parametrize(("count", "name", "labels"), [
    (3, "J{}", ["J0", "J1", "J2"]), (2, "cluster_{}00000", ["1", "2"]), (61, "{}", []),
])  # fmt: skip
def test_the_figure_names_junctions_where_there_is_room(count, name, labels):
    plan = city.plan_city(synthetic(count, name), 4000.0 * count)
    figure = city_view(plan, "town", [np.array([[0, 0], [3000, 3000]])])
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert [text for text in texts if text not in ("N", "1 km", "500 m", "200 m")] == labels
    assert misplaced(figure) == []
    assert city_view(city.plan_city(synthetic(4), 0.0, worst=True), "town").axes


def test_choosing_junctions(files, monkeypatch):
    """And a junction or a mix more only adds jobs to a study."""
    path = files / "grid.net.xml"
    assert [one.id for one in city.choose_junctions(path, "signals")] == ["A0", "A1", "B0", "B1"]
    assert [one.id for one in city.choose_junctions(path, "B1, A0")] == ["B1", "A0"]
    both, settings = [junction("A0"), junction("A1")], dict(method="greedy", evaluations=3)
    one = city.city_study(path, both[:1], [{"paper-camera": 1}], settings)
    more = city.city_study(path, both, [{"paper-camera": 1}, {"paper-camera": 2}], settings)
    assert len(more.jobs) == 4
    assert {job.key for job in one.jobs} < {job.key for job in more.jobs}
    some = (junction("a", signals=0), junction("b", signals=0))
    monkeypatch.setattr("inspe_jax.study.city.list_junctions", lambda *_: some)
    assert city.choose_junctions(path, "all") == some
    with pytest.raises(InspeError, match="none of its 2 junctions has signals; `all` takes all"):
        city.choose_junctions(path, "signals")
    monkeypatch.setattr("inspe_jax.study.city.list_junctions", lambda *_: ())
    with pytest.raises(InspeError, match="the map has no junction"):
        city.choose_junctions(path, "all")
