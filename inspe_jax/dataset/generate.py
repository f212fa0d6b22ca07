"""Generates a data set with worker processes on this machine. A scenario is written under
``.unfinished``, where readers do not look, and moves into its split when it is complete."""

import errno
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from inspe_jax.core.digest import digest
from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.files import prepare_folder, read_yaml, write_text
from inspe_jax.dataset import manifest
from inspe_jax.dataset.chunk import Chunk, Outcome, build, close, work
from inspe_jax.dataset.folders import SPLITS, disk_size
from inspe_jax.dataset.formats.protocol_file import PROTOCOL
from inspe_jax.dataset.formats.registry import DEFAULT_FORMAT
from inspe_jax.dataset.manifest import GENERATION, MANIFEST, RECORDS, Fault
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.protocol import versions
from inspe_jax.jobs.engine import load_cluster, run_jobs
from inspe_jax.jobs.locks import ADVICE, check_versions, lock_folder
from inspe_jax.jobs.sources import message_of
from inspe_jax.simulation.backends import BACKENDS, server_of
from inspe_jax.simulation.recorder import Server

UNFINISHED = ".unfinished"
FORMAT = "inspe_jax data set 3"
CONTINUE = "give the same command again to resume"


class DatasetWriter:
    """The folder of a data set, locked by its run. ``there`` holds the complete frames of each
    scenario, as last counted; ``damage`` what was wrong with scenarios that had been complete."""

    def __init__(
        self,
        generation: Generation,
        folder: Path,
        backend: str,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        """Compare finished scenarios with their manifests; ``progress`` is called with (compared,
        all). Raises InspeError if the folder contains another data set or other files."""
        self.generation, self.folder, self.backend = generation, folder, backend
        self._check()
        self.there: dict[str, set[int]] = {}
        self.damage: dict[str, list[Fault]] = {}
        for plan in generation.scenarios:
            self.there[plan.name] = self._resume(plan)
            if progress:
                progress(len(self.there), len(generation.scenarios))

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

    def chunks(self, plan: ScenarioPlan, server: Server | None) -> list[Chunk]:
        """What is missing of a scenario, in parts."""
        folder, format = self.unfinished(plan), self.generation.format
        return [
            Chunk(plan, self.backend, folder, self.lock(plan, k.start), k, missing, server, format)
            for k in plan.chunks
            if (missing := len({*k} - self.there[plan.name]))
        ]

    def finish(self, plan: ScenarioPlan) -> bool:
        """Move a scenario into its split; gives False, and does not, if a frame is missing."""
        folder, place = self.unfinished(plan), self.place(plan)
        self.there[plan.name] = set(manifest.recorded_frames(folder))
        if len(self.there[plan.name]) < plan.frames:
            return False
        for part in folder.rglob(".*.part"):  # half-written files of a worker that was killed
            part.unlink()
        manifest.write_manifest(folder, [folder / PROTOCOL])
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

    def _check(self) -> None:
        """Write the record of the data set, or compare it with the one that is there."""
        path, made = self.folder / GENERATION, self.generation
        plans = [[p.name, p.split, p.seed, p.tags, p.key, p.files] for p in made.scenarios]
        record: dict[str, Any] = {
            "format": FORMAT,
            "name": made.name,
            "digest": digest(plans),
            "backend": self.backend,
            "frames": made.frames,
            "scenarios": {name: [p.name for p in plans] for name, plans in made.splits.items()},
            "versions": versions(self.backend),
        }
        if made.format != DEFAULT_FORMAT:
            record["data_format"] = made.format
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

    def _resume(self, plan: ScenarioPlan) -> set[int]:
        """Numbers of the complete frames of a scenario. A damaged one becomes unfinished again."""
        place, folder = self.place(plan), self.unfinished(plan)
        if place.exists():
            shutil.rmtree(place / RECORDS, ignore_errors=True)  # of a run that was killed
            # Files that the manifest does not know are left alone: they may be the user's.
            kept, found = manifest.compare(place, plan.frames, deep=True)
            if kept is None and not found:
                found = [Fault(place / MANIFEST, "is missing")]
            if not found:
                return set(range(plan.frames))
            self.damage[plan.name] = found
            shutil.rmtree(folder, ignore_errors=True)
            folder.parent.mkdir(parents=True, exist_ok=True)
            for name in (PROTOCOL, MANIFEST):
                (place / name).unlink(missing_ok=True)
            os.replace(place, folder)
        return set(manifest.recorded_frames(folder, deep=True))


@dataclass(frozen=True)
class GenerationResult:
    """The result of a run: ``scenarios`` and ``frames`` that are complete now, ``size`` of all
    files [bytes], frames ``recorded`` in ``seconds``; and by scenario, ``failures``, ``notes`` on
    what was not recorded as the layout has it, and ``repaired`` faults of its files."""

    folder: Path
    scenarios: int
    frames: int
    size: int
    recorded: int
    seconds: float
    failures: dict[str, str]
    notes: dict[str, tuple[str, ...]]
    repaired: dict[str, list[Fault]]


def generate(
    generation: Generation,
    folder: str | os.PathLike[str],
    backend: str | None = None,
    *,
    workers: int | None = None,
    server: Server | None = None,
    progress: Callable[[int, int], None] | None = None,
    checking: Callable[[int, int], None] | None = None,
) -> GenerationResult:
    """Generate the scenarios of a data set that ``folder`` does not have yet.

    A scenario appears as ``folder/SPLIT/SCENARIO`` when it is complete. After a run was killed,
    call this again: it continues, and gives the same bytes. Scenarios that are there are compared
    with their manifests, by digests, and those that are damaged are recorded again. Scripts that
    call this need the usual ``if __name__ == "__main__":``, because workers are processes.

    Args:
        generation: The plan, as of :func:`inspe_jax.dataset.load_generation`.
        folder: Where the set is.
        backend: One of :data:`~inspe_jax.simulation.backends.BACKENDS`, that of the plan if None.
        workers: Processes that share the work, a few frames at a time: one per core if None, or as
            many as the backend allows.
        server: Address of the server if the backend needs one, the usual one if None.
        progress: Called with (frames done, all frames).
        checking: Called with (scenarios compared, all).

    Returns:
        What is complete now. If a scenario cannot be generated, its error is in ``failures``, and
        the others are generated.

    Raises:
        InspeError: Dask is missing, no server answers, the disk is full or cannot be written to, or
            the folder contains something else. The files written until then are valid.
    """
    began = time.monotonic()
    backend = generation.backend if backend is None else backend
    check_known(backend, BACKENDS, "backend")
    most = BACKENDS[backend].most_workers
    if workers is not None and (workers < 1 or (most is not None and workers > most)):
        allowed = "1 or more" if most is None else f"{most} with backend {backend}"
        raise InspeError(f"workers {workers}: {allowed}")
    workers = most if workers is None else workers
    server = server_of(backend, server)
    try:
        place = prepare_folder(folder)
        with lock_folder(place, f".{GENERATION}.lock"):
            writer = DatasetWriter(generation, place, backend, checking)
            had = writer.frames
            failures, notes = _record(writer, workers, server, progress)
            if not failures:
                writer.clear()
            placed = [plan.frames for plan in generation.scenarios if writer.place(plan).exists()]
            return GenerationResult(
                folder=place,
                scenarios=len(placed),
                frames=sum(placed),
                size=sum(disk_size(place / top) for top in (*SPLITS, UNFINISHED)),
                recorded=writer.frames - had,
                seconds=time.monotonic() - began,
                failures=failures,
                notes=notes,
                repaired=writer.damage,
            )
    except OSError as e:
        if e.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise InspeError(f"{folder}: the disk is full; {CONTINUE}") from e


def _record(
    writer: DatasetWriter,
    workers: int | None,
    server: Server | None,
    progress: Callable[[int, int], None] | None,
) -> tuple[dict[str, str], dict[str, tuple[str, ...]]]:
    """Record what is missing. Gives the failures and the notes, see :class:`GenerationResult`."""
    generation = writer.generation
    chunks = {plan.name: writer.chunks(plan, server) for plan in generation.scenarios}
    unsettled = {name: len(own) for name, own in chunks.items()}
    recorded, failures, notes = writer.frames, dict[str, str](), dict[str, tuple[str, ...]]()

    def report() -> None:
        if progress:
            progress(recorded, generation.frames)

    def settle(plan: ScenarioPlan) -> None:
        if not unsettled[plan.name] and plan.name not in failures and not writer.finish(plan):
            failures[plan.name] = "some of its files were deleted; give the same command again"

    report()
    for plan in generation.scenarios:
        if not writer.place(plan).exists():
            settle(plan)
    todo = [chunk for own in chunks.values() for chunk in own]
    if not todo:
        return failures, notes
    if server is not None:
        server.reach()  # else every scenario would fail on its own
    with load_cluster().client(None, workers) as client:
        try:
            for chunk, found in run_jobs(client, todo, build, work, ahead=1):
                plan = chunk.plan
                outcome = Outcome(message_of(found)) if isinstance(found, Exception) else found
                if outcome.fault:
                    raise InspeError(f"{outcome.fault}; {CONTINUE}")
                unsettled[plan.name] -= 1
                if outcome.error:
                    failures.setdefault(plan.name, outcome.error)
                else:
                    recorded += chunk.missing
                    if outcome.notes:
                        notes[plan.name] = outcome.notes
                settle(plan)
                report()
        finally:
            with suppress(Exception):
                client.run(close, on_error="ignore")
    names = [plan.name for plan in generation.scenarios if plan.name not in failures]
    return failures, {name: notes[name] for name in names if name in notes}
