"""The viewer's scene as one page that plays by itself."""

import contextlib
import io
import pathlib
from collections.abc import Callable

from ..errors import FormatError
from ..files import whole_file
from ._job import Choice, Shown, carry_out
from ._server import start_server
from ._stage import Stage


def record(
    path: str | pathlib.Path,
    choice: Choice,
    progress: Callable[[str, int, int], None] | None = None,
) -> Shown:
    """Writes what is chosen as one page that plays by itself.

    Args:
        path: ``.html``; written whole or not at all.
        choice: What is shown.
        progress: Called with a stage, frames done and frames in all.

    Raises:
        FormatError: The path doesn't end in ``.html``.
        PhysXNetError: Anything that can't be read, bound or worn.
        MissingDependencyError: Without the ``viewer`` extra.
    """
    if pathlib.Path(path).suffix.lower() != ".html":
        raise FormatError(f"{path}: the page is written as .html.")
    shown = carry_out(choice, progress)
    server = start_server("127.0.0.1", 8090)
    try:
        stage = Stage(server.scene, shown)
        tape = server.get_scene_serializer()
        for frame in range(shown.num_frames):
            stage.show(frame)
            tape.insert_sleep(1.0 / shown.clip.fps)
        text = tape.as_html()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return shown
