"""Processes of their own that heed Ctrl-C, for the tests that send it."""

import signal
import subprocess
import sys
from typing import Any


def inspe_process(*arguments: str, **options: Any) -> subprocess.Popen:
    """`inspe` with arguments; Ctrl-C counts also where the tests themselves run in the
    background, as shells have it ignored there."""
    command = "from inspe_jax.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", command, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )
