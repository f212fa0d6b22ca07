"""Processes of their own that heed Ctrl-C, for the tests that send it."""

import subprocess
import sys
from typing import Any

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
