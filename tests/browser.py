"""Debian's Chromium, for the tests that look at pages; without it they skip (`conftest`)."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
OPTIONS = (
    "--no-sandbox",
    "--ignore-gpu-blocklist",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
"""Also as root, and in three dimensions without a graphics card."""
UNDRAWN = """for (const name of ['drawArrays', 'drawElements', 'drawRangeElements',
        'drawArraysInstanced', 'drawElementsInstanced'])
    WebGL2RenderingContext.prototype[name] = () => {};"""
"""In a page: nothing is drawn in three dimensions, which without a graphics card takes most of the
time. All else is as it is, also what is met by a click."""


@contextmanager
def browser() -> Iterator[Any]:
    """A browser without a window."""
    sync = pytest.importorskip("playwright.sync_api")
    with sync.sync_playwright() as play:
        found = play.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        try:
            yield found
        finally:
            found.close()


def errors_of(tab: Any) -> list[str]:
    """What a page will complain of, from now on."""
    said: list[str] = []
    tab.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    return said
