"""Who speaks to the page's server: each attack is tried over the socket, and fails."""

import gzip
import logging
import math
import socket
import threading
import time
from contextlib import suppress
from dataclasses import replace
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import msgspec
import numpy as np
import pytest
import viser._messages as kinds
from page_socket import CAMERA, ended_by, enter, pull, send, set_value, socket_of
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request as HttpRequest

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.problem import Case
from inspe_jax.report.page_token import kept_token
from inspe_jax.viewer.app import Viewer
from inspe_jax.viewer.job_queue import WAITING
from inspe_jax.viewer.searcher import SearchEnding
from inspe_jax.viewer.server import (
    BROWSERS,
    LINES,
    MESSAGE,
    SOCKETS,
    AccessRules,
    fault_of,
    quiet,
    serve,
)

EVIL = "http://evil.example"


@pytest.fixture(autouse=True)
def _at_once(monkeypatch, plain_plan):
    """What is typed counts as soon as it comes, and every refusal has its line: the tests come
    faster than people do."""
    monkeypatch.setattr("inspe_jax.viewer.browser_view.TYPED", 0.01)
    monkeypatch.setattr("inspe_jax.viewer.server.WHILE", 0.0)


@pytest.fixture
def fresh(scene, layout, tmp_path):
    """A page that nobody has changed."""
    found = Viewer(Case(scene), layout, tmp_path / "layout.yaml", port=0)
    yield found
    found.close()


