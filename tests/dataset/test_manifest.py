"""Manifests: damage of every sort is found, and `generate` repairs it to the same bytes."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import made_up
import numpy as np
import pytest
from frames import car, frame, scan, station
from typer.testing import CliRunner

import inspe_jax.cli  # noqa: F401, which adds the commands
from inspe_jax.cli.common import app
from inspe_jax.core.files import prepare_folder
from inspe_jax.dataset import Scenario
from inspe_jax.dataset.generate import DatasetWriter
from inspe_jax.dataset.manifest import MANIFEST, RECORDS, check, manifest_of
from inspe_jax.dataset.plan import make_generation
from inspe_jax.dataset.points_in_boxes import with_counts

FRAMES = 4
STUDY = dict(
    scenes=[{"built_in": "four_way"}],
    layouts=["Cam-d1/L-d1"],
    settings=dict(radius=15, voxel=2, density=5, seconds=FRAMES / 10, light=["midday", "night"]),
    layers=["depth"],
)


def record(plan_of, out: Path) -> dict[str, list]:
    """What `generate` does, without processes; gives what was repaired."""
    writer = DatasetWriter(plan_of, prepare_folder(out), "embedded")
    for plan in plan_of.scenarios:
        if writer.place(plan).exists():
            continue
        made_up.record(writer, plan)
        assert writer.finish(plan)
    writer.clear()
    return writer.damage


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A set of two scenarios with a made-up recorder, and the plan of it."""
    folder = tmp_path_factory.mktemp("manifest")
    with pytest.MonkeyPatch.context() as patch:
        made_up.here(patch)
        plan = make_generation(STUDY, folder)
        assert record(plan, folder / "out") == {}
    return plan, folder / "out"


@pytest.fixture
def copy(made, tmp_path, monkeypatch):
    made_up.here(monkeypatch)
    plan, out = made
    shutil.copytree(out, tmp_path / "out")
    return plan, tmp_path / "out"


def scenario(out: Path) -> Path:
    return sorted(path.parent for path in out.rglob(MANIFEST))[0]


def test_a_whole_set_has_no_fault(made):
    _, out = made
    for deep in (False, True):
        found = check(out, deep)
        assert (found.scenarios, found.faults, found.unknown) == (2, (), ())
    files = [path for path in out.rglob("*") if path.is_file() and path.name[0] != "."]
    own = [path for path in files if path.name not in (MANIFEST, "generation.yaml")]
    assert found.files == len(own)
    assert found.size == sum(path.stat().st_size for path in own)
    manifest, _ = manifest_of(scenario(out))
    assert sorted(manifest.frames) == list(range(FRAMES))
    assert len(manifest.files) == found.files / 2


