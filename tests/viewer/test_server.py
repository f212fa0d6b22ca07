"""Who gets the page, over the socket as a browser does; and browsers that come, go and disturb."""

import socket
import threading
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
from page_socket import enter, pull, send, set_value, socket_of, wait_until
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request

from inspe_jax.placement.problem import Case
from inspe_jax.viewer.app import Viewer
from inspe_jax.viewer.server import kept_token, new_token, quiet, refusal, serve, with_head
from inspe_jax.viewer.workers import SearchEnding

EVIL = "http://evil.example"


@pytest.fixture(autouse=True)
def _at_once(monkeypatch, plain_plan):
    """What is typed counts as soon as it comes: the tests come faster than people do."""
    monkeypatch.setattr("inspe_jax.viewer.browser_view.TYPED", 0.01)


@pytest.fixture(scope="module")
def served(scene, layout, tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "layout.yaml"
    bad = replace(layout, name="</title><script>alert(1)</script>")
    found = Viewer(Case(scene), bad, path, port=0)
    yield found
    found.close()


@pytest.fixture
def viewer(served):
    """A page that others have used, and nobody looks at now."""
    wait_until(lambda: not served.server.get_clients() and not served.views)
    return served


def own_of(viewer):
    """The id and the view of the only page, once it is let in."""
    wait_until(lambda: viewer.views and set(viewer.views) == set(viewer.server.get_clients()))
    ((client, view),) = viewer.views.items()
    return client, view


# ── Who is let in ──


@pytest.mark.parametrize(("path", "host", "origin", "why"), [
    ("/{token}/", "127.0.0.1:8080", None, ""),
    ("/{token}", "localhost:9000", "http://localhost:9000", ""),  # through a tunnel
    ("/{token}/?a=b", "[::1]:8080", "http://[::1]:8080", ""),
    ("/{token}/", "localhost", EVIL, "another page asked"),
    ("/{token}/", "127.0.0.1:8080", "http://127.0.0.1:1", "another page asked"),
    ("/{token}/", "127.0.0.1:8080", "null", "another page asked"),
    ("/{token}/", "evil.example:8080", f"{EVIL}:8080", "not this machine"),
    ("/{token}/", "127.0.0.1@evil.example", None, "not this machine"),
    ("/{token}/", "127.0.0.1.evil.example", None, "not this machine"),
    ("/{token}/", None, None, "not this machine"),
    ("/", "localhost", None, "does not have the token"),
    ("/x{token}/", "localhost", None, "does not have the token"),
    ("/?token={token}", "localhost", None, "does not have the token"),
    ("/x/{token}/", "localhost", None, "does not have the token"),
])  # fmt: skip
def test_a_page_has_the_address_and_asks_for_itself(path, host, origin, why):
    token = new_token()
    pairs = [("Host", host), ("Origin", origin)]
    headers = Headers([pair for pair in pairs if pair[1] is not None])
    found = refusal(Request(path.format(token=token), headers), token)
    assert why in found
    assert bool(found) == bool(why)
    assert token not in found


def test_a_refusal_is_an_answer_and_each_reason_a_line(viewer, caplog):
    there = urlsplit(viewer.url)
    for _ in range(2):
        with pytest.raises(InvalidStatus) as refused, socket_of(viewer.url, origin=EVIL):
            pass
        assert refused.value.response.status_code == 403
        with pytest.raises(HTTPError) as error:
            urlopen(f"http://{there.netloc}/")
        with error.value as answer:
            assert answer.code == 403
            assert "Open the address that was printed" in answer.read().decode()
    assert [line.startswith("refused a request: ") for line in caplog.messages] == [True, True]
    assert there.path.strip("/") not in caplog.text
    assert not viewer.server.get_clients()


def test_the_page_has_its_own_title_and_keeps_its_address_to_itself(viewer):
    for url in (viewer.url, viewer.url.rstrip("/")):
        with urlopen(url) as answer:
            body = answer.read()
            assert int(answer.headers["Content-Length"]) == len(body)
            assert answer.headers["Referrer-Policy"] == "no-referrer"
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
    page = body.decode()
    assert page.count("<title>") == page.count('rel="icon"') == 1
    assert "<title>&lt;/title&gt;&lt;script&gt;" in page  # of the layout, as text
    assert "alert(1)</script>" not in page
    with pytest.raises(HTTPError) as missing:
        urlopen(f"{viewer.url}..%2f..%2f_viser.py")
    with missing.value as answer:
        assert answer.code == 404


def test_the_head_is_replaced_and_the_script_is_as_it_was():
    own = '<head><title>Viser</title><link rel="icon" href="x"/><script>"<title>a</title>"</script>'
    assert with_head(own, "<b>") == '<head><b><script>"<title>a</title>"</script>'


def test_only_this_machine_can_connect_and_the_next_free_port_serves():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = serve(port, new_token())
        with pytest.raises(OSError, match=r"refused|unreachable"):  # it has another address, too
            socket.create_connection(("127.0.0.2", server.get_port()), timeout=5)
        with quiet():
            server.stop()
    assert server.get_port() > port


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
    other = Mock()
    monkeypatch.setattr("inspe_jax.viewer.server.viser.ViserServer", other)
    with pytest.raises(RuntimeError, match="would be unprotected"):
        serve(0, new_token())
    other.return_value.stop.assert_called_once_with()


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


@contextmanager
def dragging(viewer):
    """A page that pulls its handle up by half a metre and has not let go: its socket, the id of
    its client, its view, and where the handle was."""
    with socket_of(viewer.url) as page:
        enter(page)
        owner, view = own_of(viewer)
        at = np.array(view.selection3d.gizmo.position)
        pull(page, owner, None, "Start")
        pull(page, owner, (at + [0, 0, 0.5]).tolist())
        wait_until(lambda: viewer.display.shown is not viewer.layout)
        yield page, owner, view, at


def test_a_browser_that_leaves_in_mid_drag_lets_go_there(viewer):
    before = viewer.layout
    with dragging(viewer) as (_, _, view, _):
        assert viewer.layout is before
    wait_until(lambda: viewer.layout is not before and not viewer.views)
    assert viewer.layout.poses[0, 2] - before.poses[0, 2] == pytest.approx(0.5, abs=1e-3)
    wait_until(lambda: viewer.display.shown is viewer.layout)
    wait_until(lambda: not view.sensor_view._recording._thread.is_alive())


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
    with dragging(viewer) as (page, owner, view, at):
        viewer.optimise()
        wait_until(lambda: viewer.display.shown is before)
        assert view.dragging is None
        pull(page, owner, (at + [0, 0, 2.0]).tolist())
        pull(page, owner, None, "End")
        wait_until(lambda: np.allclose(view.selection3d.gizmo.position, at))
        viewer.searcher._ended(SearchEnding(None, 0.0, 0.0, "stopped"))
        wait_until(lambda: not viewer.searching)
    assert viewer.layout is before


def test_what_another_browser_does_in_vain_leaves_a_drag_as_it_is(viewer):
    before = viewer.layout
    with dragging(viewer) as (page, owner, view, at):
        viewer.queue.submit(viewer.show_controls)
        view.select(1)
        done = threading.Event()
        viewer.queue.submit(done.set)
        done.wait()
        up = at + [0, 0, 0.5]
        np.testing.assert_allclose(view.selection3d.gizmo.position, up, atol=1e-5)
        assert view.selection == (0,)
        pull(page, owner, None, "End")
        wait_until(lambda: viewer.layout is not before)
    assert viewer.layout.poses[0, 2] - before.poses[0, 2] == pytest.approx(0.5, abs=1e-3)


def test_a_typed_number_is_read_before_the_controls_are_shown_anew(viewer, monkeypatch):
    """Even if that is asked for when the number has come, and nobody has read it yet."""
    asked, before = [], viewer.layout

    def meanwhile(*_):
        asked.append(threading.Thread(target=viewer.show_controls))
        asked[-1].start()
        asked[-1].join()

    with socket_of(viewer.url) as page:
        enter(page)
        pitch = own_of(viewer)[1].controls.pose["pitch"]
        # viser calls this once a value is there, before what is bound to its control.
        monkeypatch.setattr(pitch._impl, "sync_cb", meanwhile)
        set_value(page, pitch, -7.0)
        wait_until(lambda: viewer.layout is not before)
    assert asked
    assert np.degrees(viewer.layout.poses[0, 4]) == pytest.approx(-7.0)


def test_a_burst_of_requests_is_shown_once(viewer, layout, monkeypatch):
    """Sixty times Undo undo sixty changes."""
    layouts = [replace(layout, name=f"{k}") for k in range(70)]
    for one in layouts:
        viewer.session.take(one)
    shown, real = [], viewer.display.draw
    monkeypatch.setattr(viewer.display, "draw", lambda *told: (shown.append(told[0]), real(*told)))
    undo = dict(type="CommandTriggerMessage", uuid=viewer.panel.keys["Undo"]._impl.uuid)
    with socket_of(viewer.url) as page:
        enter(page)
        own_of(viewer)
        going = threading.Event()
        viewer.queue.submit(going.wait)
        for _ in range(60):
            send(page, **undo)
        wait_until(lambda: len(viewer.queue._waiting) >= 60)
        going.set()
        wait_until(lambda: viewer.layout is layouts[9])
        wait_until(lambda: shown and shown[-1] is layouts[9])
        assert len(shown) < 5
