"""The command line as a stranger meets it: what it prints, what it writes, how it fails."""

import inspect
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import jax
import numpy as np
import pytest
import typer
from processes import cases, inspe_process, refused
from rich.text import Text

from inspe_jax.cli import stopping
from inspe_jax.cli.claims import Claims
from inspe_jax.cli.common import MODULES, app, err, out
from inspe_jax.core.errors import missing_extra
from inspe_jax.core.files import read_csv, write_text
from inspe_jax.core.kept import keep_programs, prune
from inspe_jax.core.tables import table_of
from inspe_jax.core.words import visible
from inspe_jax.placement.result import FILES
from inspe_jax.placement.studies.tolerance import Slopes, Tolerance, tolerance
from inspe_jax.scene.scene import save_scene

LAYOUT = """
units:
  - base: [8.0, 8.0]
    sensors:
      - {device: paper-camera, height: 6.0, yaw_deg: -135, pitch_deg: -20}
      - {device: paper-lidar-32, height: 5.0, yaw_deg: 0}
"""

# On a corner of the four-way, with its back to the traffic: easily bettered.
AWAY = """
units:
  - base: [9.6, 9.6]
    sensors:
      - {device: paper-camera, height: 6.0, yaw_deg: 45, pitch_deg: -20}
"""


STUDY = "scenes: [{file: s.npz}]\nlayouts: [layout.yaml, L-c]\nsettings: {light: [%s]}\n"


@pytest.fixture(scope="module")
def files(tmp_path_factory, scene):
    """A small scene, layouts, and files that are none."""
    folder = tmp_path_factory.mktemp("files")
    save_scene(scene, folder / "s.npz")
    (folder / "layout.yaml").write_text(LAYOUT)
    (folder / "away.yaml").write_text(AWAY)
    (folder / "none.yaml").write_text("")
    for name, light in (("study", "midday, night"), ("dark", "dark")):
        (folder / f"{name}.yaml").write_text(STUDY % light)
    (folder / "zero.npz").write_bytes(b"")
    (folder / "rule.yaml").write_text(LAYOUT.replace("yaw_deg: 0", "yaw_deg: 0, offset: [3, 0]"))
    (folder / "page.xodr").write_text("<html></html>")
    (folder / "cut.xodr").write_text("<OpenDRIVE><road id='1'>")
    return folder


def test_score_prints_a_table_and_the_same_numbers_as_json(run, scored, files):
    table = run("score", "s.npz", "layout.yaml", "--json", "scores.json")
    record = scored("s.npz", "layout.yaml")
    assert record == json.loads((files / "scores.json").read_text())
    for name in ("coverage", "occlusion", "information_gain", "surrogate"):
        assert 0 < record[name] < 1
        assert f"{record[name]:.3f}" in table
    assert len(record["contributions"]) == 2


def test_targets_prints_tables_and_the_same_numbers_as_json(run, files):
    given = ("targets", "s.npz", "layout.yaml", "--road-user", "cyclist")
    table = run(*given, "--plot", "targets.png", "--json", "targets.json")
    assert "on a cyclist" in table
    assert (files / "targets.png").stat().st_size > 10_000
    record = json.loads((files / "targets.json").read_text())
    assert record["road_user"] == "cyclist"
    assert f"{record['lidar_returns']['all']['median']:.1f}" in table


