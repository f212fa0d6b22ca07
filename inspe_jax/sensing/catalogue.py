"""Named devices: ``catalogue.toml``, whose head describes its keys, and specs from them.

The file is in degrees, metres and US dollars; specs are in radians.
"""

import tomllib
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from typing import Any

from inspe_jax.core.errors import InspeError, brief, error_at, nearest
from inspe_jax.core.files import check_model
from inspe_jax.sensing.kinds import SENSOR_KINDS
from inspe_jax.sensing.sensors import Spec


@dataclass(frozen=True)
class Device:
    """One row of the catalogue: a spec, its maker and its list price [US$] in the year of ``note``,
    None if none is public. ``source`` says where the figures come from, ``note`` what was assumed.
    ``product`` is False for the model of a device that nobody sells.

    >>> device = inspe_jax.device("hesai-xt32")
    >>> device.kind, device.maker, device.price_usd
    ('lidar', 'Hesai', None)
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
    """The built-in catalogue by name, in the order of its file.

    >>> [name for name in inspe_jax.devices() if name.startswith("paper")]
    ['paper-lidar-32', 'paper-lidar-64', 'paper-camera']
    """
    return dict(_built_in())


def device(name: str) -> Device:
    """A built-in device by name. Raises InspeError with the most similar names.

    >>> inspe_jax.device("hesai-xt32").spec.reach
    80.0
    """
    known = _built_in()
    if name not in known:
        hint = nearest(name, list(known))
        raise InspeError(f"no device '{name}': run 'inspe devices' for the list{hint}")
    return known[name]


_ABOUT = ("title", "maker", "source", "note", "price_usd", "product")


@cache
def _built_in() -> dict[str, Device]:
    resource = files("inspe_jax.sensing").joinpath("catalogue.toml")
    found = {}
    for name, table in tomllib.loads(resource.read_text("utf-8")).items():
        about = {"price_usd": None} | {key: table.pop(key) for key in _ABOUT if key in table}
        spec = spec_of(table, name, f"{resource.name}: {name}")
        found[name] = Device(name=name, kind=spec.kind, spec=spec, **about)
    return found


def spec_of(table: Any, name: str, where: str) -> Spec:
    """The spec of a user's own device, from the keys of a catalogue that make a spec.

    ``like`` may name a device of the built-in catalogue: its keys are taken where ``table`` gives
    none. Raises InspeError that names ``where``, the key and what is allowed.
    """
    if not isinstance(table, dict):
        raise InspeError(f"{where}: must be a table of one device, got {brief(table)}")
    table = dict(table)
    if "like" in table:
        with error_at(f"{where}: like"):
            other = device(str(table.pop("like"))).spec
        replaces = SENSOR_KINDS[other.kind].replaces
        gone = {key for own in table for key in replaces.get(own, ())}
        table = {key: x for key, x in table_of(other).items() if key not in gone} | table
    if "kind" not in table:
        raise InspeError(f"{where}: kind: missing key")
    kind = table["kind"]
    if not isinstance(kind, str) or kind not in SENSOR_KINDS:
        known = " or ".join(f"'{name}'" for name in SENSOR_KINDS)
        raise InspeError(f"{where}: kind: must be {known}, got {kind!r}")
    return check_model(SENSOR_KINDS[kind], table, where).spec(name, where)


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
    """The catalogue keys of a spec, which :func:`spec_of` reads back: Python's own numbers."""
    return SENSOR_KINDS[spec.kind].table(spec)
