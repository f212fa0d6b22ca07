"""The house's plan, read from the imports: data flows one way, libraries keep to their rooms."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import inspe_jax

PACKAGE = Path(inspe_jax.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))

# Lowest first. A module may import its own room and the rooms above it in this list.
LADDER = [
    "core",
    "scene",
    "sensing",
    "visibility",
    "mounting",
    "scoring",
    "jobs",
    "placement",
    "study",
    "report",
    "simulation",
    "dataset",
    "perception",
    "viewer",
    "cli",
]
SCIENCE = LADDER[: LADDER.index("simulation")]
RECORDINGS = {"simulation", "dataset", "perception"}
APPS = {"viewer", "cli"}
ROOMS = {
    "shapely": (
        "scene/", "mounting/site.py", "placement/constraints.py", "placement/space.py",
        "simulation/", "report/", "viewer/scene3d.py",
    ),
    "carla": ("scene/maps/opendrive/", "simulation/carla/"),
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


def room(dotted: str) -> str:
    return dotted.split(".")[0]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_run_only_downward(path):
    here = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if here == "__init__":
        return
    for name in imports(path):
        if name.startswith("inspe_jax.") and name != "inspe_jax.__version__":
            there = room(name.removeprefix("inspe_jax."))
            assert LEVEL[there] <= LEVEL[here], f"{here} imports {name}"


def test_science_knows_neither_recordings_nor_apps_nor_recordings_studies():
    for path in FILES:
        here = path.relative_to(PACKAGE).with_suffix("").parts[0]
        there = {room(n.removeprefix("inspe_jax.")) for n in imports(path) if "inspe_jax." in n}
        if here in SCIENCE:
            assert not there & (RECORDINGS | APPS), path
        if here in RECORDINGS:
            assert not there & {"study", "placement", "report", *APPS}, path


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_libraries_keep_to_their_rooms(path):
    where = path.relative_to(PACKAGE).as_posix()
    for name in imports(path):
        allowed = ROOMS.get(room(name))
        assert allowed is None or where.startswith(allowed), f"{where} imports {name}"


def test_every_module_is_in_a_room_of_the_plan():
    rooms = {p.relative_to(PACKAGE).with_suffix("").parts[0] for p in FILES} - {"__init__"}
    assert rooms == set(LEVEL)


def test_imports_make_no_circle():
    """Read from all imports of a file, also those inside functions and type checks."""
    modules = {
        "inspe_jax." + ".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in FILES
    }
    graph = {}
    for module, path in modules.items():
        named = [name for name in imports(path) if name.startswith("inspe_jax.")]
        named += [name.rpartition(".")[0] for name in named]
        graph[module] = set(named) & set(modules)
    with pytest.raises(CycleError):  # the check itself can fail
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()
    TopologicalSorter(graph).prepare()


def test_files_stay_short():
    """About 400 lines is when to look for the wall."""
    long = {p.name: n for p in FILES if (n := len(p.read_text().splitlines())) > 450}
    assert not long
