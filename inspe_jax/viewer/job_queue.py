"""One thread that runs actions in turn: everything that draws on the page or changes the layout.
Browsers, the scorer and the search submit actions from threads of their own."""

import threading
from collections.abc import Callable, Hashable

Action = Callable[[], object]
PATIENCE = 2.0  # time that waiting actions get at the end, before the rest is dropped [s]


class JobQueue:
    """Runs actions one after another, in the order in which they were submitted."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        """``failed`` is called on the queue's thread with every exception that an action raises."""
        self.failed = failed
        self._waiting: dict[Hashable, Action] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="queue", daemon=True)
        self._thread.start()

    def submit(self, action: Action, key: Hashable = None, *, first: bool = False) -> None:
        """Add an action. It replaces one of the same ``key`` that still waits; with ``first``, it
        is done before all others. Does nothing once the queue is closed."""
        key = object() if key is None else key
        with self._changed:
            if self._closed:
                return
            if first:
                self._waiting = {key: action} | self._waiting
            self._waiting[key] = action
            self._changed.notify()

    def drop(self, *keys: Hashable) -> None:
        """Drop the actions of these keys that still wait."""
        with self._changed:
            for key in keys:
                self._waiting.pop(key, None)

    def close(self, patience: float = PATIENCE, *, wait: bool = True) -> None:
        """Run the actions that wait, for so long at most [s], drop the others, and end the thread;
        with ``wait``, come back when the action that runs has ended."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(patience)
        with self._changed:
            self._waiting.clear()
        if wait:
            self._thread.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                action = self._waiting.pop(next(iter(self._waiting)))
            try:
                action()
            except Exception as e:
                self.failed(e)


class DelayedAction:
    """Runs one action after a delay; a newer action replaces the one that waits. The lock is held
    while it runs: a caller of :meth:`run_now` continues when it is done."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._action: Action | None = None

    def start(self, seconds: float, action: Action) -> None:
        """Run this action after ``seconds``, in place of one that waits."""
        with self._lock:
            self.cancel()
            timer = threading.Timer(seconds, lambda: self.run_now(timer))
            timer.daemon = True
            self._action, self._timer = action, timer
            timer.start()

    def run_now(self, of: threading.Timer | None = None) -> None:
        """Run the action that waits now, if there is one, and is that of this timer if given."""
        with self._lock:
            if of is None or of is self._timer:  # else a newer action has replaced it
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
