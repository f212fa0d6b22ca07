"""A web server for viser's pages that checks every request and every message.

viser serves everyone who connects, and acts on everything they send. Here each request is checked
before its handshake, and each message before it is passed on:

- The address contains a random token, which no other page can know. Without it nothing can be
  loaded, and no connection opened.
- The ``Host`` of a request must be a name of this machine, so that no foreign domain can point here
  (DNS rebinding). Its ``Origin`` must be the page itself.
- A message must be of one of the few kinds that the page sends, with the fields and types of its
  kind, with finite numbers, and with at most :data:`MESSAGE` bytes.
- At most :data:`BROWSERS` pages may be open.

Each refusal is logged on one line; at most :data:`LINES` lines in :data:`WHILE` seconds.
"""

import asyncio
import errno
import io
import ipaddress
import logging
import math
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, redirect_stdout
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import ifaddr
import msgspec
import viser
import viser._messages as kinds
import websockets.asyncio.server
from viser.infra import Message
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedOK
from websockets.http11 import Request, Response

from inspe_jax.core.errors import InspeError, brief
from inspe_jax.core.words import visible
from inspe_jax.report.page_token import new_token
from inspe_jax.viewer.page_head import with_head

PORTS = 100
"""Number of ports that are tried."""
BROWSERS = 16
"""Pages that may be open at the same time."""
SOCKETS = 128
"""Connections that may be open at the same time, including those without a request yet."""
SILENCE = 10.0
"""Time that a connection gets to send its request, and to receive the page [s]."""
LINES, WHILE = 20, 10.0
"""Refusals that are logged one by one, and in which time [s]; further ones are only counted."""
LINE = 300
"""Most characters of such a line."""
MESSAGE = 2**16
"""Largest message that is read [byte]; those of the page have some hundred bytes."""
LARGEST = 1e9
"""Largest number in a message; geometry in single precision overflows with larger ones."""
LEAST = 1e-6
"""Least length of a rotation's quaternion, which should be 1."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'; object-src 'none'; base-uri 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Headers of every response: no other page can show this one in a frame, or learn its address."""

SENT: tuple[type[Message], ...] = (
    kinds.CommandTriggerMessage,
    kinds.GuiUpdateMessage,
    kinds.SceneNodeClickMessage,
    kinds.TransformControlsDragEndMessage,
    kinds.TransformControlsDragStartMessage,
    kinds.TransformControlsUpdateMessage,
    kinds.ViewerCameraMessage,
)
"""Messages that the page sends. viser's others are dropped: public tunnels, uploads, forms."""

_KINDS = {kind.__name__: kind for kind in SENT}
_KNOWN = {kind.__name__ for kind in kinds.Message.get_subclasses()}
_HOST = re.compile(r"([a-z0-9.-]+|\[[0-9a-f:.]+\])(:[0-9]{1,5})?", re.IGNORECASE)
_serving = threading.Lock()
sender: ContextVar[Hashable] = ContextVar("sender", default=None)
"""The connection whose message is being handled, in its task and in those that this one starts."""


