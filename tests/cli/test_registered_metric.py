"""A metric that is added to the registry shows everywhere, and nothing outside names it."""

import json

import pytest
from drawn import printed

from inspe_jax import evaluate, optimise
from inspe_jax.core.files import read_csv
from inspe_jax.jobs.sources import versions
from inspe_jax.placement.result import load_result, save_result
from inspe_jax.placement.studies.pareto import DeviceMix, save_pareto
from inspe_jax.report import page, tables
from inspe_jax.report.figures import plan_view
from inspe_jax.report.searches import before_after
from inspe_jax.scoring.metrics import METRICS, Metric
from inspe_jax.study.plan import make_study
from inspe_jax.study.sweep import Results, run_job
from inspe_jax.viewer.score_panel import score_panel
from inspe_jax.viewer.workers import ScoredLayout

TOY = Metric(
    "worst_frame",
    "W_f",
    0.0,
    "share of voxels that stays visible in the worst frame",
    lambda found: (found.seen / found.original).min(0),
)


@pytest.fixture
def search(scene, layout):
    """A search, whose scores are of the metrics that are registered when it is asked for."""
    return lambda: optimise(scene, layout, "random", evaluations=3)


def test_it_shows_once_it_is_in_the_registry_and_not_before(
    scene, layout, run, search, tmp_path, monkeypatch
):
    monkeypatch.setattr(page, "image_text", lambda *_: "")

    def found():
        """What a person or a program reads, by where."""
        scores, result = evaluate(scene, layout), search()
        before = (result.start, result.layout, result.scores_before, result.scores)
        scored = ScoredLayout(layout, scores, 5, 0.1)
        mixes = [DeviceMix({"paper-camera": 1}, 800.0, result, front=True)]
        save_pareto(mixes, tmp_path)
        record = json.loads(run("score", "s.npz", "layout.yaml", "--json", "-"))
        entry = page.ReportEntry(layout, scores, page.viewshed(scene, layout))
        study = make_study({"scenes": [{"file": "s.npz"}], "layouts": ["layout.yaml"]}, tmp_path)
        row, _ = swept = run_job(scene, study.jobs[0], versions())
        folder = tmp_path / f"of {len(METRICS)}"
        with Results(study, folder) as results:
            results.add(*swept)
        return scores, result, {
            "score": run("score", "s.npz", "layout.yaml"),
            "record": str([record, *record["contributions"]]),
            "metrics": run("metrics"),
            "page": page.report_page(scene, [entry]),
            "panel": "".join(score_panel(layout, scored, frames=5)),
            "before and after": printed(tables.before_after_table(result)),
            "maps": str([ax.get_title(loc="left") for ax in before_after(scene, *before).axes]),
            "map": str([text.get_text() for text in plan_view(scene, layout, scores).texts]),
            "pareto": printed(tables.pareto_table(mixes)) + str(read_csv(tmp_path / "pareto.csv")),
            "sweep": printed(tables.sweep_table([row])) + str(read_csv(folder / "results.csv")),
        }  # fmt: skip

    for text in found()[2].values():
        for word in (TOY.name, TOY.words, TOY.symbol, "W_{f}"):
            assert word not in text
    monkeypatch.setitem(METRICS, TOY.name, TOY)
    scores, result, texts = found()
    value, after = scores.value(TOY.name), result.scores.value(TOY.name)
    start = result.scores_before.value(TOY.name)
    drop = scores.contributions[0].value(TOY.name)
    assert 0 < value < 1
    for where, words in {
        "score": ("worst frame", "W_f", f"{value:.3f}", f"{drop:+.4f}"),
        "record": (f"'worst_frame': {float(value)!r}", f"'worst_frame': {float(drop)!r}"),
        "metrics": ("worst_frame", "W_f", TOY.summary),
        "page": ("worst frame W_f", TOY.summary, f">{value:.3f}<", f">{drop:+.4f}<"),
        "panel": ("worst frame W_f", f"width:{100 * value:.1f}%", f">{value:.3f}<"),
        "before and after": ("worst frame", "W_f", f"{after:.3f}"),
        "maps": (f"$W_{{f}}$ {start:.3f}", f"$W_{{f}}$ {after:.3f}"),
        "map": (f"$W_{{f}}$ {value:.3f}",),
        "pareto": ("W_f", f"{after:.3f}", f"'worst_frame': '{float(after)!r}'"),
        "sweep": ("W_f", f"{value:.3f} ± 0.00", f"'worst_frame': '{value:.7f}'"),
    }.items():
        assert [word for word in words if word not in texts[where]] == [], where


def test_results_of_before_and_of_another_registry_are_read_and_shown(
    search, tmp_path, monkeypatch
):
    before = search()
    with monkeypatch.context() as registered:
        registered.setitem(METRICS, TOY.name, TOY)
        save_result(search(), tmp_path)
        own = printed(tables.before_after_table(before))
    back = load_result(tmp_path)
    assert back.scores.value(TOY.name) > 0
    assert back.scores.contributions[0].value(TOY.name) > 0
    for text in (own, printed(tables.before_after_table(back))):
        assert "coverage" in text
        assert TOY.words not in text
