"""`physxnet view`: the viewer, or a self-contained HTML page."""

import os
import threading
import webbrowser

from rich.console import Console

from ..errors import PhysXNetError
from ..files import check_writable
from ..viewer import Choice, Viewer, is_loopback, record
from ._commands import View
from ._options import check_simulates, with_animation
from ._progress import progress_bars
from ._shape import parse_shape


def view(command: View, console: Console, *, over: threading.Event | None = None) -> int:
    """Serves the viewer until Ctrl-C, or writes an HTML page.

    Args:
        command: The options.
        console: Where to print.
        over: Event that closes the viewer.
    """
    if command.live and (command.html is not None or command.method not in ("network", "guided")):
        raise PhysXNetError(
            "--live computes frames while the page is open: leave out --html, and --method other"
            " than network or guided."
        )
    if command.compare and command.method == "simulate":
        raise PhysXNetError("--compare is for a --method other than simulate; leave it out.")
    if command.character is not None and (command.shape or command.live):
        raise PhysXNetError(
            "--character has its own shape, and is dressed as a whole: leave out --shape"
            " and --live."
        )
    if command.html is not None:
        check_writable(command.html)
        if not command.compare:
            check_simulates(
                command.method,
                command.simulation,
                command.outfit,
                command.inference.weights,
            )
    source = command.source
    choice = Choice(
        motion=with_animation(command.motion, source),
        wear=command.outfit.wear,
        method=command.method,
        inference=command.inference.build(),
        compare=command.compare,
        live=command.live,
        shape=tuple(parse_shape(command.shape).items()),
        simulation=command.simulation.build(),
        fabric=command.outfit.fabric,
        character=command.character,
        frames=Choice().frames if source.frames is None else source.frames,
        fps=source.fps,
        start=source.start,
        up=source.up,
        source_fps=source.source_fps,
        skeleton=source.skeleton,
        joint_map=source.joint_map,
    )
    if command.html is not None:
        with progress_bars(console) as progress:
            shown = record(command.html, choice, progress)
        size = command.html.stat().st_size / 1e6
        console.print(shown.summary.replace("* ", ""), highlight=False)
        console.print(f"wrote {command.html} ({size:.1f} MB)", highlight=False)
        return 0
    viewer = Viewer(choice, host=command.host, port=command.port)
    try:
        if not is_loopback(command.host):
            console.print(
                f"other machines can reach this page at {command.host}: whoever has its address,"
                " token included, can upload files and see yours",
                style="yellow",
            )
        console.print(f"viewer at {viewer.url}; Ctrl-C stops it", highlight=False, soft_wrap=True)
        port = viewer.server.get_port()
        if os.environ.get("SSH_CONNECTION"):
            console.print(f"remote access: ssh -L {port}:localhost:{port} this-machine")
        elif command.browser:
            webbrowser.open(viewer.url)
        (threading.Event() if over is None else over).wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
    return 0
