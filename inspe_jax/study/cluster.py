"""Dask: a client of a running scheduler, or of a cluster on this machine."""

import logging
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import dask
import jax
from distributed import Client, LocalCluster, Worker, WorkerPlugin

from inspe_jax.core.errors import InspeError
from inspe_jax.core.parallel import cores
from inspe_jax.study.work import versions


@contextmanager
def client(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """A client of the scheduler at an address; or, without one, of a cluster of so many workers
    on this machine, a process a core if not given, which ends with it.

    Raises InspeError where no scheduler answers, or its workers are none or of other versions.
    """
    if scheduler is not None:
        try:
            there = Client(scheduler, timeout=TIMEOUT)
        except (OSError, TimeoutError, ValueError) as e:
            raise InspeError(f"scheduler '{scheduler}' does not answer: {e}") from e
        with there:
            _check_workers(there, scheduler)
            yield there
        return
    count = workers or cores()
    with (
        _kept_memory(),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            # Dask knows nothing of JAX's memory, and would pause a worker for it without a word.
            memory_limit=None,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            # Jobs are given up for dying workers twice over, the second time alone (engine.py).
            scheduler_kwargs={"allowed_failures": 1},
        ) as cluster,
        Client(cluster) as here,
    ):
        here.register_plugin(WorkerSetup(count))
        # A worker that dies while it starts is not started again, unless somebody asks.
        cluster.adapt(minimum=count, maximum=count, interval="1s")
        yield here
        # Dask cannot end one that is just being started again.
        with suppress(TimeoutError):
            here.wait_for_workers(count, timeout=TIMEOUT)


@contextmanager
def _kept_memory() -> Iterator[None]:
    """Workers that are started here keep memory by :data:`MEMORY`, and nobody else does."""
    had = {name: os.environ.get(name) for name in MEMORY}
    try:
        with dask.config.set(
            {f"distributed.nanny.pre-spawn-environ.{k}": v for k, v in MEMORY.items()}
        ):
            yield
    finally:  # Dask leaves them in the environment
        for name, value in had.items():
            os.environ.pop(name, None)
            os.environ |= {} if value is None else {name: value}


MEMORY = {"MALLOC_TRIM_THRESHOLD_": 2**27, "MALLOC_MMAP_THRESHOLD_": 2**25}
"""What workers keep of the memory that they free [byte], for the next arrays (mallopt(3)).

By Dask's own setting they give all back at once, and spend a third of their time on getting it.
"""

TIMEOUT = 10
"""How long a scheduler may take to answer [s]."""


def _check_workers(there: Client, scheduler: str) -> None:
    if not there.nthreads():
        raise InspeError(f"scheduler '{scheduler}' has no workers yet: start some")
    for worker, found in there.run(versions, on_error="return").items():
        if isinstance(found, Exception):
            raise InspeError(f"worker {worker} cannot work: {type(found).__name__}: {found}")
        for name, version in versions().items():
            if found.get(name) != version:
                raise InspeError(
                    f"worker {worker} has {name} {found.get(name)}, and this is {version}: rows "
                    "of different versions do not belong in one table"
                )


COMPILED = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
)
"""JAX's settings of where it keeps what it compiles."""


class WorkerSetup(WorkerPlugin):
    """What each of so many workers of our own does first.

    It keeps what it compiles where this process does. It keeps to its share of the cores, as far
    as the system can do that: without it all of them would use all cores, each at the others'
    expense. And it leaves Ctrl-C to who started it.
    """

    name = "inspe-jax"

    def __init__(self, count: int) -> None:
        # Not by the environment: the script that workers begin by importing may import JAX.
        self.settings = {name: getattr(jax.config, name) for name in COMPILED}
        self.shares: list[list[int]] = []
        if hasattr(os, "sched_getaffinity"):  # not on macOS or Windows
            own = sorted(os.sched_getaffinity(0))
            self.shares = [own[k % len(own) :: count] for k in range(count)]

    def setup(self, worker: Worker) -> None:
        """Before the worker works: JAX looks at its cores when it starts."""
        for name, value in self.settings.items():
            jax.config.update(name, value)
        with suppress(ValueError):  # not in the main thread
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self.shares and isinstance(worker.name, int) and os.path.isdir("/proc/self/task"):
            share = self.shares[worker.name % len(self.shares)]
            for thread in os.listdir("/proc/self/task"):
                with suppress(ProcessLookupError):  # it may have ended meanwhile
                    os.sched_setaffinity(int(thread), share)