@dataclass(frozen=True)
class AccessRules:
    """Who may open the pages of a server that listens on ``host``: those who know the ``token``.

    With an empty token no secret is needed. At most ``browsers`` pages may be open.
    """

    host: str
    token: str = field(default_factory=new_token)
    browsers: int = BROWSERS

    @property
    def local(self) -> bool:
        """Whether only this machine can reach it."""
        return _is_loopback(self.host)

    def urls(self, port: int) -> list[str]:
        """Addresses of the page; the one for this machine first."""
        hosts, every = [self.host], _address(self.host)
        if every is not None and every.is_unspecified:
            hosts = ["localhost" if every.version == 4 else "::1"]
            for ip in (ip for adapter in ifaddr.get_adapters() for ip in adapter.ips):
                at = ipaddress.ip_address(str(ip.ip) if ip.is_IPv4 else ip.ip[0])
                if at.version == every.version and not (at.is_loopback or at.is_link_local):
                    hosts.append(str(at))
        path = f"/{self.token}/" if self.token else "/"
        return [f"http://{f'[{host}]' if ':' in host else host}:{port}{path}" for host in hosts]

    def refusal(self, request: Request) -> str:
        """Why a request is refused; an empty text if it is accepted."""
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        upgrades = request.headers.get_all("Upgrade")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return f"it asked for host {brief(hosts)}, which is not this machine"
        own = [f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")]
        if len(upgrades) > 1:
            return "it asked for more than one protocol"
        if (upgrades or origins) and not (len(origins) == 1 and origins[0].lower() in own):
            return f"a page of {brief(origins)} asked, not this one"
        path, _, query = request.path.partition("?")
        first = path.split("/")[1] if path.startswith("/") else ""
        if self.token and not secrets.compare_digest(
            first.encode(errors="surrogateescape"), self.token.encode()
        ):
            return "it does not have the token of the address that was printed"
        # The address of viser's page can name the server to connect to; no other may stand there.
        servers = [f"ws{url.removeprefix('http')}{path.rstrip('/')}" for url in own]
        if query and parse_qsl(query, keep_blank_values=True) not in [
            [("websocket", server)] for server in servers
        ]:
            return "its address names another server"
        return ""

    def _is_ours(self, header: str) -> bool:
        """Whether a ``Host`` names this machine.

        If other machines may connect, any IP address is accepted: it belongs to no domain, and
        may be that of a router or a container in between.
        """
        if not _HOST.fullmatch(header):
            return False
        name = (urlsplit(f"//{header}").hostname or "").lower()
        if self.local:
            return name == self.host.lower() or _is_loopback(name)
        own = _own_names() | {self.host.lower()}
        return name in own or _address(name) is not None or _is_loopback(name)


def fault_of(raw: Any) -> tuple[str, bool]:
    """(what is wrong with a browser's message, whether the page itself would never send it).

    The text is empty if nothing is wrong. The page itself can send numbers that are not finite,
    such as those of a window without a size, and messages that are not used here; those are only
    dropped.
    """
    if not isinstance(raw, bytes):
        return "a message is text", True
    try:
        content = msgspec.msgpack.decode(raw)
        name = content.pop("type")
        if name not in _KINDS:
            return f"a message of kind {brief(name)}", name not in _KNOWN
        message = msgspec.convert(content, _KINDS[name])
        if not set(content) <= set(message.__dict__):
            return f"a {name} has other fields than it should", True
    except Exception as e:  # also if it is nested too deep, or is not a mapping
        return f"a message cannot be read ({type(e).__name__})", True
    if not _is_finite(content):
        return f"a {name} has a number that is not finite, or too large", False
    if "wxyz" in content and math.hypot(*content["wxyz"]) < LEAST:
        return f"a {name} has a rotation without a direction", False
    if (
        isinstance(message, kinds.ViewerCameraMessage)
        and min(message.image_height, message.image_width) < 1
    ):
        return f"a {name} is of a window without a size", False
    if isinstance(message, kinds.GuiUpdateMessage):
        value = message.updates.get("value")
        if set(message.updates) != {"value"} or not isinstance(value, bool | int | float | str):
            return f"a {name} sets something other than a value", True
    return "", False


@cache
def _own_names() -> set[str]:
    """Names of this machine. Asking the system for them may take a while."""
    names = {socket.gethostname().lower(), socket.getfqdn().lower()}
    return names | {f"{name}.local" for name in names}


def serve(access: AccessRules, port: int, head: str = "") -> viser.ViserServer:
    """Start a server for browsers, at ``port`` or the next free one; at any free one for port 0.

    ``head`` is HTML for the page's head. Raises InspeError if the host is not an address of this
    machine, or no port is free.
    """
    host = access.host
    _own_names()
    try:
        kind, _, _, _, at = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as e:
        raise InspeError(f"host {host}: no server can be started there ({e.strerror})") from None
    wrong = OSError()
    for free in range(port, min(port + PORTS, 65536)):
        try:
            with socket.socket(kind, socket.SOCK_STREAM) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind((at[0], free, *at[2:]))
        except OSError as e:
            wrong = e
            if e.errno not in (errno.EADDRINUSE, errno.EACCES):
                break
        else:
            return _guarded(access, free, head)
    raise InspeError(f"host {host}, port {port}: no server can be started there ({wrong.strerror})")


def quiet() -> AbstractContextManager[Any]:
    """Suppress what viser prints: its addresses, and that it has stopped."""
    return redirect_stdout(io.StringIO())


def _guarded(access: AccessRules, port: int, head: str) -> viser.ViserServer:
    """viser's server with access rules.

    viser has no options for this. It opens its port with ``websockets.asyncio.server.serve``, which
    is replaced here by one with more options while the port is opened.
    """
    module, real, opened = websockets.asyncio.server, websockets.asyncio.server.serve, []

    def serve_behind(handler: Any, *args: Any, **options: Any) -> Any:
        if handler.__module__ != viser.infra._infra.__name__:  # somebody else's server
            return real(handler, *args, **options)
        opened.append(port)
        guard = _Guard(access, handler, options["process_request"], head)
        return real(guard.handle, *args, **options | guard.options)

    with _serving, quiet():
        try:
            module.serve = serve_behind  # type: ignore[assignment, misc]
            server = viser.ViserServer(host=access.host, port=port, verbose=False)
        finally:
            module.serve = real  # type: ignore[misc]
        if not opened:
            server.stop()
            raise RuntimeError(
                "this version of viser opens its port in another way, and would be unprotected"
            )
    # No browser may open a public tunnel to this server.
    for message in (kinds.ShareUrlRequest, kinds.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    return server


class _Guard:
    """Checks the connections of one server before viser's ``handler`` and ``files`` get them."""

    def __init__(
        self, access: AccessRules, handler: Any, files: Callable[..., Any], head: str
    ) -> None:
        self.access, self.head, self.pages = access, head, 0
        self._silent: dict[ServerConnection, None] = {}  # in the order in which they came
        self._sockets = 0
        self._logged: list[float] = []
        self._not_logged = 0
        self._handler, self._files = handler, files
        self.log = logging.Logger("inspe_jax.server")
        self.log.parent = logging.getLogger("inspe_jax")
        self.log.addFilter(self._logs)
        asyncio.get_running_loop().set_exception_handler(self._failed)
        guard = self

        class Connection(ServerConnection):
            """A connection whose messages are checked."""

            def connection_made(self, transport: Any) -> None:
                super().connection_made(transport)
                guard.connected(self)

            def connection_lost(self, exc: Exception | None) -> None:
                guard.disconnected(self)
                super().connection_lost(exc)

            async def recv(self, decode: bool | None = None) -> Any:
                return await guard.checked(self, lambda: super(Connection, self).recv(decode))

        self.options = dict(
            process_request=self.answer,
            max_size=MESSAGE,
            open_timeout=SILENCE,
            logger=self.log,
            create_connection=Connection,
            server_header=None,
        )

    def connected(self, connection: ServerConnection) -> None:
        """Count a connection. If there are too many, close the one that is silent for longest."""
        self._sockets += 1
        self._silent[connection] = None
        if self._sockets > SOCKETS:
            oldest = next(iter(self._silent))
            del self._silent[oldest]
            oldest.transport.abort()

    def disconnected(self, connection: ServerConnection) -> None:
        """Count a connection that is closed."""
        self._sockets -= 1
        self._silent.pop(connection, None)

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The response to a request: a refusal, a file, or None to continue with the handshake."""
        self._silent.pop(connection, None)
        why, status = self.access.refusal(request), 403
        if not why and request.headers.get_all("Upgrade") and self.pages >= self.access.browsers:
            why, status = f"{self.pages} pages are open already, which is the most allowed", 503
        if why:
            self._refused(connection, why)
            words = f"This is refused: {why}.\nOpen the address that was printed.\n"
            response: Response | None = connection.respond(status, words)
        else:
            token = self.access.token
            path = request.path.removeprefix(f"/{token}") if token else request.path
            response = self._files(connection, replace(request, path=path))
            if response is not None and self.head and _is_page(response):
                zipped = response.headers["Content-Encoding"] == "gzip"
                response.body = with_head(bytes(response.body), self.head, zipped=zipped)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
        if response is not None:
            response.headers.update(HEADERS)
        return response

    async def handle(self, connection: ServerConnection) -> None:
        """Pass a connection on to viser, unless too many pages are open."""
        if self.pages >= self.access.browsers:
            self._refused(connection, "too many pages are open")
            await connection.close(1013, "too many pages are open")
            return
        self.pages += 1
        try:
            await self._handler(connection)
        finally:
            self.pages -= 1

    async def checked(self, connection: ServerConnection, receive: Callable[[], Any]) -> Any:
        """The next message that is valid. One that the page would never send ends the
        connection."""
        reported: set[str] = connection.__dict__.setdefault("reported", set())
        while True:
            raw = await receive()
            why, hostile = fault_of(raw)
            if not why:
                sender.set(connection.id)
                return raw
            if why not in reported:
                reported.add(why)
                self._refused(connection, why)
            if hostile:
                await connection.close(1008, "refused")
                raise ConnectionClosedOK(None, None)

    def _refused(self, connection: ServerConnection, why: str) -> None:
        address = connection.remote_address or ("?",)
        self.log.warning("refused %s: %s", address[0], why)

    def _logs(self, record: logging.LogRecord) -> bool:
        """Whether a record is logged, or only counted. Its traceback is left out."""
        now = time.monotonic()
        self._logged = [at for at in self._logged if at > now - WHILE]
        if len(self._logged) >= LINES:
            self._not_logged += 1
            return False
        words = visible(record.getMessage())
        if record.exc_info:
            words += f": {record.exc_info[1]!r}"
        words = words if len(words) <= LINE else f"{words[:LINE]}…"
        if self._not_logged:
            words += f" (and {self._not_logged} more lines before)"
        record.msg, record.args, record.exc_info, record.exc_text = words, (), None, None
        self._logged.append(now)
        self._not_logged = 0
        return True

    def _failed(self, _: Any, context: dict[str, Any]) -> None:
        """Log other errors that a browser causes, on one line each."""
        wrong = context.get("exception")
        self.log.warning("%s: %r", context.get("message"), wrong)


def _is_page(response: Response) -> bool:
    return response.headers.get("Content-Type", "").startswith("text/html")


def _is_finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, list):
        return all(map(_is_finite, value))
    if isinstance(value, str):  # viser turns it into a number for controls that have one
        try:
            value = float(value)
        except ValueError:
            return True
    if isinstance(value, int | float):
        return math.isfinite(value) and abs(value) <= LARGEST
    return True


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IP address that a host's name is; None if it is another name."""
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _is_loopback(name: str) -> bool:
    address = _address(name)
    return name.lower() == "localhost" or (address is not None and address.is_loopback)
