"""A Dask client: of a running scheduler, or of a cluster of processes on this machine."""

import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import dask
import jax
from distributed import Client, LocalCluster, Worker, WorkerPlugin

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.kept import CACHE_SETTINGS
from inspe_jax.core.parallel import cores
from inspe_jax.jobs.sources import versions

Started = TypeVar("Started")


@contextmanager
def client(scheduler: str | None, workers: int | None) -> Iterator[Client]:
    """A client of the scheduler at an address, or of a new cluster of ``workers`` processes here,
    one per core if None. Raises InspeError if it does not answer, has no workers, or other
    versions."""
    if scheduler is not None:
        wrong = f"scheduler '{scheduler}' does not answer"
        with error_at(wrong, OSError, TimeoutError, ValueError):
            there = Client(scheduler, timeout=TIMEOUT)
        with there:
            _check_workers(there, scheduler)
            yield there
        return
    count = workers or cores()
    with _kept_memory(), _own_cluster(count) as cluster, _in_time(count, Client, cluster) as here:
        here.register_plugin(WorkerSetup(count))
        # Without this, a worker that dies while it starts is not started again.
        cluster.adapt(minimum=count, maximum=count, interval="1s")
        yield here
        # Dask cannot end a worker that is just being restarted.
        with suppress(TimeoutError):
            here.wait_for_workers(count, timeout=TIMEOUT)


@contextmanager
def _own_cluster(count: int) -> Iterator[LocalCluster]:
    cluster = _in_time(
        count,
        LocalCluster,
        n_workers=count,
        threads_per_worker=1,
        # Dask does not know of JAX's memory, and would pause a worker because of it silently.
        memory_limit=None,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
        # A job whose worker dies is tried once more, alone: see engine.py.
        scheduler_kwargs={"allowed_failures": 1},
    )
    try:
        yield cluster
    finally:
        # On a busy machine Dask gives up waiting for the workers that it kills. All is done by now.
        with suppress(TimeoutError):
            cluster.close()


def _in_time(count: int, start: Callable[..., Started], *given: Any, **options: Any) -> Started:
    """What Dask starts. Raises InspeError where it gives up waiting for its processes."""
    try:
        return start(*given, **options)
    except TimeoutError as e:
        words = f"{count} worker processes did not start in time; is the machine busy? Try fewer"
        raise InspeError(words) from e


@contextmanager
def _kept_memory() -> Iterator[None]:
    """:data:`MALLOC_SETTINGS` for workers started meanwhile, and for no other process."""
    had = {name: os.environ.get(name) for name in MALLOC_SETTINGS}
    own = {f"distributed.nanny.pre-spawn-environ.{k}": v for k, v in MALLOC_SETTINGS.items()}
    try:
        with dask.config.set(own):
            yield
    finally:  # Dask leaves the settings in the environment
        for name, value in had.items():
            os.environ.pop(name, None)
            os.environ |= {} if value is None else {name: value}


MALLOC_SETTINGS = {
    "MALLOC_TRIM_THRESHOLD_": 2**27,
    "MALLOC_MMAP_THRESHOLD_": 2**25,
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}
"""How much freed memory workers keep [byte], in huge pages; see mallopt(3) and glibc's Memory
Allocation Tunables. With Dask's settings they return all, and spend a third of their time on
getting it again; arrays above 32 MiB always return, which in huge pages costs a twentieth."""

TIMEOUT = 10  # time that a scheduler gets to answer [s]


def _check_workers(there: Client, scheduler: str) -> None:
    if not there.nthreads():
        raise InspeError(f"scheduler '{scheduler}' has no workers; start some first")
    for worker, found in there.run(versions, on_error="return").items():
        if isinstance(found, Exception):
            raise InspeError(f"worker {worker} failed: {type(found).__name__}: {found}")
        for name, version in versions().items():
            if found.get(name) != version:
                raise InspeError(
                    f"worker {worker} has {name} {found.get(name)}, and this process has "
                    f"{version}; one table needs the same versions everywhere"
                )


class WorkerSetup(WorkerPlugin):
    """Sets up each of ``count`` workers of this process: its cache of compiled programs, cores of
    its own where the system allows that, and no Ctrl-C, which is for this process."""

    name = "inspe-jax"

    def __init__(self, count: int) -> None:
        # Not through the environment: workers first import the user's script, which may import JAX.
        self.settings = {name: getattr(jax.config, name) for name in CACHE_SETTINGS}
        self.cores: list[list[int]] = []
        if hasattr(os, "sched_getaffinity"):  # not on macOS or Windows
            own = sorted(os.sched_getaffinity(0))
            self.cores = [own[k % len(own) :: count] for k in range(count)]

    def setup(self, worker: Worker) -> None:
        """Runs before any job, since JAX counts its cores when it starts."""
        for name, value in self.settings.items():
            jax.config.update(name, value)
        with suppress(ValueError):  # not in the main thread
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        if self.cores and isinstance(worker.name, int) and os.path.isdir("/proc/self/task"):
            own = self.cores[worker.name % len(self.cores)]
            for thread in os.listdir("/proc/self/task"):
                with suppress(ProcessLookupError):  # the thread may have ended
                    os.sched_setaffinity(int(thread), own)