@pytest.mark.process
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_view_serves_until_it_is_stopped(files, stop):
    """In a process of its own, as a stranger meets it; also a layout that breaks a rule."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        arguments = ("view", "s.npz", "rule.yaml", "--port", str(port), "--out", "moved.yaml")
        with inspe_process(*arguments, cwd=files) as served:
            try:
                url = served.stdout.readline().split()[-1]
                assert "only this machine can" in served.stdout.readline()
                assert "Ctrl-C ends" in served.stdout.readline()
                with urlopen(url) as page:
                    assert b"<html" in page.read()
                with pytest.raises(HTTPError) as refused:
                    urlopen(f"http://{urlsplit(url).netloc}/")
                refused.value.close()
                served.send_signal(stop)
                words, said = served.communicate(timeout=60)  # also while it compiles
            finally:
                served.kill()
    assert served.returncode == 0
    assert url.startswith("http://127.0.0.1:")
    assert not url.startswith(f"http://127.0.0.1:{port}/")
    assert len(urlsplit(url).path) > 20  # a token
    assert f"port {port} is not available" in said
    assert "refused a request: it does not have the token" in said
    assert "not saved" not in words  # nothing was changed
    assert "Traceback" not in said
    assert not (files / "moved.yaml").exists()


def test_a_strategy_is_written_and_scores_as_by_name(run, scored):
    run("layout", "s.npz", "--strategy", "cam-d1/l-d1", "--out", "placed.yaml")
    by_file = scored("s.npz", "placed.yaml")
    by_name = scored("s.npz", "Cam-d1/L-d1")
    # The file keeps 0.1 mm and 0.0001°.
    assert by_file["surrogate"] == pytest.approx(by_name["surrogate"], abs=1e-3)


def test_a_scene_is_saved_and_says_what_it_has_and_what_its_roads_could_not_hold(inspe):
    arguments = ("--radius", 20, "--voxel", 1, "--spacing", 2, "--density", 60, "--frames", 2)
    bodies = ("--statics", "street", "--out", "t.npz")
    status, text, told = inspe("scene", "triangle", *arguments, *bodies)
    assert status == 0
    words = " ".join(text.split())
    assert re.search(r"static bodies .*parked vehicle \d+, .*tree \d+.* statics street", words)
    shortfall = r"Note: road users: asked 60, got \d.*: cars \d.* of 41, trucks \d.* of 6"
    assert re.search(shortfall, " ".join(told.split()))
    assert inspe("scene", "t.npz")[1] == text.removesuffix("saved t.npz\n")


def test_what_is_known_is_listed(inspe):
    text = inspe("metrics")[1]
    for name, symbol, weight in (("coverage", "C", 0.3), ("information_gain", "IG", 0.2)):
        assert re.search(rf"{name} +{symbol} +{weight} +\w+", text)
    assert re.search(r"surrogate +P_sm +the weighted sum", text)
    assert "paper-lidar-64" in inspe("devices")[1]
    assert "ideal" in inspe("profiles")[1]
    assert "roundabout" in inspe("scene", "--list")[1]
    assert inspe("--version")[1].startswith("inspe_jax 1.")


def test_optimise_writes_a_better_layout_and_shows_it(inspe, scored, files):
    """The file it writes scores as it says."""
    arguments = ("s.npz", "away.yaml", "--method", "random", "--evaluations", 120, "--out", "o")
    status, text, error = inspe("optimise", *arguments)
    assert (status, error) == (0, "")
    assert {path.name for path in (files / "o").iterdir()} == {*FILES, "before_after.png"}
    record = json.loads((files / "o" / "result.json").read_text())
    assert record["objective"] > record["objective_before"] + 0.01
    for layout, key in (("layout.yaml", "scores"), ("start.yaml", "scores_before")):
        again = scored("s.npz", f"o/{layout}")
        assert again["surrogate"] == pytest.approx(record[key]["surrogate"], abs=1e-4)
        assert f"{record[key]['surrogate']:.3f}" in text
    assert (files / "o" / "before_after.png").read_bytes().startswith(b"\x89PNG")
    assert "random, seed 0: budget spent" in text
    assert "next: inspe score s.npz o/layout.yaml" in text


def test_optimise_goes_on_from_its_checkpoint_and_takes_every_option(inspe, run, files):
    arguments = ("s.npz", "away.yaml", "--method", "random", "--evaluations", 3, "--out", "p")
    options = (
        *("--also", "s.npz", "--worst", "--places", "areas", "--heights", 4, 8, "--seed", 5),
        *("--weight", "coverage=0.5", "--weight", "occlusion=0.5"),
        *("--start", "random", "--checkpoint", "c.npz"),
    )
    run("optimise", *arguments, *options)
    settings = json.loads((files / "p" / "result.json").read_text())["settings"]
    assert (settings["start"], settings["budget"]["evaluations"]) == ("random", 3)
    assert settings["objective"]["over"] == "worst"
    weights = {"coverage": 0.5, "occlusion": 0.5, "information_gain": 0.0}
    assert settings["objective"]["weights"] == weights
    assert settings["constraints"]["places"] == "areas"
    assert settings["constraints"]["heights"] == [4, 8]
    assert len(settings["scenes"]) == 2
    assert "c.npz has a search that has ended" in inspe("optimise", *arguments, *options)[2]
    status, _, error = inspe("optimise", *arguments, "--checkpoint", "c.npz")
    assert status == 2
    assert "c.npz: a checkpoint of another search, with another scene, another" in error


def test_compare_ranks_methods(run, files):
    arguments = ("--methods", "random, grid", "--evaluations", 40, "--seeds", 2, "--out", "v")
    text = run("compare", "s.npz", "away.yaml", *arguments)
    assert {path.suffix for path in (files / "v").iterdir()} == {".csv", ".png", ".yaml"}
    rows = read_csv(files / "v" / "compare.csv")
    runs = [(row["method"], row["seed"]) for row in rows]
    assert runs == [("random", "0"), ("random", "1"), ("grid", "0"), ("grid", "1")]
    assert f"{max(float(row['objective']) for row in rows):.4f}" in text
    assert {row["method"] for row in read_csv(files / "v" / "history.csv")} == {"random", "grid"}


def test_pareto_finds_what_is_worth_its_money(run, files):
    devices = ("--device", "velodyne-vlp-16:0,1", "--device", "paper-camera:0-1")
    prices = ("--price", "paper-camera=1,000")
    arguments = ("--method", "random", "--evaluations", 3, "--out", "w")
    text = run("pareto", "s.npz", *devices, *prices, *arguments)
    rows = read_csv(files / "w" / "pareto.csv")
    assert [float(row["cost_usd"]) for row in rows] == [1000, 4000, 5000]
    front = [row for row in rows if row["layout"]]
    there = {"pareto.csv", "pareto.png", *(row["layout"] for row in front)}
    assert {path.name for path in (files / "w").iterdir()} == there
    assert all(f"{float(row['objective']):.4f}" in text for row in front)


def test_tolerance_prints_and_writes_the_same(run, files, monkeypatch):
    def found(case, layout, *, objective, progress, **errors):
        inspect.signature(tolerance).bind(case, layout, objective=objective, **errors)
        asked.append(errors)
        slopes = (Slopes(layout.sensors[0].name, 0.01, 0.0, -0.02, 0.1, 0.3),)
        settings = dict(position=0.2, angle_deg=2.0, samples=3, **case.conditions.record)
        return Tolerance(0.7654321, slopes, np.array([0.71, 0.72, 0.73]), settings)

    asked = []
    monkeypatch.setattr("inspe_jax.cli.score.installed", found)
    arguments = ("--samples", 3, "--position", 0.2, "--angle", 2, "--json", "t.json")
    text = run("tolerance", "s.npz", "away.yaml", *arguments)
    assert asked == [dict(position=0.2, angle=np.radians(2), samples=3, seed=0)]
    record = json.loads((files / "t.json").read_text())
    assert (record["score"], record["left"]) == (0.7654321, [0.71, 0.72, 0.73])
    assert (record["slopes"][0]["pitch_per_deg"], record["settings"]["angle_deg"]) == (0.3, 2.0)
    for number in ("0.7654", "0.7200", "-0.0454", "+0.30000", "-0.02000"):
        assert number in text


def test_light_and_weather(inspe, scored, files):
    """In a score; and in a search, where every light is a scene of its own. Its start stands in
    the middle of the junction, and is moved."""
    assert "dusk, clear" in inspe("score", "s.npz", "layout.yaml", "--light", "dusk")[1]
    (files / "road.yaml").write_text(AWAY.replace("base: [9.6, 9.6]", "base: [3.0, 0.0]"))
    both = ("--light", "midday,night", "--weather", "fog:50", "--worst")
    arguments = ("--method", "random", "--evaluations", 2, "--out", "foggy")
    status, _, error = inspe("optimise", "s.npz", "road.yaml", *both, *arguments)
    assert status == 0
    assert "Note: unit 'unit 1' moved" in error
    record = json.loads((files / "foggy" / "result.json").read_text())
    lights = [row["light"] for row in record["settings"]["scenes"]]
    assert lights == ["midday", "night"]
    night = ("--light", "night", "--weather", "fog:50")
    start = scored("s.npz", "foggy/start.yaml", *night)
    assert (start["settings"]["light"], start["settings"]["weather"]) == ("night", "fog:50")
    assert record["objective_before"] == pytest.approx(start["surrogate"], abs=1e-4)


def test_a_study_is_counted_before_it_is_run(run, files):
    assert "study: 4 jobs, 2 layouts on 1 scene" in run("sweep", "study.yaml", "--dry-run")
    assert not (files / "sweep").exists()


def test_a_data_set_is_checked_and_counted_before_it_is_made(inspe, files):
    text = (
        "scenes: [{built_in: four_way, radius: 15, voxel: 2}]\nlayouts: [layout.yaml, L-c]\n"
        "settings: {light: [midday, night], seconds: 1}\nimage_size: [80, 60]\n"
    )
    (files / "set.yaml").write_text(text)
    _, words, notes = inspe("generate", "set.yaml", "--out", "set", "--dry-run")
    assert "set: 4 scenarios (4 train, 0 validate, 0 test), 40 frames" in words
    assert re.search("train +1 +4 +40", words)
    assert "test is empty: 1 scene for 3 splits; give more values of seed, or another" in notes
    status, _, words = inspe("generate", "set.yaml", "--out", "set", "--dry-run", "--server", "sim")
    assert status == 2
    assert "server sim:2000: goes with backend carla, and this is embedded" in words
    assert not (files / "set").exists()


def test_every_command_has_examples_and_says_what_its_options_are():
    count = 0
    for module in MODULES.values():
        import_module(f"inspe_jax.cli.{module}")
    for name, group in typer.main.get_command(app).commands.items():
        for word, command in getattr(group, "commands", {"": group}).items():
            example = f"Examples?:.*`inspe {name} {word}".strip()
            assert re.search(example, command.help, re.DOTALL), (name, word)
            assert all(one.help for one in command.params), (name, word)
            count += 1
    assert count > 20


@pytest.mark.process
def test_help_has_a_line_of_every_command_and_imports_no_jax():
    code = "import atexit, sys; atexit.register(lambda: print('jax' in sys.modules))\n"
    code += "from inspe_jax.cli import main; main()"
    ran = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True)
    assert ran.stdout.endswith("\nFalse\n")
    assert re.findall(r"^│ (\w+) +[A-Z]\w+ \w", ran.stdout, re.MULTILINE) == [*MODULES]


@pytest.mark.parametrize(("arguments", "message"), cases(
    (("score", "none.npz"), "none.npz: no such file"),
    (("score", "s.npz", "zero.npz"), "no layout: is a scene, which comes before the layout"),
    (("score", "s.npz", "town.xodr"), "no layout: a map is not a scene yet; build one: inspe sc"),
    (("score", "s.npz", "layout.yaml", "--plot", "plan.xyz"), "plan.xyz"),
    (("score", "s.npz", "layout.yaml", "--weight", "coverage"), "coverage=0.3"),
    (("score", "s.npz", "layout.yaml", "--weight", "coverag=1"), "did you mean coverage"),
    (("score", "s.npz", *("--weight", "coverage=1") * 2), "coverage is given twice"),
    (("score", "s.npz", "layout.yaml", "--json", "no/such/folder.json"), "no such folder"),
    (("scene", "four_way", "--out", "s2.npz", "--plot", "b.xyz"), "must end in .png"),
    (("layout", "four_way", "--out", "l.txt"), "must end in .yaml"),
    (("scene", "four_way", "--region-weight", "kerb=1"), "region_weight: region 'kerb': one of"),
    (("scene", "nosuch", "--list"), "no scene 'nosuch': give a built-in (four_way"),
    (("scene", "four_way", "--junction", 3), "a built-in intersection is no map; leave out --ju"),
    (("scene", "four_way", "--radius", 500), "radius 500 m is out of range"),
    (("scene", "s.npz", "--region-weight", "sidewalk=1", "--radius", 30),
     "a saved scene keeps the settings it was built with; leave out --radius, --region-weight"),
    (("scene", "page.xodr"), "choose a place on the map with --junction ID, --at LAT,LON or"),
    (("scene", "four_way", "--frames", 10**9), "at most 10000"),
    (("scene", "four_way", "--traffic", "a.log", "--seed", 1), "what was recorded has all of this"),
    (("scene", "cut.xodr", "--list"), "cut.xodr"),
    (("sweep", "missing.yaml"), "missing.yaml: no such file"),
    (("sweep", "dark.yaml"), "dark.yaml: settings.light: light 'dark': one of midday, dusk, night"),
    (("generate", "missing.yaml", "--out", "no/such"), "no/such: no such folder: no"),
    (("generate", "none.yaml", "--out", "set", "--server", "sim:two"), "server 'sim:two': HOST"),
    (("optimise", "s.npz", "--worst"), "add scenes with --also"),
    (("optimise", "nosuch", "--out", "no/such"), "no/such: no such folder: no"),
    (("optimise", "nosuch", "--out", "s.npz"), "s.npz: is a file; name a folder"),
    (("optimise", "nosuch", "--checkpoint", "c.txt"), "c.txt: the name must end in .npz"),
    (("optimise", "nosuch", "--heights", 9, 3), "heights 9 to 3 m"),
    (("optimise", "s.npz", "layout.yaml", "--failures"), "at least two units, it has one"),
    (("pareto", "s.npz", "--device", "hesai-xt32"), "--device hesai-xt32: write DEVICE:COUNTS"),
    (("pareto", "s.npz", "--device", "hesai-xt32:0-2"), "--price hesai-xt32=USD"),
    (("scene", "four_way", "--out", "s2.txt"), "must end in .npz"),
    (("pareto", "s.npz", "--device", "a:1", "--device", "a:2"), "a is given twice"),
    (("pareto", "s.npz", "--price", "hesai-xt32"), "DEVICE=USD, such as"),
    (("report", "nosuch", "--out", "report.pdf"), "report.pdf: the name must end in .html"),
    (("report", "s.npz", "--frame", 99), "frame 99 is out of range"),
    (("report", "s.npz", "."), "result.json: no such file"),
    (("view", "nosuch", "--out", "moved.json"), "moved.json: the name must end in .yaml"),
))  # fmt: skip
def test_bad_input_is_one_message_and_status_2(inspe, files, arguments, message):
    refused(inspe, files, arguments, message)


@pytest.mark.parametrize(("arguments", "message"), cases(
    (("score", "four_way", "missing.yaml"), "missing.yaml: no such file"),
    (("score", "four_way", "Cam-d3"), "no layout 'Cam-d3': give a .yaml or .geojson file, or"),
    (("targets", "four_way", "missing.geojson"), "missing.geojson: no such file"),
    (("targets", "four_way", "--road-user", "dog"), "one of car, truck, cyclist, pedestrian"),
    (("layout", "four_way", "--strategy", "L-x"), "no layout 'L-x'"),
    (("layout", "four_way", "--from", "none.json"), "none.json: no such file"),
    (("layout", "four_way", "--from", "s.npz", "--strategy", "L-c"), "leave out --strategy"),
    (("layout", "four_way", "--crs", "EPSG:25832"), "these go with a calibration; leave out --crs"),
    (("layout", "four_way", "--from", "s.npz", "--transform", "1"), "--transform 1: write X,Y,Z"),
    (("layout", "four_way", "--from", "s.npz", "--size", "9"), "--size 9: write WIDTHxHEIGHT"),
    (("layout", "four_way", "--camera", "paper-camera-noon"), "did you mean paper-camera"),
    (("optimise", "four_way", "--method", "adm"), "method 'adm': one of adam"),
    (("optimise", "four_way", "--start", "givn"), "did you mean given"),
    (("optimise", "four_way", "--also", "missing.npz"), "missing.npz: no such file"),
    (("optimise", "four_way", "--out", "/proc/o"), "/proc: no file can be written there"),
    (("optimise", "four_way", "--target", 1, "--device", "a:1"), "device 'a'"),
    (("optimise", "four_way", "--poles", 3), "--poles is for a mix: give --device"),
    (("optimise", "four_way", "--target", 1, "--poles", 3), "are for one mix: leave out --target"),
    (("optimise", "four_way", "--pole-price", 2), "pole_price 2: what a new pole must gain"),
    (("compare", "four_way", "--methods", "grid,grid"), "one is named twice"),
    (("compare", "four_way", "--out", "mine"), "mine/layout.yaml: is there already, and `inspe"),
    (("tolerance", "four_way", "--angle", 90), "angle 90° is out of range"),
    (("report", "four_way", "--out", "mine/r.html"), "r.html: is there already, and `inspe"),
    (("scene", "page.xodr", "--junction", 1, "--traffic", "no.log"), "no.log: no such file"),
    (("scene", "page.xodr", "--junction", 1, "--traffic", "page.log"), "not a log of CARLA"),
    (("scene", "page.xodr", "--junction", 1, "--mesh", "no.glb"), "no.glb: no such file"),
))  # fmt: skip
def test_what_needs_no_scene_is_refused_before_one_is_read(
    inspe, files, monkeypatch, arguments, message
):
    """To build the scene, or to read the map, takes up to minutes."""

    slow = Mock(side_effect=pytest.fail.Exception("the scene was read first"))
    for name in ("scene.scene.build_voxels", "cli.scene.read_map"):
        monkeypatch.setattr(f"inspe_jax.{name}", slow)
    (files / "mine").mkdir(exist_ok=True)
    for name in ("mine/layout.yaml", "mine/r.html", "page.log"):
        (files / name).write_text("mine")
    refused(inspe, files, arguments, message)
    assert (files / "mine" / "layout.yaml").read_text() == "mine"


WRITES = [
    ("layout", "s.npz", "--out", "own.yaml"),
    ("score", "s.npz", "layout.yaml", "--json", "own.json"),
    ("optimise", "s.npz", "away.yaml", "--method", "random", "--evaluations", 1, "--out", "own"),
]


@pytest.mark.parametrize("arguments", WRITES, ids=[row[0] for row in WRITES])
def test_a_command_replaces_what_it_wrote_itself_alone(inspe, run, files, arguments):
    """And not when somebody has changed that since, nor what another command wrote."""
    path = files / arguments[-1]
    if not path.suffix:
        path.mkdir()
        path /= "layout.yaml"
    path.write_bytes(b"mine")

    def refused(*words):
        before = path.read_bytes()
        status, _, error = inspe(*arguments)
        assert (status, path.read_bytes()) == (2, before)
        for word in (path.name, "--force", *words):
            assert word in error

    refused("is there already", f"`inspe {arguments[0]}` did not write it")
    run(*arguments, "--force")
    assert path.read_bytes() != b"mine"
    run(*arguments)
    path.write_bytes(path.read_bytes() + b"# mine")
    refused("was changed since")
    status, _, error = inspe("score", "s.npz", "layout.yaml", "--json", path)
    assert (arguments[0] == "score") == ("was changed since" in error)
    assert status == 2


def test_what_was_written_before_ctrl_c_is_a_commands_own(tmp_path):
    claims, path = Claims(), tmp_path / "layout.yaml"
    for _ in range(2):  # the second time, it may be replaced
        claims.begin("optimise")
        claims.file(path, force=False)
        write_text(path, "found")
        claims.record()  # as where the process is left at once


@pytest.mark.parametrize("name", ["L [/x]", "L [bold]x", "a\x1b]0;b\u202ec"])
def test_names_are_printed_as_they_are_without_control_characters(name, capsys):
    out.print(f"wrote {name}")
    err.print(Text(name))
    table = table_of("names", "name")
    table.add_row(name)
    out.print(table)
    printed = capsys.readouterr()
    assert printed.out.count(visible(name)) == 2
    assert not {"\x1b", "\u202e"} & {*printed.out}


def test_what_cannot_be_written_after_the_work_is_kept_elsewhere(tmp_path, capsys):
    claims = Claims()
    claims.begin("optimise")
    kept = claims.keep(lambda at: write_text(at, "found"), tmp_path / "gone" / "layout.yaml")
    assert kept.read_text() == "found"
    error = capsys.readouterr().err
    assert f"no such folder: {tmp_path / 'gone'}; kept in {kept} instead" in error
    with pytest.raises(typer.Exit) as ended:
        claims.end()
    assert ended.value.exit_code == 1


HERE = "file:///home/a%20b/inspe"


@pytest.mark.parametrize(("origin", "command"), [
    (None, "pip install 'inspe_jax[carla]' (Linux"),
    ({"url": HERE, "dir_info": {}}, "in /home/a b/inspe: pip install '.[carla]' (Linux"),
    ({"url": HERE, "dir_info": {"editable": True}}, "inspe: pip install -e '.[carla]'"),
    ({"url": "https://a.org/i.git", "vcs_info": {"vcs": "git"}},
     "pip install 'inspe_jax[carla] @ git+https://a.org/i.git'"),
])  # fmt: skip
def test_missing_extra_says_what_to_install(monkeypatch, origin, command):
    """As this package was installed: from a registry, a folder or an address."""
    text = SimpleNamespace(read_text=lambda _: origin and json.dumps(origin))
    monkeypatch.setattr("inspe_jax.core.errors.metadata.distribution", lambda _: text)
    assert command in str(missing_extra("recording needs it", "carla", "Linux and Windows"))


EXTRAS = {
    "view": "view",
    "report": "report",
    "generate set.yaml --out set": "dataset",
    "train set --model v2x-vit --out run": "perception",
}


@pytest.mark.process
def test_without_extras_the_base_scores_and_draws_and_the_rest_says_what_to_install(tmp_path):
    brought = "dask distributed embreex equinox fastkml filelock jinja2 msgspec pyproj viser"
    small = "scene t_junction --radius 15 --voxel 1 --frames 3 --density 5 --out t.npz"
    code = f"""import sys
