"""Every public name says what it is."""

import importlib
import inspect
import pkgutil

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