@pytest.fixture(scope="module")
def served(scene, layout, tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "layout.yaml"
    found = Viewer(Case(scene), layout, path, port=0)
    yield found
    found.close()


@pytest.fixture
def viewer(served):
    """A page that others have used, and nobody looks at now."""
    wait_until(lambda: not served.server.get_clients() and not served.views)
    return served


def wait_until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it does not come to that"
        time.sleep(0.02)


def own_of(viewer):
    """The id and the view of the only page, once it is let in."""

    def there():
        return len(viewer.views) == 1 and set(viewer.views) == set(viewer.server.get_clients())

    wait_until(there)
    ((client, view),) = viewer.views.items()
    return client, view


def controls_of(viewer):
    """The controls that it has of its own."""
    return own_of(viewer)[1].controls


def still_works(viewer):
    """A page that is let in can do something, and it is done."""
    # Those of before have left. One that is just leaving may get its view only now.
    wait_until(lambda: not viewer.server.get_clients() and not viewer.views)
    before = viewer.layout
    yaw = 12.5 if np.degrees(before.poses[0, 5]) < 12 else -12.5
    with socket_of(viewer.url) as page:
        enter(page)
        set_value(page, controls_of(viewer).pose["yaw"], yaw)
        wait_until(lambda: viewer.layout is not before)
        assert np.degrees(viewer.layout.poses[0, 5]) == pytest.approx(yaw)
        assert np.isfinite(viewer.layout.poses).all()


# ── Who is let in ──


PAGE, SOCKET = {"Host": "{host}"}, {"Host": "{host}", "Upgrade": "websocket"}
EVERYONE = {
    "a page of another origin": ("/{token}/", SOCKET | {"Origin": EVIL}),
    "a file for another origin": ("/{token}/", PAGE | {"Origin": EVIL}),
    "no origin": ("/{token}/", SOCKET),
    "a page of this machine's other port": ("/{token}/", SOCKET | {"Origin": "http://127.0.0.1:1"}),
    "a page without an origin of its own": ("/{token}/", SOCKET | {"Origin": "null"}),
    "a domain that points here": (
        "/{token}/", SOCKET | {"Host": "evil.example:80", "Origin": f"{EVIL}:80"},
    ),
    "a file for that": ("/{token}", {"Host": "evil.example:80"}),
    "a user's name": ("/{token}", {"Host": "{host}@evil.example"}),
    "a longer host": ("/{token}", {"Host": "127.0.0.1.evil.example:80"}),
    "no host": ("/{token}", {}),
    "another server": ("/{token}?websocket=ws://evil.example", PAGE),
    "another server, too": (
        "/{token}?websocket=ws://{host}/{token}&websocket=ws://evil.example", PAGE,
    ),
}  # fmt: skip
"""Requests that are refused without a secret, too."""
TOKENS = {
    "no token": ("/", PAGE),
    "another token": ("/{wrong}/", PAGE),
    "the token in the query": ("/?token={token}", PAGE),
    "the token after something": ("/x/{token}/", PAGE),
}


def refusal(access, path, headers):
    token = access.token
    wrong = ("a" if token[:1] != "a" else "b") + token[1:]
    fill = dict(host="127.0.0.1:8080", token=token, wrong=wrong)
    headers = {key: value.format(**fill) for key, value in headers.items()}
    return access.refusal(HttpRequest(path.format(**fill), Headers(headers)))


@pytest.mark.parametrize("attack", [*EVERYONE, *TOKENS])
def test_who_is_refused(attack):
    access = AccessRules("127.0.0.1")
    why = refusal(access, *(EVERYONE | TOKENS)[attack])
    assert why
    assert access.token not in why
    if attack in EVERYONE:
        assert refusal(AccessRules("127.0.0.1", token=""), *EVERYONE[attack])


@pytest.mark.parametrize("token", ["", "x" * 22])
def test_who_is_let_in(token):
    access = AccessRules("127.0.0.1", token=token)
    page, own = f"/{token}/" if token else "/", {"Origin": "http://127.0.0.1:8080"}
    assert not refusal(access, page, PAGE)
    assert not refusal(access, page, SOCKET | own)
    assert not refusal(access, f"{page}?websocket=ws://{{host}}{page.rstrip('/')}", PAGE)


def test_a_refusal_is_an_answer_and_a_line(viewer, caplog):
    with pytest.raises(InvalidStatus) as refused, socket_of(viewer.url, origin=EVIL):
        pass
    assert refused.value.response.status_code == 403
    there = urlsplit(viewer.url)
    with pytest.raises(HTTPError) as error:
        urlopen(f"http://{there.netloc}/")
    with error.value as answer:
        words = answer.read().decode()
    assert error.value.code == 403
    assert "Open the address that was printed" in words
    assert [line.startswith("refused 127.0.0.1: ") for line in caplog.messages] == [True, True]
    assert viewer.access.token not in words + caplog.text
    assert not viewer.server.get_clients()


def test_the_page_comes_with_headers_that_keep_it_to_itself(viewer):
    there = urlsplit(viewer.url)
    again = f"{viewer.url}?websocket=ws://{there.netloc}{there.path.rstrip('/')}"  # as viser has it
    for url in (viewer.url, viewer.url.rstrip("/"), again):
        with urlopen(url) as page:
            assert b"<html" in page.read()
            assert page.headers["X-Frame-Options"] == "DENY"
            assert page.headers["Referrer-Policy"] == "no-referrer"
            assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    with pytest.raises(HTTPError) as missing:
        urlopen(f"{viewer.url}..%2f..%2f_viser.py")
    assert missing.value.code == 404
    missing.value.close()


@pytest.mark.parametrize(
    ("host", "local", "own", "foreign"),
    [
        ("127.0.0.1", True, ["127.0.0.1:1", "localhost:9", "[::1]:2"], ["192.0.2.1", "a.example"]),
        (
            "localhost",
            True,
            ["localhost"],
            ["localhost.a.example", "x@localhost", "", "localhost#.x"],
        ),
        ("::1", True, ["[::1]:8"], ["[2001:db8::1]:8"]),
        ("0.0.0.0", False, ["192.0.2.7:80", socket.gethostname()], ["evil.example", "a/b"]),
        ("192.0.2.7", False, ["192.0.2.7", "localhost"], ["evil.example:8080"]),
    ],
)
def test_hosts_are_names_of_this_machine(host, local, own, foreign):
    access = AccessRules(host)
    assert access.local is local

    def refused(name):
        return access.refusal(HttpRequest(f"/{access.token}/", Headers(Host=name)))

    assert [name for name in own if refused(name)] == []
    assert [name for name in foreign if "which is not this machine" not in refused(name)] == []


def test_addresses_are_those_that_others_can_use():
    access = AccessRules("0.0.0.0")
    first, *others = access.urls(8080)
    assert first == f"http://localhost:8080/{access.token}/"
    assert not any("0.0.0.0" in url or "127.0.0.1" in url for url in others)
    own = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    outward = {ip for ip in own if not ip.startswith("127.")}
    assert outward <= {urlsplit(url).hostname for url in others}
    assert all(
        ":" in urlsplit(url).hostname for url in AccessRules("::").urls(1)
    )  # as it listens there
    assert AccessRules("::1").urls(1) != AccessRules("::1").urls(1)  # a token of its own each
    assert AccessRules("::1", token="").urls(1) == ["http://[::1]:1/"]
    assert len(access.token) >= 20


def test_a_kept_token_is_its_user_s_alone(tmp_path):
    first = kept_token("a.yaml", tmp_path)
    assert kept_token("a.yaml", tmp_path) == first
    assert kept_token("b.yaml", tmp_path) != first
    files = sorted((tmp_path / "page_tokens").iterdir())
    assert [oct(at.stat().st_mode & 0o777) for at in (files[0].parent, *files)] == [
        "0o700", "0o600", "0o600",
    ]  # fmt: skip
    (at,) = (one for one in files if one.read_text() == first)
    for spoil in (
        lambda: at.chmod(0o644),  # others could have read it
        lambda: (at.chmod(0o600), at.write_text("short")),
        lambda: (at.rename(tmp_path / "real"), at.symlink_to(tmp_path / "real")),
    ):
        spoil()
        tokens = [kept_token("a.yaml", tmp_path) for _ in range(2)]
        assert len({first, *tokens}) == 3
        assert all(len(token) == len(first) for token in tokens)
    assert kept_token("a.yaml", tmp_path / "real") != first  # a file in the folder's place


def test_a_version_of_viser_that_opens_its_port_otherwise_is_not_used(monkeypatch):
    """There nothing would guard it."""

    class Other:
        def __init__(self, **_):
            self.stopped = False

        def stop(self):
            stopped.append(self)

    stopped = []
    monkeypatch.setattr("inspe_jax.viewer.server.viser.ViserServer", Other)
    with pytest.raises(RuntimeError, match="would be unprotected"):
        serve(AccessRules("127.0.0.1"), 0)
    assert stopped


def test_where_the_port_is_taken_the_next_one_serves():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = serve(AccessRules("127.0.0.1"), port)
        with quiet():
            server.stop()
    assert server.get_port() > port


def test_a_host_that_is_not_here_is_said():
    with pytest.raises(InspeError, match=r"host 203\.0\.113\.1, port 0: no server can be started"):
        serve(AccessRules("203.0.113.1"), 0)


# ── What is sent ──


def test_nobody_can_ask_for_a_tunnel_to_the_outside(viewer):
    asked = msgspec.msgpack.encode({"type": "ShareUrlRequest"})
    assert fault_of(asked) == ("a message of kind 'ShareUrlRequest'", False)
    handlers = viewer.server._websock_server._incoming_handlers
    assert not {kinds.ShareUrlRequest, kinds.ShareUrlDisconnect} & set(handlers)


WRONG_NUMBERS = [math.nan, math.inf, -math.inf, 1e300, "nan", "-Infinity", "1e300"]


@pytest.mark.parametrize("number", WRONG_NUMBERS)
def test_numbers_that_are_none_are_dropped(number):
    """As are windows without a size, and rotations that are none; the page itself sends such."""
    typed = dict(type="GuiUpdateMessage", uuid="x", updates={"value": number})
    moved = dict(type="TransformControlsUpdateMessage", name="/handle", owner="1")
    turned = moved | dict(wxyz=[0.0] * 4, position=[0.0] * 3)
    messages = [typed, turned, CAMERA | dict(image_height=0), CAMERA | dict(wxyz=[0.0] * 4)]
    if not isinstance(number, str):  # text is no position, which ends a connection: see below
        messages.append(CAMERA | dict(position=[0.0, number, 0.0]))
        messages.append(moved | dict(wxyz=[1.0, 0.0, 0.0, 0.0], position=[0.0, number, 5.0]))
    for message in messages:
        why, hostile = fault_of(msgspec.msgpack.encode(message))
        assert why, message
        assert not hostile, message


def test_numbers_that_are_none_poison_nothing(fresh, layout, caplog, capfd):
    """And what the same page sends after them is done."""
    with socket_of(fresh.url) as page:
        send(page, **CAMERA | dict(position=[0.0, math.nan, 0.0]))
        send(page, **CAMERA | dict(image_height=0))
        enter(page)
        owner, view = own_of(fresh)
        for control in (*view.controls.pose.values(), fresh.panel.seconds):
            set_value(page, control, "nan")
        pull(page, owner, None, "Start")
        pull(page, owner, [0.0, math.inf, 5.0])
        pull(page, owner, [0.0, 0.0, 5.0], wxyz=[0.0] * 4)
        pull(page, owner, None, "End")
        set_value(page, view.controls.pose["pitch"], -7.0)
        wait_until(lambda: fresh.layout is not layout)
        (client,) = fresh.server.get_clients().values()
        assert np.isfinite(client.camera.position).all()
    changed = np.array(layout.poses)
    changed[0, 4] = np.radians(-7.0)
    np.testing.assert_allclose(fresh.layout.poses, changed, atol=1e-6)
    assert fresh.panel.seconds.value == 60.0
    assert len(caplog.messages) == 5  # one for each kind of fault
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_a_long_text_for_a_number_is_logged_shortly(fresh, caplog):
    with socket_of(fresh.url) as page:
        enter(page)
        set_value(page, fresh.panel.seconds, "x" * 60_000)
        wait_until(lambda: caplog.messages)
    (line,) = caplog.messages
    assert "could not convert string to float: 'xxx" in line
    assert len(line) < 400


def test_a_typed_number_is_read_before_the_controls_are_shown_anew(fresh, layout, monkeypatch):
    """Even if that is asked for when the number has come, and nobody has read it yet."""
    asked = []

    def meanwhile(*_):
        asked.append(threading.Thread(target=fresh._show_controls))
        asked[-1].start()
        asked[-1].join()

    with socket_of(fresh.url) as page:
        enter(page)
        # viser calls this once a value is there, before what is bound to its control.
        monkeypatch.setattr(controls_of(fresh).pose["pitch"]._impl, "sync_cb", meanwhile)
        set_value(page, controls_of(fresh).pose["pitch"], -7.0)
        wait_until(lambda: fresh.layout is not layout)
    assert asked
    assert np.degrees(fresh.layout.poses[0, 4]) == pytest.approx(-7.0)


def test_numbers_that_are_far_off_are_brought_back(fresh, scene):
    with socket_of(fresh.url) as page:
        enter(page)
        for sign, control in zip((1, -1, 1, -1, 1), controls_of(fresh).pose.values(), strict=True):
            before = fresh.layout
            set_value(page, control, sign * 1e9)
            wait_until(lambda before=before: fresh.layout is not before, 10)
    assert np.isfinite(fresh.layout.poses).all()
    assert fresh.session.faults() == []
    assert np.hypot(*fresh.layout.poses[0, :2]) <= scene.voxels.radius + 1e-3


HOSTILE = {
    "no message at all": b"\xff\xfe\x00GET / HTTP",
    "nothing": b"",
    "text": "hello",
    "a list": msgspec.msgpack.encode([1, 2]),
    "a number": msgspec.msgpack.encode(7),
    "no type": msgspec.msgpack.encode({"uuid": "x"}),
    "a type that is none": msgspec.msgpack.encode({"type": ["x"]}),
    "a type that nobody knows": msgspec.msgpack.encode({"type": "Rm"}),
    "nested 10 000 deep": b"\x91" * 10_000,
    "nested 10 000 deep, within": b"\x82\xa4type\xb0GuiUpdateMessage\xa1x" + b"\x91" * 10_000,
    "fields missing": msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
    "fields of another type": msgspec.msgpack.encode(CAMERA | {"position": "here"}),
    "a number as text": msgspec.msgpack.encode(CAMERA | {"position": ["nan", "0", "0"]}),
    "a kind with a long name": msgspec.msgpack.encode({"type": "\N{GRINNING FACE}" * 100}),
    "too few numbers": msgspec.msgpack.encode(CAMERA | {"position": [1.0]}),
    "other fields of a key": msgspec.msgpack.encode(
        {"type": "CommandTriggerMessage", "uuid": "x", "more": 1}
    ),
    "other fields": msgspec.msgpack.encode(CAMERA | {"excluded_self_client": 1}),
    "another property": msgspec.msgpack.encode(
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"update_cb": 1}}
    ),
    "a value that is none": msgspec.msgpack.encode(
        {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": {"a": 1}}}
    ),
}


