"""`inspe dataset` on the command line: what it prints, what it writes, and its errors."""

import json
from functools import partial

import pytest
from frames import WORLD, frame
from processes import cases, refused

from inspe_jax.core.files import read_csv
from inspe_jax.dataset import write_frame, write_protocol


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A data set of two scenarios with two frames each, and one without a frame."""
    root = tmp_path_factory.mktemp("files")
    for place in ("train/a", "test/a"):
        for number in (4, 6):
            write_frame(root / "infra" / place, frame(number))
        write_protocol(root / "infra" / place, {"world": WORLD})
    write_protocol(root / "bare" / "train" / "a", {"world": WORLD})
    return root


@pytest.fixture
def inspe(inspe):
    """`inspe dataset` in the folder of files."""
    return partial(inspe, "dataset")


def test_stats_prints_draws_and_writes_the_same(inspe, files):
    outputs = ("--json", "set.json", "--csv", "row.csv", "--plot", "set.png")
    status, text, error = inspe("stats", "infra", *outputs)
    assert (status, error) == (0, "")
    assert "Data set infra" in text
    assert "drew set.png" in text
    record = json.loads((files / "set.json").read_text())
    assert record["total"]["frames"] == 4
    (row,) = read_csv(files / "row.csv")
    assert row["3D boxes"] == "16"
    assert (files / "set.png").read_bytes().startswith(b"\x89PNG")
    status, text, error = inspe("stats", "infra", "--json", "-", "--csv", "row.csv")
    assert json.loads(text) == record
    assert "wrote row.csv" in error


def test_show_lists_and_draws_a_frame(inspe, files):
    status, text, error = inspe("show", "infra/test/a", 6, "--plot", "frame.png")
    assert (status, error) == (0, "")
    assert "a, frame 6" in text
    assert "pedestrian" in text
    assert (files / "frame.png").read_bytes().startswith(b"\x89PNG")
    assert inspe("show", "infra", 4, "--scenario", "test/a")[0] == 0
    assert inspe("show", "infra/train", 4, "--scenario", "a")[0] == 0


@pytest.mark.parametrize(("arguments", "message"), cases(
    (("stats", "nosuch"), "nosuch: no such folder"),
    (("stats", "bare"), "no frame in 1 scenario:"),
    (("stats", "infra", "--plot", "set.jpg"), "set.jpg: the name must end in .png"),
    (("stats", "infra", "--csv", "row.txt"), "row.txt: the name must end in .csv"),
    (("stats", "infra", "--json", "no/such.json"), "no such folder"),
    (("show", "nosuch", 4), "nosuch: no such folder"),
    (("show", "infra", 4), "infra: 2 scenarios: name one of train/a, test/a"),
    (("show", "infra", 4, "--scenario", "a"), "scenario 'a' is in 2 splits: train/a, test/a"),
    (("show", "infra", 4, "--scenario", "tset/a"), "no scenario 'tset/a': one of train/a, test/a"),
))  # fmt: skip
def test_bad_input_is_one_message_and_status_2(inspe, files, arguments, message):
    refused(inspe, files, arguments, message)
