"""Work shared out among this machine's cores.

XLA runs the body of a loop on one core, and what one thread sends to a CPU in turn. Threads
that each send a part of their own are run side by side.
"""

import os
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, TypeVar

import jax
import jax.experimental
import numpy as np

Result = TypeVar("Result")

Job = tuple[Hashable, Callable[[], Any]]
"""A job, and what tells the code it needs compiled: jobs of one key need the same."""

compiled: set[Hashable] = set()
"""Keys whose code is compiled, of functions that live as long as the process."""


@cache
def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS or Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), "inspe_jax")


def parts_of(rows: np.ndarray, size: int) -> list[np.ndarray]:
    """Rows in parts of one size, for which code is compiled once; the last is filled up."""
    filled = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % size, 0)])
    return list(filled.reshape(-1, size, *rows.shape[1:]))


def run(jobs: Sequence[Job], known: set[Hashable] = compiled) -> list[Any]:
    """The jobs' results, finished, worked out on all cores.

    Of jobs whose key is not ``known`` one goes first, so that its code is compiled once; then it
    is. Jobs may not call this themselves.
    """

    def finished(number: int) -> Any:
        return jax.block_until_ready(jobs[number][1]())

    def side_by_side(numbers: Sequence[int]) -> list[Any]:
        # Threads do not inherit JAX's settings of this one: in double precision it stays here.
        double = jax.config.jax_enable_x64  # type: ignore[attr-defined]
        if cores() == 1 or len(numbers) < 2 or double:
            return [finished(n) for n in numbers]
        return list(_pool().map(finished, numbers))

    first = {key: n for n, (key, _) in reversed(list(enumerate(jobs))) if key not in known}
    done = dict(zip(first.values(), side_by_side(list(first.values())), strict=True))
    rest = [n for n in range(len(jobs)) if n not in done]
    done |= zip(rest, side_by_side(rest), strict=True)
    known.update(first)
    return [done[n] for n in range(len(jobs))]


def at_precision(double: bool) -> AbstractContextManager[None]:
    """Double precision or single, in this thread: threads do not inherit it."""
    # It moved between versions of JAX.
    switch: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    found: AbstractContextManager[None] = switch.enable_x64(double)
    return found


def untraced(work: Callable[[], Result]) -> Result:
    """What ``work`` gives, worked out now even where something is being traced.

    In a thread of its own, since nothing is traced there; at the precision of this one.
    """
    double = jax.config.jax_enable_x64  # type: ignore[attr-defined]

    def there() -> Result:
        with at_precision(double):
            return work()

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(there).result()
