"""A metric that is added to the registry shows everywhere, and nothing outside names it."""

import csv
import io
import json
import shutil

import numpy as np
import pytest
from rich.console import Console

from inspe_jax import evaluate, strategy
from inspe_jax.core.files import read_csv
from inspe_jax.jobs.sources import versions
from inspe_jax.placement.result import Result, load_result, save_result
from inspe_jax.placement.run import Progress
from inspe_jax.placement.studies.pareto import DeviceMix, save_pareto
from inspe_jax.report import page, tables
from inspe_jax.report.figures import plan_view
from inspe_jax.report.progress import before_after
from inspe_jax.scoring.metrics import METRICS, Metric
from inspe_jax.study.plan import load_study
from inspe_jax.study.sweep import Results, run_job
from inspe_jax.viewer.score_panel import score_panel
from inspe_jax.viewer.scorer import ScoredLayout

TOY = Metric(
    "worst_frame",
    "W_f",
    0.0,
    "share of voxels that stays visible in the worst frame",
    lambda found: (found.seen / found.original).min(0),
)
STUDY = """
scenes: [{built_in: four_way}]
layouts: [L-c]
settings: {radius: 20, voxel: 1, frames: 5, density: 8}
"""


class There:
    """What the places below look at; scores are of the metrics that are registered when asked."""

    def __init__(self, scene, layout, folder, run, monkeypatch):
        self.scene, self.layout, self.folder, self.run = scene, layout, folder, run
        self.start = layout.with_poses(np.array(layout.poses) + [0, 0, 0, 0, 0, 0.3])
        self.monkeypatch = monkeypatch
        (folder / "study.yaml").write_text(STUDY)

    @property
    def scores(self):
        return evaluate(self.scene, self.layout)

    @property
    def result(self):
        return Result(
            layout=self.layout,
            start=self.start,
            scores_before=evaluate(self.scene, self.start),
            scores=self.scores,
            objective_before=0.1,
            objective=0.2,
            history=(Progress(0.5, 1.0, 0.3, 0.3),),
            path=np.asarray(self.start.poses, float)[None],
            evaluations=1.0,
            seconds=0.5,
            status="converged",
            method="grid",
            seed=0,
            settings={"scenes": [{"name": "test crossing"}]},
            versions={},
        )


@pytest.fixture
def there(scene, layout, files, run, monkeypatch):
    return There(scene, layout, files, run, monkeypatch)


def shown(table):
    out = io.StringIO()
    Console(file=out, width=200, color_system=None).print(table)
    return out.getvalue()


# Where it shows: text that a person or a program reads.


def score(there):
    return there.run("score", "s.npz", "layout.yaml")


def score_as_json(there):
    found = json.loads(there.run("score", "s.npz", "layout.yaml", "--json", "-"))
    return str([found, *found["contributions"]])


def metrics_command(there):
    return there.run("metrics")


def report_page(there):
    there.monkeypatch.setattr(page, "png_text", lambda *_: "")
    shed = page.viewshed(there.scene, there.layout)
    return page.report_page(there.scene, [page.ReportEntry(there.layout, there.scores, shed)])


def viewer_panel(there):
    scored = ScoredLayout(there.layout, there.scores, 5, 0.1)
    return "".join(score_panel(there.layout, scored, frames=5))


def before_and_after(there):
    result, layout = there.result, there.layout
    figure = before_after(there.scene, result.start, layout, result.scores_before, result.scores)
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    return " ".join([shown(tables.before_after_table(result)), *titles])


def map_heading(there):
    figure = plan_view(there.scene, there.layout, there.scores)
    return " ".join(text.get_text() for text in figure.texts)


def pareto(there):
    mixes = [DeviceMix({"paper-camera": 1}, 800.0, there.result, front=True)]
    save_pareto(mixes, there.folder)
    (row,) = csv.DictReader((there.folder / "pareto.csv").read_text().splitlines())
    return shown(tables.pareto_table(mixes)) + str(row)


def sweep(there):
    """A row of a study's results, as a worker finds it, written and read again."""
    study = load_study(there.folder / "study.yaml")
    row, found = run_job(there.scene, study.jobs[0], versions())
    with Results(study, there.folder / "out") as results:
        results.add(row, found)
    return shown(tables.sweep_table([row])) + str(read_csv(there.folder / "out" / "results.csv"))


PLACES = {
    score: ("worst frame", "W_f", "{value:.3f}", "{drop:+.4f}"),
    score_as_json: ("'worst_frame': {value!r}", "'worst_frame': {drop!r}"),
    metrics_command: ("worst_frame", "W_f", TOY.summary),
    report_page: ("worst frame W_f", TOY.summary, ">{value:.3f}<", ">{drop:+.4f}<"),
    viewer_panel: ("worst frame W_f", "width:{percent:.1f}%", ">{value:.3f}<"),
    before_and_after: ("worst frame", "W_f", "$W_{{f}}$ {before:.3f}", "$W_{{f}}$ {value:.3f}"),
    map_heading: ("$W_{{f}}$ {value:.3f}",),
    pareto: ("W_f", "{value:.3f}", "'worst_frame': '{value!r}'"),
    sweep: ("W_f", "{central:.3f} ± 0.00", "'worst_frame': '{central:.7f}'"),
}


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.__name__)
def test_it_shows_once_it_is_in_the_registry_and_not_before(place, there):
    without = place(there)
    for word in (TOY.name, TOY.words, TOY.symbol, "$W_{f}$"):
        assert word not in without
    there.monkeypatch.setitem(METRICS, TOY.name, TOY)
    shutil.rmtree(there.folder / "out", ignore_errors=True)  # other columns are another table
    result = there.result
    value, before = (float(of.value(TOY.name)) for of in (result.scores, result.scores_before))
    central = evaluate(there.scene, strategy(there.scene, "L-c")).value(TOY.name)
    assert 0 < before < 1
    assert 0 < value < 1
    assert value != pytest.approx(before, abs=1e-3)
    drop = float(result.scores.contributions[0].value(TOY.name))
    numbers = dict(value=value, percent=100 * value, before=before, drop=drop, central=central)
    text = place(there)
    assert [word for word in PLACES[place] if word.format(**numbers) not in text] == []


def test_results_of_before_and_of_another_registry_are_read_and_shown(there, tmp_path):
    before = there.result
    with there.monkeypatch.context() as registered:
        registered.setitem(METRICS, TOY.name, TOY)
        save_result(there.result, tmp_path)
        own = shown(tables.before_after_table(before))
    back = load_result(tmp_path)
    assert back.scores.value(TOY.name) > 0
    assert back.scores.contributions[0].value(TOY.name) > 0
    for text in (own, shown(tables.before_after_table(back))):
        assert "coverage" in text
        assert TOY.words not in text
