"""The notebooks keep what they printed, and run from top to bottom as for a reader, on less."""

import os
import re
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

SHORTER = {
    r"radius[=:] ?[34]0": lambda found: found[0][:-2] + "20",
    r"frames([=:] ?)\d+": r"frames\g<1>3",
    r'density="medium"': "density=5",
    r"density: \[10, 30, 50\]": "density: [5]",
    r"(?:seconds|evaluations)=\d+": "evaluations=4",
    r"samples=\d+": "samples=3",
    "-60, 60, 17": "-60, 60, 5",
    r"range\(60\)": "range(3)",
    r"STEPS, STARTS, SOFTNESS = \d+, 3": "STEPS, STARTS, SOFTNESS = 2, 2",
}
"""How much of what takes long is enough here: only budgets and sizes."""
NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.notebook
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    """With outputs of the same kinds as those in the file, the first of which is a picture."""
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    text = path.read_text(encoding="utf-8")
    if ".osm" in text:
        pytest.importorskip("sumolib", reason="OpenStreetMap needs SUMO")
    notebook = nbformat.reads(text, as_version=4)
    kept = list(map(kinds, notebook.cells))
    assert "image/png" in next(filter(None, kept))
    assert set().union(*kept) <= {"image/png", "text/plain", "stdout"}
    assert not re.search(r"(?<![\w.])/(?:home|mnt|root|tmp|work|Users)/\w", text)
    for cell in notebook.cells:
        for long, short in SHORTER.items():
            cell.source = re.sub(long, short, cell.source)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": tmp_path}}).execute()
    assert list(map(kinds, notebook.cells)) == kept


def kinds(cell):
    """Of what a cell has printed and drawn."""
    found = {kind for o in cell.get("outputs", ()) for kind in o.get("data", [o.get("name")])}
    return found - {"text/html"}