def flip_bit(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 0x40
    path.write_bytes(data)


def move_box(path: Path) -> None:
    text = path.read_text()
    first = text.index("location: [") + len("location: [")
    path.write_text(text[:first] + ("1" if text[first] != "1" else "2") + text[first + 1 :])


DAMAGE = [
    ("000001_camera0.png", Path.unlink, False, "is missing"),
    ("000001_camera0.png", lambda p: p.write_bytes(p.read_bytes()[:-9]), False, "bytes long"),
    ("000001.pcd", lambda p: flip_bit(p, -30), True, "has changed"),
    ("000001.yaml", move_box, True, "has changed"),
]


@pytest.mark.parametrize(("file", "damage", "needs_deep", "what"), DAMAGE)
def test_damage_is_found_and_repaired(made, copy, file, damage, needs_deep, what):
    plan, out = copy
    path = next(path for path in sorted(scenario(out).rglob(file)))
    damage(path)
    (fault,) = check(out, deep=True).faults
    assert fault.path == path
    assert what in fault.what
    assert (check(out).faults == ()) == needs_deep
    ((repaired,),) = record(plan, out).values()
    assert repaired == fault
    assert made_up.content(out) == made_up.content(made[1])


def test_a_protocol_and_a_manifest_are_repaired(made, copy):
    plan, out = copy
    whole = made_up.content(made[1])
    place = scenario(out)
    (place / "data_protocol.yaml").write_bytes(b"world: {}\n")
    assert len(check(out).faults) == 1
    record(plan, out)
    assert made_up.content(out) == whole
    for text in (None, "{", '{"format": "inspe_jax manifest 1"}'):
        if text is None:
            (place / MANIFEST).unlink()
            assert check(out).unknown == (place,)
        else:
            (place / MANIFEST).write_text(text)
            assert len(check(out).faults) == 1
        assert len(record(plan, out)) == 1
        assert made_up.content(out) == whole


def test_a_scenario_that_is_gone_and_files_too_many(copy):
    """A stray JPEG beside the PNG is not read in its place, and left alone."""
    plan, out = copy
    place = scenario(out)
    (png, *_) = sorted(place.rglob("000001_camera0.png"))
    before = Scenario(place).frame(1).stations[0].images[0].rgb
    stray = png.with_suffix(".jpg")
    stray.write_bytes(png.read_bytes()[:50])
    (place / ".DS_Store").touch()
    assert record(plan, out) == {}
    np.testing.assert_array_equal(Scenario(place).frame(1).stations[0].images[0].rgb, before)
    other = next(path.parent for path in out.rglob(MANIFEST) if path.parent != place)
    shutil.rmtree(other)
    assert {(fault.path, fault.what.split(":")[0]) for fault in check(out).faults} == {
        (other, "is missing"), (stray, "not in the manifest"),
    }  # fmt: skip


def test_a_manifest_that_lists_too_little_is_no_proof(made, copy):
    """With a frame gone from the manifest and from the disk, nothing else would show it."""
    plan, out = copy
    place = scenario(out)
    for change in (lambda files: files.pop("2"), lambda files: files.clear()):
        given = json.loads((place / MANIFEST).read_text())
        gone = list(given["frames"].get("2", ()))
        change(given["frames"])
        (place / MANIFEST).write_text(json.dumps(given))
        for name in gone:
            (place / name).unlink()
        told = [fault.what for fault in check(out).faults if fault.path == place / MANIFEST]
        assert told == [f"does not list all files of {FRAMES} frames"]
        assert len(record(plan, out)) == 1
        assert made_up.content(out) == made_up.content(made[1])


@pytest.mark.parametrize("text", ["", '{"a": 3}'])
def test_a_broken_record_of_a_frame_counts_as_none(made, copy, text):
    """Nor do those with a file that was changed, or left empty by a crash of the machine."""
    plan, out = copy
    one = plan.scenarios[0]
    writer = DatasetWriter(plan, out, "embedded")
    shutil.rmtree(writer.place(one))
    made_up.record(writer, one)
    folder = writer.unfinished(one)
    (folder / RECORDS / "000001.json").write_text(text)
    (folder / "-1" / "000002.pcd").write_bytes(b"")
    flip_bit(folder / "-1" / "000003.pcd", -30)
    assert not writer.finish(one)
    assert writer.there[one.name] == {0, 3}  # by sizes
    writer = DatasetWriter(plan, out, "embedded")
    assert writer.there[one.name] == {0}
    record(plan, out)
    assert made_up.content(out) == made_up.content(made[1])


@pytest.mark.parametrize("ended", ["rmtree", "replace"])
def test_a_kill_while_a_scenario_is_finished_leaves_no_records_in_it(
    made, copy, monkeypatch, ended
):
    plan, out = copy
    (one, _) = plan.scenarios
    shutil.rmtree(out / one.split / one.name)

    real = getattr(os if ended == "replace" else shutil, ended)

    def killed(path, *given):
        if Path(path).is_dir():  # not where a file gets its name
            raise KeyboardInterrupt
        real(path, *given)

    writer = DatasetWriter(plan, out, "embedded")
    with monkeypatch.context() as patch:
        made_up.record(writer, one)
        patch.setattr(os if ended == "replace" else shutil, ended, killed)
        with pytest.raises(KeyboardInterrupt):
            writer.finish(one)
        assert (writer.place(one) / RECORDS).exists() == (ended == "rmtree")
        assert (writer.unfinished(one) / RECORDS).exists() == (ended == "replace")
    record(plan, out)
    assert made_up.content(out) == made_up.content(made[1])


def test_a_manifest_that_points_out_of_its_folder_is_rejected(copy):
    path = scenario(copy[1]) / MANIFEST
    given = json.loads(path.read_text())
    for name in ("../../generation.yaml", "/etc/hostname", "a\0b"):
        more = given["files"] | {name: [1, "0" * 64]}
        path.write_text(json.dumps(given | {"files": more}))
        manifest, (fault,) = manifest_of(path.parent)
        assert manifest is None
        assert "must be the size and the digest" in fault.what


def test_the_command(copy, tmp_path):
    _, out = copy
    run = CliRunner().invoke
    whole = run(app, ["dataset", "check", str(out), "--deep"])
    assert (whole.exit_code, "2 scenarios" in whole.output) == (0, True)
    path = next(iter(sorted(scenario(out).rglob("*.pcd"))))
    path.write_bytes(b"")
    told = run(app, ["dataset", "check", str(out), "--json", str(tmp_path / "faults.json")])
    assert told.exit_code == 1
    assert f"{path}: is 0 bytes long" in told.stderr
    (fault,) = json.loads((tmp_path / "faults.json").read_text())["faults"]
    assert fault["file"] == str(path)
    assert run(app, ["dataset", "stats", str(out)]).exit_code == 1


def test_counts_where_a_recorder_tells_none():
    here = station(1, cameras=1, lidars=0)
    points = np.array([[0.0, 0.0, 0.0, 1.0], [30.0, 0.0, 0.0, 1.0]])
    on = replace(scan(), pose=np.array([10.0, 20.0, 0.75, 0, 0, 0]), points=points)
    instance = np.zeros_like(here.images[0].instance)
    instance[0, :3] = 4  # track 3
    shown = replace(here.images[0], instance=instance)
    given = frame(boxes=[car(3)], stations=[replace(here, images=(shown,), scans=(on,))])
    (found,) = with_counts(given).stations
    assert found.scans[0].returns.tolist() == [1]
    assert found.images[0].pixels.tolist() == [3]
