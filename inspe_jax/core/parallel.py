"""Runs work on all cores, and knows what fits in memory. XLA runs the programs that one thread
sends to a CPU one after the other; those of several threads run at the same time."""

import os
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache, partial
from typing import Any, TypeVar

import jax
import jax.experimental
import numpy as np

from inspe_jax.core.compiling import on_behalf_of, this_thread
from inspe_jax.core.errors import InspeError

BYTES_PER_VOXEL = 50  # peak memory of scoring, for each voxel and sensor, and once more for all
Result = TypeVar("Result")

Job = tuple[Hashable, Callable[[], Any]]
"""A key and a function. Jobs with the same key need the same compiled code."""

_ALONE = {"xla_disable_hlo_passes": "cpu-parallel-task-assigner"}
jit_job = partial(jax.jit, compiler_options=_ALONE)
"""``jax.jit`` of what jobs call. Else XLA divides each larger operation among all cores, which have
a job each: scores take a tenth longer. It can't be called while another program is traced."""

compiled: set[Hashable] = set()
"""Keys whose code is already compiled, of functions that live as long as the process."""


@cache
def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS or Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), "inspe_jax")


def parts_of(rows: np.ndarray, size: int) -> list[np.ndarray]:
    """Rows in parts of one size, so that code is compiled once. The last part is padded."""
    filled = np.concatenate([rows, np.repeat(rows[-1:], -len(rows) % size, 0)])
    return list(filled.reshape(-1, size, *rows.shape[1:]))


def shapes_of(*arrays: Any) -> tuple[tuple[int, ...], ...]:
    """The shapes of all arrays, for which programs are compiled: a part of a job's key."""
    return tuple(np.shape(leaf) for leaf in jax.tree.leaves(arrays))


def run(jobs: Sequence[Job], known: set[Hashable] = compiled) -> list[Any]:
    """Run jobs on all cores and return their finished results, in order. Of each key that is not
    ``known``, which it then is, one runs first and compiles. Jobs must not call this themselves."""
    here = this_thread()

    def finished(number: int) -> Any:
        with on_behalf_of(here):
            return jax.block_until_ready(jobs[number][1]())

    def side_by_side(numbers: Sequence[int]) -> list[Any]:
        # Threads do not inherit this thread's JAX settings, so double precision stays here.
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
    """Set double or single precision in this thread; threads do not inherit it."""
    # The function is in different places in different versions of JAX.
    switch: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    return switch.enable_x64(double)


def untraced(work: Callable[[], Result]) -> Result:
    """The result of ``work``, computed now even under a trace, at this thread's precision."""
    double = jax.config.jax_enable_x64  # type: ignore[attr-defined]

    def there() -> Result:
        with at_precision(double):
            return work()

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(there).result()


def check_memory(voxels: float, sensors: int) -> None:
    """Raise InspeError if scoring so many voxels does not fit in this machine's memory."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not on Windows
        memory = 16 * 2**30
    needed = voxels * (sensors + 1) * BYTES_PER_VOXEL
    if needed > 0.8 * memory:
        raise InspeError(
            f"the grid is too large for memory: {voxels / 1e6:,.0f} million voxels and {sensors} "
            f"sensors take about {needed / 2**30:,.0f} GiB, and this machine has "
            f"{memory / 2**30:,.0f} GiB; use larger voxels, a wider spacing or a smaller radius"
        )