@pytest.mark.parametrize("attack", HOSTILE)
def test_what_is_no_message_is_known(attack):
    why, hostile = fault_of(HOSTILE[attack])
    assert hostile
    assert "\n" not in why


def test_what_is_no_message_ends_its_connection_in_one_line(viewer, caplog, capfd):
    caplog.set_level(logging.INFO)
    attacks = "nothing", "text", "nested 10 000 deep", "a kind with a long name", "other fields"
    for attack in attacks:
        with socket_of(viewer.url) as page:
            page.send(HOSTILE[attack])
            assert ended_by(page) == 1008
    lines = [line for line in caplog.messages if "refused" in line]
    assert len(lines) == len(attacks)
    assert "\n" not in "".join(lines)
    still_works(viewer)
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_a_message_of_60_mb_is_not_read(viewer, caplog, capfd):
    with socket_of(viewer.url) as page:
        with suppress(ConnectionClosed):  # while it is still being sent
            page.send(bytes(60_000_000))
        assert ended_by(page) == 1009
    still_works(viewer)
    assert "Traceback" not in caplog.text + capfd.readouterr().err
    assert fault_of(b"x" * MESSAGE)[0]


def test_of_200_connections_few_are_let_in_and_the_page_goes_on(fresh, caplog):
    held, refused = [], 0
    with socket_of(fresh.url) as page:
        enter(page)
        wait_until(lambda: fresh.server.get_clients())
        for _ in range(200):
            made = socket_of(fresh.url)
            try:
                made.__enter__()
                held.append(made)
            except (InvalidStatus, ConnectionClosed, EOFError, OSError):
                refused += 1
        assert len(held) == BROWSERS - 1
        assert refused == 200 - len(held)
        before = fresh.layout
        set_value(page, controls_of(fresh).pose["yaw"], 33.0)
        wait_until(lambda: fresh.layout is not before)
    for made in held:
        made.__exit__(None, None, None)
    wait_until(lambda: not fresh.server._websock_server._live_connections)
    still_works(fresh)