sys.modules |= dict.fromkeys({brought.split()!r})
from inspe_jax.cli import main
for command in {[small, "score t.npz L-d1 --plot plan.png", *EXTRAS]!r}:
    sys.argv[1:] = command.split()
    try:
        main()
    except SystemExit as ended:
        assert (ended.code or 0) == 2 * (command in {[*EXTRAS]!r})
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "plan.png").exists()
    for command, extra in EXTRAS.items():
        assert re.search(rf"`inspe {command.split()[0]}` needs \w+.*\[{extra}\]'", ran.stderr)


ON_ONE_CORE = """import os
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
"""
"""Two threads that trace at once may share parts of their code or not, as it comes: then JAX knows
a kernel by another name, and keeps it once more."""


def in_a_new_shell(files, cache, *arguments, code="from inspe_jax.cli import main; main()", **own):
    """(stdout, names of what was kept in the cache) of the command line in its own process."""
    own |= {key: str(cache) for key in ("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA")}
    other = ("JAX_", "INSPE_")
    env = {key: value for key, value in os.environ.items() if not key.startswith(other)}
    given = dict(env=env | own, cwd=files, capture_output=True, text=True)
    ran = subprocess.run([sys.executable, "-c", ON_ONE_CORE + code, *arguments], **given)
    assert ran.returncode == 0, ran.stderr
    told = f"what is compiled once is kept in {cache / 'inspe_jax'}", "nothing is kept of it"
    assert ran.stderr in ("", *(f"Note: compiling; {words}\n" for words in told))  # if it is long
    kept = {path.name for path in cache.rglob("*-cache") if "inspe_jax" in path.parts}
    return ran.stdout, kept


