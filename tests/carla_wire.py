"""A CARLA 0.9.16 server without a simulator, for the unmodified client: the wire.

`serving` starts one in a process of its own, on the loopback only. What it tells is in
`carla_world`, what its sensors see in `carla_rays`. A layout that the client does not expect ends
the client's process: clients of tests run in processes of their own.

**Calls** are msgpack over TCP. A request is [0, id, name, [[no reply wanted], *arguments]], a reply
[1, id, nil, response], a response [[1, value]], [[False]] for nothing, or [[0, [text]]], which a
client raises as RuntimeError. `get_world` waits for a snapshot, which the server brings by itself;
`apply_settings` sends tick_cues until snapshots tell the time [True, seconds]; `tick` waits for the
frame that tick_cue answered, and measurements come after it. In SpawnActor, what is to be done then
has 0 for the actor that is spawned. `load_world` begins anew with get_episode_info, of another id;
what listened to snapshots is thrown away meanwhile.

**Streams.** A client connects once for each thing it listens to and sends the u32 number of the
stream; the server sends u32 lengths and payloads. `listen` returns before that connection is made;
here a tick waits for who asked for a stream. Payloads begin with kind and frame u64, time f64, and
a pose in f32; a snapshot has 119 bytes an actor, of which 54 are of vehicles and traffic lights.
"""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingTCPServer
from typing import Any

import msgpack
from carla_rays import matrix, picture, scan
from carla_world import SNAPSHOTS, STEP, VERSION, Actor, Refused, World

KINDS = {
    "sensor.camera.depth": 1,
    "sensor.lidar.ray_cast": 11,
    "sensor.camera.rgb": 13,
    "sensor.camera.semantic_segmentation": 14,
    "snapshot": 17,
}
"""The type of a payload: the sensor's index in CARLA's registry."""


class Wire:
    """A world and its listeners; code that uses either holds `changed`. Sensors `mute` go silent
    `after` so many measurements; `version` is what the server says that it is."""

    def __init__(
        self,
        maps: Sequence[Path],
        scenery: Sequence[dict] = (),
        mute: str = "",
        after: int = 0,
        version: str = VERSION,
    ):
        self.servers = [Server(self, Calls), Server(self, Streams)]
        self.port, self.stream_port = (server.server_address[1] for server in self.servers)
        self.world = World(maps, self.token, scenery, version)
        self.mute, self.left = mute, after
        self.changed = threading.Condition()
        self.listeners: dict[int, list[socket.socket]] = defaultdict(list)

    def run(self) -> None:
        """Serve from threads that end with the process."""
        for work in (*(server.serve_forever for server in self.servers), self.flow):
            threading.Thread(target=work, daemon=True).start()

    def flow(self) -> None:
        """Ticks by itself, unless a client switched synchronous mode on."""
        while True:
            time.sleep(STEP)
            with self.changed:
                if not self.world.settings[0] and time.monotonic() > self.world.loaded:
                    self.gather()
                    self.world.tick_cue()
                    self.publish()

    def answer(self, message: list, connection: socket.socket) -> None:
        """Replies first, and publishes the frame afterwards, as CARLA does."""
        _, number, name, (_, *arguments) = message
        with self.changed:
            if name in ("tick_cue", "apply_batch"):
                self.gather()
            if name == "apply_batch":
                reply = [attempt(self.world.command, *command) for [command] in arguments[0]]
                if arguments[1]:
                    self.world.tick_cue()
            else:
                reply = attempt(lambda: getattr(self.world, name)(*arguments))
            connection.sendall(msgpack.packb([1, number, None, reply]))
            if self.world.ticked:
                self.publish()

    def gather(self) -> None:
        """Waits until all clients that asked for a stream have connected to it."""
        if not self.changed.wait_for(lambda: not +self.world.awaited, timeout=2):
            self.world.awaited.clear()

    def publish(self) -> None:
        self.send(self.snapshot(), self.listeners[SNAPSHOTS])
        self.world.ticked = self.world.fresh = False
        for actor in list(self.world.actors.values()):
            if (listeners := self.listeners.get(actor.stream)) and not self.silent(actor):
                self.send(self.measurement(actor), listeners)

    def silent(self, actor: Actor) -> bool:
        if actor.blueprint.name != self.mute:
            return False
        self.left -= 1
        return self.left < 0

    def header(self, kind: str, where: Sequence[float]) -> bytes:
        return struct.pack("<QQd6f", KINDS[kind], self.world.frame, self.world.time, *where)

    def measurement(self, actor: Actor) -> bytes:
        name, spec, where = actor.blueprint.name, actor.attributes, matrix(actor.pose)
        boxes, head = self.world.boxes(), self.header(name, actor.pose)
        if name == "sensor.lidar.ray_cast":
            counts, points = scan(spec, where, boxes, self.world.step)
            head += struct.pack("<fI", 0.0, len(counts))
            return head + struct.pack(f"<{len(counts)}I", *counts) + points.tobytes()
        image = picture(name.rpartition(".")[2], spec, where, boxes, self.world.frame)
        height, width, _ = image.shape
        return head + struct.pack("<IIf", width, height, float(spec["fov"])) + image.tobytes()

    def snapshot(self) -> bytes:
        world = self.world
        body = struct.pack("<Qdf", world.episode, time.time(), world.step)
        body += struct.pack("<3iI", 0, 0, 0, world.fresh)
        for actor in world.actors.values():
            body += struct.pack("<IB6f", actor.number, 1, *actor.pose) + bytes(36 + 54)
        return self.header("snapshot", (0.0,) * 6) + body

    def token(self, stream: int) -> bytes:
        return struct.pack("<IHBB4B12x", stream, self.stream_port, 1, 1, 127, 0, 0, 1)

    def subscribe(self, stream: int, connection: socket.socket) -> None:
        """A new listener gets the last snapshot, so that no client waits for a past frame."""
        with self.changed:
            self.listeners[stream].append(connection)
            self.world.awaited[stream] -= 1
            if stream == SNAPSHOTS:
                self.send(self.snapshot(), [connection])
            self.changed.notify_all()

    def unsubscribe(self, stream: int, connection: socket.socket) -> None:
        with self.changed:
            self.listeners[stream].remove(connection)

    def send(self, payload: bytes, to: Sequence[socket.socket]) -> None:
        """Waits for slow readers, as CARLA does in synchronous mode."""
        for connection in to:
            with suppress(OSError):  # a client that has just disconnected
                connection.sendall(struct.pack("<I", len(payload)) + payload)


