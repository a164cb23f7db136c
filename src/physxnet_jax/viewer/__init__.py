"""Visualisation of results: pictures, videos, and a page in the browser."""

from ._diagram import draw_work_precision as draw_work_precision
from ._error_report import write_error_report as write_error_report
from ._guard import is_loopback as is_loopback
from ._job import Choice as Choice, run_job as run_job
from ._maps import magnified as magnified, texel_picture as texel_picture
from ._record import record as record
from ._render import (
    check_preview as check_preview,
    load_renderer as load_renderer,
    render_columns as render_columns,
    render_frame as render_frame,
    render_preview as render_preview,
)
from ._web import Viewer as Viewer
