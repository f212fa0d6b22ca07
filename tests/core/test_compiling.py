"""What is told of compiling: that it is done, how often, and for how long."""

import threading
import time

import jax
import jax.numpy as jnp
import pytest

from inspe_jax.core import compiling
from inspe_jax.core.compiling import compiled, working_clock
from inspe_jax.core.parallel import run


def compile_something(length):
    """A program that nobody has compiled: of a shape of its own."""
    return jax.block_until_ready(jax.jit(lambda x: jnp.sort(jnp.sin(x)) @ x)(jnp.ones(length)))


def test_programs_are_counted_and_their_time():
    before, began = compiled(), time.monotonic()
    compile_something(1231)
    after, took = compiled(), time.monotonic() - began
    assert after.programs > before.programs
    assert 0 < after.seconds - before.seconds <= took
    assert not after.now
    compile_something(1231)  # another function: the same shapes, compiled anew
    jax.block_until_ready(jnp.ones(1231) + 1)
    again = compiled()
    jax.block_until_ready(jnp.ones(1231) + 1)
    assert compiled().programs == again.programs


def test_that_something_is_being_compiled_is_told_meanwhile():
    """A program whose compilation is held up by another thread's look at it."""
    seen, watch, began = [], compiling._Watch(), time.monotonic()
    watch.hear(compiling.LOWERED, 0.0)
    seen.append(watch.compiled())
    time.sleep(0.05)
    seen.append(watch.compiled())
    watch.hear(compiling.COMPILED, time.monotonic() - began)
    seen.append(watch.compiled())
    assert [state.now for state in seen] == [True, True, False]
    assert seen[1].seconds - seen[0].seconds >= 0.05
    assert seen[2].programs == 1
    assert seen[2].seconds >= seen[1].seconds - 0.01
    watch.hear(compiling.LOWERED, 0.0)  # and never compiled, as by `jit(f).lower(x)`
    watch.hear(compiling.TRACED, 0.0)
    assert not watch.compiled().now
    thread = threading.Thread(target=watch.hear, args=(compiling.LOWERED, 0.0))
    thread.start()
    thread.join()
    assert not watch.compiled().now  # it ended before it was compiled


@pytest.mark.parametrize(
    ("where", "stands"), [("here", True), ("in jobs", True), ("beside", False)]
)
def test_a_clock_stands_still_while_its_thread_waits_for_a_program(monkeypatch, where, stands):
    watch = compiling._Watch()
    monkeypatch.setattr(compiling, "_watch", watch)
    clock = working_clock()

    def compiles():
        began = time.monotonic()
        time.sleep(0.3)
        watch.hear(compiling.TRACED, 0.3)  # within what is compiled: counted once
        watch.hear(compiling.COMPILED, time.monotonic() - began)

    began = clock()
    if where == "here":
        compiles()
    elif where == "in jobs":
        run([("a", compiles), ("b", compiles)], set())
    else:
        thread = threading.Thread(target=compiles)
        thread.start()
        thread.join()
    assert (abs(clock() - began) < 0.15) == stands
