"""The page obeys the person in front of it and nobody else."""

import contextlib
import http.server
import logging
import os
import pathlib
import runpy
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import types
import urllib.error
import urllib.request

import pytest

from physxnet_jax.errors import FormatError, PhysXNetError

pytest.importorskip("viser")

import msgspec
import viser
import viser._messages as messages
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from physxnet_jax.viewer import Choice, Viewer
from physxnet_jax.viewer._guard import MOST_UPLOADED, Guard

_BROWSER = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "browser.py"))
SHORT = Choice("walk", ("bottom",), method="lbs", frames=4, fps=10.0)


@pytest.fixture(scope="module")
def viewer():
    it = Viewer(SHORT, port=8400)
    it.wait()
    it.controls.playing.value = False
    yield it
    it.close()


@pytest.fixture
def own(viewer):
    port = viewer.server.get_port()
    return types.SimpleNamespace(
        port=port,
        origin=f"http://127.0.0.1:{port}",
        cookie=f"physxnet-{port}={viewer._guard.token}",
    )


@contextlib.contextmanager
def client(own, **changes):
    """A connection as the page makes it, with changed headers."""
    given = {"origin": own.origin, "cookie": own.cookie, "host": None} | changes
    headers = {"Cookie": given["cookie"]} if given["cookie"] else {}
    socket_to = socket.create_connection(("127.0.0.1", own.port))
    with connect(
        f"ws://{given['host'] or f'127.0.0.1:{own.port}'}/",
        sock=socket_to,
        origin=given["origin"],
        additional_headers=headers,
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        compression=None,
    ) as it:
        yield it


def encoded(message):
    return msgspec.msgpack.encode(message.as_serializable_dict())


def set_value(handle, value, **more):
    return encoded(messages.GuiUpdateMessage(handle._impl.uuid, {"value": value} | more))


