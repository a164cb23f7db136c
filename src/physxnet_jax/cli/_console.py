"""A console that shows control characters instead of obeying them."""

from typing import Any

from rich.console import Console
from rich.text import Text

from ..errors import visible


class PlainConsole(Console):
    """Prints text from files, such as the name of a joint, without what could reset a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """As `Console.render_str`, of the visible text."""
        return super().render_str(visible(text), **options)

    def on_broken_pipe(self) -> None:
        """The caller decides what a closed pipe means, and the exit code."""
        raise
