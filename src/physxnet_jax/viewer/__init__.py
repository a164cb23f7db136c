"""Looking at results: pictures and videos."""

from ._diagram import draw_bars as draw_bars, draw_work_precision as draw_work_precision
from ._render import (
    PREVIEWS as PREVIEWS,
    check_preview as check_preview,
    render_columns as render_columns,
    render_frame as render_frame,
    render_preview as render_preview,
)
