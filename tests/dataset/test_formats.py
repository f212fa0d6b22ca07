"""Adding a format: a module with four functions, and one row of the registry."""

from pathlib import Path
from types import SimpleNamespace

import made_up
import numpy as np
import pytest
import yaml
from frames import WORLD, assert_same, frame

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.dataset import Frame, Image, RoadUserBox, Scan, Station, chunk, load_generation
from inspe_jax.dataset.formats.options import FileOptions
from inspe_jax.dataset.formats.registry import FORMATS, DatasetFormat
from inspe_jax.dataset.writer import DatasetWriter

# ---- the toy format: a frame is one .npz file --------------------------------------------------


def toy_agents(folder: Path) -> tuple[int, ...]:
    numbers = toy_frames(folder, ())
    if not numbers:
        return ()
    with np.load(folder / f"{numbers[0]}.npz") as file:
        return tuple(-n for n in range(1, int(file["stations"]) + 1))


def toy_frames(folder: Path, agents: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(sorted(int(path.stem) for path in folder.glob("*.npz")))


def toy_write(folder: Path, given: Frame, options: FileOptions) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    flat = {"time": given.time, "stations": len(given.stations), "boxes": len(given.boxes)}
    for b, box in enumerate(sorted(given.boxes, key=lambda box: box.track)):
        flat |= {f"box{b}.{key}": value for key, value in vars(box).items()}
    for s, station in enumerate(given.stations):
        flat |= {f"{s}.number": station.number, f"{s}.name": station.name}
        flat |= {f"{s}.pose": station.pose, f"{s}.images": len(station.images)}
        flat |= {f"{s}.scans": len(station.scans)}
        for k, image in enumerate(station.images):
            there = {key: value for key, value in vars(image).items() if value is not None}
            flat |= {f"{s}.image{k}.{key}": value for key, value in there.items()}
        for k, scan in enumerate(station.scans):
            there = {key: value for key, value in vars(scan).items() if value is not None}
            flat |= {f"{s}.scan{k}.{key}": value for key, value in there.items()}
    np.savez(folder / f"{given.number}.npz", **flat)
    return [folder / f"{given.number}.npz"]


def toy_read(folder: Path, number: int, agents: tuple[int, ...], protocol) -> Frame:
    if number not in toy_frames(folder, agents):
        raise InspeError(f"{folder}: no frame {number}")
    with np.load(folder / f"{number}.npz") as file:
        flat = {key: value if value.ndim else value.item() for key, value in file.items()}

    def fields(start: str) -> dict:
        return {k.removeprefix(start): v for k, v in flat.items() if k.startswith(start)}

    stations = []
    for s in range(flat["stations"]):
        images = [Image(**fields(f"{s}.image{k}.")) for k in range(flat[f"{s}.images"])]
        scans = [Scan(**fields(f"{s}.scan{k}.")) for k in range(flat[f"{s}.scans"])]
        named = flat[f"{s}.number"], flat[f"{s}.name"], flat[f"{s}.pose"]
        stations.append(Station(*named, tuple(images), tuple(scans)))
    boxes = tuple(RoadUserBox(**fields(f"box{b}.")) for b in range(flat["boxes"]))
    return Frame(number, flat["time"], boxes, tuple(stations))


TOY = DatasetFormat(toy_agents, toy_frames, toy_read, toy_write, "0.npz")


@pytest.fixture(autouse=True)
def _toy(monkeypatch):
    """Add the row, which is the only change to the package."""
    monkeypatch.setitem(FORMATS, "npz", TOY)


def study(folder: Path, **changes) -> Path:
    path = folder / "study.yaml"
    settings = dict(radius=15, voxel=2, density=5, seconds=1.4)
    content = dict(scenes=[{"built_in": "four_way"}], layouts=["Cam-d1/L-d1"], settings=settings)
    path.write_text(yaml.safe_dump(content | changes))
    return path


# ---- what works then -----------------------------------------------------------------------


def test_frames_are_read_back_as_they_were_written(tmp_path):
    for number in (3, 68):
        dataset.write_frame(tmp_path / "train" / "a", frame(number), "npz")
    dataset.write_protocol(tmp_path / "train" / "a", {"world": WORLD})
    dataset.write_frame(tmp_path / "train" / "b", frame(1))  # OPV2V, in the same set
    first, second = dataset.open(tmp_path).splits["train"]
    assert (first.format, first.agents, first.frames) == (TOY, (-1, -2), (3, 68))
    assert first.protocol == {"world": WORLD}
    assert_same(first.frame(68), frame(68))
    assert_same(dataset.read_frame(first.path, 3), frame(3))
    assert_same(second.frame(1), frame(1))
    names = ["3.npz", "68.npz", "data_protocol.yaml"]
    assert sorted(path.name for path in first.path.iterdir()) == names


def test_a_folder_has_the_format_of_its_frames(tmp_path):
    for name in ("npz", "opv2v"):
        dataset.write_frame(tmp_path / name, frame(1), name)
    kinds = [scenario.format for scenario in dataset.open(tmp_path).scenarios]
    assert kinds == [TOY, FORMATS["opv2v"]]


def test_statistics_of_a_new_format(tmp_path):
    dataset.write_frame(tmp_path / "a" / "b", frame(1), "npz")
    dataset.write_frame(tmp_path / "c" / "d", frame(1))
    npz, opv2v = (dataset.statistics(tmp_path / name).total for name in "ac")
    for count in ("frames", "agents", "images", "clouds", "points", "boxes"):
        assert getattr(npz, count) == getattr(opv2v, count) > 0


def test_a_data_set_is_generated_in_a_new_format(tmp_path, monkeypatch):
    """By the functions of a worker, and the writer that moves finished scenarios into their
    split."""
    monkeypatch.setattr(chunk, "recorder_of", made_up.recorder_of)
    monkeypatch.setattr(chunk, "_worker", chunk.WorkerState())
    generation = load_generation(study(tmp_path, format="npz"))
    plan = generation.scenarios[0]
    with DatasetWriter(generation, tmp_path / "out", "embedded") as writer:
        folder = writer.unfinished(plan)
        for frames in plan.chunks:
            given = folder, writer.lock(plan, frames.start), frames, len(frames)
            todo = chunk.Chunk(plan, "embedded", *given, format=generation.format)
            scene = chunk.build(todo)
            assert writer.finish(plan) is False
            assert chunk.work(scene, todo).notes == ("camera: made up", "lidar: made up")
            assert chunk.work(scene, todo) == chunk.Outcome()  # nothing is left to do
        assert writer.finish(plan) is True
    (scenario,) = dataset.open(tmp_path / "out").scenarios
    assert (scenario.format, scenario.frames) == (TOY, tuple(range(14)))
    # Its protocol gives a plan in the same format.
    again = load_generation(scenario.path / "data_protocol.yaml")
    assert (again.format, again.scenarios[0].seed) == ("npz", plan.seed)
    other = load_generation(study(tmp_path))
    with pytest.raises(InspeError, match="holds another data set, data_format npz"):
        DatasetWriter(other, tmp_path / "out", "embedded")


@pytest.mark.parametrize("use", ["study", "frame"])
def test_unknown_formats(tmp_path, use):
    uses = SimpleNamespace(
        study=lambda: load_generation(study(tmp_path, format="opv2")),
        frame=lambda: dataset.write_frame(tmp_path / "a", frame(1), "opv2"),
    )
    with pytest.raises(InspeError, match="format: 'opv2': one of opv2v, npz; did you mean opv2v"):
        getattr(uses, use)()
    assert not (tmp_path / "a").exists()


def test_the_error_for_other_folders_names_every_format(tmp_path):
    with pytest.raises(InspeError, match=r"SPLIT/SCENARIO/AGENT/000000.yaml.*, SCENARIO/0.npz"):
        dataset.open(tmp_path)


def test_only_the_registry_knows_the_formats():
    """No other module imports a format: a new one is one new file and a row."""
    root = Path(dataset.__file__).parents[1]
    knows = [
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if "formats.opv2v" in path.read_text() and "opv2v" not in path.parts
    ]
    assert knows == ["dataset/formats/registry.py"]
