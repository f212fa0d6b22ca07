"""The notebooks run from top to bottom, as a reader would run them, on less."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

SHORTER = {
    "radius=30": "radius=15",
    r"frames=\d+": "frames=3",
    'density="medium"': "density=5",
    r"(?:seconds|evaluations)=\d+": "evaluations=4",
    r"samples=\d+": "samples=3",
    "-60, 60, 17": "-60, 60, 5",
}
"""How much of what takes long is enough here: only budgets and sizes."""
NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.notebook
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        for long, short in SHORTER.items():
            cell.source = re.sub(long, short, cell.source)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": tmp_path}}).execute()
    printed = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    assert printed