def test_probes_of_the_port_leave_a_line_at_most(viewer, caplog, capfd):
    """Bare connections that say nothing, or something else; and 200 of them that are held."""
    there = urlsplit(viewer.url)
    hello = b"\x16\x03\x01\x02\x00\x01\x00\x01"  # of TLS
    for words in (b"", hello, b"GET / HTTP/1.1\r\nHost", b"\n" * 5000):
        with socket.create_connection((there.hostname, there.port)) as probe:
            probe.sendall(words)
    held = [socket.create_connection((there.hostname, there.port)) for _ in range(200)]

    def is_open(probe):
        probe.setblocking(False)
        try:
            return probe.recv(1) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    wait_until(lambda: sum(map(is_open, held)) <= SOCKETS)
    still_works(viewer)  # while they are held: who is silent longest makes room
    for probe in held:
        probe.close()
    assert not any("\n" in line for line in caplog.messages)
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_many_refusals_are_counted_and_not_told_one_by_one(caplog, monkeypatch):
    """A page somewhere may ask without end."""
    monkeypatch.setattr("inspe_jax.viewer.server.WHILE", 600.0)
    server = serve(AccessRules("127.0.0.1"), 0)
    try:
        for _ in range(3 * LINES):
            with pytest.raises(HTTPError) as refused:
                urlopen(f"http://127.0.0.1:{server.get_port()}/")
            refused.value.close()
    finally:
        with quiet():
            server.stop()
    told = [line for line in caplog.messages if "it does not have the token" in line]
    assert len(told) == LINES


