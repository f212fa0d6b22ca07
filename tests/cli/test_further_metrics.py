"""Further metrics where a user asks for them: scores, reports, studies; and a target."""

import json

import pytest

from inspe_jax import evaluate, load_layout
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import read_csv
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.problem import Case
from inspe_jax.report.page import report_entry, report_page
from inspe_jax.scene.traffic.frames import CLASSES


def test_scores_have_those_that_are_named(run, scored, scene, layout):
    record = scored("s.npz", "layout.yaml", "--metrics", "detectability")
    found = evaluate(scene, layout, metrics=("detectability",))
    assert record["detectability"] == pytest.approx(found.metrics["detectability"], abs=1e-6)
    assert "localisation" not in record
    assert "detectability" in record["contributions"][0]
    words = run("score", "s.npz", "layout.yaml", "--metrics", "all")
    for name in ("detectability D", "localisation L", "redundancy R 0 0.000"):
        assert name in words
    usual = run("score", "s.npz", "layout.yaml")
    assert "detectability" not in usual
    assert "detectability D 0 chance that a detector finds a road user" in run("metrics")


def test_curves_of_ones_own_are_scored_with(run, scored, scene, layout, tmp_path):
    """Read from a file, and said in the record."""
    none = "".join(f"[camera.{name}]\nmost = 1e-9\nhalf = 1\nslope = 1\n" for name in CLASSES)
    (tmp_path / "blind.toml").write_text(none)
    given = ("s.npz", "layout.yaml", "--metrics", "detectability", "--detection", "blind.toml")
    record = scored(*given)
    assert evaluate(scene, layout, metrics=("detectability",)).metrics["detectability"] > 0
    assert record["detectability"] == pytest.approx(0, abs=1e-8)
    assert record["settings"]["detection"]["camera"]["car"]["most"] == 1e-9
    seen = json.loads(run("targets", *given[:2], "--detection", "blind.toml", "--json", "-"))
    assert seen["detectability"]["all"] == pytest.approx(0, abs=1e-8)
    assert "no.toml: no such file" in run("score", *given[:-1], "no.toml", fails=True)
    with pytest.raises(InspeError, match="give curves, as inspe_jax"):
        evaluate(scene, layout, detection="blind.toml")


def test_a_page_has_them_and_a_map_of_what_a_pedestrian_gets(scene, layout, monkeypatch):
    from inspe_jax.report import page

    monkeypatch.setattr(page, "image_text", lambda figure, _: str(len(figure.axes)))
    plain = report_page(scene, [report_entry(Case(scene), layout, Objective())])
    further = report_entry(Case(scene), layout, Objective(metrics=("detectability",)))
    with_it = report_page(scene, [further])
    assert page.ON_TARGET not in plain
    assert "detectability D" not in plain
    assert page.ON_TARGET in with_it
    assert "detectability D" in with_it


def test_the_cheapest_mix_is_told_with_those_that_fall_short(run, tmp_path):
    given = ("--device", "velodyne-vlp-16:1-2", "--evaluations", "3", "--method", "random")
    words = run(
        "optimise", "s.npz", "--target", "0.3", "--region", "crosswalk", *given, "--out", "c"
    )
    assert "1 velodyne-vlp-16 reaches 0.3" in words
    assert (tmp_path / "c" / "layout.yaml").is_file()
    short = run("optimise", "s.npz", "--target", "0.999", *given, "--out", "d")
    assert "none reaches 0.999; the best is 2 velodyne-vlp-16; 2 of 2 mixes were" in short
    assert read_csv(tmp_path / "d" / "history.csv")


@pytest.mark.parametrize(("arguments", "words"), [
    (("layout.yaml", "--target", "95"), "scores are between 0 and 1"),
    (("layout.yaml", "--target", "0.9", "--start", "random"), "leave out --checkpoint and --start"),
    (("layout.yaml", "--device", "velodyne-vlp-16:1"), "layout.yaml has its own devices: give one"),
    (("layout.yaml", "--price", "paper-camera=1"), "--price is for --target"),
    (("--target", "0.9", "--device", "paper-camera:1"), "--price paper-camera=USD"),
    (("layout.yaml", "--region", "crosswalk"), "occlusion counts every voxel"),
    (("layout.yaml", "--region", "kerbs", "--weight", "coverage=1"), "region 'kerbs': one of driv"),
    (("layout.yaml", "--metrics", "localization"), "did you mean localisation"),
    (("--device", "paper-camera:1-2"), "one number of it"),
    (("--device", "a:1"), "device 'a'"),
    (("--device", "paper-camera:0"), "no sensor"),
])  # fmt: skip
def test_what_does_not_go_together_is_said(run, arguments, words):
    assert words in run("optimise", "s.npz", *arguments, fails=True)


def test_a_search_begins_with_a_mix_of_devices(run, tmp_path):
    mix = ("--device", "velodyne-vlp-16:1", "--device", "paper-camera:2")
    run("optimise", "s.npz", *mix, "--method", "random", "--evaluations", 1, "--out", "m")
    text = (tmp_path / "m" / "start.yaml").read_text()
    assert (text.count("device: velodyne-vlp-16"), text.count("device: paper-camera")) == (1, 2)


AIM = ("--weight", "detectability=1", "--region", "crosswalk", "--road-user", "pedestrian")


def test_a_layout_says_what_it_was_searched_for_and_is_scored_for_that(run, scored, tmp_path):
    """The same number from search, score, report and Python; the usual P_sm beside it."""
    words = run(
        "optimise", "s.npz", "layout.yaml", *AIM, "--method", "random", "--evaluations", 2,
        "--out", "g",
    )  # fmt: skip
    assert "D of crosswalk only; road users: pedestrian only" in words
    found = json.loads((tmp_path / "g" / "result.json").read_text())["objective"]
    layout = load_layout(tmp_path / "g" / "layout.yaml")
    goal = dict(weights={"detectability": 1.0}, regions=["crosswalk"], road_users=["pedestrian"])
    assert layout.goal.record == goal
    assert load_layout(tmp_path / "g" / "start.yaml").goal is None
    with_goal = scored("s.npz", "g/layout.yaml")
    assert with_goal["searched_for"].pop("score") == pytest.approx(found, abs=1e-6)
    assert with_goal["searched_for"] == goal
    given = scored("s.npz", "g/layout.yaml", *AIM)
    assert given["surrogate"] == pytest.approx(found, abs=1e-6)
    assert "searched_for" not in given
    assert given["settings"]["regions"] == ["crosswalk"]
    assert abs(with_goal["surrogate"] - found) > 0.01
    headline = "searched for detectability (crosswalk, pedestrian only): "
    numbers = f"{found:.4f}; P_sm {with_goal['surrogate']:.4f}"
    assert f"{headline}{numbers}" in run("score", "s.npz", "g/layout.yaml")
    assert f"{headline}{numbers}" in run("report", "s.npz", "g/layout.yaml")
    page = " ".join((tmp_path / "report.html").read_text().split())
    assert f"{headline}{numbers}." in page
    card = f'{found:.3f}</span></b> <span class="soft">{headline[:-2]};'
    assert card in page
    wrong = (tmp_path / "g" / "layout.yaml").read_text().replace("[crosswalk]", "[kerb]")
    (tmp_path / "wrong.yaml").write_text(wrong)
    said = run("score", "s.npz", "wrong.yaml", fails=True)
    assert "wrong.yaml: searched_for: region 'kerb': one of" in said
