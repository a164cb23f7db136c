"""`physxnet view`: the viewer, or a page of it to send."""

import os
import threading
import webbrowser

from rich.console import Console

from ..errors import PhysXNetError
from ..files import check_writable
from ..viewer import Choice, Viewer, record
from ._commands import View
from ._progress import progress_bars
from ._shape import parse_shape


def view(command: View, console: Console, *, over: threading.Event | None = None) -> int:
    """Serves the page until Ctrl-C, or writes it.

    Args:
        command: What was asked for.
        console: Where to say it.
        over: Ends the viewer when set.
    """
    if command.live and (command.html is not None or command.method != "network"):
        raise PhysXNetError(
            "--live asks the network while the page is open: no --html, no other --method."
        )
    if command.compare and command.method == "simulate":
        raise PhysXNetError("--compare sets the simulation beside another --method; leave it out.")
    if command.html is not None:
        check_writable(command.html)
    choice = Choice(
        motion=command.motion,
        wear=command.wear,
        method=command.method,
        weights=command.weights,
        compare=command.compare,
        live=command.live,
        push_out=command.push_out,
        shape=tuple(parse_shape(command.shape).items()),
        accuracy=command.accuracy,
        fabric=command.fabric,
        wind=command.wind,
        self_contact=command.self_contact,
        frames=command.frames,
        fps=command.fps,
        source_fps=command.source_fps,
        skeleton=command.skeleton,
        joint_map=command.joint_map,
    )
    if command.html is not None:
        with progress_bars(console) as progress:
            shown = record(command.html, choice, progress)
        size = command.html.stat().st_size / 1e6
        console.print(shown.told.replace("* ", ""), highlight=False)
        console.print(f"wrote {command.html} ({size:.1f} MB)", highlight=False)
        return 0
    viewer = Viewer(choice, host=command.host, port=command.port)
    try:
        console.print(f"viewer at {viewer.url}; Ctrl-C ends it", highlight=False)
        port = viewer.server.get_port()
        if os.environ.get("SSH_CONNECTION"):
            console.print(f"from afar: ssh -L {port}:localhost:{port} this-machine")
        elif command.browser:
            webbrowser.open(viewer.url)
        (threading.Event() if over is None else over).wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
    return 0
