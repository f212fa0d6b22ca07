"""The command line run by tests: here, or in processes of their own that heed Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from inspe_jax.cli import main, stopping

# Where tests run in the background, shells have Ctrl-C ignored, and processes inherit that. It is
# set in the new process: what runs between fork and exec is no place for threads, as JAX has.
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from inspe_jax.cli import main
main()
"""


def inspe_process(*arguments: str | Path, before: str = "", **options: Any) -> subprocess.Popen:
    """`inspe` with arguments, its output in pipes; Python that runs ``before`` it."""
    options |= dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    return subprocess.Popen([sys.executable, "-c", f"{before}\n{COMMAND}", *arguments], **options)


def inspe_here(
    folder: Path, monkeypatch: Any, capsys: Any, *arguments: Any
) -> tuple[int, str, str]:
    """`inspe` with arguments in a folder, in this process: (status, stdout, stderr)."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["inspe", *map(str, arguments)])
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr(stopping, "LONG", float("inf"))  # a busy machine compiles for long
    status = 0
    try:
        main()
    except SystemExit as e:
        status = e.code or 0
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def cases(*rows: tuple[Any, str]) -> list[Any]:
    """Parameters of (arguments, message) each, named by the arguments."""
    return [pytest.param(*row, id=" ".join(map(str, row[0]))) for row in rows]


def refused(inspe: Any, folder: Path, arguments: Any, message: str) -> None:
    """The command ends with a message and status 2, and writes nothing in the folder."""
    before = sorted(folder.iterdir())
    status, _, error = inspe(*arguments)
    assert status == 2
    assert message in " ".join(error.split())
    assert "Traceback" not in error
    assert sorted(folder.iterdir()) == before


def in_this_process() -> Any:
    """A scheduler with a worker that is a thread."""
    import distributed

    own = dict(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp")
    return distributed.LocalCluster(**own, dashboard_address="127.0.0.1:0")


def wait_for_rows(
    process: subprocess.Popen, out: Path, count: int, name: str = "results.csv"
) -> None:
    table = out / name
    end = time.monotonic() + 240
    while not table.exists() or table.read_text().count("\n") <= count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


def kill_with_workers(process: subprocess.Popen) -> None:
    """Kill a process, and wait until the workers that it started are gone too."""
    workers = psutil.Process(process.pid).children(recursive=True)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    end = time.monotonic() + 60
    while any(map(lives, workers)):
        assert time.monotonic() < end
        time.sleep(0.1)


def lives(process: psutil.Process) -> bool:
    """Whether it still runs; nobody may have asked for its end."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
