"""The audit hook: which events of the interpreter no input may cause."""

from __future__ import annotations

import os
import sys
import sysconfig
import threading
from collections.abc import Iterable
from pathlib import Path
from types import FrameType
from typing import Any

PAYLOAD = "hostile_payload"  # the module that hostile input names; importing it is an execution


class Watch:
    """An audit hook that writes a line to ``log`` for each event that is not allowed; files may change ``inside`` alone."""

    def __init__(self, log: Path, inside: Iterable[Path]) -> None:
        self.inside = (os.devnull, *(os.path.realpath(path) for path in inside))
        self.busy = threading.local()
        self.log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if getattr(self.busy, "now", False):
            return
        self.busy.now = True
        try:
            if complaint := self.judge(event, arguments, sys._getframe(1)):
                self.note(f"{event}: {complaint}")
        except Exception as error:
            self.note(f"{event}: the hook failed: {error!r}")
        finally:
            self.busy.now = False

    def note(self, line: str) -> None:
        os.write(self.log, f"{' '.join(line.split())[:300]}\n".encode(errors="backslashreplace"))

    def judge(self, event: str, arguments: tuple[Any, ...], frame: FrameType) -> str | None:
        """Why an event is forbidden; ``None`` if it is not."""
        caller = frame.f_code.co_filename
        if event in ("subprocess.Popen", "os.posix_spawn") and arguments[0] == "/sbin/ldconfig":
            return None  # ctypes looks for a library: EGL for MuJoCo's pictures, CUDA's for torch
        if event in _NEVER:
            return f"{arguments!r} from {caller}"
        if event in ("exec", "compile"):
            name = arguments[0].co_filename if event == "exec" else _text(arguments[1])
            # Libraries make code while they are imported; those that read what a user gives may not.
            library = caller.startswith(_INSTALLED) and not any(reader in caller for reader in _READERS)
            known = library or name.startswith(_INSTALLED) or caller.endswith(_GENERATORS)
            return None if known else f"{name} from {caller}"
        if event == "import":
            return arguments[0] if arguments[0].split(".")[0] in (PAYLOAD, "hydra_plugins.hostile") else None
        if event == "code.__new__":
            return None if caller.endswith("/types.py") else f"from {caller}"
        if event == "marshal.loads":
            return None if caller.startswith("<frozen importlib") else f"from {caller}"
        if event == "pickle.find_class":
            return None if "/multiprocessing/" in caller or "/concurrent/" in caller else f"{arguments!r}"
        if event == "open":
            path, mode, flags = arguments
            writes = (isinstance(mode, str) and set(mode) & set("wax+")) or (flags or 0) & _WRITE_FLAGS
            path = "" if isinstance(path, int) else _text(path)
            return path if writes and path and not self.is_inside(os.path.realpath(path)) else None
        for place, descriptor in _CHANGES.get(event, ()):
            folder = arguments[descriptor] if descriptor is not None else -1
            path = os.path.join("" if folder == -1 else os.readlink(f"/proc/self/fd/{folder}"), _text(arguments[place]))
            if not self.is_inside(os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))):
                return path
        return None

    def is_inside(self, path: str) -> bool:
        return any(path == root or path.startswith(root + os.sep) for root in self.inside)


_NEVER = {
    *("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "os.kill", "pty.spawn"),
    *("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.sendto", "subprocess.Popen", "webbrowser.open"),
    *("cpython.run_command", "cpython.run_file", "cpython.run_module", "builtins.input", "urllib.Request"),
}
#: Events that change a file: the places of path and folder descriptor among their arguments.
_CHANGES: dict[str, tuple[tuple[int, int | None], ...]] = {
    **{"os.rename": ((0, 2), (1, 3)), "os.link": ((1, 3),), "os.symlink": ((1, 2),), "shutil.move": ((0, None), (1, None))},
    **dict.fromkeys(("os.remove", "os.rmdir"), ((0, 1),)),
    **dict.fromkeys(("os.mkdir", "os.chmod"), ((0, 2),)),
    **dict.fromkeys(("os.chown", "os.utime"), ((0, 3),)),
    **dict.fromkeys(("os.truncate", "os.setxattr", "tempfile.mkstemp", "tempfile.mkdtemp"), ((0, None),)),
    **dict.fromkeys(("shutil.rmtree", "shutil.make_archive"), ((0, None),)),
    **dict.fromkeys(("shutil.copyfile", "shutil.copytree", "shutil.unpack_archive"), ((1, None),)),
}
_WRITE_FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
#: Parts of the standard library that make code from their caller's names, parsers that make none, and who calls MuJoCo's
#: bindings, which are C and make a word of code to see what a warning's handler is.
_GENERATORS = ("/typing.py", "/dataclasses.py", "/collections/__init__.py", "/ast.py", "/sim/mujoco_arm.py")
#: What reads files and could make code from them.
_READERS = ("/matplotlib/", "/yaml/", "/hydra/", "/omegaconf/", "/uarm_rl/")
_ROOT = Path(__file__).parents[2]
_INSTALLED = (
    *(os.path.join(sysconfig.get_path(name), "") for name in ("stdlib", "platstdlib")),
    *(os.path.join(path, "") for path in sys.path if path.endswith("site-packages")),
    *(os.path.join(os.path.realpath(_ROOT / name), "") for name in ("uarm_rl", "conf", "tests")),
    "<frozen ",
    "<__array_function__ internals>",
)


def _text(path: object) -> str:
    return os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else str(path)
