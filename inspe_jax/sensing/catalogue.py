"""Named devices: ``catalogue.toml``, and catalogues that users write in the same format.

Files are in degrees, metres and US dollars, with the unit in each key; specs are in radians.
A device is a spec with the source of its figures. The head of ``catalogue.toml`` describes
the keys.
"""

import os
import tomllib
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, create_model

from inspe_jax.core.errors import InspeError, brief, nearest
from inspe_jax.core.files import check_model, read_toml
from inspe_jax.sensing.kinds import SENSOR_KINDS, DeviceKeys, Positive, keys_of
from inspe_jax.sensing.sensors import Spec


@dataclass(frozen=True)
class Device:
    """One row of a catalogue: a spec, its maker and its price.

    ``price_usd`` is a list price [US$] of the year in ``note``, None if none is public.
    ``source`` says where the figures come from, ``note`` what was assumed. ``product`` is False for
    the model of a device that nobody sells.
    """

    name: str
    kind: str
    title: str
    maker: str
    spec: Spec
    price_usd: float | None
    source: str
    note: str
    product: bool = True


def devices() -> dict[str, Device]:
    """The built-in catalogue by name, in the order of its file."""
    return dict(_built_in())


def device(name: str) -> Device:
    """A built-in device by name. Raises InspeError with the most similar names."""
    known = _built_in()
    if name not in known:
        hint = nearest(name, list(known))
        raise InspeError(f"no device '{name}': run 'inspe devices' for the list{hint}")
    return known[name]


def load_devices(path: str | os.PathLike[str]) -> dict[str, Device]:
    """Read a catalogue file (TOML, as ``catalogue.toml``) and return its devices by name.

    Raises InspeError with the file, the device, the key and what is allowed.
    """
    path = Path(path)
    return _parse(read_toml(path), str(path))


@cache
def _built_in() -> dict[str, Device]:
    resource = files("inspe_jax.sensing").joinpath("catalogue.toml")
    return _parse(tomllib.loads(resource.read_text("utf-8")), resource.name)


def _parse(tables: dict[str, Any], where: str) -> dict[str, Device]:
    if not tables:
        raise InspeError(f"{where}: the catalogue is empty: it needs one table for each device")
    return {name: _device(name, table, f"{where}: {name}") for name, table in tables.items()}


# ── The entries ─────────────────────────────────────────────────────────────

_Text = Annotated[str, Field(min_length=1)]


class _About(BaseModel):
    title: _Text
    maker: _Text
    source: _Text
    note: str = ""
    price_usd: Positive | None = None
    product: bool = True


@cache
def _entry(keys: type[DeviceKeys]) -> Any:
    """What a catalogue holds of a device: the keys of its kind, and what is known about it."""
    return create_model(keys.__name__, __base__=(keys, _About))


def spec_of(table: Any, name: str, where: str) -> Spec:
    """The spec of a user's own device, from the keys of a catalogue that make a spec.

    ``like`` may name a device of the built-in catalogue: its keys are taken where ``table`` gives
    none. Raises InspeError that names ``where``, the key and what is allowed.
    """
    table = _checked(table, where)
    if "like" in table:
        try:
            other = device(table.pop("like")).spec
        except InspeError as e:
            raise InspeError(f"{where}: like: {e}") from None
        table = SENSOR_KINDS[other.kind].combined(table_of(other), table)
    keys = _keys(table, where)
    return check_model(keys, table, where).spec(name, where)


@lru_cache(maxsize=1024)
def check_spec(spec: Spec) -> None:
    """Raise InspeError if a device has a number that no catalogue could have; the message names
    the key of a catalogue, in degrees and metres."""
    where = f"device '{spec.name}'"
    if spec.kind not in SENSOR_KINDS:
        return
    try:
        table = table_of(spec)
    except ZeroDivisionError:
        raise InspeError(f"{where}: it has no rays: a count of columns or rows is 0") from None
    spec_of(table, spec.name, where)


def table_of(spec: Spec) -> dict[str, Any]:
    """The catalogue keys of a spec, which :func:`spec_of` reads back.

    They are Python's numbers, also if the spec has NumPy's.
    """
    return SENSOR_KINDS[spec.kind].table(spec)


def _checked(table: Any, where: str) -> dict[str, Any]:
    """A device's table, which is a mapping. Raises InspeError."""
    if not isinstance(table, dict):
        raise InspeError(f"{where}: must be a table of one device, got {brief(table)}")
    return dict(table)


def _keys(table: dict[str, Any], where: str) -> type[DeviceKeys]:
    """The keys that the kind of a device has. Raises InspeError."""
    if "kind" not in table:
        raise InspeError(f"{where}: kind: missing key")
    return keys_of(table["kind"], where)


def _device(name: str, table: Any, where: str) -> Device:
    table = _checked(table, where)
    entry = check_model(_entry(_keys(table, where)), table, where)
    return Device(
        name=name,
        kind=entry.kind,
        title=entry.title,
        maker=entry.maker,
        spec=entry.spec(name, where),
        price_usd=entry.price_usd,
        source=entry.source,
        note=entry.note,
        product=entry.product,
    )