@pytest.mark.process
def test_what_is_compiled_is_kept_for_the_next_run(files, tmp_path):
    command = ("score", "s.npz", "away.yaml")
    first, kept = in_a_new_shell(files, tmp_path, *command)
    assert kept
    assert in_a_new_shell(files, tmp_path, *command) == (first, kept)


IN_PYTHON = """import sys, jax, jax.monitoring
heard = []
jax.monitoring.register_event_listener(lambda event, **_: heard.append(event))
import inspe_jax
try:
    if sys.argv[1:]:
        from inspe_jax.cli import main
        main()
except SystemExit:
    pass
jax.jit(lambda x: x + 1)(1.0)
print(sum(event.endswith("cache_hits") for event in heard))
"""


@pytest.mark.process
def test_what_python_compiles_is_kept_too_unless_it_is_not_wanted(files, tmp_path):
    shell = partial(in_a_new_shell, files, tmp_path, code=IN_PYTHON)
    assert shell(INSPE_CACHE="0") == ("0\n", set())
    assert shell("--no-cache", "metrics")[1] == set()
    first, kept = shell()
    assert (first, bool(kept)) == ("0\n", True)
    again, after = shell()
    assert int(again) == len(kept) == len(after)


def test_of_kept_programs_the_least_used_go_first(tmp_path):
    for name, age in (("a-cache", 3), ("b-cache", 1), ("c-cache", 2), ("times.json", 9)):
        (tmp_path / name).write_bytes(b"x" * 10)
        os.utime(tmp_path / name, (10**9 - age, 10**9 - age))
    prune(tmp_path, most=20)
    assert {path.name for path in tmp_path.iterdir()} == {"b-cache", "c-cache", "times.json"}


