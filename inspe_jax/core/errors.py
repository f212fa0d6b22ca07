"""The exception for errors of the user, and hints for misspelt names."""

import json
import reprlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import metadata
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit

from inspe_jax.core.words import visible

Kind = TypeVar("Kind")

LONGEST = 2000  # most characters of an error's message. A longer one loses its middle


class InspeError(ValueError):
    """Bad input: a file, a key, a value or a name that cannot be used.

    The message names what was given, where, and what is allowed; the command line prints it and
    exits with status 2. It shows control characters of names as their escapes, and has at most
    :data:`LONGEST` characters.

    >>> inspe_jax.device("hesai-xt23")
    Traceback (most recent call last):
        ...
    inspe_jax.core.errors.InspeError: no device 'hesai-xt23': ... did you mean hesai-xt32 or ...
    """

    def __init__(self, message: str) -> None:
        message, half = visible(message), LONGEST // 2
        if len(message) > LONGEST:
            message = f"{message[: half - 2]} … {message[1 - half :]}"
        super().__init__(message)


@contextmanager
def error_at(where: str, *kinds: type[Exception]) -> Iterator[None]:
    """Begin the message of an InspeError in the block with ``where`` it is; or, if ``kinds`` of
    errors are given, turn those into an InspeError with such a message."""
    caught = kinds or (InspeError,)
    try:
        yield
    except caught as error:
        raise InspeError(f"{where}: {error}") from (error if kinds else None)


_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxdict = 2, 6, 4
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 80


def brief(value: Any) -> str:
    """What a message quotes of a value: 80 characters or so; first items of lists and mappings."""
    try:
        text = _SHORT.repr(value)
    except ValueError:  # Python writes no integer of more than 4,300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:77]}..."


def check_known(name: str, known: Iterable[str], what: str) -> None:
    """Raise InspeError, which lists the known names of ``what``, if ``name`` is none of them."""
    known = tuple(known)
    if name not in known:
        hint = nearest(str(name), known)
        raise InspeError(f"{what} '{name}': one of {', '.join(known)}{hint}".lstrip())


def missing_extra(what: str, extra: str, where: str = "") -> InspeError:
    """The error of a library that is not installed: ``what`` needs it, and how the ``extra`` with
    it is installed, as this package was. ``where`` says where there is such a library."""
    return InspeError(f"{what}: {_install(extra)}{where and f' ({where})'}")


@contextmanager
def needs(what: str, extra: str, where: str = "") -> Iterator[None]:
    """Turn an import in the block that fails into the error of a :func:`missing_extra`."""
    try:
        yield
    except ImportError as e:
        if (e.name or "").startswith("inspe_jax"):
            raise
        raise missing_extra(what, extra, where) from e


def _install(extra: str) -> str:
    """The command that installs an extra: from the folder or address that this package is from."""
    package = f"inspe_jax[{extra}]"
    try:
        origin = json.loads(metadata.distribution("inspe_jax").read_text("direct_url.json") or "{}")
    except metadata.PackageNotFoundError:  # run in its folder
        origin = {}
    url = origin.get("url", "")
    if "dir_info" in origin:
        editable = "-e " if origin["dir_info"].get("editable") else ""
        return f"in {unquote(urlsplit(url).path)}: pip install {editable}'.[{extra}]'"
    if url:
        vcs = origin.get("vcs_info", {}).get("vcs")
        return f"pip install '{package} @ {f'{vcs}+' if vcs else ''}{url}'"
    return f"pip install '{package}'"


def wrong_kind(name: str, given: Any, wanted: str) -> InspeError:
    """The error of an argument that is something else than what is ``wanted``."""
    text = " ".join(brief(given).split())
    return InspeError(f"{name}: got {text}, of type {type(given).__name__}; give {wanted}")


def or_usual(name: str, given: Kind | None, kind: type[Kind]) -> Kind:
    """``given``, or the usual one of its kind for None. Raises InspeError for another kind."""
    if given is not None and not isinstance(given, kind):
        raise wrong_kind(name, given, f"inspe_jax.{kind.__name__}(…), or None for the usual one")
    return kind() if given is None else given


def nearest(name: str, known: Sequence[str]) -> str:
    """``'; did you mean X?'`` with the known names most similar to ``name``, or ``''``."""
    lowered = {k.lower(): k for k in known}
    close = get_close_matches(name.lower(), list(lowered), n=3, cutoff=0.5)
    return f"; did you mean {' or '.join(lowered[c] for c in close)}?" if close else ""
