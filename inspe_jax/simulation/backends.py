"""The registry of backends, which record scenes; recorders are imported when they are opened."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.recorder import Recorder, Recording, Server


@dataclass(frozen=True)
class Backend:
    """A way to record: ``open`` takes the keywords of :func:`recorder_of` but ``backend``; bytes
    depend on ``packages``; a ``remote`` one needs a server; ``most_workers`` processes record at
    once."""

    open: Callable[..., AbstractContextManager[Recorder]]
    packages: tuple[str, ...]
    remote: bool = False
    most_workers: int | None = None


def _embedded(server: None, **options: Any) -> AbstractContextManager[Recorder]:
    from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder

    return nullcontext(EmbeddedRecorder(**options))


def _carla(**options: Any) -> AbstractContextManager[Recorder]:
    from inspe_jax.simulation.carla.recorder import CarlaRecorder

    return CarlaRecorder(**options)


BACKENDS: dict[str, Backend] = {
    "embedded": Backend(_embedded, ("embreex",)),
    "carla": Backend(_carla, ("carla",), remote=True, most_workers=1),  # a server has one world
}
"""The backends by name."""
DEFAULT_BACKEND = "embedded"


def server_of(backend: str, server: Server | None) -> Server | None:
    """The server of a backend, None if it needs none. Raises InspeError where it is not valid."""
    if not BACKENDS[backend].remote:
        if server is not None:
            remote = " or ".join(name for name, row in BACKENDS.items() if row.remote)
            raise InspeError(f"server {server}: goes with backend {remote}, and this is {backend}")
        return None
    server = server or Server()
    server.check()
    return server


def recorder_of(
    backend: str,
    scene: Scene,
    layout: Layout,
    conditions: Conditions = FAIR,
    recording: Recording | None = None,
    seed: int = 0,
    server: Server | None = None,
    appearance_seed: int = 0,
) -> AbstractContextManager[Recorder]:
    """A recorder of a scene's traffic, to be opened. Raises InspeError for unknown backends."""
    check_known(backend, BACKENDS, "backend")
    seeds = dict(seed=seed, appearance_seed=appearance_seed)
    given = dict(conditions=conditions, recording=recording, server=server)
    return BACKENDS[backend].open(scene=scene, layout=layout, **given, **seeds)
