"""Work on all cores: results in order, code compiled once, errors passed on."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from inspe_jax.core import parallel


def test_results_come_in_the_order_of_the_jobs():
    jobs = [("square", lambda n=n: n * n) for n in range(20)]
    assert parallel.run(jobs) == [n * n for n in range(20)]
    assert parallel.run([]) == []


def test_parts_have_one_size_and_the_last_row_fills_up():
    parts = parallel.parts_of(np.arange(10).reshape(5, 2), 3)
    assert [part[:, 0].tolist() for part in parts] == [[0, 2, 4], [6, 8, 8]]
    assert [len(part) for part in parallel.parts_of(np.zeros((6, 2)), 3)] == [3, 3]


def test_of_jobs_that_need_the_same_code_one_goes_first(monkeypatch):
    """Until the first is done no other of its key begins; once it was, they go side by side."""
    monkeypatch.setattr(parallel, "cores", lambda: 4)
    monkeypatch.setattr(parallel, "_pool", lambda: ThreadPoolExecutor(4))
    begun, done = [], threading.Event()

    def job(n):
        begun.append((n, done.is_set()))
        if n == 0:
            time.sleep(0.05)  # the others would begin meanwhile
            done.set()

    key = object()
    parallel.run([(key, lambda n=n: job(n)) for n in range(8)])
    assert begun[0] == (0, False)
    assert all(after for _, after in begun[1:])


def test_a_job_that_fails_raises_and_its_code_does_not_count_as_compiled():
    key = object()

    def fail():
        raise ZeroDivisionError

    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            parallel.run([(key, fail), (key, lambda: None)])
        assert key not in parallel.compiled