def test_values_that_are_no_option_ask_for_nothing(fresh, layout, capfd):
    panel = fresh.panel
    with socket_of(fresh.url) as page:
        enter(page)
        wait_until(lambda: fresh.server.get_clients())
        _, view = own_of(fresh)
        own = view.controls
        groups = own.row_buttons, own.toggle_buttons, own.existing
        for control in (own.sensor, own.device, own.new, *groups, panel.method, panel.edit):
            set_value(page, control, "-3  nobody")
        set_value(page, panel.frame, -5)
        set_value(page, panel.frame, 10_000)
        set_value(page, own.pose["yaw"], "north")
        set_value(page, own.pose["yaw"], 5.0)
        wait_until(lambda: fresh.layout is not layout)
        wait_until(lambda: own.sensor.value in own.sensor.options)
    assert view.selection == (0,)
    assert panel.method.value in panel.method.options
    assert own.new.value in own.new.options
    assert 0 <= fresh.panel.shown_frame < fresh.frames
    assert "Traceback" not in capfd.readouterr().err


# ── Browsers come and go ──


def test_a_handle_is_pulled_by_its_own_browser_alone(viewer):
    before = viewer.layout
    up = np.array(before.poses[0, :3]) - viewer.scene3d.shift + [0, 0, 1.0]
    with socket_of(viewer.url) as page, socket_of(viewer.url) as other:
        enter(page)
        owner, _ = own_of(viewer)
        enter(other)
        wait_until(lambda: len(viewer.views) == 2)
        (foreign,) = set(viewer.views) - {owner}
        for socket, of in ((other, owner), (page, foreign), (page, owner)):
            moved = up if socket is page and of == owner else up + [0, 0, 1.0]
            pull(socket, of, None, "Start")
            pull(socket, of, moved.tolist())
            pull(socket, of, None, "End")
        wait_until(lambda: viewer.layout is not before)
        went = viewer.layout.poses[0, 2] - before.poses[0, 2]
        assert went == pytest.approx(1.0, abs=1e-3)
        viewer.undo_or_redo("Undo")
        wait_until(lambda: viewer.layout is before)  # it was one change


