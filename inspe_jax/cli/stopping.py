"""What a command says when Ctrl-C ends it, and while it compiles.

XLA compiles in C++, where Python's main thread does not hear Ctrl-C. A thread of its own hears it.
"""

import contextlib
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from inspe_jax.core.compiling import compiled, holds_main_thread, kept_in

PATIENCE = 0.5
"""Time in which the main thread hears Ctrl-C if it is in Python [s]."""
LONG = 3.0
"""Compiling that takes longer is told of [s]."""
CTRL_C = 130
"""Exit status of a command that Ctrl-C has ended."""


@dataclass
class Step:
    """What a command does now.

    ``search``: compiling does not count as its time. ``writes``: Ctrl-C lets it write what it has.
    ``asked``: Ctrl-C was pressed.
    """

    what: str
    search: bool = False
    writes: bool = False
    asked: bool = False


_steps: list[Step] = []


@contextlib.contextmanager
def step(what: str, *, search: bool = False, writes: bool = False) -> Iterator[Step]:
    """Do something that takes a while. After Ctrl-C it is still known."""
    now = Step(what, search, writes)
    _steps.append(now)
    yield now
    _steps.remove(now)


def stopped() -> str:
    """What Ctrl-C has stopped, in words."""
    if not _steps:
        return "stopped"
    if _steps[-1].search and not _steps[-1].writes:
        return "stopped before the start was scored: nothing was searched, nothing is written"
    return f"stopped; not finished: {_steps[-1].what}"


@contextlib.contextmanager
def attended(say: Callable[[str], None], leave: Callable[[int], Any]) -> Iterator[None]:
    """Let Ctrl-C be answered in the block at any time, and long compiling be told of, once.

    ``say`` prints a line; ``leave`` ends the process with a status.
    """
    _steps.clear()
    began = compiled().seconds
    own = threading.current_thread() is threading.main_thread()
    if not own or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield  # a test's thread, or a shell's background job, which has Ctrl-C ignored
        return
    listener, caller = socket.socketpair()
    caller.setblocking(False)
    heard, ended = threading.Event(), threading.Event()

    def hear(*_: object) -> None:
        heard.set()
        raise KeyboardInterrupt

    def swallowed(unraisable: Any) -> None:
        """Ctrl-C in a callback of C++ is lost there: it is raised again later."""
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            threading.Timer(0.05, signal.raise_signal, [signal.SIGINT]).start()
        else:
            hook(unraisable)

    def attend() -> None:
        told = False
        while not ended.is_set():
            if not told and compiled().now and compiled().seconds - began > LONG:
                told = True
                say(_compiling())
            if select.select([listener], [], [], 0.25)[0]:
                if signal.SIGINT in listener.recv(64) and not heard.wait(PATIENCE):
                    _answer(heard, say, leave)
                heard.clear()

    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    signal.signal(signal.SIGINT, hear)
    before = signal.set_wakeup_fd(caller.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=attend, name="Ctrl-C", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        signal.set_wakeup_fd(before)
        if signal.getsignal(signal.SIGINT) is hear:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = hook
        thread.join()
        listener.close()
        caller.close()


def _answer(
    heard: threading.Event, say: Callable[[str], None], leave: Callable[[int], Any]
) -> None:
    """Answer Ctrl-C until the main thread hears it, while that is in XLA."""
    while not heard.is_set():
        if holds_main_thread():
            now = _steps[-1] if _steps else Step("")
            if now.asked or not now.writes:
                say(stopped())
                leave(CTRL_C)
            now.asked = True
            say("stops once XLA has compiled, and keeps what it has; Ctrl-C again ends it now")
            return
        time.sleep(0.05)


def _compiling() -> str:
    folder = kept_in()
    words = f"compiling, once: kept in {folder}" if folder else "compiling, and not kept"
    if _steps and _steps[-1].search:
        words += "; the time of a search stands still while it waits for this"
    return words
