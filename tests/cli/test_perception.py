"""`inspe train`, `evaluate` and `detect`, from a set to a figure."""

import json
import shutil
from importlib import import_module
from unittest.mock import Mock

import numpy as np
import pytest
from loading_sets import write_set
from processes import in_this_process, inspe_process, wait_for_rows
from typer.testing import CliRunner

from inspe_jax.cli.common import app
from inspe_jax.perception.training import open_run
from inspe_jax.perception.training.run import LOSSES
from inspe_jax.simulation.frame import KINDS

SMALL = ("--pictures", "32x24", "--workers", "1")
TRAIN = ("--model", "early-fusion", "--steps", "2", "--every", "1")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A set, its cache, and a training on it."""
    root = tmp_path_factory.mktemp("perception")
    write_set(root / "set")
    for words in (
        ("dataset", "cache", root / "set", "--out", root / "set_cache", *SMALL),
        ("train", root / "set_cache", *TRAIN, "--out", root / "run"),
    ):
        found = CliRunner().invoke(app, [*map(str, words)])
        assert found.exit_code == 0, found.output
    assert "early-fusion: 2 steps\nwrote" in found.output
    return root


def test_several_are_trained_by_workers(run, tmp_path):
    """As of one alone: tests/perception/test_training.py."""
    with in_this_process() as cluster:
        words = ("--seed", 0, "--seed", 1, "--scheduler", cluster.scheduler_address)
        text = run("train", "set_cache", *TRAIN, *words, "--out", tmp_path / "runs")
    assert "early-fusion_0: 2 steps early-fusion_1: 2 steps wrote" in text
    first, second = (open_run(tmp_path / "runs" / f"early-fusion_{k}") for k in (0, 1))
    assert first.rows(LOSSES) != second.rows(LOSSES)


@pytest.mark.parametrize(("words", "said"), [
    (("train", "set", "--workers", 2, "--scheduler", "tcp://host:1"), "workers 2: give 1 or more"),
    (("train", "set_cache", "--rate", "-1"), "training: rate: input should be greater than 0"),
    (("detect", "run", "set_cache", "--scenario", "d"), "no scenario 'd' in split 'test': it h"),
    (("detect", "run", "set_cache", "--frame", "6"), "c: no frame 6: it has 3, from 7 to 9"),
    (("detect", "run", "set_cache", "--split", "tset"), "split 'tset': one of"),
])  # fmt: skip
def test_what_cannot_be_done_is_said(run, words, said):
    assert said in run(*words, *("--out", "other") * (words[0] == "train"), fails=True)


@pytest.mark.process
def test_a_killed_training_goes_on_to_the_same_losses(run, files, tmp_path):
    words = ("train", files / "set_cache", *TRAIN[:2], "--steps", 6, "--every", 2, "--out")
    process = inspe_process(*map(str, (*words, tmp_path / "parts")))
    wait_for_rows(process, tmp_path / "parts", 3, LOSSES)
    process.kill()
    process.communicate()
    assert 3 <= len(open_run(tmp_path / "parts").rows(LOSSES)) < 6
    for name in ("whole", "parts"):
        run(*words, tmp_path / name)
    whole, parts = (open_run(tmp_path / name).rows(LOSSES) for name in ("whole", "parts"))
    assert [row["step"] for row in parts] == list(range(1, 7))
    heat, again = (np.array([row["heat"] for row in rows]) for rows in (whole, parts))
    # Another process may add up in another order, as above; Adam makes more of it with each step.
    np.testing.assert_allclose(again[0], heat[0], rtol=1.5e-5)
    np.testing.assert_allclose(again, heat, rtol=1e-3)


def test_ctrl_c_says_how_to_go_on(inspe, tmp_path, monkeypatch):
    room = import_module("inspe_jax.perception.training.train")

    monkeypatch.setattr(room, "training_step", Mock(side_effect=KeyboardInterrupt))
    status, _, error = inspe("train", "set_cache", *TRAIN, "--out", tmp_path / "run")
    assert status == 130
    assert "stopped; give the same command again to resume" in error


def test_evaluate_tells_by_class(run):
    classes = json.loads(run("evaluate", "run", "set_cache", "--json", "-"))["classes"]
    assert [row["class"] for row in classes] == ["car", "truck", "cyclist", "pedestrian", "all"]
    assert classes[-1]["road_users"] == 12 >= classes[-1]["seen"] > 0


def test_detect_lists_and_draws_a_frame(run, files):
    words = ("detect", "run", "set_cache", "--frame", 8, "--score", 0)
    run(*words, "--plot", "frame.png")
    assert (files / "frame.png").stat().st_size > 10_000
    record = json.loads(run(*words, "--json", "-"))
    assert (record["scenario"], record["frame"]) == ("c", 8)
    assert {found["class"] for found in record["detections"]} <= set(KINDS)
    assert all(abs(found["x"]) < 60 < 1000 * found["length"] for found in record["detections"])
    scores = sorted(found["score"] for found in record["detections"])
    assert scores
    middle = scores[len(scores) // 2]
    few = json.loads(run(*words[:-1], middle, "--json", "-"))["detections"]
    assert [found["score"] for found in few] == [
        found["score"] for found in record["detections"] if found["score"] >= middle
    ]


def test_a_training_that_is_not_done_is_measured_as_such(run, files, tmp_path):
    shutil.copytree(files / "run", tmp_path / "run")
    record = tmp_path / "run" / "run.json"
    record.write_text(record.read_text().replace('"steps": 2', '"steps": 1000'))
    words = run("evaluate", tmp_path / "run", "set_cache")
    assert "of 3 frames, after 2 of 1,000 steps" in words
    assert "Detections, after 2 of 1,000 steps" in run("detect", tmp_path / "run", "set_cache")
    assert "steps" not in run("evaluate", "run", "set_cache")
