"""Trainings: repeated, stopped, damaged, refused."""

import shutil
from dataclasses import replace
from importlib import import_module

import equinox as eqx
import jax
import numpy as np
import pytest
from loading_sets import HEIGHT, WIDTH, frame_of, write_scenario, write_set
from processes import in_this_process

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.perception import detector as detectors
from inspe_jax.perception import encoders
from inspe_jax.perception.detector import MODELS
from inspe_jax.perception.inputs import BevGrid
from inspe_jax.perception.training import Training, TrainingSettings, open_run, train, train_all
from inspe_jax.perception.training import run as runs
from inspe_jax.perception.training.run import LOSSES, VALIDATION, TrainingRun, begun
from inspe_jax.perception.training.train import content_of, distillation

GRID = BevGrid(half=12.8)
SETTINGS = TrainingSettings(
    model="coalign", steps=4, batch=2, every=2, validate_frames=2, rate=1e-3
)


@pytest.fixture(scope="module", autouse=True)
def _small():
    """A network of two scales, which is compiled sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(encoders, "WIDTHS", (16, 16))
        patch.setattr(detectors, "CHANNELS", 16)
        yield


@pytest.fixture(scope="module")
def cached(tmp_path_factory):
    root = tmp_path_factory.mktemp("training")
    write_set(root / "set")
    write_scenario(root / "set" / "validate" / "d", [frame_of(n) for n in (10, 11, 12)])
    return dataset.cache(root / "set", root / "cache", pictures=(HEIGHT, WIDTH), workers=1)


def stop_at(step: int, model: str = "coalign"):

    def stop(report):
        if (report.step, report.model) == (step, model):
            raise KeyboardInterrupt

    return stop


@pytest.fixture(scope="module")
def stopped_and_not(cached, tmp_path_factory):
    """A training in one go, and one that is stopped after three steps of four and goes on."""
    root = tmp_path_factory.mktemp("runs")
    whole = train(cached, root / "whole", SETTINGS, grid=GRID)

    with pytest.raises(KeyboardInterrupt):
        train(cached, root / "parts", SETTINGS, grid=GRID, progress=stop_at(3))
    run = open_run(root / "parts")
    assert run.steps == 2
    assert [row["step"] for row in run.rows(LOSSES)] == [1, 2, 3]
    with (root / "parts" / LOSSES).open("a") as file:
        file.write("4,0.3")  # as a kill leaves it
    return whole, train(cached, root / "parts", SETTINGS, grid=GRID)


def test_a_stopped_training_goes_on_to_the_same_losses(stopped_and_not):
    whole, parts = stopped_and_not
    assert whole.steps == parts.steps == SETTINGS.steps
    for name, count in ((LOSSES, 4), (VALIDATION, 2)):
        assert len(whole.rows(name)) == count
        assert whole.rows(name) == parts.rows(name)
    ours, theirs = (run.states[-1][1].read_bytes() for run in (whole, parts))
    assert ours == theirs
    losses = {row["heat"] + row["values"] for row in whole.rows(LOSSES)}
    assert np.isfinite([*losses]).all()
    assert len(losses) == 4


def test_trainings_by_workers_are_the_same_and_one_that_fails_stops_no_other(
    stopped_and_not, cached, tmp_path
):
    whole, _ = stopped_and_not
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "notes.txt").write_text("of somebody else")
    trainings = [Training(cached.path, tmp_path / name, SETTINGS, GRID) for name in ("bad", "good")]
    told = []
    with in_this_process() as cluster:
        given = dict(scheduler=cluster.scheduler_address, progress=lambda *now: told.append(now))
        found = {each.folder.name: result for each, result in train_all(trainings, **given)}
    assert isinstance(found["bad"], InspeError)
    assert "has other files" in str(found["bad"])
    assert found["good"].steps == SETTINGS.steps
    assert found["good"].rows(LOSSES) == whole.rows(LOSSES)
    assert told[-1] == (8, 8)
    assert {done for done, _ in told} >= {5, 6}  # of single steps


def test_a_damaged_state_is_named_and_the_one_before_is_there(stopped_and_not, cached, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(stopped_and_not[0].path, folder)
    (_, path) = open_run(folder).states[-1]
    content = path.read_bytes()
    for broken in (content[:1000], content + b"x", b""):
        path.write_bytes(broken)
        with pytest.raises(InspeError, match=r"step_00000004.eqx: is damaged.*from step 2"):
            open_run(folder).last()
    path.unlink()
    again = train(cached, folder, SETTINGS, grid=GRID)
    assert again.rows(LOSSES) == stopped_and_not[0].rows(LOSSES)


def test_whatever_a_kill_leaves_is_mended(stopped_and_not, cached, tmp_path):
    whole = stopped_and_not[0]
    folder = tmp_path / "run"
    shutil.copytree(whole.path, folder)
    lines = (folder / VALIDATION).read_text().splitlines(keepends=True)
    (folder / VALIDATION).write_text("".join(lines[:-1]))
    (folder / ".step_00000004.eqx.abc.part").write_bytes(b"half")
    again = train(cached, folder, SETTINGS, grid=GRID)
    assert again.rows(VALIDATION) == whole.rows(VALIDATION)
    assert not list(folder.glob(".*.part"))
    for _, path in again.states:
        path.unlink()
    (folder / LOSSES).write_text("")
    (folder / ".run.json.abc.part").write_text("{")
    with pytest.raises(KeyboardInterrupt):
        train(cached, folder, SETTINGS, grid=GRID, progress=stop_at(1))
    assert [row["step"] for row in again.rows(LOSSES)] == [1]
    assert again.rows(LOSSES) == whole.rows(LOSSES)[:1]


def test_what_cannot_be_trained_leaves_no_folder(cached, tmp_path):
    many = SETTINGS.model_copy(update={"batch": 64})
    with pytest.raises(InspeError, match="use a smaller batch"):
        train(cached, tmp_path / "run", many, grid=GRID)
    assert not (tmp_path / "run").exists()
    with pytest.raises(InspeError, match=r"50 cells .* a multiple of 32 .* half 12\.8 m"):
        train(cached, tmp_path / "run", SETTINGS, grid=BevGrid(half=20))
    same = Training(cached.path, tmp_path / "run", SETTINGS, GRID)
    with pytest.raises(InspeError, match="two trainings"):
        list(train_all([same, same]))
    (tmp_path / "mine.txt").touch()
    with pytest.raises(InspeError, match=r"has other files, such as mine.txt"):
        train(cached, tmp_path, SETTINGS, grid=GRID)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_model_that_is_taught_has_its_teacher_first(cached, tmp_path, monkeypatch):
    """As DiscoNet, but of LiDARs alone, which is compiled sooner."""
    monkeypatch.setitem(MODELS, "pupil", replace(MODELS["disconet"], sensors=("lidar",)))
    settings = TrainingSettings(model="pupil", steps=2, batch=2, every=1, validate_frames=0)
    with pytest.raises(KeyboardInterrupt):
        train(cached, tmp_path / "run", settings, grid=GRID, progress=stop_at(2, "pupil"))
    run = train(cached, tmp_path / "run", settings, grid=GRID)
    assert run.steps == open_run(tmp_path / "run" / "teacher").steps == settings.steps
    taught = [row["taught"] for row in run.rows(LOSSES)]
    assert len(taught) == 2
    assert min(taught) > 0
    teacher = open_run(tmp_path / "run" / "teacher")
    before = teacher.states[-1][1].read_bytes()
    train(cached, tmp_path / "run", settings, grid=GRID)
    assert teacher.states[-1][1].read_bytes() == before
    # Of another teacher, other things are learnt.
    shutil.copytree(teacher.path, tmp_path / "other" / "run" / "teacher")
    other = open_run(tmp_path / "other" / "run" / "teacher")
    step, state = other.restore()
    other.keep(step, jax.tree.map(lambda leaf: 0 * leaf if eqx.is_array(leaf) else leaf, state))
    again = train(cached, tmp_path / "other" / "run", settings, grid=GRID)
    first, second = (of.rows(LOSSES)[0] for of in (run, again))
    assert first["heat"] == second["heat"]
    assert abs(first["taught"] - second["taught"]) > 1e-3


def test_distillation_is_a_divergence():
    rng = np.random.default_rng(0)
    own, teacher = rng.normal(size=(2, 1, 3, 4, 8)).astype(np.float32)
    found, same = jax.jit(lambda a, b: (distillation(a, b), distillation(b, b)))(own, teacher)
    p, q = (np.exp(x) / np.exp(x).sum(-1, keepdims=True) for x in (teacher, own))
    assert found == pytest.approx((p * np.log(p / q)).mean(), rel=1e-4)
    assert same == pytest.approx(0, abs=1e-6)


def test_other_settings_are_refused_in_the_same_folder(stopped_and_not, cached, tmp_path):
    folder = stopped_and_not[0].path
    for key, value in (("steps", 5), ("model", "v2vnet"), ("rate", 0.1)):
        other = SETTINGS.model_copy(update={key: value})
        with pytest.raises(InspeError, match=f"this run has {key} .*, not {value}"):
            train(cached, folder, other, grid=GRID)
    with pytest.raises(InspeError, match=r"this run has half 12\.8, not 25\.6"):
        train(cached, folder, SETTINGS, grid=BevGrid(half=25.6))
    with pytest.raises(InspeError, match="not a training run"):
        open_run(tmp_path)
    shutil.copytree(folder, tmp_path / "old")
    record = tmp_path / "old" / "run.json"
    record.write_text(record.read_text().replace('"inspe_jax run 3"', '"inspe_jax run 2"'))
    with pytest.raises(InspeError, match="format: input should be 'inspe_jax run 3'"):
        open_run(tmp_path / "old")


@pytest.mark.parametrize(("loss", "weight", "step"), [(np.nan, 0, 3), (1.0, np.nan, 4)])
def test_numbers_that_are_none_stop_and_keep_the_states(
    stopped_and_not, cached, tmp_path, monkeypatch, loss, weight, step
):
    """Of a loss, and of weights where a state is due: a loss is of the weights before its step."""
    folder = tmp_path / "run"
    shutil.copytree(stopped_and_not[0].path, folder)
    run = open_run(folder)
    run.states[-1][1].unlink()
    room = import_module("inspe_jax.perception.training.train")

    def broken(constant, detector, moments):
        worse = jax.device_put(np.asarray(detector.head.values.bias) + np.float32(weight))
        detector = eqx.tree_at(lambda it: it.head.values.bias, detector, worse)
        return detector, moments, room._Losses(loss, 0.0, 0.0, 0.0)

    monkeypatch.setattr(room, "training_step", broken)
    with pytest.raises(
        InspeError, match=rf"step {step} gave no numbers: train into another folder.* 2 stays"
    ):
        train(cached, folder, SETTINGS, grid=GRID)
    assert open_run(folder).steps == 2


def test_only_one_process_trains_a_run(cached, tmp_path):
    """Also before its first state, when another would replace its record."""
    folder = tmp_path / "run"
    with begun(folder, content_of(cached, SETTINGS, GRID)) as run:
        for rate in (SETTINGS.rate, 0.1):
            other = SETTINGS.model_copy(update={"rate": rate})
            with pytest.raises(InspeError, match="is in use by another run"):
                train(cached, folder, other, grid=GRID)
        assert open_run(folder) == run
    with begun(folder, content_of(cached, SETTINGS, GRID)) as again:
        assert again == run


def test_a_model_needs_its_sensors(cached, tmp_path):
    write_scenario(tmp_path / "set" / "train" / "a", [frame_of(0, lidars=False)])
    blind = dataset.cache(tmp_path / "set", tmp_path / "cache", pictures=None, workers=1)
    blind_to = "needs pictures, and the cache was made without pictures"
    for name, why in (("lss-eff", blind_to), ("coalign", "needs LiDARs, and no scenario has one")):
        with pytest.raises(InspeError, match=why):
            train(blind, tmp_path / "run", TrainingSettings(model=name), grid=GRID)
    assert not (tmp_path / "run").exists()


def test_pictures_of_another_size_are_refused(stopped_and_not, tmp_path):
    write_scenario(tmp_path / "set" / "train" / "a", [frame_of(0)])
    other = dataset.cache(tmp_path / "set", tmp_path / "other", pictures=(24, 32), workers=1)
    run = stopped_and_not[0]
    runs.check_pictures(run, other)  # coalign takes none
    settings = run.content.settings.model_copy(update={"model": "lss-eff"})
    run = TrainingRun(run.path, run.content.model_copy(update={"settings": settings}))
    with pytest.raises(InspeError, match=r"pictures of 32x24, but .* --pictures 64x48"):
        runs.check_pictures(run, other)
