"""Checks the files of a data set against the manifests that were written with them."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import read_yaml
from inspe_jax.dataset.folders import Dataset, Scenario, open_dataset
from inspe_jax.dataset.manifest import Fault, compare

GENERATION = "generation.yaml"
"""The record of a generated data set: among other things, which scenarios it has."""


@dataclass(frozen=True)
class Check:
    """The result of a check.

    ``scenarios``, ``files`` and ``size`` [bytes] are those with a manifest. ``faults`` are what is
    wrong with them; ``unknown`` are scenarios without a manifest, of which nothing can be said.
    """

    scenarios: int
    files: int
    size: int
    faults: tuple[Fault, ...]
    unknown: tuple[Path, ...]

    @property
    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "scenarios": self.scenarios,
            "files": self.files,
            "bytes": self.size,
            "faults": [{"file": str(fault.path), "what": fault.what} for fault in self.faults],
            "without_manifest": [str(path) for path in self.unknown],
        }


def check(
    given: Dataset | str | os.PathLike[str],
    deep: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Check:
    """Compare every file of a data set with its manifest: by size, and if ``deep`` by digest.

    Scenarios that a generated data set should have and has not are faults, too. ``progress`` is
    called with the number of scenarios done and of all. Raises InspeError if there is no such data
    set.
    """
    data = given if isinstance(given, Dataset) else open_dataset(given)
    found = [*_missing_scenarios(data)]
    files = size = known = 0
    unknown = []
    for number, scenario in enumerate(data.scenarios, 1):
        manifest, own = compare(scenario.path, _frame_count(scenario), deep, others=True)
        found += own
        if manifest is not None:
            known, size = known + 1, size + manifest.size
            files += len(manifest.files)
        elif not own:
            unknown.append(scenario.path)
        if progress:
            progress(number, len(data.scenarios))
    return Check(known, files, size, tuple(found), tuple(unknown))


def differing(scenario: Scenario) -> list[Fault]:
    """The files of a scenario that have not the size that its manifest says, if it has one.

    Files that the manifest does not know are left out.
    """
    return compare(scenario.path)[1]


def _frame_count(scenario: Scenario) -> int | None:
    """How many frames the protocol says there are; a damaged one is a fault of its own."""
    try:
        told = scenario.protocol
        return round(told["settings"]["seconds"] * told["recording"]["rate_hz"])
    except (InspeError, KeyError, TypeError):
        return None


def _missing_scenarios(data: Dataset) -> list[Fault]:
    path = data.path / GENERATION
    record = read_yaml(path) if path.is_file() else None
    scenarios = record.get("scenarios") if isinstance(record, dict) else None
    named = scenarios.items() if isinstance(scenarios, dict) else ()
    there = {scenario.path for scenario in data.scenarios}
    return [
        Fault(place, "is missing: the same `inspe generate` records it again")
        for split, names in named
        for name in names or ()
        if (place := data.path / str(split) / str(name)) not in there
    ]
