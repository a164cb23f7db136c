"""Who may connect to the page, and what they may send."""

import hmac
import http
import http.cookies
import ipaddress
import logging
import math
import secrets
import socket
import urllib.parse
from collections.abc import Callable
from typing import Any

MOST_UPLOADED = 200_000_000
"""Largest upload, and the most that may be under way at once [bytes]."""

# The page sends parts of 512 KiB.
_LARGEST_MESSAGE = 4 * 1024 * 1024
_MOST_PARTS = 4096
_LOG = logging.getLogger("physxnet_jax.viewer")


def is_loopback(host: str) -> bool:
    """Whether an address belongs to this machine alone."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class Guard:
    """Checks connections and messages before viser sees them.

    A page of another origin in the same browser can reach every port of this machine, so an
    address alone proves nothing: a request needs this server's own ``Host``, a connection its
    own ``Origin`` too, and both the token of the printed address, which the first request
    leaves in a cookie. Each message must be one that the page's controls can send, with a value
    that they offer.

    Args:
        host: Address that the server listens on.
        report: Called with a sentence for the person when an upload is refused.
    """

    def __init__(self, host: str, report: Callable[[str], None]) -> None:
        self.token = secrets.token_urlsafe(16)
        self.gui: Any = None
        self.port = 0
        self._host = host.strip("[]")
        self._report = report
        # Bytes under way: by connection and transfer, those that may still come.
        self._uploads: dict[tuple[int, str], list[int]] = {}

    def wrap(self, serve: Callable[..., Any]) -> Callable[..., Any]:
        """`websockets.asyncio.server.serve` with checks before its handlers."""

        def guarded(handler: Any, host: str, port: int, **options: Any) -> Any:
            answer = options.pop("process_request")

            def process_request(connection: Any, request: Any) -> Any:
                self.port = connection.local_address[1]
                refusal = self.refusal(request)
                if refusal is not None:
                    _LOG.warning("refused a connection: %s", refusal)
                    return connection.respond(http.HTTPStatus.FORBIDDEN, refusal + "\n")
                response = answer(connection, request)
                if response is not None:
                    self._add_headers(response, request)
                return response

            async def handle(connection: Any) -> None:
                self._filter(connection)
                try:
                    await handler(connection)
                finally:
                    for key in [k for k in self._uploads if k[0] == id(connection)]:
                        self._uploads.pop(key, None)

            options |= {"process_request": process_request, "max_size": _LARGEST_MESSAGE}
            return serve(handle, host, port, **options)

        return guarded

    def refusal(self, request: Any) -> str | None:
        """Why a request is refused; None if it may pass.

        Args:
            request: With ``path`` and ``headers``.
        """
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return "the address isn't this viewer's"
        own = f"http://{hosts[0]}".lower()
        if "Upgrade" in headers and not origins:
            return "no origin is given"
        if any(origin.lower() != own for origin in origins):
            return "the page is of another origin"
        if not self._has_token(request):
            return "the token is missing: open the address that `physxnet view` printed"
        return None

    def allows(self, raw: bytes | str, connection: int = 0) -> str | None:
        """Why a message is dropped; None if it may pass.

        Args:
            raw: The message.
            connection: Identity of its connection.
        """
        from viser._messages import (
            FileTransferPart,
            FileTransferPartAck,
            FileTransferStartUpload,
            GuiUpdateMessage,
            Message,
            ViewerCameraMessage,
        )

        if not isinstance(raw, bytes) or self.gui is None:
            return "text"
        try:
            message = Message.deserialize(raw)
        except Exception as error:
            return f"unreadable ({type(error).__name__})"
        kind = type(message).__name__
        try:
            match message:
                case GuiUpdateMessage():
                    fine = self._is_offered(message)
                case ViewerCameraMessage():
                    fine = _is_camera(message)
                case FileTransferStartUpload():
                    fine = self._may_start(message, connection)
                case FileTransferPart():
                    fine = self._may_continue(message, connection)
                case FileTransferPartAck():
                    fine = isinstance(message.transfer_uuid, str)
                case _:
                    fine = False
        except (TypeError, ValueError, AttributeError, OverflowError):
            # Fields of other types than declared.
            fine = False
        return None if fine else kind

    def _is_own(self, host: str) -> bool:
        """Whether ``Host`` names this server: a name that others resolve does not."""
        try:
            url = urllib.parse.urlsplit(f"//{host}")
            name, port = url.hostname or "", url.port or 80
        except ValueError:
            return False
        if port != self.port or "@" in host or url.path:
            return False
        if is_loopback(name):
            return True
        names = {socket.gethostname().lower(), socket.getfqdn().lower()}
        if is_loopback(self._host):
            return False
        return name == self._host.lower() or name in names or _is_number(name)

    def _has_token(self, request: Any) -> bool:
        query = urllib.parse.urlsplit(request.path).query
        found = urllib.parse.parse_qs(query).get("token", [])
        for header in request.headers.get_all("Cookie"):
            try:
                cookies = http.cookies.SimpleCookie(header)
            except http.cookies.CookieError:
                continue
            if self._cookie in cookies:
                found.append(cookies[self._cookie].value)
        return any(hmac.compare_digest(x.encode(), self.token.encode()) for x in found)

    @property
    def _cookie(self) -> str:
        # Cookies are shared by all ports of a machine.
        return f"physxnet-{self.port}"

    def _add_headers(self, response: Any, request: Any) -> None:
        if "token=" in request.path:
            response.headers["Set-Cookie"] = (
                f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            )
        response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["X-Content-Type-Options"] = "nosniff"

    def _filter(self, connection: Any) -> None:
        receive = connection.recv

        async def recv(*args: Any, **options: Any) -> Any:
            while True:
                raw = await receive(*args, **options)
                reason = self.allows(raw, id(connection))
                if reason is None:
                    return raw
                _LOG.warning("dropped a message: %s", reason)

        connection.recv = recv

    def _is_offered(self, message: Any) -> bool:
        """Whether a control's new value is one that it offers."""
        handle = self.gui._gui_input_handle_from_uuid.get(message.uuid)
        if handle is None or set(message.updates) != {"value"}:
            return False
        if getattr(handle, "disabled", False) or not getattr(handle, "visible", True):
            return False
        value = message.updates["value"]
        if hasattr(handle, "options"):
            return isinstance(value, str) and value in handle.options
        if hasattr(handle, "min"):
            number = isinstance(value, int | float) and not isinstance(value, bool)
            return number and math.isfinite(value) and handle.min <= value <= handle.max
        return isinstance(value, bool) and isinstance(handle.value, bool)

    def _may_start(self, message: Any, connection: int) -> bool:
        from viser import GuiUploadButtonHandle

        button = self.gui._gui_input_handle_from_uuid.get(message.source_component_uuid)
        if not isinstance(button, GuiUploadButtonHandle):
            return False
        key, size = (connection, message.transfer_uuid), message.size_bytes
        under_way = sum(left for left, _ in self._uploads.values())
        if size < 0 or size + under_way > MOST_UPLOADED:
            megabytes = MOST_UPLOADED // 1_000_000
            self._report(f"{message.filename}: an upload may have {megabytes} MB at most.")
            return False
        if key in self._uploads or not 0 <= message.part_count <= _MOST_PARTS:
            return False
        if message.part_count:
            self._uploads[key] = [size, message.part_count]
        return True

    def _may_continue(self, message: Any, connection: int) -> bool:
        left = self._uploads.get((connection, message.transfer_uuid))
        if left is None or not isinstance(message.content, bytes):
            return False
        if len(message.content) > left[0]:
            return False
        left[0] -= len(message.content)
        left[1] -= 1
        if left[1] == 0:
            del self._uploads[connection, message.transfer_uuid]
        return True


def _is_camera(message: Any) -> bool:
    vectors = ((message.wxyz, 4), (message.position, 3), (message.look_at, 3))
    numbers = (message.fov, message.near, message.far, message.image_height, message.image_width)
    right = all(len(v) == n for v, n in (*vectors, (message.up_direction, 3)))
    flat = (*numbers, *(x for v, _ in vectors for x in v), *message.up_direction)
    return right and all(math.isfinite(x) for x in flat)


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
