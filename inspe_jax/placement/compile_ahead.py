"""Compiles in another thread what a search will need, while the search goes on."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from weakref import WeakSet

import jax

from inspe_jax.core.parallel import at_precision

CompileJob = Callable[[], bool]
"""Calls a function on the shapes that the search will use, so that it is compiled. Returns False if
it did not, because no time is left for it."""

_thread = ThreadPoolExecutor(1, "compile")  # Python waits for it at the end: XLA would abort
_jobs: "WeakSet[Future[bool]]" = WeakSet()


class Ahead:
    """Jobs by name, run one after the other in another thread.

    XLA cannot be interrupted. Ctrl-C ends the search, and the job that runs goes on to its end.
    """

    def __init__(self, jobs: Mapping[str, CompileJob]) -> None:
        double = jax.config.jax_enable_x64  # type: ignore[attr-defined]

        def done(job: CompileJob) -> bool:
            with at_precision(double):  # a thread does not inherit JAX's settings
                return job()

        self._done = {name: _thread.submit(done, job) for name, job in jobs.items()}
        _jobs.update(self._done.values())

    def ready(self, name: str) -> bool:
        """Whether a job is done, or there is none of that name. Raises the job's error."""
        job = self._done.get(name)
        return job is None or (job.done() and not job.cancelled() and job.result())

    def wait(self, name: str) -> None:
        """Wait until a job is done; return at once if there is none. Raises the job's error."""
        if name in self._done:
            self._done[name].result()

    def close(self) -> None:
        """Start no further job."""
        for job in self._done.values():
            job.cancel()


def compiles() -> bool:
    """Whether a job still runs, also of a search that has ended."""
    return any(job.running() for job in _jobs)
