"""What is public: it is documented, its examples run, and pages import nothing else."""

import ast
import doctest
import inspect
import json
import re
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import inspe_jax
from inspe_jax import dataset, report
from inspe_jax.cli.common import app

ROOT = Path(__file__).parents[1]
CONF = ROOT / "notebooks" / "conf.py"
NEEDS = {
    "inspe_jax": None,
    "inspe_jax.report": None,
    "inspe_jax.dataset": None,
    "inspe_jax.dataset.loading": None,
    "inspe_jax.perception.training": "equinox",
}
"""The packages whose ``__all__`` is public, and what they need of an extra that may be missing."""
PUBLIC = {
    name: import_module(name) for name, needed in NEEDS.items() if not needed or find_spec(needed)
}


def documented():
    """What is public and has a docstring of its own, by its name: methods and properties too."""
    found = dict(PUBLIC)
    for package, module in PUBLIC.items():
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                found[f"{package}.{name}"] = thing
            if inspect.isclass(thing):
                own = {key: part for key, part in vars(thing).items() if not key.startswith("_")}
                found |= {
                    f"{package}.{name}.{key}": getattr(part, "__func__", part)
                    for key, part in own.items()
                    if inspect.getdoc(part) and (inspect.isroutine(part) or hasattr(part, "fget"))
                }
    return {name: thing for name, thing in found.items() if inspect.getdoc(thing)}


DOCUMENTED, PARSER = documented(), doctest.DocTestParser()
EXAMPLES = {
    name: found
    for name, thing in {id(thing): (name, thing) for name, thing in DOCUMENTED.items()}.values()
    if (found := PARSER.get_doctest(inspect.getdoc(thing), {}, name, name, 0)).examples
}
NAMES = {"inspe_jax": inspe_jax, "dataset": dataset, "report": report, "jax": jax, "np": np}
"""What examples have, besides what those of the package make."""


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What examples begin with, and the folder of the files of ``inspe examples``."""
    folder, found = tmp_path_factory.mktemp("examples"), dict(NAMES)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert CliRunner().invoke(app, ["examples"]).exit_code == 0
    for example in EXAMPLES["inspe_jax"].examples:
        exec(example.source, found)
    return found, folder


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_of_a_docstring_run(name, names, monkeypatch):
    """With public names alone, and the scene and layout of the package's own example."""
    if "Georeference" in name:
        pytest.importorskip("pyproj", reason="projections need the extra [geo]")
    monkeypatch.chdir(names[1])
    example, said = EXAMPLES[name], list[str]()
    example.globs = dict(names[0])
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    with mock.patch.dict(inspe_jax.MIXES):  # an example adds one
        assert not runner.run(example, out=said.append).failed, "".join(said)


def test_there_are_examples_of_what_users_call():
    assert len(EXAMPLES) >= 60


def test_the_site_has_what_is_public():
    """Building it takes an extra: .ci/run does that."""
    listed = re.search(r"^PACKAGES = \((.*?)^\)", CONF.read_text(), re.MULTILINE | re.DOTALL)[1]
    assert re.findall(r'"([\w.]+)"', listed) == [*NEEDS]


@pytest.mark.parametrize("package", PUBLIC)
def test_what_is_listed_is_there_and_says_what_it_is(package):
    """A function of more than four arguments says of each what it is, and what is raised."""
    module = PUBLIC[package]
    assert len({*module.__all__}) == len(module.__all__)
    assert {*module.__all__} <= {*dir(module)}
    for name in module.__all__:
        thing = getattr(module, name)
        text = inspect.getdoc(thing) or ""
        assert vars(thing).get("__doc__") if inspect.isclass(thing) else text, name
        if inspect.isfunction(thing) and len(of := inspect.signature(thing).parameters) > 4:
            section = re.search(r"^Args:\n((?:    .*\n)+)", text, re.MULTILINE)
            entries = re.findall(r"^    (\w[\w,\s]*):", section[1] if section else "", re.MULTILINE)
            assert {*re.findall(r"\w+", " ".join(entries))} == {*of}, name
            assert "\nRaises:\n" in text, name


LATER = {"jaxopt", "matplotlib", "optax", "rich", "scipy.optimize", "scipy.spatial", "typer"}
"""What takes as long to import as a tenth of the package, and not all who import it need."""


@pytest.mark.process
def test_importing_the_package_does_not_wait_for_what_few_need():
    code = "import sys, inspe_jax.public, inspe_jax.report; print(*sys.modules)"
    command = [sys.executable, "-W", "error", "-c", code]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert not ran.stderr
    assert not LATER & {*ran.stdout.split()}


def code_of(page):
    """The Python of a page: a guide's cells without IPython's own lines, and blocks of Markdown."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    cells = [("".join(c["source"]), c["cell_type"]) for c in json.loads(text)["cells"]]
    words = "\n".join(source for source, kind in cells if kind == "markdown")
    own = [re.sub(r"^[%!].*$", "", source, flags=re.M) for source, kind in cells if kind == "code"]
    return own + re.findall(r"^```python\n(.*?)^```$", words, re.MULTILINE | re.DOTALL)


def room(name):
    """Whether a module is of the package."""
    return name.split(".")[0] == "inspe_jax"


def not_public(code):
    """What the imports of some code take that is not listed, and what it reads of the package."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            named = (alias.name for alias in node.names)
            yield from (name for name in named if room(name) and name not in NEEDS)
        elif isinstance(node, ast.ImportFrom) and room(node.module):
            listed = getattr(PUBLIC.get(node.module), "__all__", ())
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                if alias.name not in listed and name not in NEEDS:
                    yield name
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "inspe_jax":
            name = f"inspe_jax.{node.attr}"
            yield from () if node.attr in inspe_jax.__all__ or name in NEEDS else (name,)


PAGES = (ROOT / "README.md", *sorted(ROOT.glob("notebooks/*.ipynb")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_uses_public_names_alone(page):
    assert not [name for code in code_of(page) for name in not_public(code)]


def test_names_that_are_not_public_are_found():
    code = "from inspe_jax.scoring.metrics import METRICS\nimport inspe_jax.core\ninspe_jax.scene\n"
    assert len(list(not_public(code))) == 3
