"""Reading users' files key by key, bounded in size and depth; writing files whole or not at all."""

import csv
import errno
import functools
import gzip
import hashlib
import io
import json
import math
import os
import re
import secrets
import stat
import tempfile
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import IO, Any, TypeVar
from xml.parsers import expat

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from inspe_jax.core.errors import InspeError, brief, error_at, nearest
from inspe_jax.core.yaml_loader import DEPTH, check_digits, load_yaml

Model = TypeVar("Model", bound=BaseModel)
Content = TypeVar("Content")

YAML, TEXT, ARRAYS = 2**22, 2**28, 2**30
"""Largest file of YAML and of other text, and largest arrays of a file together [bytes]."""
UNPACKED = 100  # a packed map is at most this many times as large when it is unpacked, or 64 MiB
_FORMULA = re.compile("'*[=+\\-@\t\r\n＝＋－＠].", re.DOTALL)

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""For models of what users write. A quoted number is reported as a mistake, not converted."""

_WORDS = {
    "missing": "missing key",
    "too_short": "needs at least {min_length}, has {actual_length}",
    "too_long": "has more than {max_length}",
    "list_type": "must be a list, got {given}",
    "float_type": "must be a number (in YAML without quotes, and 1.0e+9, not 1e9), got {given}",
    "int_type": "must be a whole number (without quotes), got {given}",
}
"""What is said of pydantic's kinds of fault, in place of its own words."""


def check_model(model: type[Model], content: Any, where: str) -> Model:
    """Read ``content`` as a pydantic ``model``. Raises InspeError with the first fault and the path
    of its key, as ``layout.yaml: units[0].base: …``."""
    try:
        return model.model_validate(content)
    except ValidationError as e:
        # A misspelt key is also a missing key. The unknown key is reported: it shows the mistake.
        fault = max(e.errors(include_url=False), key=lambda f: f["type"] == "extra_forbidden")
        parts = (
            f"[{x}]" if isinstance(x, int) else f".{x}" for x in fault["loc"] if x not in ("", " ")
        )
        key = "".join(parts).lstrip(".")
        given = brief(fault["input"])
        if fault["type"] == "extra_forbidden":
            known = sorted(_fields(model, fault["loc"][:-1]))
            message = f"unknown key{nearest(str(fault['loc'][-1]), known)}"
            message += f"; allowed: {', '.join(known)}"
        elif fault["type"] in ("model_type", "dict_type"):
            message = f"must hold keys with values: {', '.join(sorted(model.model_fields))}"
        elif fault["type"] in _WORDS:
            message = _WORDS[fault["type"]].format(given=given, **fault.get("ctx", {}))
        else:
            message = fault["msg"][:1].lower() + fault["msg"][1:]
            message += "" if isinstance(fault["input"], dict) else f", got {given}"
        raise InspeError(f"{where}: {key or 'the file'}: {message}") from None


def _fields(model: type[BaseModel], path: Sequence[int | str]) -> set[str]:
    """The names of the keys that are allowed at a path inside a model."""
    current: Any = model
    for part in path:
        if isinstance(part, str) and part in current.model_fields:
            current = _inner_model(current.model_fields[part].annotation) or current
    return set(current.model_fields)


def _inner_model(annotation: Any) -> Any:
    """The pydantic model within an annotation such as ``list[Entry]``, or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _inner_model(inner)
        if found is not None:
            return found
    return None


def read_yaml(path: Path) -> Any:
    """The content of a YAML file. Raises InspeError if it is missing, too large or not YAML."""
    check_input(path, YAML)
    return parse_yaml(path.read_bytes(), str(path))


def parse_yaml(text: str | bytes, where: str) -> Any:
    """The content of a YAML text. Raises InspeError, which names ``where``, if it is not YAML."""
    try:
        return load_yaml(text if isinstance(text, str) else text.decode("utf-8"))
    except (yaml.YAMLError, ValueError) as e:
        words = " ".join(str(e).replace('"<unicode string>", ', "").split())
        raise InspeError(f"{where}: not YAML: {words}") from e
    except (TypeError, LookupError, AttributeError) as e:  # PyYAML is not prepared for it
        raise InspeError(f"{where}: not YAML: a value is not of its tag") from e


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises InspeError if it is missing, too large or not JSON."""
    check_input(path, TEXT)
    with error_at(f"{path}: not JSON", ValueError, RecursionError):
        return json.loads(path.read_bytes(), parse_int=lambda text: int(check_digits(text)))


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file. Raises InspeError if it is missing, too large or not TOML."""
    check_input(path, YAML)
    with error_at(f"{path}: not TOML", ValueError, RecursionError):
        return tomllib.loads(path.read_text("utf-8"))


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file. Raises InspeError if it is missing, too large or not CSV."""
    check_input(path, TEXT)
    return parse_csv(path.read_bytes(), str(path))