def attempt(work: Callable, *arguments: Any) -> list:
    try:
        value = work(*arguments)
    except Refused as error:
        return [[0, [str(error)]]]
    except Exception as error:  # an error here must be visible there, instead of a timeout
        traceback.print_exc()
        return [[0, [f"the server failed: {error!r}"]]]
    return [[False]] if value is None else [[1, value]]


class Server(ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, wire: Wire, handler: type):
        self.wire = wire
        super().__init__(("127.0.0.1", 0), handler)


class Calls(StreamRequestHandler):
    disable_nagle_algorithm = True

    def handle(self) -> None:
        unpacker = msgpack.Unpacker()
        with suppress(OSError):
            while chunk := self.request.recv(1 << 16):
                unpacker.feed(chunk)
                for message in unpacker:
                    self.server.wire.answer(message, self.request)


class Streams(StreamRequestHandler):
    disable_nagle_algorithm = True

    def handle(self) -> None:
        asked = self.rfile.read(4)
        if len(asked) < 4:
            return
        (stream,) = struct.unpack("<I", asked)
        self.server.wire.subscribe(stream, self.request)
        with suppress(OSError):
            while self.request.recv(1 << 12):
                pass
        self.server.wire.unsubscribe(stream, self.request)


@contextmanager
def serving(*maps: Path, **options: Any) -> Iterator[int]:
    """The port of a server in a process of its own, as of `Wire`; the first map is open."""
    given = json.dumps({"maps": [*map(str, maps)], **options})
    command = [sys.executable, __file__, given]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield int(process.stdout.readline())
        finally:
            process.terminate()


def main() -> None:
    given = json.loads(sys.argv[1])
    parent = os.getppid()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    wire = Wire([*map(Path, given.pop("maps"))], **given)
    wire.run()
    print(wire.port, flush=True)
    while os.getppid() == parent:
        time.sleep(0.2)


if __name__ == "__main__":
    main()
