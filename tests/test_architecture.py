"""The house's plan, read from the imports: data flows one way, libraries keep to their rooms."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import inspe_jax

PACKAGE = Path(inspe_jax.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))

# Lowest first. A module may import its own room and the rooms above it in this list.
LADDER = [
    "core", "scene", "sensing", "visibility", "mounting", "scoring", "jobs", "placement", "study",
    "report", "simulation", "dataset", "perception", "viewer", "cli",
]  # fmt: skip
SCIENCE = LADDER[: LADDER.index("simulation")]
RECORDINGS = {"simulation", "dataset", "perception"}
APPS = {"viewer", "cli"}
ROOMS = {
    "shapely": (
        "scene/", "mounting/site.py", "placement/constraints.py", "placement/space.py",
        "simulation/", "report/", "viewer/scene3d.py",
    ),
    "carla": ("simulation/carla/",),
    "embreex": ("simulation/embedded/embree.py",),
    "pyproj": ("scene/georeference.py",),
    "fastkml": ("report/",),
    "sumolib": ("scene/maps/sumo/", "scene/traffic/sumo/"),
    "sumo": ("scene/maps/sumo/", "scene/traffic/sumo/"),
    "jaxopt": ("placement/methods/solver_rounds.py",),
    "optax": ("placement/methods/adam.py", "perception/training/run.py"),
    "equinox": ("perception/",),
    "PIL": (
        "dataset/formats/", "dataset/loading/stored.py", "simulation/", "viewer/sensor_view.py",
    ),
    "matplotlib": (
        "core/sheet.py", "dataset/figure.py", "dataset/frame_figure.py", "perception/figure.py",
        "report/", "study/city_report.py", "viewer/",
    ),
    "viser": ("viewer/",),
    "websockets": ("viewer/server.py",),
    "jinja2": ("report/",),
    "typer": ("cli/",),
    "distributed": ("jobs/",),
    "dask": ("jobs/",),
}  # fmt: skip
LISTS = {"__init__", "public"}
"""The files beside the rooms: they list what is public."""
LEVEL = {room: i for i, room in enumerate(LADDER)}


def imports(path: Path) -> list[str]:
    """Dotted names that a file imports anywhere, also inside functions and type checks."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


IMPORTS = {path.relative_to(PACKAGE).as_posix(): imports(path) for path in FILES}
"""By file."""


def room(name: str) -> str:
    """Of a file, or of a module of the package; of a library its first name."""
    return re.split(r"[/.]", name.removeprefix("inspe_jax."))[0]


@pytest.mark.parametrize("path", IMPORTS)
def test_imports_run_only_downward(path):
    for name in IMPORTS[path] if room(path) not in LISTS else ():
        if name.startswith("inspe_jax.") and name != "inspe_jax.__version__":
            assert LEVEL[room(name)] <= LEVEL[room(path)], f"{path} imports {name}"


def test_science_knows_neither_recordings_nor_apps_nor_recordings_studies():
    for path, names in IMPORTS.items():
        there = {room(name) for name in names if "inspe_jax." in name}
        if room(path) in SCIENCE:
            assert not there & (RECORDINGS | APPS), path
        if room(path) in RECORDINGS:
            assert not there & {"study", "placement", "report", *APPS}, path


@pytest.mark.parametrize("path", IMPORTS)
def test_libraries_keep_to_their_rooms(path):
    for name in IMPORTS[path]:
        allowed = ROOMS.get(room(name))
        assert allowed is None or path.startswith(allowed), f"{path} imports {name}"


def test_every_module_is_in_a_room_of_the_plan():
    assert {*map(room, IMPORTS)} - LISTS == set(LEVEL)


def test_imports_make_no_circle():
    """Read from all imports of a file, also those inside functions and type checks."""
    graph = {}
    for path, names in IMPORTS.items():
        within = [name for name in names if name.startswith("inspe_jax.")]
        within += [name.rpartition(".")[0] for name in within]
        graph["inspe_jax." + path.removesuffix(".py").replace("/", ".")] = set(within)
    with pytest.raises(CycleError):  # the check itself can fail
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()
    TopologicalSorter({name: within & graph.keys() for name, within in graph.items()}).prepare()


def test_files_stay_short():
    """About 400 lines is when to look for the wall."""
    long = {p.name: n for p in FILES if (n := len(p.read_text().splitlines())) > 450}
    assert not long
