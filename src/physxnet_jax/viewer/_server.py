"""The page's server, with a camera."""

import contextlib
import io
import logging
import threading
from typing import Any

from ..errors import MissingDependencyError
from ._guard import Guard

_STARTING = threading.Lock()


def start_server(host: str, port: int, guard: Guard) -> Any:
    """Starts a viser server without console output.

    Args:
        host: Address to listen on.
        port: Port to listen on; the next free one is used.
        guard: Checks connections and messages.

    Raises:
        MissingDependencyError: Without the ``viewer`` extra.
    """
    try:
        import viser
        import websockets.asyncio.server as transport
    except ImportError as error:
        raise MissingDependencyError(
            "The viewer needs viser: pip install 'physxnet-jax[viewer]'."
        ) from error
    # A browser that disconnects while connecting isn't worth a report.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with _STARTING:
        # viser has no hook for requests: it looks this function up when it starts.
        serve = transport.serve
        transport.serve = guard.wrap(serve)
        try:
            # viser prints a banner despite verbose=False.
            with contextlib.redirect_stdout(io.StringIO()):
                server = viser.ViserServer(host=host, port=port, verbose=False)
        finally:
            transport.serve = serve
    guard.port, guard.gui = server.get_port(), server.gui
    server.scene.set_up_direction("+y")
    # A person of 1.7 m fills four fifths of the height, left of the controls.
    server.initial_camera.position = (1.6, 1.25, 2.85)
    server.initial_camera.look_at = (0.33, 0.84, -0.12)
    server.initial_camera.fov = 0.62
    return server
