"""The site: guides as they are kept, and a reference from docstrings. CONTRIBUTING.md says how."""

import inspect
from importlib import import_module
from pathlib import Path

from inspe_jax import __version__ as release

project, author, copyright = "inspe_jax", "The inspe_jax developers", "MIT licence"
html_title, html_theme = f"inspe_jax {release}", "furo"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

nb_execution_mode = "off"
suppress_warnings = ["misc.highlighting_failure"]  # of a cell with IPython's own ! before a command

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_use_rtype = False

PACKAGES = (
    "inspe_jax", "inspe_jax.report", "inspe_jax.dataset", "inspe_jax.dataset.loading",
    "inspe_jax.perception.training",
)  # fmt: skip


SEEN: set[int] = set()
"""What a page has already: a package's own package may list it too."""


def page_of(name: str) -> str:
    """The reference of a package: what it lists, by the names that users write."""
    package = import_module(name)
    lines = [name, "=" * len(name), "", f".. automodule:: {name}", "   :no-members:", ""]
    for member in package.__all__:
        thing = getattr(package, member)
        if isinstance(thing, dict):
            lines += [f"``{member}``, rows by name: {', '.join(thing)}.", ""]
        elif id(thing) not in SEEN:
            kind = "class" if inspect.isclass(thing) else "function"
            lines += [f".. auto{kind}:: {name}.{member}", ""]
        SEEN.add(id(thing))
    return "\n".join(lines)


for name in PACKAGES:
    path = Path(__file__).parent / "reference" / f"{name}.rst"
    path.parent.mkdir(exist_ok=True)
    path.write_text(page_of(name))
