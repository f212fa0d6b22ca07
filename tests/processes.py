"""The command line run by tests: here, or in processes of their own that heed Ctrl-C."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from inspe_jax.cli import main

# Where tests run in the background, shells have Ctrl-C ignored, and processes inherit that. It is
# set in the new process: what runs between fork and exec is no place for threads, as JAX has.
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from inspe_jax.cli import main
main()
"""


def inspe_process(*arguments: str, **options: Any) -> subprocess.Popen:
    """`inspe` with arguments, its output in pipes."""
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def inspe_here(
    folder: Path, monkeypatch: Any, capsys: Any, *arguments: Any
) -> tuple[int, str, str]:
    """`inspe` with arguments in a folder, in this process: (status, stdout, stderr)."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["inspe", *map(str, arguments)])
    monkeypatch.setenv("COLUMNS", "160")
    status = 0
    try:
        main()
    except SystemExit as e:
        status = e.code or 0
    captured = capsys.readouterr()
    return status, captured.out, captured.err