def read_columns(
    path: Path, numbers: Collection[str], words: Collection[str]
) -> dict[str, np.ndarray]:
    """The columns of a large CSV file that have these names, as arrays. Raises InspeError if it is
    missing, too large or not CSV, has no rows, or if a cell of ``numbers`` is none."""
    check_input(path, TEXT)
    with error_at(f"{path}", ValueError, csv.Error):
        with path.open(encoding="utf-8-sig", newline="") as file:
            head = next(csv.reader(file), [])
            if not any(line.strip() for line in file):
                raise ValueError("has no rows")

        def load(names: Collection[str], kind: type) -> dict[str, np.ndarray]:
            own = [name for name in dict.fromkeys(head) if name in names]
            at = [head.index(name) for name in own]
            form: dict[str, Any] = dict(delimiter=",", quotechar='"', comments=None, ndmin=2)
            form |= dict(skiprows=1, usecols=at, unpack=True)
            with path.open(encoding="utf-8-sig") as file:
                lines = (line for line in file if not line.isspace())
                return dict(zip(own, np.loadtxt(lines, kind, **form) if own else (), strict=True))

        return load(numbers, float) | load(words, str)


def parse_csv(text: bytes, where: str) -> list[dict[str, str]]:
    """The rows of a CSV text, as :func:`csv_text` had them, without cells beyond the head's. Raises
    InspeError, which names ``where``, for other text."""
    with error_at(f"{where}: not CSV", ValueError, csv.Error):
        rows = [*csv.reader(io.StringIO(text.decode("utf-8-sig"), newline=""))]
    cells = [[_without_prefix(cell) for cell in row] for row in rows if row]
    if not cells:
        raise InspeError(f"{where}: not CSV: it is empty")
    return [dict(zip(cells[0], row, strict=False)) for row in cells[1:]]


@contextmanager
def open_arrays(path: Path, otherwise: str) -> Iterator[Mapping[str, np.ndarray]]:
    """The arrays of an ``.npz`` file by name: each is read when it is asked for, without pickle.

    Raises InspeError if there is no such file, if its arrays are larger than :data:`ARRAYS`, and
    with the words ``otherwise`` on any other error, also of what is done with the arrays.
    """
    check_input(path)
    try:
        with path.open("rb") as f:
            with zipfile.ZipFile(f) as members:
                sizes = {member.filename: member.file_size for member in members.infolist()}
                if len(sizes) < len(members.infolist()):
                    raise ValueError("two members have one name")
            check_size(path, sum(sizes.values()), ARRAYS, "arrays")
            f.seek(0)
            with np.load(f, allow_pickle=False) as arrays:
                yield arrays
    except InspeError:
        raise
    except Exception as e:  # NumPy, zipfile and what reads the record raise many
        raise InspeError(f"{path}: {otherwise}") from e


def check_xml(file: io.BufferedIOBase, where: str, root: str) -> None:
    """Raise InspeError unless a file, read as a stream, is well-formed XML, at most :data:`DEPTH`
    deep, with a ``root``. A gzipped file may be :data:`UNPACKED` times its size."""
    parser, level = expat.ParserCreate(namespace_separator=" "), 0

    def start(tag: str, _: Any) -> None:
        nonlocal level
        level += 1
        name = tag.rpartition(" ")[2]
        if level == 1 and name != root:
            raise InspeError(f"{where}: the root element is <{name[:80]}>, not <{root}>")
        if level > DEPTH:
            line = parser.CurrentLineNumber
            raise InspeError(f"{where}: line {line}: elements nested more than {DEPTH} deep")

    def end(_: str) -> None:
        nonlocal level
        level -= 1

    def entity(*_: Any) -> None:
        raise InspeError(f"{where}: has XML entities of its own, which are not read")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.EntityDeclHandler = parser.SkippedEntityHandler = entity
    most = math.inf
    if isinstance(file, gzip.GzipFile):
        most = max(2**26, UNPACKED * os.fstat(file.fileno()).st_size)
    read, wrong = 0, f"{where}: not well-formed XML, perhaps cut short"
    with error_at(wrong, expat.ExpatError, LookupError, OSError, EOFError, zlib.error):
        while chunk := file.read(2**20):
            read += len(chunk)
            check_size(where, read, most, "unpacked text")
            parser.Parse(chunk)
        parser.Parse(b"", True)


def check_input(path: Path, most: float = math.inf) -> None:
    """Raise InspeError if there is no such file, or if it has more than ``most`` bytes."""
    try:
        facts = path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):
        raise InspeError(f"{path}: no such file") from None
    except OSError as e:
        raise InspeError(f"{path}: cannot be read: {e.strerror}") from None
    if stat.S_ISDIR(facts.st_mode):
        raise InspeError(f"{path}: is a folder; name a file")
    if not stat.S_ISREG(facts.st_mode):
        raise InspeError(f"{path}: is not a file on disk; name one")
    check_size(path, facts.st_size, most, "content")


OTHER_KINDS = {
    b"\x1f\x8b\x08": "is packed with gzip; unpack it: gunzip FILE",
    b"1AY&SY": "is packed with bzip2; unpack it: bunzip2 FILE",
    b"PK\x03\x04": "is a zip archive; unpack it: unzip FILE (a saved scene's name ends in .npz)",
    b"OSMHeader": "is OpenStreetMap's PBF; make XML of it: osmium cat FILE -o city.osm",
    b"<kml": "is KML; make bodies of it: ogr2ogr -f GeoJSON bodies.geojson FILE",
    b"<osm": "is XML of OpenStreetMap or Lanelet2; the first is a map: name it city.osm",
}
"""What files begin with of kinds that are given in place of others, and what to do with them."""


