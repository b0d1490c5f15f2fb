"""viser's server for one user of this machine alone: loopback, a secret in the address, nothing for foreign pages.

viser itself listens to whoever comes and checks nothing. What it gives to the library that listens for it, ``websockets``, is
completed here: a socket that is bound to 127.0.0.1 already, and a look at every request, those that open a websocket too,
before viser sees it. A request must name this address as its host (a page elsewhere whose name was made to mean 127.0.0.1 does
not), come from no other page, and have the secret as the first part of its path.
"""

from __future__ import annotations

import errno
import hmac
import html
import io
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from typing import Any, Final

from uarm_rl.checks import UsageError
from uarm_rl.view.scene import viser  # first: it says what to install

# isort: split
import websockets.asyncio.server as websocket_server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK: Final = "127.0.0.1"
_HEADERS: Final = {
    "Referrer-Policy": "no-referrer",  # the address is the secret
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
_PORTS: Final = 0xFFFF
# The end waits for connections: for those that a browser opens in case it needs them, and for a page that is busy drawing.
_OPENING_S: Final = 1.0
_FAREWELL_S: Final = 0.5

#: viser's client has a name of its own, and does not ask the browser whether its user likes pages light or dark.
_TITLE: Final = "<title>Viser</title>"
_SCHEMES: Final = ("light", "dark")
_ASKS: Final = r"""<script>{
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const tell = (waits) => {
    const request = new XMLHttpRequest();
    request.open("GET", location.pathname.replace(/\/?$/, dark.matches ? "/dark" : "/light"), !waits);
    request.send();
  };
  dark.addEventListener("change", () => tell(false));
  tell(true);  // before there is anything to see
}</script>"""

Handler = Callable[[Any, Request], Response | None]


@contextmanager
def guarded_server(port: int, label: str) -> Iterator[tuple[viser.ViserServer, str]]:
    """A server and the address, secret included, under which this machine's browsers find it; 0: any port that is free.

    ``label`` is the page's title; it is light or dark as the browser's user likes it. Raises :class:`UsageError` for a port
    that is taken.
    """
    secret = secrets.token_urlsafe(24)
    listening = _listening(port)
    port = listening.getsockname()[1]
    gate = Gate(secret, port, label)
    with _guarding(listening, gate) as guarded, redirect_stdout(io.StringIO()):  # it prints an address
        server = viser.ViserServer(host=LOOPBACK, port=port, label=label, verbose=False)
    try:
        if not guarded:
            raise RuntimeError("this viser listens in a way that cannot be guarded; install the version in constraints.txt")
        # What a button on the page would do: open a way in from the whole internet.
        setattr(server, "request_share_url", lambda *args, **words: None)  # noqa: B010 (a method is replaced)
        gate.set_scheme = partial(_set_theme, server)
        gate.set_scheme("light")
        yield server, f"http://{LOOPBACK}:{port}/{secret}/"
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def _set_theme(server: viser.ViserServer, scheme: str) -> None:
    """A page without viser's own buttons."""
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large", dark_mode=scheme == "dark")


def _listening(port: int) -> socket.socket:
    if not 0 <= port <= _PORTS:
        raise UsageError(f"port must be a whole number from 0 to {_PORTS}, got {port}")
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            why = "is taken" if error.errno == errno.EADDRINUSE else "is not for everybody"
            raise UsageError(f"port {port} {why}; give another port=NUMBER, or port=0 for one that is free") from None
        raise


class Gate:
    """What may come in at a port, and the page's title. ``set_scheme`` is told "light" or "dark" by the page."""

    def __init__(self, secret: str, port: int, title: str) -> None:
        self._secret, self._title = secret.encode(), title
        self.set_scheme: Callable[[str], None] = lambda scheme: None
        self._hosts = {f"{name}:{port}" for name in (LOOPBACK, "localhost")}
        self._origins = {f"http://{host}" for host in self._hosts}

    def refusal(self, request: Request) -> str:
        """Why a request may not come in, as a sentence; empty if it may."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or hosts[0] not in self._hosts:
            return "This page answers to 127.0.0.1 alone."
        if not set(origins) <= self._origins:
            return "This page answers no other page."
        given = request.path.partition("?")[0].split("/")[1:2] or [""]
        if not hmac.compare_digest(given[0].encode(errors="replace"), self._secret):
            return "Open the whole address that uarm-rl watch has printed; a new start has a new one."
        return ""

    def checked(self, handle: Handler) -> Handler:
        """The handler, behind the gate."""

        def checked(connection: Any, request: Request) -> Response | None:
            if reason := self.refusal(request):
                body = f"{reason}\n".encode()
                headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
                response: Response | None = Response(HTTPStatus.FORBIDDEN, "Forbidden", headers, body)
            else:
                path, question, query = request.path.partition("?")
                inner = path.split("/", 2)[2] if path.count("/") > 1 else ""
                if inner in _SCHEMES:
                    self.set_scheme(inner)
                    return Response(HTTPStatus.NO_CONTENT, "No Content", Headers())
                # Packed, the page could not be given a title, and the way is short.
                plain = Headers(
                    (name, value) for name, value in request.headers.raw_items() if name.lower() != "accept-encoding"
                )
                response = handle(connection, replace(request, path=f"/{inner}{question}{query}", headers=plain))
                if response is not None and not inner:
                    self._name(response)
            if response is not None:
                for name, value in _HEADERS.items():
                    response.headers[name] = value
            return response

        return checked

    def _name(self, page: Response) -> None:
        page.body = page.body.replace(_TITLE.encode(), f"<title>{html.escape(self._title)}</title>{_ASKS}".encode(), 1)
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))


@contextmanager
def _guarding(listening: socket.socket, gate: Gate) -> Iterator[list[bool]]:
    """What is served while the body runs listens there, behind the gate; the list is not empty if anything was."""
    original, guarded = websocket_server.serve, list[bool]()

    def serve(handler: Any, host: Any, port: Any, *, process_request: Handler, **options: Any) -> Any:
        guarded.append(True)
        options |= {"sock": listening, "process_request": gate.checked(process_request)}
        return original(handler, **options, open_timeout=_OPENING_S, close_timeout=_FAREWELL_S)

    setattr(websocket_server, "serve", serve)  # noqa: B010 (a function of a module is replaced)
    try:
        yield guarded
    finally:
        setattr(websocket_server, "serve", original)  # noqa: B010
