"""Every public name says what it is."""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import pytest

import inspe_jax

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
    root, package = Path(__file__).parents[1], Path(inspe_jax.__file__).parent
    text = (root / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`([a-z0-9_./]+(?:\.py|\.toml|/))`", text)
    assert len(named) > 20
    missing = [
        name
        for name in named
        if "/" in name and not (root / name).exists() and not (package / name).exists()
    ]
    assert not missing
