"""Generating data sets: killed, out of disk space and continued, the bytes stay the same."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import made_up
import pytest
import yaml
from opv2v_validator import check_scenario, check_set
from processes import in_this_process, inspe_process

import inspe_jax.dataset as dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import prepare_folder
from inspe_jax.dataset import chunk, generate, load_generation
from inspe_jax.dataset.manifest import GENERATION
from inspe_jax.jobs.locks import lock_folder

LAYOUT = """
name: two masts
units:
  - name: north-east
    base: [9.0, 9.0]
    sensors:
      - {device: paper-camera, height: 6, yaw_deg: -135, pitch_deg: -20}
      - {device: paper-lidar-32, height: 5, yaw_deg: 0}
  - base: [-9.0, -9.0]
    sensors: [{device: paper-lidar-32, height: 5, yaw_deg: 0}]
"""

BOTH = dict(seed=[0, 1], light=["midday", "night"])
STUDY = dict(
    scenes=[{"built_in": "four_way", "tags": {"kind": "four-way"}}],
    layouts=["two.yaml", "L-c"],
    settings=dict(radius=15, voxel=2, density=5, seconds=1.4) | BOTH,
    layers=["depth"],
    split_by="scenario",
)
FRAMES = 14


@contextmanager
def one_thread():
    """One worker in this process, which does not have to import anything first."""
    from distributed import Client

    @contextmanager
    def client(scheduler, workers):
        patch.setattr(chunk, "_worker", chunk.WorkerState())
        with in_this_process() as cluster, Client(cluster) as here:
            yield here

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("inspe_jax.core.files.os", os)
        patch.setattr("inspe_jax.jobs.cluster.client", client)
        yield


@pytest.fixture(autouse=True)
def _made_up():
    back = made_up.use()
    with one_thread():
        yield
    back()


def write(folder: Path, **changes) -> Path:
    (folder / "two.yaml").write_text(LAYOUT)
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(STUDY | changes))
    return path


def begin(path: Path, out: Path, **more) -> subprocess.Popen:
    """Start `inspe generate` with the random recorder, in a new process and process group."""
    here = str(Path(__file__).parents[1])
    paths = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])
    return inspe_process(
        *("generate", str(path), "--out", str(out), "--workers", "1"),
        before="import made_up; made_up.use()",
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": paths, made_up.SLOW: "0.02", **more},
    )


def wait_for_frames(process: subprocess.Popen, out: Path, count: int) -> None:
    """Wait for this number of frames; every file with its final name must be complete meanwhile."""
    end = time.monotonic() + 120
    while sum(path.match("-1/[0-9]*.yaml") for path in files_in(out)) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        assert_whole(out)
        time.sleep(0.01)


def assert_whole(out: Path) -> None:
    for split in ("train", "validate", "test"):
        for scenario in (out / split).glob("*"):
            (found,) = dataset.open(scenario).scenarios
            assert found.frames == tuple(range(FRAMES)), scenario
            assert not [path for path in files_in(scenario) if path.match(".*.part")]


def files_in(folder: Path) -> Iterator[Path]:
    """Its files; unlike ``rglob``, it passes over a folder that a worker has removed meanwhile."""
    return (Path(at, name) for at, _, names in os.walk(folder) for name in names)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> tuple[Path, dict[str, bytes]]:
    folder = tmp_path_factory.mktemp("whole")
    path = write(folder)
    told = []
    back = made_up.use()
    with one_thread():
        made = generate(
            load_generation(path), folder / "out", workers=1, progress=lambda *at: told.append(at)
        )
    back()
    assert (told[0], told[-1]) == ((0, 8 * FRAMES), (8 * FRAMES, 8 * FRAMES))
    assert told == sorted(told)
    assert (made.scenarios, made.frames, made.recorded) == (8, 8 * FRAMES, 8 * FRAMES)
    assert not made.failures
    plans = load_generation(path).scenarios
    notes = {plan.name: 2 if plan.layout.name == "two masts" else 1 for plan in plans}
    assert {name: len(told) for name, told in made.notes.items()} == notes
    files = made_up.content(folder / "out")
    assert made.size == sum(len(data) for name, data in files.items() if name.count("/") > 1)
    return path, files


def test_every_scenario_is_valid_and_in_its_split(undisturbed):
    path, _ = undisturbed
    reports = check_set(path.parent / "out")
    plans = load_generation(path).scenarios
    assert {*reports} == {f"{plan.split}/{plan.name}" for plan in plans}
    assert {report.frames for report in reports.values()} == {FRAMES}
    opened = dataset.open(path.parent / "out")
    assert [len(opened.splits[split]) for split in opened.splits] == [5, 1, 2]
    for scenario in opened.scenarios:
        (plan,) = (plan for plan in plans if plan.name == scenario.name)
        assert scenario.frame(FRAMES - 1).time == pytest.approx((FRAMES - 1) / 10)
        told = scenario.protocol
        assert told["world"]["weather"] == plan.conditions.record
        assert told["world"]["seed"] == plan.settings["seed"]
        assert told["tags"] == {"kind": "four-way"}
        assert told["notes"][-1] == "lidar: made up"
        assert told["stations"][-1] == ("north-east" if len(scenario.agents) == 2 else "centre")


def test_existing_frames_are_not_recorded_again(undisturbed, tmp_path):
    path, files = undisturbed
    out = tmp_path / "out"
    shutil.copytree(path.parent / "out", out)
    made = generate(load_generation(path), out)
    assert (made.recorded, made.frames) == (0, 8 * FRAMES)
    (first, *_) = sorted((out / "train").iterdir())
    (first / "-1" / "000003.yaml").unlink()
    (out / "test").rename(tmp_path / "test")
    made = generate(load_generation(path), out, workers=1)
    assert made.recorded == 3 * FRAMES
    assert made_up.content(out) == files


@pytest.mark.process
def test_a_killed_worker_is_replaced_and_a_run_goes_on_after_ctrl_c(undisturbed, tmp_path):
    path, files = undisturbed
    out, pids = tmp_path / "out", tmp_path / "pids"
    pids.mkdir()
    process = begin(path, out, **{made_up.PIDS: str(pids)})
    wait_for_frames(process, out, 5)
    (worker,) = pids.iterdir()
    os.kill(int(worker.name), signal.SIGKILL)
    wait_for_frames(process, out, 3 * FRAMES)
    assert len([*pids.iterdir()]) == 2
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to workers as well
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "give the same command again to resume" in err
    assert "Traceback" not in err
    assert_whole(out)
    made = generate(load_generation(path), out, workers=1)
    assert 0 < made.recorded <= 5 * FRAMES
    assert made_up.content(out) == files


@pytest.mark.process
def test_a_run_that_was_killed_continues_where_it_was(undisturbed, tmp_path):
    """The second run starts at once: a worker of the first may still write frames."""
    path, files = undisturbed
    out = tmp_path / "out"
    killed = begin(path, out)
    wait_for_frames(killed, out, 7)
    os.kill(killed.pid, signal.SIGKILL)
    assert killed.wait(60) == -signal.SIGKILL
    assert_whole(out)
    generate(load_generation(path), out, workers=1)
    killed.communicate(timeout=100)  # until its worker is gone
    assert made_up.content(out) == files


def test_a_full_disk(undisturbed, tmp_path, monkeypatch):
    path, files = undisturbed
    out = tmp_path / "out"
    monkeypatch.setenv(made_up.ROOM, "400")
    full = "No space left on device: .*; give the same command again to resume"
    with pytest.raises(InspeError, match=full):
        generate(load_generation(path), out, workers=1)
    assert check_set(out)
    assert_whole(out)
    monkeypatch.delenv(made_up.ROOM)
    generate(load_generation(path), out, workers=1)
    assert made_up.content(out) == files


def test_scenarios_that_cannot_be_generated(tmp_path, monkeypatch):
    for name in ("broken", "unheard of"):
        (tmp_path / f"{name}.yaml").write_text(LAYOUT.replace("two masts", name))
    (tmp_path / "broken.xodr").write_text("<OpenDRIVE/>")
    path = write(
        tmp_path,
        scenes=[{"built_in": "four_way"}, {"map": "broken.xodr", "junction": 1}],
        layouts=["two.yaml", "broken.yaml", "unheard of.yaml", "L-c"],
        settings=STUDY["settings"] | dict(seed=0, light="midday"),
    )
    generation = load_generation(path)
    deadly = generation.scenarios[3].seed

    def dies(scene, todo):
        if todo.plan.seed == deadly:
            raise RuntimeError("what the scheduler says of a worker that was killed")
        return made_up.work(scene, todo)

    monkeypatch.setattr(sys.modules[generate.__module__], "work", dies)
    made = generate(generation, tmp_path / "out", workers=1)
    assert (made.scenarios, len(made.failures)) == (1, 7)
    for name, words in {
        "four_way__broken": "frame 13: the sun is too low",
        "four_way__unheard_of": "recording needs embreex, which is not installed",
        "four_way__L-c": "a worker that was killed",
        "broken_1__two_masts": "broken.xodr",
        "broken_1__L-c": "broken.xodr",
    }.items():
        assert words in made.failures[f"{name}__5__midday__0"]
    (only,) = check_set(tmp_path / "out")
    assert only.endswith("/four_way__two_masts__5__midday__0")
    assert_whole(tmp_path / "out")


def test_a_scenario_is_generated_again_from_its_protocol(undisturbed, tmp_path):
    """To the same bytes: from this file alone, in another folder."""
    path, files = undisturbed
    plan = load_generation(path).scenarios[2]
    assert plan.layout.strategy == "L-c"
    place = f"{plan.split}/{plan.name}"
    (tmp_path / "data_protocol.yaml").write_bytes(files[f"{place}/data_protocol.yaml"])
    out = tmp_path / "out"
    made = generate(load_generation(tmp_path / "data_protocol.yaml"), out, workers=1)
    assert (made.scenarios, made.frames) == (1, FRAMES)
    assert [*made.notes.values()] == [("lidar: made up",)]
    check_scenario(out / place)
    again = made_up.content(out)
    del again["generation.yaml"]
    assert again == {name: data for name, data in files.items() if name.startswith(place)}


def test_other_folders_are_not_changed(undisturbed, tmp_path):
    path, files = undisturbed
    out = tmp_path / "out"
    shutil.copytree(path.parent / "out", out)
    for other in (
        STUDY | dict(image_size=[40, 30]),
        STUDY | dict(splits=dict(train=1, test=1)),
        STUDY | dict(settings=STUDY["settings"] | dict(seed=[0, 2])),
    ):
        words = "out: holds another data set, 'study', with other scenarios"
        with pytest.raises(InspeError, match=words):
            generate(load_generation(write(tmp_path, **other)), out)
    with pytest.raises(InspeError, match="out: holds another data set, backend embedded"):
        generate(load_generation(path), out, "carla")
    record = out / "generation.yaml"
    record.write_text(record.read_text().replace("numpy: ", "numpy: 0."))
    with pytest.raises(InspeError, match=r"was begun with numpy 0.\d.*, but this is \d"):
        generate(load_generation(path), out)
    for text in ("a: [", "- 1", "format: 3"):
        record.write_text(text)
        with pytest.raises(InspeError, match=r"generation.yaml: not"):
            generate(load_generation(path), out)
    record.unlink()
    with pytest.raises(InspeError, match=r"out: has no generation.yaml, so it is no data set"):
        generate(load_generation(path), out)
    record.write_bytes(files["generation.yaml"])
    assert made_up.content(out) == files


@pytest.mark.parametrize(("options", "message"), [
    (dict(workers=0), "workers 0: 1 or more"),
    (dict(backend="carla", workers=2), "workers 2: 1 with backend carla"),
    (dict(backend="carla", server=dataset.Server(port=70000)), "port 70000 is out of range"),
    (dict(server=dataset.Server("sim")), "server sim:2000: goes with backend carla, and this"),
    (dict(backend="carl"), "backend 'carl': one of embedded, carla; did you mean carla"),
    (dict(folder="no/such"), "no/such: no such folder: no"),
    (dict(folder="study.yaml"), "study.yaml: is a file; name a folder"),
])  # fmt: skip
def test_bad_options(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    generation = load_generation(write(tmp_path))
    with pytest.raises(InspeError, match=message):
        generate(generation, **{"folder": "out", **options})
    assert not (tmp_path / "out").exists()


def test_a_folder_is_of_one_run_at_a_time(tmp_path):
    generation, in_use = load_generation(write(tmp_path)), "is in use by another run"
    lock = lock_folder(prepare_folder(tmp_path / "out"), f".{GENERATION}.lock")
    with lock, pytest.raises(InspeError, match=in_use):
        generate(generation, tmp_path / "out")


def test_workers_need_dask(tmp_path, monkeypatch):
    for name in ("distributed", "inspe_jax.jobs.cluster"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delattr(sys.modules["inspe_jax.jobs"], "cluster", raising=False)
    monkeypatch.delitem(sys.modules, "inspe_jax.jobs.cluster")
    with pytest.raises(InspeError, match=r"needs Dask: .*pip install .*\[sweep\]'"):
        generate(load_generation(write(tmp_path)), tmp_path / "out")


def test_a_worker_has_one_recorder_at_a_time(tmp_path, monkeypatch):
    told = []

    @contextmanager
    def recorder_of(backend, scene, layout, conditions, *given):
        told.append(("open", conditions.light))
        with made_up.recorder_of(backend, scene, layout, conditions, *given) as found:
            yield found
        told.append(("close", conditions.light))

    monkeypatch.setattr(chunk, "recorder_of", recorder_of)
    monkeypatch.setattr(chunk, "_worker", chunk.WorkerState())
    day, night, *_ = load_generation(write(tmp_path)).scenarios
    for number, (plan, first) in enumerate(((day, 0), (day, 10), (night, 0))):
        given = tmp_path / plan.name, tmp_path / f"lock {number}", range(first, first + 2), 2
        todo = chunk.Chunk(plan, "embedded", *given)
        found = chunk.work(chunk.build(todo), todo)
        assert found == chunk.Outcome(notes=("camera: made up", "lidar: made up"))
    chunk.close()
    assert told == [(word, light) for light in ("midday", "night") for word in ("open", "close")]
    assert dataset.open(tmp_path / day.name).scenarios[0].frames == (0, 1, 10, 11)
