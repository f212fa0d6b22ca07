"""The command line in this process, in the folder of the fixture ``files``."""

import json
from functools import partial

import pytest
from processes import inspe_here
from worlds import place_sensors

from inspe_jax import build_scene, built_in, device, save_layout, save_scene


@pytest.fixture(scope="session")
def scene():
    """A small scene."""
    return build_scene(built_in("four_way"), radius=20, voxel=1.0, frames=5, density=8)


@pytest.fixture(scope="session")
def layout():
    """A camera on a corner."""
    return place_sensors((device("paper-camera").spec, [8, 8, 6, 0, -0.4, -2.3]))


@pytest.fixture
def files(scene, layout, tmp_path):
    """A folder with both; modules that need more have their own."""
    save_scene(scene, tmp_path / "s.npz")
    save_layout(layout, tmp_path / "layout.yaml")
    return tmp_path


@pytest.fixture
def inspe(files, monkeypatch, capsys):
    """Run the command line in the folder of files: (status, stdout, stderr)."""
    return partial(inspe_here, files, monkeypatch, capsys)


@pytest.fixture
def run(inspe):
    """The words of a command that does what it is told, or with ``fails`` the error."""

    def words(*arguments, fails=False):
        status, text, err = inspe(*arguments)
        assert (status != 0) == fails, err
        return " ".join((err if fails else text).split())

    return words


@pytest.fixture
def scored(run):
    """The record of a score."""
    return lambda *arguments: json.loads(run("score", *arguments, "--json", "-"))
