"""A browser's side of the socket, without a browser: what a script can send."""

from contextlib import contextmanager
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

CAMERA = dict(
    type="ViewerCameraMessage",
    wxyz=[1.0, 0.0, 0.0, 0.0],
    position=[0.0, -20.0, 20.0],
    fov=0.8,
    near=0.01,
    far=1000.0,
    image_height=900,
    image_width=1440,
    look_at=[0.0, 0.0, 0.0],
    up_direction=[0.0, 0.0, 1.0],
)


@contextmanager
def socket_of(url, *, origin=None, host=None, version=viser.__version__):
    """A connection to the server of a page at ``url``, as from a page of ``origin``.

    ``host`` is what the request calls the server. An empty ``origin`` is left out.
    """
    there = urlsplit(url)
    headers = {"Host": host} if host is not None else {}
    with connect(
        f"ws://{there.netloc}{there.path.rstrip('/')}",
        origin=(f"http://{there.netloc}" if origin is None else origin) or None,
        subprotocols=[f"viser-v{version}"],
        additional_headers=headers,
        compression=None,
        max_size=None,
        proxy=None,
        close_timeout=0.1,  # nobody reads what the server says, so its answer may never get through
        create_connection=_named(host),
    ) as found:
        yield found


def send(socket, **message):
    """Send a message of viser's."""
    socket.send(msgspec.msgpack.encode(message))


def enter(socket):
    """Be a client: viser counts one after its camera's first message."""
    send(socket, **CAMERA)


def set_value(socket, control, value):
    """What a browser sends when somebody sets a control."""
    send(socket, type="GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})


def pull(socket, owner, position, phase="Update", wxyz=(1.0, 0.0, 0.0, 0.0)):
    """What a browser sends when somebody moves the handle of the client ``owner``."""
    where = dict(position=position, wxyz=list(wxyz)) if phase == "Update" else {}
    kind = "" if phase == "Update" else "Drag"
    kind = f"TransformControls{kind}{phase}Message"
    send(socket, type=kind, name="/handle", owner=str(owner), **where)


def ended_by(socket):
    """The code with which the server ends a connection, after whatever it says before."""
    try:
        while True:
            socket.recv(timeout=30)
    except ConnectionClosed as end:
        return end.rcvd.code


def _named(host):
    """A client's connection that calls the server by another name."""

    class Named(ClientConnection):
        def handshake(self, additional_headers=None, *args, **options):
            if host is not None:
                make = self.protocol.connect

                def renamed():
                    request = make()
                    del request.headers["Host"]
                    request.headers["Host"] = host
                    return request

                self.protocol.connect = renamed
                additional_headers = None
            return super().handshake(additional_headers, *args, **options)

    return Named
