"""A recorder of random frames. Environment variables make it slow, or fill the disk.

It is a module because workers import the functions that they are sent.
"""

import errno
import importlib
import os
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from inspe_jax.core import files
from inspe_jax.core.errors import InspeError
from inspe_jax.dataset import Frame, Image, RoadUserBox, Scan, Station, chunk
from inspe_jax.scene.traffic.frames import CLASSES

SLOW, ROOM, PIDS = "MADE_UP_SLOW", "MADE_UP_ROOM", "MADE_UP_PIDS"
"""Names of variables: the seconds per frame; the number of files that the disk has room for; and a
folder in which each worker leaves a file named by its process id."""

_work = chunk.work


class Recorder:
    """Records the scene's traffic, and random pictures and points that depend on seed and frame."""

    def __init__(self, scene, layout, recording, seed):
        self.scene, self.layout, self.recording, self.seed = scene, layout, recording, seed
        self.notes = tuple(sorted({f"{s.spec.kind}: made up" for s in layout.sensors}))

    def frame(self, t):
        if self.layout.name == "broken" and t == 13:
            raise InspeError("the sun is too low")
        time.sleep(float(os.environ.get(SLOW, "0")))
        rng, traffic = np.random.default_rng([self.seed, t]), self.scene.traffic
        boxes = []
        for b in np.flatnonzero(traffic.valid[t]):
            kind = CLASSES[traffic.kind[t, b]]
            place = traffic.center[t, b], float(traffic.yaw[t, b]), traffic.size[t, b]
            track, velocity = int(traffic.track[t, b]), traffic.velocity[t, b]
            boxes.append(RoadUserBox(track, kind, f"a {kind}", *place, velocity))
        stations = [self.station(u, rng) for u in range(len(self.layout.units))]
        return Frame(t, t / self.recording.rate, tuple(boxes), tuple(stations))

    def station(self, u, rng):
        own = [(self.layout.sensors[s], self.layout.poses[s]) for s in self.layout.members()[u]]
        pose = np.array([*self.layout.units[u].base, 0, 0, 0])
        images = [image(pose, rng, self.recording.layers) for s, pose in own if is_camera(s)]
        scans = [scan(pose, rng) for s, pose in own if not is_camera(s)]
        return Station(u + 1, self.layout.units[u].name, pose, tuple(images), tuple(scans))


def is_camera(sensor):
    return sensor.spec.kind == "camera"


def image(pose, rng, layers):
    pixels = {
        "depth": rng.uniform(1, 50, (6, 8)).astype(np.float32),
        "instance": rng.integers(0, 9, (6, 8)),
        "semantic": rng.integers(0, 9, (6, 8)).astype(np.uint8),
    }
    intrinsic = np.array([[5.0, 0, 4], [0, 5.0, 3], [0, 0, 1]])
    rgb = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
    return Image(pose, intrinsic, rgb, **{key: pixels.get(key) for key in layers})


def scan(pose, rng):
    points = rng.uniform([-20, -20, -7, 0], [20, 20, -1, 1], (50, 4))
    return Scan(pose, points.astype(np.float32))


@contextmanager
def recorder_of(
    backend, scene, layout, conditions, recording, seed, server=None, appearance_seed=0
):
    if layout.name == "unheard of":
        raise InspeError("recording needs embreex, which is not installed")
    yield Recorder(scene, layout, recording, seed)


def work(scene, todo):
    """What `chunk.work` does, with this recorder."""
    chunk.recorder_of = recorder_of
    if PIDS in os.environ:
        (Path(os.environ[PIDS]) / str(os.getpid())).touch()
    files.os = os
    if ROOM in os.environ:
        files.os = SimpleNamespace(**{**vars(os), "replace": short_of_room(todo)})
    return _work(scene, todo)


def content(folder):
    """The content of every file of a data set, by its path, without lock files."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def here(patch):
    """Let a worker's functions in this process record with this recorder; ``patch`` undoes it."""
    patch.setattr(chunk, "recorder_of", recorder_of)
    patch.setattr(chunk, "_worker", chunk.WorkerState())


def record(writer, plan):
    """Record what is missing of a scenario, as a worker does; gives what it told of each chunk."""
    told = []
    for part in plan.chunks:
        place = writer.unfinished(plan), writer.lock(plan, part.start)
        todo = chunk.Chunk(
            plan, "embedded", *place, part, len(part), format=writer.generation.format
        )
        told.append(chunk.work(chunk.build(todo), todo))
        assert not told[-1].error
    return told


def short_of_room(todo):
    def replace(part, path):
        root = todo.folder.parents[2]
        if sum(len(names) for _, _, names in os.walk(root)) > int(os.environ[ROOM]):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        os.replace(part, path)

    return replace


def use():
    """Let `generate` send this function to workers; gives a function that undoes it."""
    module = importlib.import_module("inspe_jax.dataset.generate")
    before, module.work = module.work, work
    recorder = chunk.recorder_of

    def back():
        module.work, chunk.recorder_of = before, recorder

    return back
