"""Debian's Chromium, for the tests that look at pages; without it they skip (`conftest`)."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from common import CHROMIUM, CHROMIUM_OPTIONS


@contextmanager
def browser() -> Iterator[Any]:
    """A browser without a window."""
    sync = pytest.importorskip("playwright.sync_api")
    with sync.sync_playwright() as play:
        found = play.chromium.launch(executable_path=CHROMIUM, args=list(CHROMIUM_OPTIONS))
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
