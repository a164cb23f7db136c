"""Looking at results: pictures, videos, and a page in the browser."""

from ._diagram import draw_bars as draw_bars, draw_work_precision as draw_work_precision
from ._job import Choice as Choice, Shown as Shown, carry_out as carry_out
from ._maps import frame_maps as frame_maps, magnified as magnified, texel_picture as texel_picture
from ._record import record as record
from ._render import (
    PREVIEWS as PREVIEWS,
    check_preview as check_preview,
    render_columns as render_columns,
    render_frame as render_frame,
    render_preview as render_preview,
)
from ._web import Viewer as Viewer