def check_kind(path: Path, *allowed: bytes) -> None:
    """Raise InspeError if a file is missing, or of :data:`OTHER_KINDS` but for the allowed."""
    check_input(path)
    with path.open("rb") as f:
        start = f.read(1024).partition(b"{")[0]  # of JSON, nothing
    start = re.sub(rb"<!--.*?(-->|\Z)", b"", start, flags=re.DOTALL)  # they may name other files
    for mark, words in OTHER_KINDS.items():
        if mark in start and mark not in allowed:
            raise InspeError(f"{path}: {words}")


def check_size(where: object, size: float, most: float, what: str) -> None:
    """Raise InspeError if ``what`` has more than ``most`` bytes."""
    if size > most:
        limit = f"{most / 1e6:,.0f} MB of {what}"
        raise InspeError(f"{where}: has more than {limit}, the most that is read")


def cached_by_file(size: int) -> Callable[[Callable[..., Content]], Callable[..., Content]]:
    """A decorator for readers of files: it caches the content of ``size`` files, until they change,
    and raises InspeError if there is no file. Options that are None count as not given."""

    def decorated(read: Callable[..., Content]) -> Callable[..., Content]:
        cached = functools.lru_cache(maxsize=size)(lambda facts, *given: read(*given))

        @functools.wraps(read)
        def load(path: str | os.PathLike[str], *options: Any) -> Content:
            check_input(path := Path(path))
            facts, given = path.stat(), [one for one in options if one is not None]
            return cached((path.resolve(), facts.st_mtime_ns, facts.st_size), path, *given)

        return load

    return decorated


def check_output(path: str | os.PathLike[str] | None, suffixes: Collection[str] = ()) -> None:
    """Raise InspeError if a file could not be written: to be called before the work for it. A
    ``path`` of None is accepted. ``suffixes`` are the allowed ones; if empty, any is."""
    if path is None:
        return
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise InspeError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise InspeError(f"{path}: no such folder: {path.parent}")
    if path.is_dir():
        raise InspeError(f"{path}: is a folder")


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A binary file that gets its name when complete. Raises InspeError if it can't be written."""
    check_output(path)
    path = Path(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        file = part.open("xb")
    except OSError as e:
        raise InspeError(f"{path}: cannot be written: {e.strerror}") from e
    try:
        with named(path), file:
            yield file
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextmanager
def named(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise errors of writing, as of a full disk, as InspeError with the name of the file."""
    try:
        yield
    except OSError as e:
        if e.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS):
            raise
        raise InspeError(f"{path}: cannot be written: {e.strerror}") from e


def prepare_folder(folder: str | os.PathLike[str]) -> Path:
    """A folder to write to, which is created if missing. Raises InspeError if that fails."""
    folder = Path(folder)
    check_folder(folder)
    folder.mkdir(exist_ok=True)
    return folder


def check_folder(folder: str | os.PathLike[str]) -> None:
    """Raise InspeError if a folder could not be created or written: call it before the work."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InspeError(f"{folder}: is a file; name a folder")
    if not folder.exists() and not folder.parent.is_dir():
        raise InspeError(f"{folder}: no such folder: {folder.parent}")
    check_writable(folder if folder.exists() else folder.parent)


def check_writable(folder: Path) -> None:
    """Raise InspeError if no file can be written in a folder that there is."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as e:
        raise InspeError(f"{folder}: no file can be written there: {e.strerror}") from e


def digest_of(path: Path) -> str:
    """The SHA-256 of a file's content, as hexadecimal text."""
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a UTF-8 text file, whole or not at all."""
    with whole_file(path) as f:
        f.write(text.encode("utf-8"))


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV text, under the keys of the first. Text that a spreadsheet would run as a formula
    gets an apostrophe before it (OWASP, "CSV injection"), which :func:`parse_csv` takes away."""
    keys = list(rows[0])
    return csv_line(keys) + "".join(csv_line(row.get(key, "") for key in keys) for row in rows)


def csv_line(cells: Iterable[Any]) -> str:
    """A line of :func:`csv_text`."""
    text = io.StringIO()
    csv.writer(text).writerow(map(_with_prefix, cells))
    return text.getvalue().removesuffix("\r\n") + "\n"  # a cell with either of them is quoted


def _with_prefix(cell: Any) -> Any:
    if isinstance(cell, str) and _FORMULA.match(cell):
        try:
            float(cell)
        except ValueError:
            return f"'{cell}"
    return cell


def _without_prefix(cell: str) -> str:
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def json_value(value: Any) -> Any:
    """A value for JSON: tuples and arrays become lists, NumPy's numbers Python's, records dicts."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: json_value(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [json_value(item) for item in value] if isinstance(value, list | tuple) else value