def test_a_browser_that_leaves_in_mid_drag_lets_go_there(viewer):
    before = viewer.layout
    up = np.array(before.poses[0, :3]) - viewer.scene3d.shift + [0, 0, 0.5]
    with socket_of(viewer.url) as page:
        enter(page)
        owner, view = own_of(viewer)
        pull(page, owner, None, "Start")
        pull(page, owner, up.tolist())
        wait_until(lambda: viewer.display.shown is not before)
        assert viewer.layout is before
    wait_until(lambda: viewer.layout is not before and not viewer.views)
    assert viewer.layout.poses[0, 2] - before.poses[0, 2] == pytest.approx(0.5, abs=1e-3)
    wait_until(lambda: viewer.display.shown is viewer.layout)
    wait_until(lambda: not view.sensor_view._recording._thread.is_alive())
    still_works(viewer)


def test_what_a_browser_has_typed_counts_when_it_leaves(viewer, monkeypatch):
    """Before what others do after it has left."""
    monkeypatch.setattr("inspe_jax.viewer.browser_view.TYPED", 600.0)
    before = viewer.layout
    yaw = 12.5 if np.degrees(before.poses[0, 5]) < 12 else -12.5
    with socket_of(viewer.url) as page:
        enter(page)
        _, view = own_of(viewer)
        set_value(page, view.controls.pose["yaw"], yaw)
        wait_until(lambda: view._typing["yaw"]._action)
        assert viewer.layout is before
    wait_until(lambda: viewer.layout is not before)
    assert np.degrees(viewer.layout.poses[0, 5]) == pytest.approx(yaw)


def test_a_search_ends_a_drag_and_shows_what_it_begins_from(viewer, monkeypatch):
    monkeypatch.setattr(viewer.searcher, "start", lambda *_: None)
    before = viewer.layout
    with socket_of(viewer.url) as page:
        enter(page)
        owner, view = own_of(viewer)
        at = np.array(view.handle.gizmo.position)
        pull(page, owner, None, "Start")
        pull(page, owner, (at + [0, 0, 1.0]).tolist())
        wait_until(lambda: viewer.display.shown is not before)
        viewer.optimise()
        wait_until(lambda: viewer.display.shown is before)
        assert view.dragging is None
        pull(page, owner, (at + [0, 0, 2.0]).tolist())
        pull(page, owner, None, "End")
        wait_until(lambda: np.allclose(view.handle.gizmo.position, at))
        viewer._on_end(SearchEnding(None, 0.0, 0.0, "stopped"))
        wait_until(lambda: not viewer.searching)
    assert viewer.layout is before
    still_works(viewer)


