"""One thread that does in turn what is asked of it: whatever draws or changes something.

Browsers, the scorer and the search all ask from threads of their own.
"""

import threading
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor

Job = Callable[[], None]


class JobQueue:
    """Jobs done one after another, in the order in which they were asked for."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        """``failed`` is called, on the desk's thread, with what a job raised."""
        self._failed = failed
        self._newest: dict[Hashable, Job] = {}
        self._lock = threading.Lock()
        self._closed = False
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="desk")

    def ask(self, job: Job, key: Hashable = None) -> None:
        """Have a job done; in place of one that waits under the same key, if there is one.

        Nothing once the desk is closed.
        """
        key = object() if key is None else key
        with self._lock:
            if self._closed:
                return
            if key not in self._newest:
                self._thread.submit(self._do, key)
            self._newest[key] = job

    def close(self) -> None:
        """Do what waits, and end."""
        with self._lock:
            self._closed = True
        self._thread.shutdown()

    def _do(self, key: Hashable) -> None:
        with self._lock:
            job = self._newest.pop(key)
        try:
            job()
        except Exception as e:
            self._failed(e)


class Later:
    """One thing to do after a while; another one takes its place.

    It is done with its lock held: who asks for it :meth:`now` goes on when it is done.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._job: Job | None = None

    def do(self, seconds: float, job: Job) -> None:
        """Do this so many seconds from now, and what waited not at all."""
        with self._lock:
            self.cancel()
            timer = threading.Timer(seconds, lambda: self._do(timer))
            timer.daemon = True
            self._job, self._timer = job, timer
            timer.start()

    def now(self) -> None:
        """Do what waits now, if anything does."""
        with self._lock:
            job = self._job
            self.cancel()
            if job is not None:
                job()

    def cancel(self) -> None:
        """Do not do what waits."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            self._job = self._timer = None

    def _do(self, timer: threading.Timer) -> None:
        with self._lock:
            if timer is self._timer:  # no other took its place
                self.now()
