"""Reading files that users write, key by key, and writing files whole or not at all."""

import csv
import functools
import io
import json
import os
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import yaml
from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict, ValidationError

from inspe_jax.core.errors import InspeError, nearest

Model = TypeVar("Model", bound=BaseModel)
Content = TypeVar("Content")


STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""For models of what users write. A quoted number is reported as a mistake, not converted."""


def check_model(model: type[Model], content: Any, where: str) -> Model:
    """Read ``content`` as a pydantic ``model``. Raises InspeError with the first fault.

    The message begins with the path of the key, as ``layout.yaml: units[0].base: …``.
    """
    try:
        return model.model_validate(content)
    except ValidationError as e:
        # A misspelt key is also a missing key. The unknown key is reported: it shows the mistake.
        fault = max(e.errors(), key=lambda f: f["type"] == "extra_forbidden")
        key = "".join(
            f"[{part}]" if isinstance(part, int) else f".{part}" for part in fault["loc"]
        ).lstrip(".")
        limits = fault.get("ctx", {})
        if fault["type"] == "extra_forbidden":
            known = sorted(_fields(model, fault["loc"][:-1]))
            message = f"unknown key{nearest(str(fault['loc'][-1]), known)}"
            message += f"; allowed: {', '.join(known)}"
        elif fault["type"] == "missing":
            message = "missing key"
        elif fault["type"] in ("model_type", "dict_type"):
            message = f"must hold keys with values: {', '.join(sorted(model.model_fields))}"
        elif fault["type"] == "too_short":
            message = f"needs at least {limits['min_length']}, has {limits['actual_length']}"
        elif fault["type"] == "too_long":
            message = f"has more than {limits['max_length']}"
        elif fault["type"] == "list_type":
            message = f"must be a list, got {fault['input']!r}"
        else:
            given = f", got {fault['input']!r}" if not isinstance(fault["input"], dict) else ""
            message = fault["msg"][:1].lower() + fault["msg"][1:] + given
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


class _Loader(yaml.SafeLoader):
    """A YAML loader for which a key given twice is an error; YAML itself would keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping; raises YAMLError on a key given twice."""
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.YAMLError(f"the key '{twice}' is given twice, {node.start_mark}".strip())
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """The content of a YAML file. Raises InspeError if it is missing or is not YAML."""
    check_input(path)
    return parse_yaml(path.read_bytes(), str(path))


def parse_yaml(text: str | bytes, where: str) -> Any:
    """The content of a YAML text. Raises InspeError, which names ``where``, if it is not YAML."""
    try:
        return yaml.load(text if isinstance(text, str) else text.decode("utf-8"), _Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        raise InspeError(f"{where}: not YAML: {' '.join(str(e).split())}") from e


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises InspeError if it is missing or is not JSON."""
    check_input(path)
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as e:
        raise InspeError(f"{path}: not JSON: {e}") from e


def check_input(path: Path) -> None:
    """Raise InspeError if there is no such file."""
    if not path.is_file():
        raise InspeError(f"{path}: no such file")


def cached_by_file(
    size: int,
) -> Callable[[Callable[[Path], Content]], Callable[[str | os.PathLike[str]], Content]]:
    """A decorator for readers of files: it caches the content of ``size`` files.

    A file is read again when it changes. The reader then raises InspeError if there is no file.
    """

    def decorated(read: Callable[[Path], Content]) -> Callable[[str | os.PathLike[str]], Content]:
        @functools.lru_cache(maxsize=size)
        def cached(path: Path, _where: Path, _modified: int, _size: int) -> Content:
            return read(path)

        @functools.wraps(read)
        def load(path: str | os.PathLike[str]) -> Content:
            path = Path(path)
            check_input(path)
            stat = path.stat()
            return cached(path, path.resolve(), stat.st_mtime_ns, stat.st_size)

        return load

    return decorated


def check_output(path: str | os.PathLike[str] | None, suffixes: Collection[str] = ()) -> None:
    """Raise InspeError if a file could not be written: to be called before the work for it.

    A ``path`` of None is accepted. ``suffixes`` are the allowed ones; if empty, any is.
    """
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
    """A binary file to write. It gets its name when it is complete, and is deleted on any error.

    Raises InspeError if it cannot be written.
    """
    check_output(path)
    path = Path(path)
    try:
        handle, part = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as e:
        raise InspeError(f"{path}: cannot be written: {e.strerror}") from e
    try:
        with os.fdopen(handle, "wb") as f:
            yield f
        os.chmod(part, 0o666 & ~_umask())
        os.replace(part, path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise


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


def lock_folder(folder: Path, name: str) -> FileLock:
    """Take the lock ``name`` of a folder, until its ``release``.

    A killed process leaves no lock. Raises InspeError if another run has it.
    """
    lock = FileLock(folder / name)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InspeError(f"{folder}: is in use by another run; wait until it is done") from None
    return lock


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a UTF-8 text file, whole or not at all."""
    with whole_file(path) as f:
        f.write(text.encode("utf-8"))


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows as CSV text, under the keys of the first; there must be at least one."""
    text = io.StringIO()
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    return text.getvalue()


def json_value(value: Any) -> Any:
    """A value for JSON: lists for tuples and arrays, Python numbers for NumPy's, and records as
    mappings."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: json_value(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [json_value(item) for item in value] if isinstance(value, list | tuple) else value


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
