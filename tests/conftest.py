"""Strict promotion and no NaN, for every test; compiled quickly, once, and within a budget."""

import atexit
import gc
import hashlib
import os
import platform
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax
import jaxlib
import pytest
from common import CHROMIUM
from worlds import MAPS

from inspe_jax.core import compiling, parallel

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_nans", True)

gc.set_threshold(100_000, 50, 100)  # what is traced is many small objects, most of which stay

QUICKLY = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1"
)
"""Tests ask what code means, not how fast it is: XLA compiles in a quarter of the time, and what
it compiles runs fast enough on scenes as small as these."""

KEPT = 2 * 2**30
"""Bytes of compiled programs that are kept from run to run."""

PROGRAMS = {"science": 800, "other": 1000}
"""Programs that the tests of README's command, and all others, may compile, or read where another
process compiled them.

Each is traced, lowered and compiled, and that is most of what a run takes. A test that needs many
should take the shapes of another (:mod:`worlds`), or NumPy where it has no use for a program.
"""

OTHER = "wing", "browser", "notebook", "process", "slow"
"""Marks of the tests that README's command leaves out."""

programs: dict[str, Counter[str]] = {part: Counter() for part in PROGRAMS}
"""Compiled so far, by file of tests; where processes share the work, their sum is in the first."""


def pytest_configure(config: pytest.Config) -> None:
    """What one process compiles, the others of this run need not, nor those that tests start,
    nor later runs: the environment is theirs too."""
    if "INSPE_TESTS" not in os.environ:
        state = tempfile.TemporaryDirectory()
        config.add_cleanup(state.cleanup)
        os.environ |= {
            "XDG_STATE_HOME": state.name,
            "INSPE_TESTS": "1",
            "XLA_FLAGS": f"{QUICKLY} {os.environ.get('XLA_FLAGS', '')}".strip(),
            "JAX_COMPILATION_CACHE_DIR": str(folder_for_programs(config)),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    jax.config.update(
        "jax_persistent_cache_min_compile_time_secs",
        float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"]),
    )


def folder_for_programs(config: pytest.Config) -> Path:
    """A folder of pytest's cache for this JAX on this CPU, with what was left unused removed.

    JAX's own limit to a folder's size would look at every file for each that is added.
    """
    if not hasattr(config, "cache"):  # -p no:cacheprovider
        folder = tempfile.mkdtemp()
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return Path(folder)
    root = config.cache.mkdir("compiled")
    known = [(path.stat().st_mtime, path.stat().st_size, path) for path in root.glob("*/*")]
    size = 0
    for _, more, path in sorted(known, reverse=True):
        size += more
        if size > KEPT:
            path.unlink()
    what = jax.__version__, jaxlib.__version__, platform.platform(), cpu()
    folder = root / hashlib.sha256(repr(what).encode()).hexdigest()[:16]
    folder.mkdir(exist_ok=True)
    return folder


def cpu() -> str:
    """Which instructions there are: code that was compiled for others cannot run."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text().split("\n\n")[0].splitlines()
        return "\n".join(line for line in lines if line.startswith(("model name", "flags", "Feat")))
    return f"{platform.machine()} {platform.processor()}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    before = compiling.compiled().programs
    try:
        return (yield)
    finally:
        part = "other" if any(map(item.get_closest_marker, OTHER)) else "science"
        programs[part][item.nodeid.split("::")[0]] += compiling.compiled().programs - before


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    """One of the processes that share the work is done."""
    for part, found in getattr(node, "workeroutput", {}).get("programs", {}).items():
        programs[part].update(found)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    over = any(found.total() > PROGRAMS[part] for part, found in programs.items())
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["programs"] = {k: dict(found) for k, found in programs.items()}
    elif over and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter) -> None:
    for part, found in programs.items():
        line = (
            f"{found.total()} programs compiled or read, of {PROGRAMS[part]} at most: {part} tests"
        )
        if found.total() > PROGRAMS[part]:
            most = ", ".join(f"{count} by {file}" for file, count in found.most_common(5))
            terminalreporter.write_line(f"ERROR {line}: {most}", red=True)
        elif found.total():
            terminalreporter.write_line(line)


LONG = (
    "test_docs", "test_notebooks", "test_methods", "test_soft", "test_page", "test_cli",
    "test_sweep", "test_lens", "test_target_metrics", "test_evaluate", "test_exact", "test_statics",
    "test_generate", "test_city", "test_traffic", "test_candidates", "test_queries",
    "test_compiles", "test_constraints",
)  # fmt: skip


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Long files first, the longest before others: what a process is left with at the end is then
    short."""
    first = {stem: n for n, stem in enumerate(LONG)}
    science = [config.rootpath / path for path in config.getini("testpaths")]
    items.sort(key=lambda item: first.get(item.path.stem, len(LONG)))
    for item in items:
        if not any(item.path.is_relative_to(path) for path in science):
            item.add_marker(pytest.mark.wing)
        if CHROMIUM is None and item.get_closest_marker("browser"):
            item.add_marker(pytest.mark.skip(reason="there is no Chromium here"))


@pytest.fixture(scope="session")
def maps() -> Path:
    """The folder of town maps beside the checkout; tests that need it skip where it is absent."""
    if not MAPS.is_dir():
        pytest.skip("the town maps are not beside this checkout")
    return MAPS


MAPPINGS = 40_000
"""Of the 65 530 memory maps that Linux allows a process; each program takes a few."""


@pytest.fixture(scope="module", autouse=True)
def _forget_what_was_compiled():
    """After each file, where there is much of it."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()
        parallel.compiled.clear()
