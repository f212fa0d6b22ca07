"""A metric that is added to the registry shows everywhere, and nothing outside names it."""

import csv
import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from processes import inspe_here
from rich.console import Console
from worlds import CAMERA, place_sensors, world

from inspe_jax.placement.problem import Objective
from inspe_jax.placement.result import Result, load_result, save_result
from inspe_jax.placement.run import Progress
from inspe_jax.placement.studies.pareto import DeviceMix, save_pareto
from inspe_jax.report import page, tables
from inspe_jax.report.figures import plan_view
from inspe_jax.report.progress import before_after
from inspe_jax.scoring import evaluate as scoring
from inspe_jax.scoring.evaluate import Contribution, Scores
from inspe_jax.scoring.metrics import METRICS, Metric
from inspe_jax.sensing.layout import save_layout
from inspe_jax.study.plan import load_study
from inspe_jax.study.results import Results, read_results
from inspe_jax.study.work import columns
from inspe_jax.viewer.score_panel import score_panel
from inspe_jax.viewer.scorer import ScoredLayout

TOY = Metric("toy_metric", "TM_x", 0.0, "share of toys that are seen")
VALUE, DROP, BEFORE = 0.2468, 0.1357, 0.1111
STUDY = """
scenes: [{built_in: four_way}]
layouts: [L-c]
settings: {radius: 20, voxel: 2, frames: 2}
"""


@pytest.fixture(scope="module")
def scene():
    return world(radius=12, voxel=1.0, frames=3, count=5)


@pytest.fixture(scope="module")
def layout():
    return place_sensors((CAMERA, [5, 5, 6, 0, -0.4, -2.0]))


@pytest.fixture(scope="module")
def result(scene, layout):
    """Of a search whose scores have the toy metric."""
    paper = scoring.evaluate(scene, layout)
    part = Contribution("s0", paper.contributions[0].metrics | {TOY.name: DROP}, 0.1)
    after = replace(paper, metrics=paper.metrics | {TOY.name: VALUE}, contributions=(part,))
    before = replace(after, metrics=paper.metrics | {TOY.name: BEFORE})
    return Result(
        layout=layout,
        start=layout,
        scores_before=before,
        scores=after,
        objective_before=0.1,
        objective=0.2,
        history=(Progress(0.5, 1.0, 0.3, 0.3),),
        path=np.asarray(layout.poses, float)[None],
        evaluations=1.0,
        seconds=0.5,
        status="converged",
        method="grid",
        seed=0,
        settings={"scenes": [{"name": "test crossing"}]},
        versions={},
    )


@pytest.fixture
def there(scene, layout, result, tmp_path, monkeypatch, capsys):
    """What the places below look at. Scores are the result's: no toy is really measured."""
    monkeypatch.setattr(scoring, "evaluate", lambda *_, **options: scored_as(result, options))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.yaml").write_text(STUDY)
    save_layout(layout, tmp_path / "layout.yaml")
    return SimpleNamespace(
        scene=scene, layout=layout, result=result, scores=result.scores, folder=tmp_path,
        monkeypatch=monkeypatch, capsys=capsys,
    )  # fmt: skip


def scored_as(result: Result, options) -> Scores:
    return replace(result.scores, settings=result.scores.settings | {"weights": options["weights"]})


def shown(table):
    out = io.StringIO()
    Console(file=out, width=200, color_system=None).print(table)
    return out.getvalue()


def inspe(there, *arguments):
    status, text, _ = inspe_here(there.folder, there.monkeypatch, there.capsys, *arguments)
    assert status == 0
    return text


# ── Where it shows: text that a person or a program reads ───────────────────


def score(there):
    return inspe(there, "score", "four_way", "layout.yaml")


def score_as_json(there):
    found = json.loads(inspe(there, "score", "four_way", "layout.yaml", "--json", "-"))
    parts = [(key, found[key]) for key in found if key.startswith("toy")]
    parts += [(key, row[key]) for row in found["contributions"] for key in row if "toy" in key]
    return str(parts)


def metrics_command(there):
    return inspe(there, "metrics")


def report_page(there):
    there.monkeypatch.setattr(page, "_png", lambda _: "")
    there.monkeypatch.setattr(page, "scene3d_page", lambda *_: "")
    shed = page.viewshed(there.scene, there.layout)
    return page.report_page(there.scene, [page.ReportEntry(there.layout, there.scores, shed)])


def viewer_panel(there):
    scored = ScoredLayout(there.layout, there.scores, 3, 0.1)
    return score_panel(there.layout, scored, frames=3)


def before_and_after(there):
    return shown(tables.before_after_table(there.result))


def map_heading(there):
    figure = plan_view(there.scene, there.layout, there.scores)
    return " ".join(text.get_text() for text in figure.texts)


def maps_before_and_after(there):
    result, layout = there.result, there.layout
    figure = before_after(there.scene, layout, layout, result.scores_before, result.scores)
    return " ".join(ax.get_title(loc="left") for ax in figure.axes)


