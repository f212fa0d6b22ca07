"""The work of a worker process: it records and writes a few frames of a scenario."""

import multiprocessing
import threading
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from filelock import FileLock

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import parse_yaml
from inspe_jax.dataset.formats.other_readers import lidar_range, with_cameras
from inspe_jax.dataset.formats.protocol_file import PROTOCOL, write_protocol
from inspe_jax.dataset.formats.registry import DEFAULT_FORMAT, FORMATS
from inspe_jax.dataset.manifest import record_frame, recorded_frames
from inspe_jax.dataset.plan import ScenarioPlan
from inspe_jax.dataset.points_in_boxes import with_counts
from inspe_jax.dataset.protocol import protocol_of
from inspe_jax.jobs.sources import SceneSource, message_of, place_layout, release_compiled, scene_of
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout, layout_text, parse_layout
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.simulation.backends import recorder_of
from inspe_jax.simulation.recorder import Recorder, Server


@dataclass(frozen=True)
class Chunk:
    """Some frames of a scenario, for ``folder`` under ``lock``; so many are ``missing``."""

    plan: ScenarioPlan
    backend: str
    folder: Path
    lock: Path
    frames: range
    missing: int
    server: Server | None = None
    format: str = DEFAULT_FORMAT

    @property
    def key(self) -> str:
        """A short text that identifies the chunk."""
        return f"{self.plan.key}-{self.frames.start}"

    @property
    def scene(self) -> str:
        """A short text that identifies its scene."""
        return self.plan.scene

    @property
    def source(self) -> SceneSource:
        """Where its scene comes from."""
        return self.plan.source


@dataclass(frozen=True)
class Outcome:
    """Why a chunk could not be recorded (``error``) or written (``fault``), and notes."""

    error: str = ""
    fault: str = ""
    notes: tuple[str, ...] = ()


@dataclass
class WorkerState:
    """The recorder that a worker process has open. Once ``closing``, no frame is begun."""

    key: str = ""
    recorder: Recorder | None = None
    protocol: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    stack: ExitStack = field(default_factory=ExitStack)
    closing: bool = False

    def open(self, scene: Scene, chunk: Chunk) -> Recorder:
        """The recorder of a chunk's scenario; that of another one is closed."""
        plan = chunk.plan
        if self.recorder is not None and self.key == plan.key:
            return self.recorder
        self.close()
        release_compiled(chunk.scene)
        layout, content = layout_of(plan, scene)
        given = (scene, layout, plan.conditions, plan.recording, plan.seed, chunk.server)
        opened = recorder_of(chunk.backend, *given, plan.appearance_seed)
        recorder = self.stack.enter_context(opened)
        short = scene.shortfall
        self.notes = (*recorder.notes, *([f"road users: {short}"] if short else []))
        about = (chunk.backend, self.notes, chunk.format, scene.voxels.center.tolist())
        self.protocol = protocol_of(plan, content, *about)
        self.key, self.recorder = plan.key, recorder
        return recorder

    def close(self) -> None:
        """Close the recorder, if one is open."""
        self.recorder = None
        self.stack.close()


_worker = WorkerState()
_recording = threading.Lock()


def layout_of(plan: ScenarioPlan, scene: Scene) -> tuple[Layout, dict[str, Any]]:
    """The layout of a scenario on its scene, and its content as in a layout file."""
    source = plan.layout
    text = source.text or layout_text(place_layout(source, scene))
    content = {"name": source.name, **parse_yaml(text, source.name)}
    layout = parse_layout(content, source.name, source.name, scene)
    for sensor in layout.sensors:
        if isinstance(sensor.spec, CameraSpec) and sensor.spec.bends:
            raise InspeError(
                f"{source.name}: {sensor.spec.name}: formats and detectors of data sets know "
                "pinholes alone: give a device without 'lens', 'distortion' and 'image_circle_deg'"
            )
    return layout, content


def build(chunk: Chunk) -> Scene | str:
    """The scene of a chunk; or the message of the error, if it cannot be built."""
    try:
        return scene_of(chunk.source, chunk.plan.build)
    except Exception as e:
        return message_of(e)


def work(scene: Scene | str, chunk: Chunk) -> Outcome:
    """Record and write the missing frames of a chunk, to the same bytes whoever does it."""
    if isinstance(scene, str):
        return Outcome(error=scene)
    notes, options = tuple[str, ...](), chunk.plan.files
    try:
        with FileLock(chunk.lock):
            sender = multiprocessing.parent_process()
            for t in sorted({*chunk.frames} - set(recorded_frames(chunk.folder))):
                if sender is not None and not sender.is_alive():
                    break
                with _recording:
                    if _worker.closing:
                        break
                    try:
                        recorder = _worker.open(scene, chunk)
                        frame = replace(recorder.frame(t), number=t)
                    except Exception as e:
                        return Outcome(error=f"frame {t}: {message_of(e)}")
                    notes = _worker.notes
                    frame = with_counts(frame)
                    if not (chunk.folder / PROTOCOL).is_file():
                        agents = with_cameras(frame.stations, options.cameras_per_agent)
                        range_ = {"lidar_range": lidar_range(agents, scene.voxels)}
                        write_protocol(chunk.folder, _worker.protocol | range_, agents)
                    files = FORMATS[chunk.format].write(chunk.folder, frame, options)
                    record_frame(chunk.folder, t, files)
    except Exception as e:
        if isinstance(e, OSError) or isinstance(e.__cause__, OSError):
            return Outcome(fault=message_of(e))
        return Outcome(error=message_of(e))
    return Outcome(notes=notes)


def close() -> None:
    """Close the worker's recorder after its current frame; no other frame is begun."""
    _worker.closing = True
    with _recording:
        _worker.close()
