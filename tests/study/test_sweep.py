"""Jobs done by processes: killed and taken up again, in part failing, the table stays the same."""

import os
import platform
import signal
import subprocess
from pathlib import Path

import deadly
import psutil
import pytest
import yaml
from processes import in_this_process, inspe_process, kill_with_workers, wait_for_rows

from inspe_jax import Conditions, build_scene, built_in, evaluate, strategy
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import read_csv
from inspe_jax.jobs import cluster
from inspe_jax.jobs.cluster import MALLOC_SETTINGS
from inspe_jax.sensing.layout import load_layout
from inspe_jax.study.plan import load_study
from inspe_jax.study.sweep import Results, sweep

STUDY = dict(
    scenes=[{"built_in": "four_way"}, {"built_in": "t_junction", "tags": {"kind": "T"}}],
    layouts=["L-c", {"strategy": "L-d2", "name": "roadside"}],
    settings=dict(radius=20, voxel=2, frames=2, density=[5, 8], weather=["clear", "fog"]),
)


LAYOUT = """
name: far away
units:
  - base: [900, 900]
    sensors: [{device: paper-lidar-32, height: 5, yaw_deg: 0}]
"""


def write(folder: Path, **changes) -> Path:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(STUDY | changes))
    return path


def begin(path: Path, out: Path, *options: str) -> subprocess.Popen:
    """`inspe sweep` in a process and a group of its own."""
    arguments = ("sweep", str(path), "--out", str(out), *options)
    return inspe_process(*arguments, start_new_session=True)


def go_on(path: Path, out: Path) -> None:
    """Without a process: a run from the beginning, or on from where one was ended."""
    with in_this_process() as running:
        sweep(load_study(path), out, scheduler=running.scheduler_address)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> tuple[Path, bytes]:
    folder = tmp_path_factory.mktemp("whole")
    path = write(folder)
    go_on(path, folder / "out")
    return path, (folder / "out" / "results.csv").read_bytes()


