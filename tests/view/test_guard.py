"""Who may look: loopback alone, with the address's secret, from no foreign page. Real sockets, the server's own answers."""

from __future__ import annotations

import socket
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest

viser = pytest.importorskip("viser")

from uarm_rl.checks import UsageError  # noqa: E402
from uarm_rl.view.guard import guarded_server  # noqa: E402

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
}


@pytest.fixture(scope="module")
def guarded():
    with guarded_server(0, "test") as (server, address):
        yield server, urlsplit(address)


def answer(place, path=None, **headers):
    """Status and body of a request; a header that is ``None`` is left out."""
    connection = HTTPConnection("127.0.0.1", place.port, timeout=10)
    words = {"Host": place.netloc} | headers
    connection.putrequest("GET", place.path if path is None else path, skip_host=True)
    for name, value in words.items():
        if value is not None:
            connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    response = connection.getresponse()
    body = b"" if response.status == 101 else response.read()
    connection.close()
    return response, body


def test_the_whole_address_opens_the_page_and_its_socket(guarded):
    _, place = guarded
    for words in ({}, {"Origin": f"http://{place.netloc}"}, {"Host": f"localhost:{place.port}"}):
        response, body = answer(place, **words)
        assert (response.status, b"<html" in body, b"<title>test</title>" in body) == (200, True, True)
        assert response.headers["Referrer-Policy"] == "no-referrer"
        assert response.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        assert answer(place, place.path.rstrip("/"), **words, **UPGRADE)[0].status == 101
    assert len(place.path) > 30
    assert answer(place, f"{place.path}..%2f..%2fsetup.cfg")[0].status == 404


@pytest.mark.parametrize("upgrade", [{}, UPGRADE], ids=["page", "socket"])
@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/", {}),
        ("/index.html", {}),
        ("/AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA/", {}),
        ("/?token=PATH", {}),
        ("//PATH", {}),
        ("/%C3%A4/", {}),
        (None, {"Host": "evil.example"}),
        (None, {"Host": "evil.example:PORT"}),
        (None, {"Host": "127.0.0.1.evil.example:PORT"}),
        (None, {"Host": "127.0.0.1"}),
        (None, {"Host": None}),
        (None, {"Origin": "http://evil.example"}),
        (None, {"Origin": "null"}),
        (None, {"Origin": "http://127.0.0.1:1"}),
        (None, {"Origin": "https://127.0.0.1:PORT"}),
    ],
)
def test_everybody_else_is_refused(guarded, path, headers, upgrade):
    _, place = guarded
    path = path and path.replace("PATH", place.path.strip("/"))
    headers = {name: value and value.replace("PORT", str(place.port)) for name, value in headers.items()}
    response, body = answer(place, path, **headers, **upgrade)
    assert response.status == 403
    assert b"viser" not in body
    assert place.path.strip("/").encode() not in body


def test_nothing_listens_but_on_loopback(guarded):
    _, place = guarded
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # nothing is sent; it tells the address of this machine
            own = probe.getsockname()[0]
        except OSError:
            pytest.skip("this machine has no address but loopback's")
    if own.startswith("127."):
        pytest.skip("this machine has no address but loopback's")
    with pytest.raises(OSError, match=r"refused|timed out|unreachable"):
        socket.create_connection((own, place.port), timeout=2).close()


def test_the_page_is_dark_where_the_browser_says_so(guarded):
    server, place = guarded
    for scheme in ("dark", "light"):
        assert answer(place, f"{place.path}{scheme}")[0].status == 204
        (theme,) = [
            one for one in server._websock_server._broadcast_buffer.message_from_id.values() if hasattr(one, "dark_mode")
        ]
        assert theme.dark_mode == (scheme == "dark")
    assert answer(place, "/dark")[0].status == 403


def test_the_page_can_open_no_tunnel(guarded):
    server, _ = guarded
    assert "request_share_url" in vars(server)  # not viser's own
    assert server.request_share_url() is None
    assert server._share_tunnel is None


def test_a_port_that_is_taken_and_one_that_is_none_are_refused_in_a_sentence(guarded):
    _, place = guarded
    with pytest.raises(UsageError, match=rf"port {place.port} is taken; give another port=NUMBER, or port=0"):
        guarded_server(place.port, "test").__enter__()
    with pytest.raises(UsageError, match="from 0 to 65535, got 70000"):
        guarded_server(70000, "test").__enter__()


def test_a_new_start_has_a_new_secret(guarded):
    _, place = guarded
    with guarded_server(0, "test") as (_, address):
        assert urlsplit(address).path != place.path
        assert answer(urlsplit(address), place.path)[0].status == 403
