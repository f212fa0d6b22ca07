"""The secret in a page's address: random, and kept for the next server of the same page."""

import hashlib
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

BYTES = 16
"""Length of a token [byte]."""
FOLDER = "page_tokens"
"""Folder in the user's cache of tokens that are kept."""
_TOKEN = re.compile(r"[A-Za-z0-9_-]{22}")


def new_token() -> str:
    """A random token."""
    return secrets.token_urlsafe(BYTES)


def kept_token(name: str, cache: Path | None = None) -> str:
    """The token that this user's page of this ``name`` had last, so that one that is still open
    gets in again; a new one if there is none.

    It is in a file of the user's ``cache`` that nobody else can read; if others can, it is not
    used. It must never be sent over a network, where others may read it.
    """
    token = new_token()
    with suppress(OSError, RuntimeError, UnicodeError):  # such as no folder of the user's own
        folder = (cache or user_cache_path("inspe_jax", appauthor=False)) / FOLDER
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        at = folder / hashlib.sha256(name.encode()).hexdigest()
        with suppress(FileExistsError), open(at, "x", opener=_private) as f:
            f.write(token)
            return token
        with open(at, opener=_itself) as f:
            status, kept = os.fstat(f.fileno()), f.read(2 * len(token))
        alone = os.name == "nt" or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
        if alone and _TOKEN.fullmatch(kept):
            return kept
    return token


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _itself(path: str, flags: int) -> int:
    """Open a file, and none that a link of its name points to."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0))
