"""What a search needs compiled, compiled in a thread of its own while the search goes on."""

import atexit
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from weakref import WeakSet

import jax

from inspe_jax.core.compiling import counts_as_compiling
from inspe_jax.core.parallel import at_precision

CompileJob = Callable[[], bool]
"""Calls what is to be compiled on the shapes that the search will use. Gives False where it left
that undone, as there is no time for it."""

_threads: "WeakSet[threading.Thread]" = WeakSet()
_one_by_one = threading.Lock()  # what a search that has ended still compiles may serve the next


class Ahead:
    """Jobs by name, done in turn in a thread beside a search.

    XLA cannot be interrupted: Ctrl-C ends the search, and what is being compiled goes on.
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
        """Whether a job is done, or was never asked for. Raises what the job raised."""
        done = self._done.get(name)
        return done is None or (done.done() and not done.cancelled() and done.result())

    def wait(self, name: str) -> None:
        """Return once a job is over, or at once if it was never asked for; raises as it did."""
        if name in self._done:
            self._done[name].result()

    def close(self) -> None:
        """Begin no further job."""
        for done in self._done.values():
            done.cancel()


def _work(work: list[tuple["Future[bool]", CompileJob]], double: bool) -> None:
    # Threads do not inherit JAX's settings of the one that starts them.
    with counts_as_compiling(), at_precision(double), _one_by_one:
        for done, job in work:
            if not done.set_running_or_notify_cancel():
                continue
            try:
                done.set_result(job())
            except BaseException as e:  # raised where the search asks for it
                done.set_exception(e)


def compiles() -> bool:
    """Whether something is still being compiled for a search that may have ended."""
    return any(thread.is_alive() for thread in _threads)


@atexit.register
def _wait() -> None:
    """Wait for what is being compiled: coming back to a Python that has ended, XLA would abort.

    Ctrl-C ends the process at once, and so does the command line.
    """
    try:
        for thread in list(_threads):
            thread.join()
    except KeyboardInterrupt:
        os._exit(130)
