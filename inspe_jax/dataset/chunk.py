"""What a worker does for a data set: records and writes a few frames of a scenario."""

import errno
import multiprocessing
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock

from inspe_jax.core.files import parse_yaml
from inspe_jax.dataset.formats.opv2v.reader import agent_ids
from inspe_jax.dataset.formats.opv2v.writer import PROTOCOL, write_frame, write_protocol
from inspe_jax.dataset.plan import ScenarioPlan
from inspe_jax.dataset.protocol import protocol_of
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import layout_text, parse_layout
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.recorder import Recorder, Server
from inspe_jax.study.sources import SceneSource
from inspe_jax.study.work import message_of, place_layout, release_compiled, scene_of

SIZE = 10
"""Frames of a chunk."""
FULL = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True)
class Chunk:
    """Frames ``first`` to ``last`` of a scenario that is written in ``folder``.

    ``left`` of them were not there when it was sent. Only one process at a time writes a chunk:
    it holds the file ``lock``. ``server`` is where the backend records, if it needs one.
    """

    plan: ScenarioPlan
    backend: str
    folder: Path
    lock: Path
    first: int
    last: int
    left: int
    server: Server | None = None

    @property
    def key(self) -> str:
        """A short text that is this chunk's own."""
        return f"{self.plan.key}-{self.first}"

    @property
    def scene(self) -> str:
        """The same for its scene."""
        return self.plan.scene

    @property
    def source(self) -> SceneSource:
        """Where its scene comes from."""
        return self.plan.source


@dataclass(frozen=True)
class Outcome:
    """What became of a chunk: ``error`` if it cannot be made, ``fault`` if it cannot be written.

    ``full``: since there is no room. ``notes`` tell what its recorder cannot do as asked.
    """

    error: str = ""
    fault: str = ""
    full: bool = False
    notes: tuple[str, ...] = ()


@dataclass
class _Desk:
    """The one recorder that a worker has open; what it is of, and its scenario's protocol."""

    of: str = ""
    recorder: Recorder | None = None
    protocol: dict[str, Any] | None = None
    notes: tuple[str, ...] = ()
    error: str = ""
    left: ExitStack | None = None
    closing: bool = False

    def set(self, scene: Scene, chunk: Chunk) -> None:
        """Open the recorder of a chunk, if it is another one; ``error`` says why it cannot be."""
        if self.of == chunk.plan.key:
            return
        self.clear()
        release_compiled(chunk.scene)
        self.of, plan = chunk.plan.key, chunk.plan
        try:
            source = plan.layout
            text = source.text or layout_text(place_layout(source, scene))
            content = {"name": source.name, **parse_yaml(text, source.name)}
            layout = parse_layout(content, source.name, source.name, scene)
            given = (scene, layout, plan.conditions, plan.recording, plan.seed, chunk.server)
            self.left = ExitStack()
            self.recorder = self.left.enter_context(recorder_of(chunk.backend, *given))
            self.notes = self.recorder.notes
            self.protocol = protocol_of(plan, content, chunk.backend, self.notes)
        except Exception as e:
            self.error = message_of(e)

    def clear(self) -> None:
        """Close the recorder."""
        left = self.left
        self.of, self.recorder, self.protocol, self.notes = "", None, None, ()
        self.error, self.left = "", None
        if left is not None:
            left.close()


_desk = _Desk()
_at_work = threading.Lock()


def build(chunk: Chunk) -> Scene | str:
    """The scene of a chunk; or what is wrong with it, for every chunk that is on it."""
    try:
        return scene_of(chunk.source, chunk.plan.build)
    except Exception as e:
        return message_of(e)


def work(scene: Scene | str, chunk: Chunk) -> Outcome:
    """Record and write the frames of a chunk that are not there.

    The files of a frame are the same whenever, and by whomever, it is made.
    """
    if isinstance(scene, str):
        return Outcome(error=scene)
    notes: tuple[str, ...] = ()
    try:
        with FileLock(chunk.lock):
            for t in _left(chunk):
                with _at_work:
                    if _desk.closing:
                        break
                    _desk.set(scene, chunk)
                    if _desk.error:
                        return Outcome(error=_desk.error)
                    notes = _desk.notes
                    try:
                        frame = replace(_desk.recorder.frame(t), number=t)  # type: ignore[union-attr]
                    except Exception as e:
                        return Outcome(error=f"frame {t}: {message_of(e)}")
                    if not (chunk.folder / PROTOCOL).exists():
                        write_protocol(chunk.folder, _desk.protocol or {}, frame.stations)
                    write_frame(chunk.folder, frame)
    except Exception as e:
        fault = os_error(e)
        if fault is None:
            return Outcome(error=message_of(e))
        return Outcome(fault=message_of(e), full=fault.errno in FULL)
    return Outcome(notes=notes)


def close() -> None:
    """Close the worker's recorder when it is done with its frame; it begins no other."""
    _desk.closing = True
    with _at_work:
        _desk.clear()


def os_error(e: BaseException) -> OSError | None:
    """The fault of the system that an error came from, if any."""
    seen: BaseException | None = e
    while seen is not None and not isinstance(seen, OSError):
        seen = seen.__cause__
    return seen


def _left(chunk: Chunk) -> Iterator[int]:
    """Frames of a chunk that are not there; no more once who sent it is gone."""
    sender = multiprocessing.parent_process()
    begun = (chunk.folder / PROTOCOL).exists()
    agents = [chunk.folder / str(agent) for agent in agent_ids(chunk.folder)] if begun else []
    for t in range(chunk.first, chunk.last + 1):
        if sender is not None and not sender.is_alive():
            return
        # A frame's YAML files are its last, and all agents' folders are there before any.
        if not agents or not all((agent / f"{t:06d}.yaml").exists() for agent in agents):
            yield t
