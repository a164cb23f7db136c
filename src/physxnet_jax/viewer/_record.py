"""The viewer's scene as a self-contained HTML page that plays by itself."""

import contextlib
import io
import pathlib
from collections.abc import Callable

from ..errors import FormatError
from ..files import atomic_write
from ._guard import Guard
from ._job import Choice, Shown, run_job
from ._server import start_server
from ._stage import Stage

# viser's page unpacks its scripts itself; whatever they do, nothing leaves the page.
_POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="'
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:;"
    " style-src 'unsafe-inline' blob: data:; img-src blob: data:; font-src blob: data:;"
    " media-src blob: data:; connect-src blob: data:; worker-src blob: data:;"
    " base-uri 'none'; form-action 'none'\">"
)


def record(
    path: str | pathlib.Path,
    choice: Choice,
    progress: Callable[[str, int, int], None] | None = None,
) -> Shown:
    """Writes a self-contained HTML page that plays the clip by itself.

    Args:
        path: An ``.html`` file, written atomically.
        choice: Settings of the viewer.
        progress: Called with a stage, the frames done and the total.

    Raises:
        FormatError: The path doesn't end in ``.html``.
        PhysXNetError: An input can't be read, bound or worn.
        MissingDependencyError: Without the ``viewer`` extra.
    """
    if pathlib.Path(path).suffix.lower() != ".html":
        raise FormatError(f"{path}: the page must be an .html file.")
    shown = run_job(choice, progress)
    server = start_server("127.0.0.1", 8090, Guard("127.0.0.1", lambda _: None))
    try:
        stage = Stage(server.scene, shown)
        serializer = server.get_scene_serializer()
        for frame in range(shown.num_frames):
            stage.show(frame)
            serializer.insert_sleep(1.0 / shown.clip.fps)
        text = serializer.as_html().replace("<head>", f"<head>{_POLICY}", 1)
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
    return shown
