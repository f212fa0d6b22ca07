"""Every public name says what it is, and what the README shows runs."""

import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import inspe_jax

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(bash|python|yaml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ELSEWHERE = {
    "bin/inspe optimise": ".ci/run runs it, in a new environment",
    "bin/pytest": ".ci/run runs it, in a new environment",
    "inspe view": "it waits for a browser: tests/viewer opens one",
}
"""What a block that is not run here has in it, and why."""
SHORTER = {
    r"--seconds \d+": "--evaluations 2",
    r"(inspe (?:optimise|plan) (?!.*--evaluations).*)": r"\1 --evaluations 2",
    r" --frames \d+": "",
    r"(inspe scene (?=.*--out).*)": r"\1 --frames 8",
    r"  density: \[low, high\]": "  frames: 8\n  density: [low]",
    r":0-2|:0,2,4|:1-3": ":1-2",
    r"--seeds \d+": "--seeds 1",
    r"(inspe train .*)": r"\1 --steps 2",
    r"seconds=\d+": "evaluations=2",
    r'load_scene\("four_way"\)': 'build_scene("four_way", radius=20, frames=10)',
    r"seconds: \d+": "seconds: 0.5",
    r"--radius \d+": "--radius 20",
    r"radius: \d+": "radius: 20",
}
"""What takes long, and how much of it is enough here: only budgets, lengths and sizes."""
MODULES = [m.name for m in pkgutil.walk_packages(inspe_jax.__path__, "inspe_jax.")]


@pytest.mark.parametrize("name", inspe_jax.__all__)
def test_public_names_are_documented(name):
    thing = getattr(inspe_jax, name)
    if callable(thing):
        assert inspect.getdoc(thing), f"{name} has no docstring"


@pytest.mark.parametrize("module", MODULES)
def test_modules_and_their_public_functions_are_documented(module):
    loaded = importlib.import_module(module)
    assert loaded.__doc__ or module.endswith(("scene", "sensing", "placement", "report")), module
    for name, thing in vars(loaded).items():
        own = getattr(thing, "__module__", None) == module
        if own and not name.startswith("_") and inspect.isroutine(thing):
            assert inspect.getdoc(thing), f"{module}.{name} has no docstring"


def test_contributing_names_files_that_are_there():
    package = Path(inspe_jax.__file__).parent
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`([a-z0-9_./]+(?:\.py|\.toml|/))`", text)
    assert len(named) > 20
    missing = [
        name
        for name in named
        if "/" in name and not (ROOT / name).exists() and not (package / name).exists()
    ]
    assert not missing


@pytest.mark.slow
def test_every_block_of_the_readme_runs(tmp_path, monkeypatch):
    """In order, in one folder, as a reader would paste them; YAML says its file's name first."""
    pytest.importorskip("carla", reason="reading OpenDRIVE needs the CARLA client")
    pytest.importorskip("sumolib", reason="OpenStreetMap needs SUMO")
    text, names, skipped = (ROOT / "README.md").read_text(encoding="utf-8"), {}, []
    monkeypatch.chdir(tmp_path)
    programs = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for found in BLOCK.finditer(text):
        where = f"README.md:{text[: found.start()].count(chr(10)) + 2}"
        language, block = found.groups()
        if why := [key for key in ELSEWHERE if key in block]:
            skipped += why
            continue
        for long, short in SHORTER.items():
            block = re.sub(long, short, block)
        if language == "yaml":
            Path(re.match(r"# (\w+\.yaml)\n", block)[1]).write_text(block)
        elif language == "python":
            exec(compile(block, where, "exec"), names)
        else:
            ran = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", block],
                env=os.environ | {"PATH": programs},
                capture_output=True,
                text=True,
                timeout=900,
            )
            assert ran.returncode == 0, f"{where}\n{block}{ran.stdout[-2000:]}{ran.stderr[-2000:]}"
    assert sorted(skipped) == sorted(ELSEWHERE)
