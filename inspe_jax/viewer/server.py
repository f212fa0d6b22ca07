"""A server of viser's page for this machine alone, and for those who have the page's address.

viser serves everyone who connects. Here it listens on the loopback address, which other machines
reach through a tunnel such as ``ssh -L``, and each request is checked before viser gets it:

- Its address must contain a random token, which no other page and no other user can know.
- Its ``Host`` must be a name of this machine: a foreign domain may point here (DNS rebinding).
- Its ``Origin``, which browsers send with what a page asks for, must be the page's own.
"""

import hashlib
import io
import logging
import os
import re
import secrets
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import viser
import websockets.asyncio.server
from platformdirs import user_cache_path
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

HOST = "127.0.0.1"  # the address that the server listens on
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
}
"""Headers of every response: no other page can show this one in a frame, or learn its address."""

Files = Callable[[ServerConnection, Request], Response | None]
"""Answers a request: with a file, or with None to continue with the handshake of a socket."""

BYTES = 16  # length of a token [byte]
FOLDER = "page_tokens"  # folder in the user's cache of tokens that are kept
_TOKEN = re.compile(r"[A-Za-z0-9_-]{22}")
_HERE = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)
_OWN_HEAD = re.compile(
    r'<title>.*?</title>|<link\s+rel="icon".*?/>|<meta\s+name="description".*?/>', re.DOTALL
)
_log = logging.getLogger(__name__)
_serving = threading.Lock()


def serve(port: int, token: str, head: str = "") -> viser.ViserServer:
    """Start a server for browsers that have the token, the first part of the page's path.

    viser opens its port with ``websockets.asyncio.server.serve``, which is replaced here by one
    that checks requests while the port is opened. If ``port`` is taken, the next free one is used;
    0 is any free one. ``head`` is HTML in place of viser's title, icon and description. Raises
    RuntimeError if this version of viser opens its port in another way.
    """
    module, real, opened = websockets.asyncio.server, websockets.asyncio.server.serve, []

    def serve_guarded(*args: Any, process_request: Files, **options: Any) -> Any:
        opened.append(port)
        return real(*args, process_request=_guarded(process_request, token, head), **options)

    with _serving, quiet():
        try:
            module.serve = serve_guarded  # type: ignore[assignment, misc]
            server = viser.ViserServer(host=HOST, port=port, verbose=False)
        finally:
            module.serve = real  # type: ignore[misc]
        if not opened:
            server.stop()
            raise RuntimeError(
                "this version of viser opens its port in another way, and would be unprotected"
            )
    return server


def quiet() -> AbstractContextManager[Any]:
    """Suppress what viser prints: its addresses, and that it has stopped."""
    return redirect_stdout(io.StringIO())


def refusal(request: Request, token: str) -> str:
    """Why a request is refused; an empty text if it is accepted."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    if len(hosts) != 1 or not _HERE.fullmatch(hosts[0]):
        return "it asked for a host that is not this machine"
    if [origin.lower() for origin in origins] not in ([], [f"http://{hosts[0]}".lower()]):
        return "another page asked"
    given = request.path.partition("?")[0].removeprefix("/").partition("/")[0]
    if not secrets.compare_digest(given.encode(errors="surrogateescape"), token.encode()):
        return "it does not have the token of the address that was printed"
    return ""


def _guarded(files: Files, token: str, head: str) -> Files:
    """``files`` for those who have the token. Each reason of a refusal is logged once."""
    logged: set[str] = set()

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        why = refusal(request, token)
        if why:
            if why not in logged:
                logged.add(why)
                _log.warning("refused a request: %s", why)
            words = f"This is refused: {why}.\nOpen the address that was printed.\n"
            return connection.respond(403, words)
        # Without an encoding, so that the head can be put into the page as it is.
        pairs = request.headers.raw_items()
        headers = Headers((key, value) for key, value in pairs if key.lower() != "accept-encoding")
        response = files(connection, Request(request.path.removeprefix(f"/{token}"), headers))
        if response is not None:
            if response.headers.get("Content-Type", "").startswith("text/html"):
                response.body = with_head(bytes(response.body).decode(), head).encode()
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            response.headers.update(HEADERS)
        return response

    return answer


def with_head(page: str, head: str) -> str:
    """viser's page with ``head`` in its head, in place of its own title, icon and description."""
    first, script, rest = page.partition("<script")  # what is behind it is compressed
    return _OWN_HEAD.sub("", first).replace("<head>", f"<head>{head}", 1) + script + rest


def new_token() -> str:
    """A random token."""
    return secrets.token_urlsafe(BYTES)


def kept_token(name: str, cache: Path | None = None) -> str:
    """The token that this user's page of this ``name`` had last, so that one that is still open
    gets in again; a new one if there is none in a file that only the user can read. It must never
    be sent over a network, where others may read it."""
    token = new_token()
    with suppress(OSError, RuntimeError, UnicodeError):  # such as no folder of the user's own
        folder = (cache or user_cache_path("inspe_jax", appauthor=False)) / FOLDER
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        at = folder / hashlib.sha256(name.encode()).hexdigest()
        with suppress(FileExistsError), open(at, "x", opener=_own) as f:
            f.write(token)
            return token
        with open(at, opener=_own) as f:
            status, kept = os.fstat(f.fileno()), f.read(2 * len(token))
        alone = os.name == "nt" or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
        if alone and _TOKEN.fullmatch(kept):
            return kept
    return token


def _own(path: str, flags: int) -> int:
    """Open a file that nobody else can read, and none that a link of its name points to."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o600)
