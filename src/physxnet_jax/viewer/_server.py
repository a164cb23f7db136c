"""The page's server, with a floor and a camera."""

import contextlib
import io
import logging
from typing import Any

from ..errors import MissingDependencyError


def start_server(host: str, port: int) -> Any:
    """Starts a viser server without console output.

    Raises:
        MissingDependencyError: Without the ``viewer`` extra.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingDependencyError(
            "The viewer needs viser: pip install 'physxnet-jax[viewer]'."
        ) from error
    # A browser that disconnects while connecting isn't worth a report.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    # viser prints a banner despite verbose=False.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.scene.set_up_direction("+y")
    server.scene.add_grid("/floor", width=12.0, height=12.0, plane="xz", cell_size=0.5)
    server.initial_camera.position = (1.1, 1.3, 2.7)
    server.initial_camera.look_at = (0.1, 0.85, 0.0)
    return server