@pytest.mark.parametrize(("folder", "before"), [
    (Mock(side_effect=RuntimeError), None),  # no home
    (lambda *_, **__: Path("~/x"), None),
    (lambda *_, **__: Path("/dev/null/x"), None),
    (lambda *_, **__: pytest.fail("not asked for"), "/own"),
])  # fmt: skip
def test_nowhere_to_keep_what_is_compiled_is_no_error_and_ones_own_folder_stays(
    monkeypatch, folder, before
):
    monkeypatch.setattr("inspe_jax.core.kept.user_cache_path", folder)
    usual = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", before)
    try:
        keep_programs()
        assert jax.config.jax_compilation_cache_dir == before
    finally:
        jax.config.update("jax_compilation_cache_dir", usual)


# ── Ctrl-C, also where Python does not hear it ──


IN_XLA = """
import hashlib, threading
from inspe_jax.core import compiling
from inspe_jax.placement.problem import Problem
scores = iter([0.5] * {scores})
def exact(self, x):
    for score in scores:
        return score
    compiling._watch.hear(compiling.LOWERED, 0.0)
    # Said once the main thread is in C: in Python it would hear Ctrl-C itself.
    threading.Timer(1.0, print, ("compiles",), dict(flush=True)).start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # minutes of C
Problem.exact = exact
"""
LATER = "Note: stops once XLA has compiled, and keeps what it has; Ctrl-C again ends it now\n"


