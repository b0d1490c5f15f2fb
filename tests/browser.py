"""A real browser without a screen, by the pipe of Chromium's DevTools protocol: opens a file, asks it, takes pictures."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

CHROMIUM = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)
#: Chromium reads its descriptor 3 and writes to 4, which may be taken here.
_MOVE = """
import fcntl, os, sys
for number in (1, 2):
    sys.argv[number] = fcntl.fcntl(int(sys.argv[number]), fcntl.F_DUPFD, 10)
for number, place in enumerate((3, 4), start=1):
    os.dup2(sys.argv[number], place)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """One page. ``problems`` are errors and warnings of its console and exceptions so far, ``requests`` what it asked for."""

    def __init__(self, to: int, back: int) -> None:
        self._to, self._back, self._rest, self._number, self._session = to, back, b"", 0, ""
        self.problems: list[str] = []
        self.requests: list[str] = []
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._ask("Page.enable")
        self._listen(self._session)

    def _send(self, method: str, session: str, **params: Any) -> int:
        self._number += 1
        message = {"id": self._number, "method": method, "params": params} | ({"sessionId": session} if session else {})
        os.write(self._to, json.dumps(message).encode() + b"\0")
        return self._number

    def _listen(self, session: str) -> None:
        """Hear what a page or a frame in it complains of, and of the frames in that; it waits until then."""
        for domain in ("Runtime", "Log", "Network"):
            self._send(f"{domain}.enable", session)
        self._send("Target.setAutoAttach", session, autoAttach=True, waitForDebuggerOnStart=True, flatten=True)
        self._send("Runtime.runIfWaitingForDebugger", session)

    def _ask(self, method: str, **params: Any) -> dict[str, Any]:
        number = self._send(method, self._session, **params)
        while True:
            answer = self._next()
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                result: dict[str, Any] = answer["result"]
                return result

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            chunk = os.read(self._back, 1 << 16)
            if not chunk:
                raise RuntimeError("the browser has gone")
            self._rest += chunk
        one, _, self._rest = self._rest.partition(b"\0")
        message: dict[str, Any] = json.loads(one)
        method, params = message.get("method"), message.get("params", {})
        if method == "Target.attachedToTarget" and self._session:
            self._listen(params["sessionId"])
        elif method == "Runtime.exceptionThrown":
            self.problems.append(str(params["exceptionDetails"].get("exception", params["exceptionDetails"])))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.problems.append(str([arg.get("value", arg.get("description")) for arg in params["args"]]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.problems.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        return message

    def wait(self, seconds: float) -> None:
        """Let the page go on for a while."""
        self.value(f"new Promise(done => setTimeout(done, {1000 * seconds}))")

    def open(self, place: Path | str, *, width: int = 1280, height: int = 900, dark: bool = False) -> None:
        """Open a file, or an address, and wait until it has loaded."""
        self._ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._ask("Emulation.setEmulatedMedia", features=[scheme])
        self._ask("Page.navigate", url=place if isinstance(place, str) else place.absolute().as_uri())
        while self._next().get("method") != "Page.loadEventFired":
            pass

    def value(self, expression: str) -> Any:
        """What a JavaScript expression is, a promise's value once it is there; JSON's kinds alone."""
        answer = self._ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def picture(self, path: Path, clip: Sequence[float] = ()) -> None:
        """A PNG of what is seen, or of x, y, width, height of the page."""
        area = {"clip": dict(zip(("x", "y", "width", "height"), clip, strict=True)) | {"scale": 1}} if clip else {}
        answer = self._ask("Page.captureScreenshot", captureBeyondViewport=bool(clip), **area)
        path.write_bytes(base64.b64decode(answer["data"]))


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser of its own, with an empty profile; ``CHROMIUM`` must be there."""
    assert CHROMIUM
    to, back = os.pipe(), os.pipe()
    with TemporaryDirectory(prefix="browser-", ignore_cleanup_errors=True) as profile:
        command = [sys.executable, "-c", _MOVE, str(to[0]), str(back[1]), CHROMIUM, *_FLAGS, f"--user-data-dir={profile}"]
        process = subprocess.Popen(command, pass_fds=(to[0], back[1]), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(to[0])
        os.close(back[1])
        try:
            yield Browser(to[1], back[0])
        finally:
            os.close(to[1])
            os.close(back[0])
            process.terminate()
            process.wait()