def test_what_another_browser_does_in_vain_leaves_a_drag_as_it_is(viewer):
    before = viewer.layout
    with socket_of(viewer.url) as page:
        enter(page)
        owner, view = own_of(viewer)
        up = np.array(view.handle.gizmo.position) + [0, 0, 0.5]
        pull(page, owner, None, "Start")
        pull(page, owner, up.tolist())
        wait_until(lambda: viewer.display.shown is not before)
        viewer.restore()
        view.select(1)
        done = []
        viewer.queue.submit(lambda: done.append(True))
        wait_until(lambda: done)
        np.testing.assert_allclose(view.handle.gizmo.position, up, atol=1e-5)
        assert view.selection == (0,)
        pull(page, owner, None, "End")
        wait_until(lambda: viewer.layout is not before)
    assert viewer.layout.poses[0, 2] - before.poses[0, 2] == pytest.approx(0.5, abs=1e-3)


# ── The page's head ──


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_page_has_its_own_title_and_is_else_as_it_was(viewer, encoding, layout):
    def page(at):
        with urlopen(Request(at, headers={"Accept-Encoding": encoding})) as answer:
            body = answer.read()
            assert int(answer.headers["Content-Length"]) == len(body)
            assert answer.headers["X-Frame-Options"] == "DENY"
        return (gzip.decompress(body) if encoding == "gzip" else body).decode()

    dressed = page(viewer.url)
    assert "<title>layout at test crossing – inspe_jax</title>" in dressed
    assert dressed.count("<title>") == dressed.count('rel="icon"') == 1
    access = AccessRules("127.0.0.1")
    plain = serve(access, 0)
    try:
        own = page(*access.urls(plain.get_port()))
    finally:
        with quiet():
            plain.stop()
    assert "<title>Viser</title>" in own
    behind = own.index("<script")
    assert dressed.endswith(own[behind:])


def test_names_in_the_title_are_text(scene, layout, tmp_path):
    bad = replace(layout, name="</title><script>alert(1)</script>")
    found = Viewer(Case(scene), bad, tmp_path / "layout.yaml", port=0)
    try:
        page = urlopen(found.url).read().decode()
        assert "alert(1)</script>" not in page
        assert "&lt;/title&gt;&lt;script&gt;" in page
    finally:
        found.close()


def test_a_burst_of_requests_is_shown_once_and_holds_nobody_up(fresh, layout):
    """Sixty times Undo undo sixty changes; of hundreds a bounded number is done, and another
    browser's request is done soon after."""
    layouts = [replace(layout, name=f"{k}") for k in range(70)]
    for one in layouts:
        fresh.session.take(one)
    shown, real = [], fresh.display.draw
    fresh.display.draw = lambda *told: (shown.append(told[0]), real(*told))
    undo = dict(type="CommandTriggerMessage", uuid=fresh.panel.keys["Undo"]._impl.uuid)
    with socket_of(fresh.url) as page, socket_of(fresh.url) as other:
        enter(page)
        own_of(fresh)
        enter(other)
        wait_until(lambda: len(fresh.views) == 2)
        done, going = [], threading.Event()
        fresh.queue.submit(going.wait)
        for _ in range(60):
            send(page, **undo)
        wait_until(lambda: len(fresh.queue._waiting) >= 60)
        going.set()
        wait_until(lambda: fresh.layout is layouts[9])
        wait_until(lambda: shown and shown[-1] is layouts[9])
        assert len(shown) < 5
        for k in range(5 * WAITING):
            set_value(page, fresh.panel.edit, ("Undo", "Redo", "Save")[k % 3])
        set_value(other, fresh.panel.edit, "Save")
        fresh.queue.submit(lambda: done.append(True))
        wait_until(lambda: done and not fresh.queue._waiting, 20)
        began = time.monotonic()
        fresh.close()
        assert time.monotonic() - began < 10