def pareto_table(there):
    return shown(tables.pareto_table([DeviceMix({"paper-camera": 1}, 800.0, there.result)]))


def pareto_csv(there):
    save_pareto([DeviceMix({"paper-camera": 1}, 800.0, there.result, front=True)], there.folder)
    (row,) = csv.DictReader((there.folder / "pareto.csv").read_text().splitlines())
    return str(row)


def sweep_columns(there):
    """The columns of a study's table, and a row of it as it is written and read again."""
    study = load_study(there.folder / "study.yaml")
    row = {m: f"{there.scores.value(m):.7f}" for m in (*METRICS, "surrogate")}
    with Results(study, there.folder / "out") as results:
        results.add({"key": study.jobs[0].key, **dict.fromkeys(columns(study), ""), **row})
    return str(read_results(there.folder / "out"))


def sweep_table(there):
    row = {m: f"{there.scores.value(m):.7f}" for m in (*METRICS, "surrogate")}
    return shown(tables.sweep_table([{"layout": "L-c", "status": "done", **row}]))


PLACES = {
    score: ("toy metric", "TM_x", "0.247", "+0.1357"),
    score_as_json: ("toy_metric", "0.2468", "0.1357"),
    metrics_command: ("toy_metric", "TM_x", "share of toys that are seen"),
    report_page: ("toy metric TM_x", "share of toys that are seen", ">0.247<", ">+0.1357<"),
    viewer_panel: ("toy metric TM_x", "width:24.7%", ">0.247<"),
    before_and_after: ("toy metric", "TM_x", "0.111", "0.247", "+0.136"),
    map_heading: ("$TM_{x}$ 0.247",),
    maps_before_and_after: ("$TM_{x}$ 0.111", "$TM_{x}$ 0.247"),
    pareto_table: ("TM_x", "0.247"),
    pareto_csv: ("'toy_metric': '0.2468'",),
    sweep_columns: ("'toy_metric': '0.2468000'",),
    sweep_table: ("TM_x", "0.247 ± 0.00"),
}


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)
def test_it_shows_once_it_is_in_the_registry_and_not_before(place, there):
    words = PLACES[place]
    without = place(there)
    for word in (TOY.name, TOY.words, TOY.symbol, "TM_{x}"):
        assert word not in without
    there.monkeypatch.setitem(METRICS, TOY.name, TOY)
    if place is sweep_columns:  # other columns are another table
        there.folder = there.folder / "again"
        there.folder.mkdir()
        (there.folder / "study.yaml").write_text(STUDY)
    text = place(there)
    assert [word for word in words if word not in text] == []


# ── What it can do: carry weight ────────────────────────────────────────────


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setitem(METRICS, TOY.name, TOY)


@pytest.mark.usefixtures("registered")
def test_it_carries_weight_on_the_command_line(there):
    weights = ("--weight", "toy_metric=0.25", "--weight", "occlusion=0.75")
    found = json.loads(inspe(there, "score", "four_way", "layout.yaml", *weights, "--json", "-"))
    assert {k: v for k, v in found["settings"]["weights"].items() if v} == {
        "toy_metric": 0.25,
        "occlusion": 0.75,
    }
    assert "toy metric TM_x 0.25" in " ".join(
        inspe(there, "score", "four_way", "layout.yaml", *weights).split()
    )


@pytest.mark.usefixtures("registered")
def test_it_carries_weight_in_an_objective_and_in_a_study(tmp_path):
    weights = {"toy_metric": 0.25, "occlusion": 0.75}
    objective = Objective(weights=weights)
    objective.check()
    assert objective.weights_by_name == {
        "coverage": 0.0, "occlusion": 0.75, "information_gain": 0.0, "toy_metric": 0.25
    }  # fmt: skip
    content = yaml.safe_load(STUDY)
    paper = load_of(tmp_path, content)
    content["settings"]["weights"] = weights
    toy = load_of(tmp_path, content)
    assert toy.settings["weights"] == weights
    assert toy.key != paper.key
    content["settings"]["weights"] = [0.3, 0.5, 0.2]
    assert load_of(tmp_path, content).key == paper.key


def load_of(folder, content):
    (folder / "s.yaml").write_text(yaml.safe_dump(content))
    (job,) = load_study(folder / "s.yaml").jobs
    return job


def test_a_result_keeps_it_also_where_nobody_registers_it(result, tmp_path):
    save_result(result, tmp_path)
    back = load_result(tmp_path)
    assert back.scores.value(TOY.name) == VALUE
    assert back.scores.contributions[0].value(TOY.name) == DROP
    assert "coverage" in shown(tables.before_after_table(back))


@pytest.mark.usefixtures("registered")
def test_a_result_of_before_it_was_registered_is_shown_without_it(result):
    paper = {name: value for name, value in result.scores.metrics.items() if "toy" not in name}
    of = replace(result.scores, metrics=paper)
    old = shown(tables.before_after_table(replace(result, scores=of, scores_before=of)))
    assert "coverage" in old
    assert "toy" not in old
