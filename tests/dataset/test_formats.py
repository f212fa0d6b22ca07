"""Adding a format: a module with four functions, and one row of the registry."""

import pickle
from dataclasses import replace
from pathlib import Path

import made_up
import pytest
from frames import WORLD, assert_same, frame

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import prepare_folder
from inspe_jax.dataset import Frame, Generation, chunk, load_generation
from inspe_jax.dataset.formats.other_readers import FileOptions
from inspe_jax.dataset.formats.registry import FORMATS, DatasetFormat
from inspe_jax.dataset.generate import DatasetWriter
from inspe_jax.dataset.plan import make_generation


def toy_agents(folder: Path) -> tuple[int, ...]:
    frames = toy_frames(folder, ())
    return tuple(-s.number for s in toy_read(folder, frames[0], (), {}).stations) if frames else ()


def toy_frames(folder: Path, agents: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(sorted(int(path.stem) for path in folder.glob("*.pickle")))


def toy_read(folder: Path, number: int, agents: tuple[int, ...], protocol) -> Frame:
    return pickle.loads((folder / f"{number}.pickle").read_bytes())


def toy_write(folder: Path, given: Frame, options: FileOptions) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    ordered = replace(given, boxes=tuple(sorted(given.boxes, key=lambda box: box.track)))
    (folder / f"{given.number}.pickle").write_bytes(pickle.dumps(ordered))
    return [folder / f"{given.number}.pickle"]


TOY = DatasetFormat(toy_agents, toy_frames, toy_read, toy_write, "0.pickle")


@pytest.fixture(autouse=True)
def _toy(monkeypatch):
    monkeypatch.setitem(FORMATS, "pickle", TOY)


def generation(folder: Path, **changes) -> Generation:
    settings = dict(radius=15, voxel=2, density=5, seconds=1.4)
    content = dict(scenes=[{"built_in": "four_way"}], layouts=["Cam-d1/L-d1"], settings=settings)
    return make_generation(content | changes, folder)


def test_frames_are_read_back_as_they_were_written(tmp_path):
    for number in (3, 68):
        dataset.write_frame(tmp_path / "train" / "a", frame(number), "pickle")
    dataset.write_protocol(tmp_path / "train" / "a", {"world": WORLD})
    dataset.write_frame(tmp_path / "train" / "b", frame(1))  # OPV2V, in the same set
    first, second = dataset.open(tmp_path).splits["train"]
    assert (first.format, first.agents, first.frames) == (TOY, (-1, -2), (3, 68))
    assert first.protocol == {"world": WORLD}
    assert_same(first.frame(68), frame(68))
    assert_same(first.frame(3), frame(3))
    assert_same(second.frame(1), frame(1))
    names = ["3.pickle", "68.pickle", "data_protocol.yaml"]
    assert sorted(path.name for path in first.path.iterdir()) == names


def test_a_data_set_is_generated_in_a_new_format(tmp_path, monkeypatch):
    made_up.here(monkeypatch)
    toy = generation(tmp_path, format="pickle")
    (plan,) = toy.scenarios
    writer = DatasetWriter(toy, prepare_folder(tmp_path / "out"), "embedded")
    assert writer.finish(plan) is False
    told = chunk.Outcome(notes=("camera: made up", "lidar: made up"))
    assert made_up.record(writer, plan) == [told] * 2
    assert made_up.record(writer, plan) == [chunk.Outcome()] * 2  # nothing is left to do
    assert writer.finish(plan) is True
    (scenario,) = dataset.open(tmp_path / "out").scenarios
    assert (scenario.format, scenario.frames) == (TOY, tuple(range(14)))
    # Its protocol gives a plan in the same format.
    again = load_generation(scenario.path / "data_protocol.yaml")
    assert (again.format, again.scenarios[0].seed) == ("pickle", plan.seed)
    with pytest.raises(InspeError, match="holds another data set, data_format pickle"):
        DatasetWriter(generation(tmp_path), tmp_path / "out", "embedded")


def test_errors_name_every_format(tmp_path):
    unknown = "format: 'opv2': one of opv2v, pickle; did you mean"
    with pytest.raises(InspeError, match=unknown):
        generation(tmp_path, format="opv2")
    with pytest.raises(InspeError, match=unknown):
        dataset.write_frame(tmp_path / "a", frame(1), "opv2")
    assert not (tmp_path / "a").exists()
    with pytest.raises(InspeError, match=r"SPLIT/SCENARIO/AGENT/000000.yaml.*, SCENARIO/0.pickle"):
        dataset.open(tmp_path)
