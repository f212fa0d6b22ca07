"""The file that says what made a scenario, and the YAML that formats share."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from inspe_jax.core.errors import InspeError, brief
from inspe_jax.core.files import read_yaml, write_text
from inspe_jax.simulation.frame import Station

PROTOCOL = "data_protocol.yaml"  # the name of the file, in the scenario's folder


class _Dumper(yaml.CSafeDumper):
    """YAML without anchors: an object that is in two dictionaries is written twice."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def write_protocol(
    scenario: str | os.PathLike[str], protocol: Mapping[str, Any], stations: Iterable[Station] = ()
) -> None:
    """Write what made a scenario into its folder, as :data:`PROTOCOL`, with the names of
    ``stations``. ``world`` must have fixed_delta_seconds (the time step [s]), client_port, seed,
    weather and town, which some readers need. Raises InspeError where a key is missing, or YAML
    cannot hold a value."""
    path = make_folder(Path(scenario)) / PROTOCOL
    for key in ("fixed_delta_seconds", "client_port", "seed", "weather", "town"):
        if key not in section_of(protocol, "world"):
            raise InspeError(f"{path}: world.{key}: missing key")
    names = {-station.number: station.name for station in stations}
    content = {**protocol, "stations": names} if names else dict(protocol)
    try:
        text = dump_yaml(content)
    except yaml.YAMLError as e:
        raise InspeError(f"{path}: {' '.join(str(e).split())}") from e
    write_text(path, text)


def read_protocol(scenario: Path) -> dict[str, Any]:
    """What made a scenario; empty if nothing says so. Raises InspeError if it is not YAML."""
    path = scenario / PROTOCOL
    return as_mapping(read_yaml(path), path) if path.is_file() else {}


def section_of(protocol: Mapping[str, Any], key: str) -> Mapping[Any, Any]:
    """A section of a protocol; empty where there is none."""
    found = protocol.get(key)
    return found if isinstance(found, Mapping) else {}


def make_folder(path: Path) -> Path:
    """Make a folder and those above it, and return it. Raises InspeError where that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InspeError(f"{path}: the folder cannot be created: {e.strerror}") from e
    return path


def dump_yaml(content: Mapping[str, Any]) -> str:
    """YAML in the order given, with each list of numbers on one line."""
    text: str = yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=2**31 - 1
    )
    return text


def as_mapping(content: Any, where: object) -> dict[str, Any]:
    """The content, if it is a mapping. Raises InspeError, which names ``where``, otherwise."""
    if not isinstance(content, dict):
        raise InspeError(f"{where}: must hold keys with values, got {brief(content)}")
    return content
