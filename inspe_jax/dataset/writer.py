"""A data set on disk while it is generated.

A scenario is written under ``.unfinished``, where readers do not look, and moves into its split
when it is complete: also after a kill the splits hold complete scenarios only.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import prepare_folder, read_yaml, write_text
from inspe_jax.dataset.folders import SPLITS, disk_size
from inspe_jax.dataset.formats.protocol_file import PROTOCOL
from inspe_jax.dataset.formats.registry import DEFAULT_FORMAT
from inspe_jax.dataset.manifest import (
    GENERATION,
    MANIFEST,
    RECORDS,
    Fault,
    compare,
    recorded_frames,
    write_manifest,
)
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.protocol import versions
from inspe_jax.jobs.locks import ADVICE, check_versions, lock_folder

UNFINISHED = ".unfinished"
FORMAT = "inspe_jax data set 2"


class DatasetWriter:
    """The folder of a data set, locked for one run.

    ``there`` holds the numbers of the complete frames of each scenario, by name, as last counted;
    ``damage`` what was found wrong with scenarios that had been complete.
    """

    def __init__(
        self,
        generation: Generation,
        folder: str | os.PathLike[str],
        backend: str,
        deep: bool = True,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Compare finished scenarios with their manifests: ``deep`` by digests, else by sizes.

        ``progress`` is called with the number of scenarios compared and of all. Raises InspeError
        if the folder cannot be written to, another run uses it, or it contains another data set or
        other files.
        """
        self.folder = prepare_folder(folder)
        self.format_name = generation.format
        self._lock = lock_folder(self.folder, f".{GENERATION}.lock")
        try:
            self._check(record_of(generation, backend))
            self.there: dict[str, set[int]] = {}
            self.damage: dict[str, list[Fault]] = {}
            for plan in generation.scenarios:
                self.there[plan.name] = self._resume(plan, deep)
                if progress:
                    progress(len(self.there), len(generation.scenarios))
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def place(self, plan: ScenarioPlan) -> Path:
        """The folder of a finished scenario."""
        return self.folder / plan.split / plan.name

    def unfinished(self, plan: ScenarioPlan) -> Path:
        """The folder of a scenario that is not finished yet."""
        return self.folder / UNFINISHED / plan.split / plan.name

    def lock(self, plan: ScenarioPlan, first: int) -> Path:
        """The lock file of the chunk of a scenario that begins with frame ``first``."""
        locks = self.folder / UNFINISHED / ".locks"
        locks.mkdir(parents=True, exist_ok=True)
        return locks / f"{plan.key}-{first}.lock"

    def finish(self, plan: ScenarioPlan) -> bool:
        """Move a scenario into its split. Gives False, and does not move it, if a frame is
        missing."""
        folder, place = self.unfinished(plan), self.place(plan)
        self.there[plan.name] = set(recorded_frames(folder))
        if len(self.there[plan.name]) < plan.frames:
            return False
        for part in folder.rglob(".*.part"):  # half-written files of a worker that was killed
            part.unlink()
        write_manifest(folder, [folder / PROTOCOL])
        place.parent.mkdir(exist_ok=True)
        os.replace(folder, place)
        shutil.rmtree(place / RECORDS)
        return True

    def clear(self) -> None:
        """Delete the files that were needed only while the data set was generated."""
        shutil.rmtree(self.folder / UNFINISHED, ignore_errors=True)

    @property
    def frames(self) -> int:
        """Number of complete frames, as last counted."""
        return sum(map(len, self.there.values()))

    @property
    def size(self) -> int:
        """Size of all scenarios, finished or not [bytes]."""
        return sum(disk_size(self.folder / top) for top in (*SPLITS, UNFINISHED))

    def _check(self, record: dict[str, Any]) -> None:
        """Write the record of the data set, or compare it with the one that is there."""
        path = self.folder / GENERATION
        text = yaml.safe_dump(record, sort_keys=False, default_flow_style=None)
        if not path.exists():
            names = (path.name for path in self.folder.iterdir())
            strange = [name for name in names if not name.startswith(f".{GENERATION}.")]
            if strange:
                raise InspeError(
                    f"{self.folder}: has no {GENERATION}, so it is no data set, but is not empty: "
                    f"{strange[0]}; name another folder"
                )
            write_text(path, text)
            return
        kept = read_yaml(path)
        if not isinstance(kept, dict) or kept.get("format") != FORMAT:
            raise InspeError(f"{path}: not written by this version of the package; {ADVICE}")
        for key in ("backend", "data_format", "digest"):
            if kept.get(key) != record.get(key):
                what = f"'{kept.get('name')}'" if key == "digest" else f"{key} {kept.get(key)}"
                raise InspeError(
                    f"{self.folder}: holds another data set, {what}, with other scenarios or "
                    f"recorded in another way; {ADVICE}"
                )
        check_versions(kept.get("versions") or {}, record["versions"], self.folder)

    def _resume(self, plan: ScenarioPlan, deep: bool) -> set[int]:
        """Numbers of the complete frames of a scenario.

        A finished scenario of which a file is damaged or missing becomes unfinished again.
        """
        place, folder = self.place(plan), self.unfinished(plan)
        if place.exists():
            shutil.rmtree(place / RECORDS, ignore_errors=True)  # of a run that was killed
            # Files that the manifest does not know are left alone: they may be the user's.
            manifest, found = compare(place, plan.frames, deep)
            if manifest is None and not found:
                found = [Fault(place / MANIFEST, "is missing")]
            if not found:
                return set(range(plan.frames))
            self.damage[plan.name] = found
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(parents=True, exist_ok=True)
            for name in (PROTOCOL, MANIFEST):
                (place / name).unlink(missing_ok=True)
            os.replace(place, folder)
        return set(recorded_frames(folder, deep))


def record_of(generation: Generation, backend: str) -> dict[str, Any]:
    """The content of a data set's ``generation.yaml``."""
    plans = [[p.name, p.split, p.seed, p.tags, p.key, p.files] for p in generation.scenarios]
    record: dict[str, Any] = {
        "format": FORMAT,
        "name": generation.name,
        "digest": digest(plans),
        "backend": backend,
        "frames": generation.frames,
        "scenarios": {name: [p.name for p in plans] for name, plans in generation.splits.items()},
        "versions": versions(backend),
    }
    other = generation.format != DEFAULT_FORMAT
    return record | ({"data_format": generation.format} if other else {})
