"""The house's plan, read from the imports: data flows one way, libraries keep to their rooms."""

import ast
from pathlib import Path

import pytest

import inspe_jax

PACKAGE = Path(inspe_jax.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))

# Lowest first. A module may import its own row and the rows above it in this list.
LADDER = [
    ("errors",),
    ("files", "arrays", "numerics", "masks", "cores", "sharding"),
    ("compiling",),
    ("geometry", "carla_frame", "profiles"),
    ("scene",),
    ("sensing",),
    ("metrics", "measures", "world", "exact", "soft", "evaluation", "viewshed"),
    ("placement",),
    ("study",),
    ("dataset",),
    ("report",),
    ("viewer",),
    ("cli",),
]
ROOMS = {
    "shapely": ("scene/", "placement/constraints.py", "placement/site.py", "dataset/", "report/"),
    "carla": ("scene/opendrive", "dataset/carla"),
    "embreex": ("dataset/embree.py",),
    "sumolib": ("scene/sumo",),
    "sumo": ("scene/sumo",),
    "jaxopt": ("placement/rounds.py",),
    "optax": ("placement/adam.py",),
    "PIL": ("dataset/",),
    "matplotlib": ("report/",),
    "viser": ("report/", "viewer/"),
    "websockets": ("report/server.py",),
    "msgspec": ("report/server.py",),
    "jinja2": ("report/",),
    "typer": ("cli/",),
    "distributed": ("study/",),
    "dask": ("study/",),
}
LEVEL = {room: i for i, row in enumerate(LADDER) for room in row}


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


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_libraries_keep_to_their_rooms(path):
    where = path.relative_to(PACKAGE).as_posix()
    for name in imports(path):
        allowed = ROOMS.get(room(name))
        assert allowed is None or where.startswith(allowed), f"{where} imports {name}"


def test_every_room_is_on_the_plan():
    rooms = {p.relative_to(PACKAGE).with_suffix("").parts[0] for p in FILES} - {"__init__"}
    assert rooms == set(LEVEL)


def test_files_stay_short():
    """About 400 lines is when to look for the wall."""
    long = {p.name: n for p in FILES if (n := len(p.read_text().splitlines())) > 450}
    assert not long
