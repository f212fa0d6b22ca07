"""Compiles in another thread what a search will need, while the search goes on."""

import atexit
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from weakref import WeakSet

import jax

from inspe_jax.core.parallel import at_precision

CompileJob = Callable[[], bool]
"""Calls a function on the shapes that the search will use, so that it is compiled. Returns False if
it did not, because no time is left for it."""

_threads: "WeakSet[threading.Thread]" = WeakSet()
_one_by_one = threading.Lock()  # the next search may use what an ended one still compiles


class Ahead:
    """Jobs by name, run one after the other in another thread.

    XLA cannot be interrupted. Ctrl-C ends the search, and the job that runs goes on to its end.
    """

    def __init__(self, jobs: Mapping[str, CompileJob]) -> None:
        self._done: dict[str, Future[bool]] = {name: Future() for name in jobs}
        double = jax.config.jax_enable_x64  # type: ignore[attr-defined]
        work = [(self._done[name], job) for name, job in jobs.items()]
        if work:
            thread = threading.Thread(target=_work, args=(work, double), daemon=True)
            _threads.add(thread)
            thread.start()

    def ready(self, name: str) -> bool:
        """Whether a job is done, or there is none of that name. Raises the job's error."""
        done = self._done.get(name)
        return done is None or (done.done() and not done.cancelled() and done.result())

    def wait(self, name: str) -> None:
        """Wait until a job is done; return at once if there is none. Raises the job's error."""
        if name in self._done:
            self._done[name].result()

    def close(self) -> None:
        """Start no further job."""
        for done in self._done.values():
            done.cancel()


def _work(work: list[tuple["Future[bool]", CompileJob]], double: bool) -> None:
    # Threads do not inherit JAX's settings of the one that starts them.
    with at_precision(double), _one_by_one:
        for done, job in work:
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(job())
            except BaseException as e:  # raised where the search asks for it
                done.set_exception(e)


def compiles() -> bool:
    """Whether a job still runs, also of a search that has ended."""
    return any(thread.is_alive() for thread in _threads)


@atexit.register
def _wait() -> None:
    """Wait for the jobs that run: XLA aborts if Python ends before it.

    Ctrl-C ends the process at once, and so does the command line.
    """
    try:
        for thread in list(_threads):
            thread.join()
    except KeyboardInterrupt:
        os._exit(130)
