"""The registry of recorders: adding one is adding a row."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.recorder import Recorder, Recording, Server

Opening = Callable[..., AbstractContextManager[Recorder]]


@dataclass(frozen=True)
class Backend:
    """A way to record: ``open`` gives a recorder of a scene, a layout, conditions, a recording, a
    seed and a server; ``packages`` are those that its bytes depend on; ``remote`` backends record
    with a server."""

    open: Opening
    packages: tuple[str, ...]
    remote: bool = False


def _embedded(*given: Any) -> AbstractContextManager[Recorder]:
    return nullcontext(EmbeddedRecorder(*given[:-1]))


def _carla(*given: Any) -> AbstractContextManager[Recorder]:
    from inspe_jax.simulation.carla.recorder import CarlaRecorder

    return CarlaRecorder(*given)


BACKENDS: dict[str, Backend] = {
    "embedded": Backend(_embedded, ("embreex",)),
    "carla": Backend(_carla, ("carla",), remote=True),
}
"""What can record."""


def check_backend(backend: str) -> None:
    """Raise InspeError for a backend that is not in :data:`BACKENDS`."""
    if backend not in BACKENDS:
        known = tuple(BACKENDS)
        raise InspeError(f"backend '{backend}': one of {', '.join(known)}{nearest(backend, known)}")


def server_of(backend: str, server: Server | None) -> Server | None:
    """The server that a backend records with: CARLA's usual one if none is given, or None.

    Raises InspeError where one is given and the backend needs none, or its values are out of range.
    """
    if BACKENDS[backend].remote:
        server = server or Server()
        server.check()
        return server
    if server is not None:
        raise InspeError(f"server {server}: goes with backend carla, and this is {backend}")
    return None


def recorder_of(
    backend: str,
    scene: Scene,
    layout: Layout,
    conditions: Conditions = FAIR,
    recording: Recording | None = None,
    seed: int = 0,
    server: Server | None = None,
) -> AbstractContextManager[Recorder]:
    """A recorder by the name of its backend, in :data:`BACKENDS`. Raises InspeError for another.

    ``server`` is for those that need one.
    """
    check_backend(backend)
    return BACKENDS[backend].open(scene, layout, conditions, recording, seed, server)
