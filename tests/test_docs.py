"""What CONTRIBUTING.md and links name is there, and what the README and the guides show runs."""

import json
import re
import shlex
import time
from pathlib import Path

import pytest
from processes import in_this_process
from typer.testing import CliRunner

import inspe_jax
from inspe_jax.cli.common import app

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(bash|python|yaml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!https?:)([^)#]+)\)")
ELSEWHERE = {
    "bin/inspe optimise": ".ci/run runs it, in a new environment",
    "bin/pytest": ".ci/run runs it, in a new environment",
    "inspe view": "it waits for a browser: tests/viewer opens one",
}
"""What a block that is not run here has in it, and why."""
SHORTER = {
    # Searches and trainings: what each may do.
    r"--seconds \d+": "--evaluations 2",
    r"(inspe (?:optimise|plan) (?!.*--evaluations).*)": r"\1 --evaluations 2",
    r"seconds=\d+": "evaluations=2",
    r"--seeds \d+": "--seeds 1",
    r":0-2|:1-3": ":0-1",
    r":0,2,4|:2,4": ":1",
    r"--model v2x-vit": "--model early-fusion",
    r"(inspe train .*)": r"\1 --steps 2 --batch 1 --validate 1",
    # Scenes and recordings: how large they are.
    r" --frames \d+| --radius \d+": "",
    r"(inspe (?:scene (?=.*--out)|plan).*)": r"\1 --frames 10 --radius 20 --voxel 1",
    r"light: \[midday, night\]": "light: [night]",
    r"  density: \[low, high\]": "  frames: 10\n  voxel: 1\n  density: low",
    r'load_scene\("four_way"\)': 'build_scene("four_way", radius=20, voxel=1, frames=10)',
    r"radius: \d+": "radius: 20",
    r"- built_in: four_way": "- {built_in: four_way, radius: 20}",
    r"density: \[low, medium\]": "density: [low, 5]",
    r"seconds: \d+": "seconds: 0.2",
    r"dataset show set 4": "dataset show set 1",
    r"352x128": "176x64",
    r"\[352, 128\]": "[176, 64]",
    # Where they run.
    r"(inspe (?:generate|dataset cache) .*)": r"\1 --workers 1",
    r"(inspe (?:plan|sweep) .*)": r"\1 --scheduler HERE",
}
"""What takes long, and how much of it is enough here: budgets, lengths, sizes and workers; and a
detector that is compiled sooner, since tests/perception/test_detectors.py has each."""


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


def text_of(page):
    """A page's Markdown; of a guide, that of its cells."""
    text = page.read_text(encoding="utf-8")
    cells = json.loads(text)["cells"] if page.suffix == ".ipynb" else ()
    words = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
    return "\n\n".join(words) or text


PAGES = {p: text_of(p) for p in (ROOT / "README.md", *sorted(ROOT.glob("notebooks/*.ipynb")))}


def test_links_lead_to_files_and_every_guide_is_linked():
    named = [page.parent / name for page in PAGES for name in LINK.findall(PAGES[page])]
    assert not [path for path in named if not path.exists()]
    assert {*PAGES} <= {ROOT / "README.md", *named}
    blocks = [block for text in PAGES.values() for _, block in BLOCK.findall(text)]
    assert sorted(key for b in blocks for key in ELSEWHERE if key in b) == sorted(ELSEWHERE)
    assert all(text.count("```") == 2 * len(BLOCK.findall(text)) for text in PAGES.values())
    assert PAGES[ROOT / "README.md"].count("\n") <= 150
    assert f"version: {inspe_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.fixture(scope="module")
def cluster():
    with in_this_process() as found:
        yield found


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if "```" in PAGES[p]], ids=lambda p: p.stem)
def test_every_block_of_a_page_runs(page, cluster, tmp_path, monkeypatch):
    """In order, in one folder, as a reader would paste them; YAML says its file's name first."""
    text, names = PAGES[page], {}
    if ".osm" in text:
        pytest.importorskip("sumolib", reason="OpenStreetMap needs SUMO")
    monkeypatch.chdir(tmp_path)
    for found in BLOCK.finditer(text):
        where = f"{page.name}:{text[: found.start()].count(chr(10)) + 2}"
        language, block = found.groups()
        if any(key in block for key in ELSEWHERE):
            continue
        for long, short in SHORTER.items():
            block = re.sub(long, short.replace("HERE", cluster.scheduler_address), block)
        if language == "yaml":
            Path(re.match(r"# (\w+\.yaml)\n", block)[1]).write_text(block)
        elif language == "python":
            exec(compile(block, where, "exec"), names)
        else:
            run(where, block)


def run(where, block):
    """The commands of a block, in this process: what one compiles, the next has."""
    for line in block.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "inspe", where
        began = time.monotonic()
        found = CliRunner().invoke(app, arguments)
        print(f"{time.monotonic() - began:5.1f} s: {line}")
        assert found.exit_code == 0, f"{where}: {found.output[-2000:]}{found.exception}"
