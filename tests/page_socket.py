"""A browser's side of the socket, without a browser: what a script can send."""

import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import msgpack
import viser
from websockets.sync.client import connect


def wait_until(true, seconds=120):
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it does not come to that"
        time.sleep(0.01)


@contextmanager
def socket_of(url, *, origin=None):
    """A connection to the server of a page at ``url``, as from a page of ``origin``."""
    there = urlsplit(url)
    with connect(
        f"ws://{there.netloc}{there.path.rstrip('/')}",
        origin=origin or f"http://{there.netloc}",
        subprotocols=[f"viser-v{viser.__version__}"],
        compression=None,
        max_size=None,
        proxy=None,
        close_timeout=0.1,  # nobody reads what the server says, so its answer may never get through
    ) as found:
        yield found


def send(socket, **message):
    """Send a message of viser's."""
    socket.send(msgpack.packb(message))


def enter(socket):
    """Be a client: viser counts one after its camera's first message."""
    send(
        socket, type="ViewerCameraMessage", wxyz=[1.0, 0.0, 0.0, 0.0], position=[0.0, -20.0, 20.0],
        look_at=[0.0, 0.0, 0.0], up_direction=[0.0, 0.0, 1.0], fov=0.8, near=0.01, far=1000.0,
        image_height=900, image_width=1440,
    )  # fmt: skip


def set_value(socket, control, value):
    """What a browser sends when somebody sets a control."""
    send(socket, type="GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})


def pull(socket, owner, position, phase="Update"):
    """What a browser sends when somebody moves the handle of the client ``owner``."""
    where = dict(position=position, wxyz=[1.0, 0.0, 0.0, 0.0]) if phase == "Update" else {}
    kind = "" if phase == "Update" else "Drag"
    kind = f"TransformControls{kind}{phase}Message"
    send(socket, type=kind, name="/handle", owner=str(owner), **where)