def request(own, path="/", **changes):
    """Status and headers of the answer to a request."""
    headers = {k.capitalize(): v for k, v in changes.items() if v is not None}
    asked = urllib.request.Request(f"http://127.0.0.1:{own.port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(asked, timeout=20) as answer:
            return answer.status, answer.headers
    except urllib.error.HTTPError as error:
        return error.code, error.headers


def test_the_token_of_the_address_opens_the_page_and_stays_in_a_cookie(viewer, own):
    token = viewer.url.partition("token=")[2]
    assert request(own)[0] == 403
    assert request(own, "/?token=wrong")[0] == 403
    status, headers = request(own, f"/?token={token}")
    assert status == 200 and "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    status, headers = request(own, cookie=cookie.partition(";")[0])
    assert status == 200 and "Set-Cookie" not in headers
    other = Guard("127.0.0.1", print)
    assert other.token != token, "each viewer has its own"


@pytest.mark.parametrize(
    "changes",
    [
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:1"},
        {"origin": "null"},
        {"origin": None},
        {"host": "evil.example:8400"},
        {"host": "127.0.0.1.evil.example:8400"},
        {"host": "127.0.0.1:1"},
        {"cookie": None},
        {"cookie": "physxnet-8400=wrong"},
        {"cookie": "physxnet-8400="},
    ],
    ids=str,
)
def test_connections_of_others_are_refused(viewer, own, changes):
    with pytest.raises(InvalidStatus, match="403"), client(own, **changes):
        pass
    # As the page makes it, it is accepted.
    with client(own) as it:
        assert it.recv(timeout=20)


@pytest.mark.parametrize(
    ("host", "name", "own"),
    [
        ("127.0.0.1", "localhost:80", True),
        ("127.0.0.1", "[::1]:80", True),
        ("127.0.0.1", "192.168.1.7:80", False),
        ("0.0.0.0", "192.168.1.7:80", True),
        ("0.0.0.0", f"{socket.gethostname()}:80", True),
        ("0.0.0.0", "evil.example:80", False),
        ("farm.example", "farm.example:80", True),
        ("0.0.0.0", "me@127.0.0.1:80", False),
        ("0.0.0.0", "127.0.0.1:x", False),
        ("0.0.0.0", "", False),
    ],
)
def test_a_host_is_the_servers_own_or_a_number(host, name, own):
    """A number can't be made to point here by somebody else's name server."""
    guard = Guard(host, print)
    guard.port = 80
    headers = Headers(Host=name, Cookie=f"physxnet-80={guard.token}")
    asked = types.SimpleNamespace(path="/", headers=headers)
    assert (guard.refusal(asked) is None) == own
    headers["Host"] = name
    assert guard.refusal(asked) is not None, "two hosts are none"


def test_every_control_refuses_what_it_does_not_offer(viewer):
    guard = viewer._guard
    controls = viewer.controls
    wrong = ["", "/../../x.html", "/etc/passwd", 0, -1e9, 1e9, float("nan"), float("inf")]
    wrong += [None, True, False, [], ["walk"], {}, b"walk", "a" * 10_000, "walk\x00"]
    for handle in viewer.server.gui._gui_input_handle_from_uuid.values():
        offered = getattr(handle, "options", None)
        low, high = getattr(handle, "min", None), getattr(handle, "max", None)
        for value in wrong:
            number = isinstance(value, int | float) and not isinstance(value, bool)
            fine = (
                value in offered
                if offered is not None
                else number and low <= value <= high
                if low is not None
                else isinstance(value, bool) and handle is not controls.upload
            )
            assert (guard.allows(set_value(handle, value)) is None) == fine, (handle, value)
        # Only a value: nothing else of a control can be changed from outside.
        if offered:
            assert guard.allows(set_value(handle, offered[0])) is None
            assert guard.allows(set_value(handle, offered[0], options=("x",))) is not None
    frame = controls.frame
    frame.disabled = True
    assert guard.allows(set_value(frame, 1)) is not None
    frame.disabled = False
    assert guard.allows(set_value(frame, 1)) is None


def test_messages_that_no_control_sends_are_dropped(viewer):
    """Removal of controls and a public tunnel among them."""
    sent = {"GuiUpdateMessage", "ViewerCameraMessage", "FileTransferStartUpload"}
    sent |= {"FileTransferPart", "FileTransferPartAck"}
    kinds = messages.Message._subclass_from_type_string()
    assert {"ShareUrlRequest", "GuiRemoveMessage", "RunJavascriptMessage"} <= kinds.keys() - sent
    for name in kinds.keys() - sent:
        text = msgspec.msgpack.encode({"type": name, "uuid": "x", "name": "x"})
        assert viewer._guard.allows(text) is not None, name
    for raw in (b"", b"\xc1", b"\x80", msgspec.msgpack.encode({"type": "x"}), "text", b"\x91\x01"):
        assert viewer._guard.allows(raw) is not None
    camera = messages.ViewerCameraMessage(
        (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, 1.0, 0.1, 10.0, 9, 9, (0.0,) * 3, (0.0, 1.0, 0.0)
    )
    assert viewer._guard.allows(encoded(camera)) is None
    camera.position = (float("nan"), 0.0, 0.0)
    assert viewer._guard.allows(encoded(camera)) == "ViewerCameraMessage"


def test_malformed_messages_cost_a_line_each_and_nothing_else(viewer, own, caplog):
    menu = viewer.controls.settings["motion"]
    with client(own) as it, caplog.at_level(logging.WARNING):
        for k in range(50):
            it.send(bytes([k]) * k)
        it.send(set_value(menu, "/etc/passwd"))
        it.send(set_value(viewer.controls.format, "/../../x.html"))
        it.send(set_value(viewer.controls.frame, 2))
        end = time.monotonic() + 20
        while viewer.controls.frame.value != 2 and time.monotonic() < end:
            time.sleep(0.05)
    assert viewer.controls.frame.value == 2
    assert menu.value == "walk" and viewer.controls.format.value == ".usdc"
    lines = [r.getMessage() for r in caplog.records if "dropped" in r.getMessage()]
    assert len(lines) == 52 and not any("\n" in line for line in lines)
    with pytest.raises(FormatError, match="No format"):
        viewer.export("/../../x.html")
    viewer.controls.settings["fabric"]._impl.value = "tin"
    with pytest.raises(PhysXNetError, match="isn't in the menu"):
        viewer.chosen()
    viewer.controls.settings["fabric"]._impl.value = "as cut"


def start_upload(viewer, size, parts, key="a", name="a.obj"):
    uuid = viewer.controls.upload._impl.uuid
    return encoded(messages.FileTransferStartUpload(uuid, key, name, "", parts, size))


def part(viewer, index, content, key="a"):
    return encoded(
        messages.FileTransferPart(viewer.controls.upload._impl.uuid, key, index, content)
    )


def test_uploads_end_where_they_said_they_would(viewer):
    said = []
    guard = Guard("127.0.0.1", said.append)
    guard.gui = viewer.server.gui
    assert guard.allows(part(viewer, 0, b"x")) is not None, "never begun"
    assert guard.allows(start_upload(viewer, MOST_UPLOADED + 1, 4)) is not None
    assert "200 MB" in said[0]
    assert guard.allows(start_upload(viewer, -1, 1)) is not None
    assert guard.allows(start_upload(viewer, 10, 10**9)) is not None
    assert guard.allows(start_upload(viewer, 10, 2)) is None
    assert guard.allows(start_upload(viewer, 10, 2)) is not None, "begun already"
    assert guard.allows(part(viewer, 0, b"12345678")) is None
    assert guard.allows(part(viewer, 1, b"12345678")) is not None, "more than said"
    assert guard.allows(part(viewer, 1, b"12")) is None
    assert guard.allows(part(viewer, 2, b"")) is not None, "it is over"
    # Several at once have no more than one.
    for key in "bc":
        assert guard.allows(start_upload(viewer, MOST_UPLOADED // 2, 9, key)) is None
    assert guard.allows(start_upload(viewer, 1, 1, "d")) is not None


def test_uploads_touch_no_other_file(viewer, tmp_path):
    controls = viewer.controls
    text = b"no garment"
    before = dict(controls.files)
    for name in ("../../evil.obj", "evil.obj", "C:\\x\\evil.obj", "e\x1b[2Jvil.obj"):
        controls.add_file(name, text)
    added = {k: v for k, v in controls.files.items() if k not in before}
    assert set(added) == {"evil.obj", "evil.obj (2)", "evil.obj (3)", "e__2Jvil.obj"}
    folder = pathlib.Path(viewer._folder.name).resolve()
    assert len(set(added.values())) == 4
    assert all(folder in p.resolve().parents and p.read_bytes() == text for p in added.values())
    for name in ("", ".", "..", ".obj", "walk", "a.exe"):
        with pytest.raises(FormatError):
            controls.add_file(name, text)
    for name in added:
        controls.worn[name].value = False
    viewer.wait()


@pytest.mark.release
def test_dropped_connections_and_endless_uploads_leave_the_page_alive(viewer, own):
    for k in range(200):
        with contextlib.suppress(OSError):
            raw = socket.create_connection(("127.0.0.1", own.port))
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            words = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{own.port}\r\nOrigin: {own.origin}\r\n"
            words += f"Cookie: {own.cookie}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            words += "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
            words += f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n"
            # Cut at all stages, within the handshake too; with a reset instead of an end.
            raw.sendall(words.encode()[: None if k % 2 else 7 * k])
            if k % 4 == 1:
                raw.recv(64)
            raw.close()
    with client(own) as it:
        it.send(start_upload(viewer, 1 << 20, 4))
        for k in range(200):
            it.send(part(viewer, k, bytes(1 << 20)))
        it.send(set_value(viewer.controls.frame, 1))
        end = time.monotonic() + 30
        while viewer.controls.frame.value != 1 and time.monotonic() < end:
            time.sleep(0.05)
    assert viewer.controls.frame.value == 1
    end = time.monotonic() + 20
    while (viewer.server.get_clients() or viewer._guard._uploads) and time.monotonic() < end:
        time.sleep(0.1)
    assert not viewer.server.get_clients() and not viewer._guard._uploads


@pytest.mark.release
@pytest.mark.skipif(not hasattr(signal, "SIGTERM"), reason="no SIGTERM")
def test_nothing_is_left_after_sigterm(tmp_path):
    words = [
        sys.executable,
        "-c",
        "import sys; from physxnet_jax.cli import main; sys.exit(main())",
    ]
    words += ["view", "walk", "--wear", "bottom"]
    words += ["--method", "lbs", "--frames", "2", "--port", "8450", "--no-browser"]
    environment = os.environ | {"TMPDIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        line = process.stdout.readline()
        assert "?token=" in line
        assert [p for p in tmp_path.iterdir() if p.name.startswith("physxnet-view-")]
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.stdout.close()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith("physxnet-view-")]


@pytest.mark.browser
@pytest.mark.release
@pytest.mark.skipif(_BROWSER["BROWSER"] is None, reason="no Chromium installed")
def test_a_page_of_another_origin_cannot_reach_the_viewer(viewer, own, tmp_path):
    """In a browser that has the viewer's cookie."""
    (tmp_path / "evil.html").write_text(
        f"""<script>
        let said = {{}};
        let ws = new WebSocket("ws://127.0.0.1:{own.port}/", ["viser-v{viser.__version__}"]);
        ws.onopen = () => said.ws = "open"; ws.onerror = () => said.ws = "refused";
        fetch("http://127.0.0.1:{own.port}/", {{credentials: "include"}}).then(
            () => said.http = "read", () => said.http = "refused");
        </script><iframe src="http://127.0.0.1:{own.port}/"></iframe>"""
    )

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *a, **k):
            super().__init__(*a, directory=str(tmp_path), **k)

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = _BROWSER["Page"](viewer.url, tmp_path / "profile")
    try:
        page.until("document.body.innerText.includes('bottom')")
        # Another port of the same machine shares the viewer's cookies.
        page.call("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/evil.html")
        page.until("typeof said != 'undefined' && said.ws && said.http")
        assert page.run("said.ws") == "refused" and page.run("said.http") == "refused"
    finally:
        page.close()
        server.shutdown()
        server.server_close()
