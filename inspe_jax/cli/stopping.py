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

from inspe_jax.core.compiling import compiled, holds_main_thread

PATIENCE = 0.5  # time in which the main thread hears Ctrl-C if it is in Python [s]
TOGETHER = 0.2  # time between its two threads' hearing of one Ctrl-C, at most [s]
LONG = 3.0  # compiling that takes longer is told of [s]
CTRL_C = 130  # exit status of a command that Ctrl-C has ended


@dataclass
class Step:
    """What a command does now. ``search``: compiling does not count as its time. ``writes``: Ctrl-C
    lets it write what it has. ``asked``: Ctrl-C was pressed."""

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
    """Let Ctrl-C be answered in the block at any time, and long compiling be told of, once: ``say``
    prints a line, ``leave`` ends the process with a status."""
    _steps.clear()
    began = compiled().seconds
    # A shell's background job has Ctrl-C ignored.
    hears = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    hears &= threading.current_thread() is threading.main_thread()
    listener, caller = socket.socketpair()
    caller.setblocking(False)
    heard: list[float] = []  # times at which the main thread heard Ctrl-C
    ended = threading.Event()

    def hear(*_: object) -> None:
        heard.append(time.monotonic())
        raise KeyboardInterrupt

    def swallowed(unraisable: Any) -> None:
        """Ctrl-C in a callback of C++ is lost there: it is raised again later."""
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            threading.Timer(0.05, _press).start()
        else:
            hook(unraisable)

    def attend() -> None:
        told = False
        while not ended.is_set():
            if not told and compiled().now and compiled().seconds - began > LONG:
                told = True
                say(_compiling())
            if not select.select([listener], [], [], 0.25)[0]:
                continue
            if signal.SIGINT in listener.recv(64):
                answer(time.monotonic())

    def answer(pressed: float) -> None:
        """Answer Ctrl-C where the main thread is in XLA and does not hear it."""
        while not ended.is_set() and not (heard and heard[-1] > pressed - TOGETHER):
            if time.monotonic() > pressed + PATIENCE and holds_main_thread():
                now = _steps[-1] if _steps else Step("")
                if now.asked or not now.writes:
                    say(stopped())
                    leave(CTRL_C)
                now.asked = True
                say("stops once XLA has compiled, and keeps what it has; Ctrl-C again ends it now")
                return
            time.sleep(0.05)

    hook, sys.unraisablehook = sys.unraisablehook, swallowed
    if hears:
        signal.signal(signal.SIGINT, hear)
        before = signal.set_wakeup_fd(caller.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=attend, name="Ctrl-C", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        if hears:
            signal.set_wakeup_fd(before)
            if signal.getsignal(signal.SIGINT) is hear:
                signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = hook
        caller.send(b"\0")  # it need not wait
        thread.join()
        listener.close()
        caller.close()


def _press() -> None:
    """Ctrl-C for the main thread, also where it sleeps."""
    if hasattr(signal, "pthread_kill"):  # not on Windows
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)


def _compiling() -> str:
    from inspe_jax.core.kept import kept_in

    folder = kept_in()
    kept = f"what is compiled once is kept in {folder}" if folder else "nothing is kept of it"
    words = f"compiling; {kept}"
    if _steps and _steps[-1].search:
        words += "; the time of a search stands still while it waits for this"
    return words
