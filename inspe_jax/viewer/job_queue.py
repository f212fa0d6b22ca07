"""One thread that runs actions in turn: everything that draws on the page or changes the layout.

Browsers, the scorer and the search submit actions from threads of their own.
"""

import threading
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor

Action = Callable[[], object]


class JobQueue:
    """Runs actions one after another, in the order in which they were submitted.

    ``failed`` is told of every exception that an action raises.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        """``failed`` is called on the queue's thread with the exception that an action raised."""
        self.failed = failed
        self._newest: dict[Hashable, Action] = {}
        self._lock = threading.Lock()
        self._closed = False
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="queue")

    def submit(self, action: Action, key: Hashable = None) -> None:
        """Add an action. It replaces one of the same ``key`` that still waits.

        Does nothing once the queue is closed.
        """
        key = object() if key is None else key
        with self._lock:
            if self._closed:
                return
            if key not in self._newest:
                self._thread.submit(self._run, key)
            self._newest[key] = action

    def close(self, *, wait: bool = True) -> None:
        """Run the actions that wait, and end the thread. Without ``wait``, drop them, and come
        back at once."""
        with self._lock:
            self._closed = True
        self._thread.shutdown(wait=wait, cancel_futures=not wait)

    def _run(self, key: Hashable) -> None:
        with self._lock:
            action = self._newest.pop(key)
        try:
            action()
        except Exception as e:
            self.failed(e)


class DelayedAction:
    """Runs one action after a delay; a newer action replaces the one that waits.

    The lock is held while the action runs: a caller of :meth:`run_now` continues when it is done.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._action: Action | None = None

    def start(self, seconds: float, action: Action) -> None:
        """Run this action after ``seconds``, in place of one that waits."""
        with self._lock:
            self.cancel()
            timer = threading.Timer(seconds, lambda: self._run(timer))
            timer.daemon = True
            self._action, self._timer = action, timer
            timer.start()

    def run_now(self) -> None:
        """Run the action that waits now, if there is one."""
        with self._lock:
            action = self._action
            self.cancel()
            if action is not None:
                action()

    def cancel(self) -> None:
        """Drop the action that waits."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            self._action = self._timer = None

    def _run(self, timer: threading.Timer) -> None:
        with self._lock:
            if timer is self._timer:  # no newer action has replaced it
                self.run_now()