@pytest.mark.process
def test_rows_are_what_a_score_says(undisturbed):
    path, _ = undisturbed
    rows = read_csv(path.parent / "out" / "results.csv")
    assert [row["key"] for row in rows] == [job.key for job in load_study(path).jobs]
    assert {row["status"] for row in rows} == {"done"}
    assert [row["tag_kind"] for row in rows] == [""] * 8 + ["T"] * 8
    for row in (rows[1], rows[-1]):
        scene = build_scene(
            built_in(row["scene"]), radius=20, voxel=2, frames=2, density=int(row["density"])
        )
        layout = strategy(scene, {"roadside": "L-d2"}.get(row["layout"], row["layout"]))
        scores = evaluate(scene, layout, conditions=Conditions.of("midday", row["weather"]))
        for name in ("coverage", "occlusion", "information_gain", "surrogate"):
            assert float(row[name]) == pytest.approx(getattr(scores, name), abs=1e-6)
        assert int(row["sensors"]) == len(layout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
def test_workers_keep_the_memory_that_they_free(monkeypatch):
    """Arrays of 2 MB, one after the other: pages are mapped for the first, not for all."""

    def faults(size, times):
        import resource

        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(times):
            bytearray(b"x") * size  # NumPy asks for huge pages itself
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    for name in MALLOC_SETTINGS:
        monkeypatch.delenv(name, raising=False)
    with cluster.client(None, 1) as client:
        (kept,) = client.run(faults, 2**21, 200).values()
    assert kept < 200 * 2**21 / 4096 / 5
    assert not set(MALLOC_SETTINGS) & set(os.environ)


@pytest.mark.process
def test_a_killed_worker_changes_nothing(undisturbed, tmp_path):
    path, whole = undisturbed
    process = begin(path, tmp_path / "out", "--workers", "2")
    wait_for_rows(process, tmp_path / "out", 3)
    kill_a_worker(process)
    out, err = process.communicate(timeout=500)
    assert process.returncode == 0, err
    assert "roadside" in out
    assert (tmp_path / "out" / "results.csv").read_bytes() == whole


def kill_a_worker(process: subprocess.Popen) -> None:
    """The child that has used most time: a worker, since the tracker of resources uses none."""
    children = psutil.Process(process.pid).children(recursive=True)
    used = {child: sum(child.cpu_times()[:2]) for child in children}
    worker = max(used, key=used.get)
    assert used[worker] > 1.0  # seconds; it has imported JAX and compiled
    worker.send_signal(signal.SIGKILL)


@pytest.mark.process
def test_a_killed_run_goes_on_where_it_was(undisturbed, tmp_path):
    """Its workers go with it."""
    path, whole = undisturbed
    process = begin(path, tmp_path / "out", "--workers", "2")
    wait_for_rows(process, tmp_path / "out", 3)
    kill_with_workers(process)
    with Results(load_study(path), tmp_path / "out") as results:  # less a row cut short
        assert 3 <= len(results.rows) < 16
    go_on(path, tmp_path / "out")
    assert (tmp_path / "out" / "results.csv").read_bytes() == whole


@pytest.mark.process
def test_ctrl_c_says_how_to_go_on(undisturbed, tmp_path):
    path, _ = undisturbed
    process = begin(path, tmp_path / "out", "--workers", "1")
    wait_for_rows(process, tmp_path / "out", 1)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to workers as well
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "give the same command again to resume" in err
    assert "Traceback" not in err
    assert read_csv(tmp_path / "out" / "results.csv")


def test_jobs_that_fail_say_why_and_the_others_go_on(tmp_path):
    """No traffic: no entropy. A place with no road. A layout that is elsewhere. And searches."""
    (tmp_path / "broken.xodr").write_text("<OpenDRIVE/>")
    (tmp_path / "far.yaml").write_text(LAYOUT)
    path = write(
        tmp_path,
        scenes=[{"built_in": "four_way"}, {"map": "broken.xodr", "junction": 1}],
        layouts=["L-c", "far.yaml"],
        settings=dict(radius=20, voxel=2, frames=2, density=[0, 5], method=["none", "random"],
                      evaluations=3),
    )  # fmt: skip
    told = []
    study = load_study(path)
    rows = sweep(study, tmp_path / "out", workers=1, progress=lambda *at: told.append(at))
    assert told == [(n, 16) for n in range(17)]
    names = ("scene", "density", "layout", "method")
    errors = {tuple(row[name] for name in names): row["error"] for row in rows}
    assert "needs traffic" in errors["four_way", "0", "L-c", "none"]
    assert "is this layout for another scene" in errors["four_way", "5", "far away", "none"]
    assert "broken.xodr" in errors["broken 1", "5", "L-c", "none"]
    done = [tuple(row[name] for name in names) for row in rows if row["status"] == "done"]
    assert done == [("four_way", "5", "L-c", method) for method in ("none", "random")]
    assert not any(errors[row] for row in done)
    (found,) = (row for row in rows if row["status"] == "done" and row["method"] == "random")
    assert float(found["surrogate"]) >= float(found["surrogate_before"]) > 0
    moved = load_layout(tmp_path / "out" / "layouts" / f"{found['key']}.yaml")
    scene = build_scene(built_in("four_way"), radius=20, voxel=2, frames=2, density=5)
    assert evaluate(scene, moved).surrogate == pytest.approx(float(found["surrogate"]), abs=1e-6)
    told.clear()
    with in_this_process() as running:
        again = sweep(
            study, tmp_path / "out", scheduler=running.scheduler_address,
            progress=lambda *at: told.append(at),
        )  # fmt: skip
    assert again == rows
    assert told == [(n, 16) for n in range(2, 17)]  # those that were done are not done again


@pytest.mark.process
def test_a_job_that_kills_its_workers_takes_no_other_with_it(tmp_path, monkeypatch):
    """Dask suspects every job that a dead worker had before it."""
    (tmp_path / "deadly.yaml").write_text(LAYOUT.replace("far away", "deadly"))
    path = write(
        tmp_path, scenes=[{"built_in": "four_way"}], layouts=["L-c", "L-d1", "deadly.yaml", "L-d2"],
        settings=dict(radius=20, voxel=2, frames=2, density=5),
    )  # fmt: skip
    monkeypatch.setattr("inspe_jax.study.sweep.run_job", deadly.work)
    rows = sweep(load_study(path), tmp_path / "out", workers=1)
    assert [row["status"] for row in rows] == ["done", "done", "failed", "done"]
    assert "KilledWorker" in rows[2]["error"]


def test_bad_options(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "TIMEOUT", 0.3)
    study = load_study(write(tmp_path))
    with pytest.raises(InspeError, match="workers 0: give 1 or more"):
        sweep(study, tmp_path / "out", workers=0)
    with pytest.raises(InspeError, match=r"scheduler '127.0.0.1:1' does not answer"):
        sweep(study, tmp_path / "out", scheduler="127.0.0.1:1")