@pytest.mark.process
@pytest.mark.parametrize(("scores", "words"), [
    (0, ["", "stopped before the start was scored: nothing was searched, nothing is written"]),
    (1, [LATER, "stopped; not finished: searching"]),
])  # fmt: skip
def test_ctrl_c_is_answered_while_xla_compiles(files, tmp_path, scores, words):
    arguments = ("optimise", files / "s.npz", files / "layout.yaml", "--method", "random")
    before = IN_XLA.format(scores=scores)
    with inspe_process(*arguments, before=before, cwd=tmp_path) as process:
        try:
            assert process.stdout.readline() == "compiles\n"
            first, last = words
            if first:
                process.send_signal(signal.SIGINT)
                line = process.stderr.readline()
                while "compiling; " in line:
                    line = process.stderr.readline()
                assert line == first
            process.send_signal(signal.SIGINT)
            assert process.communicate(timeout=30)[1].splitlines()[-1].endswith(last)
            assert process.returncode == 130
        finally:
            process.kill()
    assert not list(tmp_path.iterdir())


def test_ctrl_c_that_a_callback_swallows_comes_again():
    class Falls:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        began = time.monotonic()
        with stopping.attended(print, sys.exit), pytest.raises(KeyboardInterrupt):
            time.sleep(30 if Falls() else 60)  # it falls at once
        assert time.monotonic() - began < 20
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("wrong", [AssertionError, RuntimeError])
def test_a_device_that_is_not_there_is_told_in_a_line(inspe, monkeypatch, wrong):
    fail = Mock(side_effect=wrong)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr("inspe_jax.report.tables.scores_of", fail)
    with pytest.raises(wrong):  # with devices it is this package's
        inspe("score", "s.npz", "layout.yaml")
    monkeypatch.setattr(jax, "devices", fail)
    status, _, error = inspe("score", "s.npz", "layout.yaml")
    assert status == 2
    assert re.fullmatch(r"Error: JAX_PLATFORMS=cuda: .* or set JAX_PLATFORMS=cpu\n", error)
