"""Hostile files and hostile command lines, fed to the real commands: nothing of theirs may run or be written elsewhere.

    python -m tests.hostile [--every 1] [--out FILE]

One process installs an audit hook, imports the package and makes a small run. Then it forks for every case: the child goes
to a folder of its own, arms the hook and calls ``uarm_rl.cli.main()``. A case is passed if the hook saw no forbidden event,
no file outside the results changed, and the command ended in time with one ``error:`` line and no traceback. Broken variants
of the package (unsafe YAML, unpickled policies, Hydra's own settings let through) show that payloads would have been seen.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import os
import pickle
import resource
import shutil
import signal
import stat
import struct
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any, NamedTuple
from unittest import mock

LIMIT_S = 20.0  # of a case
MEMORY_BYTES = 3 << 30  # that a case may take on top of what is loaded
LONGEST_LINE = 10_000  # characters of an error line
PAYLOAD = "hostile_payload"  # the module that hostile files name; importing it is an execution

TOY = (
    "name=toy",
    "episodes=2",
    "experiences_per_episode=20",
    "max_decisions_per_episode=80",
    "warmup_experiences=20",
    "batch_size=8",
    "agent.hidden=[16,16]",
    "buffer.capacity=70",
    "validate_every=2",
    "checkpoint_every=1",
    "time_limit_s=0.05",
    "simulate_beside=false",
)
RUN = "results/toy/seed0"
TRAIN = ("train", *TOY, "results_dir=half", "resume=true")
EVALUATE = ("evaluate", f"run={RUN}", "overwrite=true", "workers=1")
RENDER = ("render", f"run={RUN}", "episodes=1", "width=64", "height=64")
REPORT = ("report", "results_dir=results")


# The hook


class Watch:
    """What the audit hook forbids once it is armed: an event that is not allowed becomes a line of ``log``."""

    def __init__(self) -> None:
        self.log: int | None = None
        self.inside: tuple[str, ...] = ()
        self.starting = False
        self.busy = threading.local()

    def arm(self, log: Path, inside: Iterable[Path], *, starting: bool = False) -> None:
        """``starting``: modules are still to be imported, some of which make code of their own."""
        self.starting = starting
        self.inside = tuple(os.path.realpath(path) for path in inside)
        self.log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.log is None or getattr(self.busy, "now", False):
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
        assert self.log is not None
        os.write(self.log, f"{' '.join(line.split())[:300]}\n".encode(errors="backslashreplace"))

    def judge(self, event: str, arguments: tuple[Any, ...], frame: FrameType) -> str | None:
        """Why an event is forbidden; ``None`` if it is not."""
        caller = frame.f_code.co_filename
        if event in _NEVER:
            return f"{arguments!r} from {caller}"
        if event in ("exec", "compile"):
            name = arguments[0].co_filename if event == "exec" else _text(arguments[1])
            known = _installed(name) or caller.endswith(_GENERATORS)
            known = known or (self.starting and _installed(caller) and not any(reader in caller for reader in _READERS))
            return None if known else f"{name} from {caller}"
        if event == "import":
            return arguments[0] if arguments[0].split(".")[0] in (PAYLOAD, "hydra_plugins.hostile") else None
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
        return f"{path}/".startswith("/dev/null/") or any(
            path == root or path.startswith(root + os.sep) for root in self.inside
        )


_NEVER = {
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "os.forkpty",
    "os.kill",
    "pty.spawn",
    "subprocess.Popen",
    "socket.connect",
    "socket.bind",
    "socket.getaddrinfo",
    "socket.sendto",
    "urllib.Request",
    "webbrowser.open",
    "cpython.run_command",
    "cpython.run_file",
    "cpython.run_module",
    "code.__new__",
    "builtins.input",
}
#: Events that change a file: the places of path and folder descriptor among their arguments.
_CHANGES: dict[str, tuple[tuple[int, int | None], ...]] = {
    "os.rename": ((0, 2), (1, 3)),
    "os.link": ((1, 3),),
    "os.symlink": ((1, 2),),
    "os.remove": ((0, 1),),
    "os.rmdir": ((0, 1),),
    "os.mkdir": ((0, 2),),
    "os.truncate": ((0, None),),
    "os.chmod": ((0, 2),),
    "os.chown": ((0, 3),),
    "os.utime": ((0, 3),),
    "os.setxattr": ((0, None),),
    "shutil.rmtree": ((0, None),),
    "shutil.move": ((0, None), (1, None)),
    "shutil.copyfile": ((1, None),),
    "shutil.copytree": ((1, None),),
    "shutil.unpack_archive": ((1, None),),
    "shutil.make_archive": ((0, None),),
    "tempfile.mkstemp": ((0, None),),
    "tempfile.mkdtemp": ((0, None),),
}
_WRITE_FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
#: Parts of the standard library that make code from their caller's names, and parsers that make none.
_GENERATORS = ("/typing.py", "/dataclasses.py", "/collections/__init__.py", "/ast.py")
#: What reads files and could make code from them.
_READERS = ("/matplotlib/", "/yaml/", "/hydra/", "/omegaconf/", "/uarm_rl/")
_INSTALLED = tuple(
    {os.path.join(sysconfig.get_path(name), "") for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    | {os.path.join(os.path.realpath(Path(__file__).parents[1] / name), "") for name in ("uarm_rl", "conf", "tests")}
    | {"<frozen ", "<__array_function__ internals>"}
)


def _text(path: object) -> str:
    return os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else str(path)


def _installed(name: str) -> bool:
    return name.startswith(_INSTALLED)


# The folder of a case


class Box(NamedTuple):
    """A case's folder: ``cwd`` is the working directory, ``outside`` what nothing may touch."""

    root: Path

    @property
    def cwd(self) -> Path:
        return self.root / "cwd"

    @property
    def run(self) -> Path:
        """A finished and evaluated run."""
        return self.cwd / RUN

    @property
    def half(self) -> Path:
        """The same run, stopped after its first episode."""
        return self.cwd / "half" / "toy" / "seed0"

    @property
    def outside(self) -> Path:
        return self.root / "outside"

    def fill(self, text: str) -> str:
        return text.replace("CANARY", str(self.outside / "canary")).replace("OUTSIDE", str(self.outside))


Prepare = Callable[[Box], object]


class Case(NamedTuple):
    """A command line and what lies in its folder. ``OUTSIDE`` and ``CANARY`` in it stand for paths."""

    group: str
    what: str
    words: tuple[str, ...]
    prepare: Prepare = lambda box: None
    environment: Mapping[str, str] = MappingProxyType({})
    accepted: bool = False  # the input is odd but does no harm: the command may do its work
    fresh: bool = False  # in an interpreter of its own: it is the start that is attacked
    allowed: tuple[str, ...] = ()  # folders below the working directory that the user named as a place for results
    check: Callable[[Box], str | None] = lambda box: None


def put(where: str, content: str | bytes) -> Prepare:
    """Write a file below the working directory, in place of what is there."""

    def prepare(box: Box) -> None:
        path = box.cwd / where
        path.parent.mkdir(parents=True, exist_ok=True)
        remove(path)
        path.write_bytes(box.fill(content).encode() if isinstance(content, str) else content)

    return prepare


def put_link(where: str, target: str) -> Prepare:
    def prepare(box: Box) -> None:
        remove(box.cwd / where)
        (box.cwd / where).parent.mkdir(parents=True, exist_ok=True)
        (box.cwd / where).symlink_to(box.fill(target))

    return prepare


def put_pipe(where: str) -> Prepare:
    def prepare(box: Box) -> None:
        remove(box.cwd / where)
        os.mkfifo(box.cwd / where)

    return prepare


def put_folder(where: str) -> Prepare:
    def prepare(box: Box) -> None:
        remove(box.cwd / where)
        (box.cwd / where / "keep").mkdir(parents=True)

    return prepare


def put_giant(where: str, size: int = 1 << 40) -> Prepare:
    """A file of a terabyte that takes no room."""

    def prepare(box: Box) -> None:
        with open(box.cwd / where, "ab") as file:
            file.truncate(size)

    return prepare


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def every(*steps: Prepare) -> Prepare:
    def prepare(box: Box) -> None:
        for step in steps:
            step(box)

    return prepare


# Hostile files: configurations


def config(change: Callable[[dict[str, Any]], object] | None = None, without: str = "", behind: str = "") -> Prepare:
    """The run's configuration changed, without a key, or with text behind it."""

    def prepare(box: Box) -> None:
        import yaml

        settings = yaml.safe_load((box.run / "config.yaml").read_text())
        if change:
            change(settings)
        settings.pop(without, None)
        (box.run / "config.yaml").write_text(yaml.safe_dump(settings, sort_keys=False) + box.fill(behind), encoding="utf-8")

    return prepare


_TAGS = {
    "os.system": "!!python/object/apply:os.system ['touch CANARY']",
    "os.system, keywords": "!!python/object/apply:os.system {args: ['touch CANARY']}",
    "Popen": "!!python/object/apply:subprocess.Popen [[touch, CANARY]]",
    "new": "!!python/object/new:subprocess.Popen [[touch, CANARY]]",
    "eval": '!!python/object/apply:builtins.eval [\'open("CANARY", "w")\']',
    "exec": '!!python/object/apply:builtins.exec [\'open("CANARY", "w")\']',
    "extend": "!!python/object/new:type {args: [z, !!python/tuple [], {extend: !!python/name:exec }], listitems: 'x=1'}",
    "module": f"!!python/module:{PAYLOAD} ''",
    "name": f"!!python/name:{PAYLOAD}.run ''",
    "object": f"!!python/object:{PAYLOAD}.Run {{x: 1}}",
    "whole tag": "!<tag:yaml.org,2002:python/object/apply:os.system> ['touch CANARY']",
    "rename": "!!python/object/apply:os.rename [OUTSIDE/victim.txt, OUTSIDE/gone]",
}
#: Place -> (key to leave out of the good configuration, text behind it).
_PLACES = {
    "alone": (None, "TAG\n"),
    "a new key": ("", "extra: TAG\n"),
    "servo": ("servo", "servo: TAG\n"),
    "inside sim": ("sim", "sim: {physics_hz: TAG}\n"),
    "in a list": ("tolerance_m", "tolerance_m: [1, [TAG]]\n"),
    "a key": ("", "? TAG\n: 1\n"),
    "merged": ("", "<<: TAG\n"),
    "second document": ("", "---\nTAG\n"),
}


def yaml_cases() -> Iterator[Case]:
    commands = (EVALUATE, RENDER, ("evaluate", "results_dir=results", "overwrite=true"))
    for number, (tag, text) in enumerate(_TAGS.items()):
        for place, (without, behind) in list(_PLACES.items())[number % 2 :: 2]:
            raw = behind.replace("TAG", text)
            prepare = put(f"{RUN}/config.yaml", raw) if without is None else config(without=without, behind=raw)
            # Merging takes a mapping for what it is, whatever its tag says.
            yield Case("yaml tag", f"{tag}, {place}", commands[number % 3], prepare, accepted=place == "merged")
    yield Case(
        "yaml tag",
        "own handle",
        EVALUATE,
        put(f"{RUN}/config.yaml", f"%TAG !e! tag:yaml.org,2002:python/\n---\n!e!module:{PAYLOAD} ''\n"),
    )
    yield Case("yaml tag", "in a run to resume", TRAIN, put("half/toy/seed0/config.yaml", _TAGS["os.system"]))
    laughs = "".join(f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]\n" for n in range(1, 10))
    merges = "".join(f"m{n}: &m{n} {{<<: [{', '.join([f'*m{n - 1}'] * 10)}]}}\n" for n in range(1, 10))
    for name, key in (("servo", "servo"), ("tolerance", "tolerance_m"), ("physics", "sim"), ("policy's hold", "buffer")):
        yield Case(
            "yaml bomb",
            f"billion laughs as {name}",
            EVALUATE,
            config(without=key, behind=f"l0: &l0 [ha]\n{laughs}{key}: *l9\n"),
        )
    yield Case("yaml bomb", "billion laughs aside", EVALUATE, config(behind=f"l0: &l0 [ha]\n{laughs}"), accepted=True)
    yield Case("yaml bomb", "laughs as a key", EVALUATE, config(behind=f"l0: &l0 [ha]\n{laughs}? *l9\n: 1\n"))
    yield Case("yaml bomb", "a billion merges", EVALUATE, config(behind=f"m0: &m0 {{a: 1}}\n{merges}"), accepted=True)
    yield Case("yaml bomb", "merged with itself", EVALUATE, config(behind="r: &r {<<: *r}\n"), accepted=True)
    for key in ("servo", "sim", "tolerance_m", "buffer"):
        yield Case("yaml bomb", f"recursive {key}", EVALUATE, config(without=key, behind=f"{key}: &r {{x: *r}}\n"))
    yield Case("yaml bomb", "recursive list", RENDER, config(without="control_hz", behind="control_hz: &r [*r]\n"))
    for depth in (500, 100_000):
        yield Case(
            "yaml bomb",
            f"{depth} lists deep",
            EVALUATE,
            config(behind="deep: " + "[" * depth + "]" * depth + "\n"),
            accepted=depth < 1000,
        )
        yield Case("yaml bomb", f"{depth} maps deep", RENDER, put(f"{RUN}/config.yaml", "{a: " * depth))
    yield Case(
        "yaml bomb",
        "an int of a million digits",
        EVALUATE,
        config(without="control_hz", behind="control_hz: 1" + "0" * 10**6 + "\n"),
    )
    yield Case(
        "yaml bomb", "a sexagesimal int", EVALUATE, config(without="control_hz", behind="control_hz: 1" + ":59" * 10**4 + "\n")
    )
    odd = {
        "empty": b"",
        "NULs": b"\0" * 100,
        "not UTF-8": b"name: \xff\xfe\n",
        "UTF-16": "name: toy\n".encode("utf-16"),
        "a list": b"[1, 2]",
        "a number": b"1",
        "a broken time": b"t: 2001-99-99\n",
        "a broken binary": b"t: !!binary 'x'\n",
        "a broken int": b"t: !!int x\n",
        "an escape code": b"\x1b[2J\x1b]0;owned\x07: 1\n",
        "only braces": b"{{{{",
        "interpolations": b"name: ${oc.env:HOME}\nsim: ${hydra:runtime.cwd}\n",
        "a pickle": pickle.dumps(Touch("CANARY")),
    }
    for name, data in odd.items():
        yield Case("yaml text", name, EVALUATE, put(f"{RUN}/config.yaml", data))
    for where, value in (
        ("sim", None),
        ("sim", []),
        ("sim", {"_target_": "os.system"}),
        ("servo", 5),
        ("servo", {"name": "os.system", "command": "true"}),
        ("servo", {"name": "second_order", "_target_": f"{PAYLOAD}.run"}),
        ("servo", {"name": ["second_order"]}),
        ("servo", {"name": {"a": 1}}),
        ("servo", {1: 2}),
        ("servo", [["name", "second_order"]]),
        ("servo", {"name": "second_order", "self": 1}),
        ("reward", "penalty"),
        ("reward", {"name": "../../evil"}),
        ("reward", {"name": "plain", "__class__": "x"}),
        ("reward", {"name": "plain", "alpha": "x", "beta": None, "sigma": True, "alpha_d": [], "beta_d": {}}),
        ("buffer", None),
        ("buffer", {"hold": None}),
        ("buffer", {"hold": {"name": "fixed", "control_steps": 10**400}}),
        ("buffer", {"hold": {"name": "fixed", "control_steps": True}}),
        ("buffer", {"hold": {"name": "until_steady", "_partial_": True}}),
        ("control_hz", True),
        ("control_hz", 0),
        ("control_hz", -20),
        ("control_hz", 10**400),
        ("control_hz", "20"),
        ("control_hz", 1e308),
        ("max_delta_rad", float("nan")),
        ("max_delta_rad", 10**400),
        ("tolerance_m", float("inf")),
        ("tolerance_m", "CANARY"),
        ("dwell_s", float("inf")),
        ("dwell_s", -1),
        ("dwell_s", 10**400),
        ("dwell_s", 1e308),
        ("time_limit_s", float("nan")),
        ("time_limit_s", 1e12),
        ("time_limit_s", None),
    ):

        def change(settings: dict[str, Any], where: str = where, value: object = value) -> None:
            settings[where] = value

        # A hold that no episode is long enough for ends with the episode.
        harmless = "control_steps': 1000" in repr(value)
        yield Case("configuration's value", f"{where}={value!r:.60}", EVALUATE, config(change), accepted=harmless)
    for key, value in (
        ("physics_hz", 120 * 10**9),
        ("physics_hz", True),
        ("object_size_m", [0.03]),
        ("object_mass_kg", 1e-320),
        ("exact_cup", "1"),
        ("friction", float("nan")),
        ("gui", True),
        ("urdf", "OUTSIDE/evil.urdf"),
    ):

        def change_sim(settings: dict[str, Any], key: str = key, value: object = value) -> None:
            settings["sim"][key] = value

        # The window is never opened for a run that is read from a folder; the stiffness is a very hard cup.
        harmless = key in ("gui", "object_mass_kg")
        yield Case("configuration's value", f"sim.{key}={value!r:.60}", EVALUATE, config(change_sim), accepted=harmless)


# Hostile files: policies


class Touch:
    """Unpickling it runs a command."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.path}",)


class Exec(Touch):
    """Unpickling it runs Python."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"open({self.path!r}, 'w')",)


class Import(Touch):
    """Unpickling it imports a module."""

    def __reduce__(self) -> tuple[Any, ...]:
        return __import__, (PAYLOAD,)


def torch_file(content: object, **how: Any) -> Callable[[Box], bytes]:
    def make(box: Box) -> bytes:
        import torch

        with tempfile.NamedTemporaryFile(dir=box.outside) as file:
            torch.save(content, file.name, **how)
            return Path(file.name).read_bytes()

    return make


def pickles() -> Iterator[tuple[str, Callable[[Box], bytes]]]:
    """Files that run something when unpickled."""
    for make in (Touch, Exec, Import):
        for protocol in (0, 2, 5):
            yield (
                f"pickle {protocol} with {make.__name__}",
                lambda box, m=make, p=protocol: pickle.dumps(m(box.fill("CANARY")), p),
            )
        yield f"torch zip with {make.__name__}", lambda box, m=make: torch_file({"weight0": m(box.fill("CANARY"))})(box)
        yield (
            f"old torch file with {make.__name__}",
            lambda box, m=make: torch_file(m(box.fill("CANARY")), _use_new_zipfile_serialization=False)(box),
        )


def tensors(header: dict[str, Any] | bytes, data: bytes = b"", length: int | None = None) -> bytes:
    """A safetensors file with any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + data


def one(start: int, end: int, shape: Sequence[int] = (2,), dtype: str = "F32") -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "data_offsets": [start, end]}


def broken_tensors() -> dict[str, bytes]:
    """Files that are no safetensors, or hostile ones."""
    sign = "uarm-rl policy 1"
    signed = {"__metadata__": {sign: json.dumps({"policy": {"_target_": "os.system"}, "sha256": "0"})}}
    return {
        "empty": b"",
        "seven bytes": b"1234567",
        "NULs": b"\0" * 64,
        "not UTF-8": tensors(b"\xff" * 20),
        "giant header length": tensors(b"{}", length=2**63),
        "header length -1": tensors(b"{}", length=2**64 - 1),
        "header longer than file": tensors(b"{}", length=1000),
        "header of 100 MB": tensors(b" " * 100, length=100_000_001),
        "no header": tensors(b""),
        "header a list": tensors(b"[]"),
        "header a number": tensors(b"1"),
        "header null": tensors(b"null"),
        "deep header": tensors(b"[" * 100_000 + b"]" * 100_000),
        "deep metadata": tensors(b'{"__metadata__":' + b'{"a":' * 50_000 + b"1" + b"}" * 50_001),
        "deep text in metadata": tensors({"__metadata__": {sign: '{"policy":' + "[" * 100_000 + "]" * 100_000 + "}"}}),
        "metadata a list": tensors({"__metadata__": [sign]}),
        "metadata of numbers": tensors({"__metadata__": {sign: 1}}),
        "metadata no JSON": tensors({"__metadata__": {sign: "os.system('true')"}}),
        "metadata without policy": tensors({"__metadata__": {sign: "{}"}}),
        "metadata null": tensors({"__metadata__": {sign: "null"}}),
        "other format": tensors({"__metadata__": {"pt": "x"}}),
        "escape code as format": tensors({"__metadata__": {"\x1b[2J\x1b]0;owned\x07": "x"}}),
        "huge format name": tensors({"__metadata__": {"x" * 1_000_000: "x"}}),
        "signed, no tensors": tensors(signed),
        "offsets beyond the file": tensors({"weight0": one(0, 2**40)}, b"\0" * 8),
        "offsets backwards": tensors({"weight0": one(8, 0)}, b"\0" * 8),
        "offsets negative": tensors({"weight0": one(-8, 0)}, b"\0" * 8),
        "offsets overlapping": tensors({"weight0": one(0, 8), "bias0": one(4, 12)}, b"\0" * 12),
        "offsets with a gap": tensors({"weight0": one(0, 8), "bias0": one(16, 24)}, b"\0" * 24),
        "offsets huge": tensors({"weight0": one(2**63, 2**64 - 1)}),
        "offsets as text": tensors({"weight0": {"dtype": "F32", "shape": [2], "data_offsets": ["0", "8"]}}, b"\0" * 8),
        "shape overflows": tensors({"weight0": one(0, 8, (2**33, 2**33))}, b"\0" * 8),
        "shape negative": tensors({"weight0": one(0, 8, (-2,))}, b"\0" * 8),
        "shape zero times huge": tensors({"weight0": one(0, 0, (0, 2**60))}),
        "shape of 100 000 axes": tensors({"weight0": one(0, 4, (1,) * 100_000)}, b"\0" * 4),
        "unknown type": tensors({"weight0": one(0, 8, (2,), "PICKLE")}, b"\0" * 8),
        "type of 8-bit floats": tensors({"weight0": one(0, 2, (2,), "F8_E4M3")}, b"\0" * 2),
        "twice the same name": tensors(
            b'{"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
            b"\0" * 4,
        ),
        "names with paths": tensors({"../../OUTSIDE/evil": one(0, 8)} | signed, b"\0" * 8),
        "names of attributes": tensors(
            {"__class__": one(0, 8), "weight0": one(8, 16), "__reduce__": one(16, 24)} | signed, b"\0" * 24
        ),
        "bytes behind the end": tensors({"weight0": one(0, 8)}, b"\0" * 8 + b"#!/bin/sh\ntouch CANARY\n"),
        "a zip": b"PK\x03\x04" + b"\0" * 60,
        "a shell script": b"#!/bin/sh\ntouch CANARY\n",
        "Python": b"import os; os.system('touch CANARY')\n",
    }


def own_policy(change: Callable[[Any, Any], object]) -> Prepare:
    """A policy with a valid hash whose content is wrong: ``change`` gets the policy and numpy."""

    def prepare(box: Box) -> None:
        from dataclasses import asdict
        from types import SimpleNamespace

        import numpy as np

        from uarm_rl.task.policy import ActorPolicy, encode

        path = box.run / "policy.safetensors"
        good = ActorPolicy.load(path)
        layers = tuple((weight.astype("float32"), bias.astype("float32")) for weight, bias in good.layers)
        offset, scale = good.offset.astype("float32"), good.scale.astype("float32")
        wrong = SimpleNamespace(layers=layers, offset=offset, scale=scale, card=asdict(good.card))
        change(wrong, np)
        tensors = {"offset": wrong.offset, "scale": wrong.scale}
        for number, (weight, bias) in enumerate(wrong.layers):
            tensors |= {f"weight{number}": weight, f"bias{number}": bias}
        path.write_bytes(encode({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}, wrong.card))

    return prepare


def _layers(index: int, change: Callable[[Any, Any], tuple[Any, Any]]) -> Callable[[Any, Any], None]:
    def apply(policy: Any, np: Any) -> None:
        layers = list(policy.layers)
        layers[index] = change(*layers[index])
        policy.layers = tuple(layers)

    return apply


def _number(index: int, part: int, value: float) -> Callable[[Any, Any], None]:
    def apply(policy: Any, np: Any) -> None:
        policy.layers[index][part].reshape(-1)[-1] = value

    return apply


def _set(name: str, value: Callable[[Any, Any], Any]) -> Callable[[Any, Any], None]:
    return lambda policy, np: setattr(policy, name, value(policy, np))


_WRONG_POLICIES: dict[str, Callable[[Any, Any], None]] = {
    "NaN in the first weight": _number(0, 0, float("nan")),
    "NaN in the last bias": _number(-1, 1, float("nan")),
    "infinity": _number(1, 0, float("-inf")),
    "scale of zero": _set("scale", lambda policy, np: policy.scale * 0),
    "NaN in the offset": _set("offset", lambda policy, np: policy.offset * np.float32("nan")),
    "offset of 21": _set("offset", lambda policy, np: np.zeros(21, np.float32)),
    "scale without axes": _set("scale", lambda policy, np: np.ones((), np.float32)),
    "float64": _layers(0, lambda weight, bias: (weight.astype("float64"), bias)),
    "float16": _layers(0, lambda weight, bias: (weight, bias.astype("float16"))),
    "whole numbers": _layers(-1, lambda weight, bias: (weight.astype("int8"), bias)),
    "booleans": _layers(-1, lambda weight, bias: (weight > 0, bias)),
    "turned": _layers(0, lambda weight, bias: (weight.T, bias)),
    "three axes": _layers(0, lambda weight, bias: (weight[None], bias)),
    "no axes": _layers(0, lambda weight, bias: (weight.sum(), bias)),
    "bias of two axes": _layers(0, lambda weight, bias: (weight, bias[None])),
    "bias of one": _layers(0, lambda weight, bias: (weight, bias[:1])),
    "four outputs": _layers(-1, lambda weight, bias: (weight[:, [0, 1, 2, 0]], bias[[0, 1, 2, 0]])),
    "no outputs": _layers(-1, lambda weight, bias: (weight[:, :0], bias[:0])),
    "no layers": _set("layers", lambda policy, np: ()),
    "a list of names as card": _set("card", lambda policy, np: ["max_delta_rad", "hold"]),
    "a word as card": _set("card", lambda policy, np: "max_delta_rad hold"),
    "a card without hold": _set("card", lambda policy, np: {"max_delta_rad": 0.1, "_target_": "os.system"}),
}


def policy_cases() -> Iterator[Case]:
    path = f"{RUN}/policy.safetensors"
    for number, (name, make) in enumerate(pickles()):

        def prepare(box: Box, make: Callable[[Box], bytes] = make) -> None:
            (box.run / "policy.safetensors").write_bytes(make(box))

        yield Case("pickle as policy", name, (EVALUATE, RENDER)[number % 2], prepare)
    for number, (name, data) in enumerate(broken_tensors().items()):
        yield Case("policy", name, (EVALUATE, RENDER)[number % 2], put(path, data))
    for number, (name, change) in enumerate(_WRONG_POLICIES.items()):
        yield Case("policy", name, (EVALUATE, RENDER)[number % 2], own_policy(change))
    told = {"hold": {"_target_": f"{PAYLOAD}.run", "name": "../../evil"}}
    # What only the real arm uses; the simulation takes it from the run's configuration.
    change = _set("card", lambda policy, np: policy.card | told)
    yield Case("policy", "a card with a target", EVALUATE, own_policy(change), accepted=True)
    yield Case("policy", "a terabyte", EVALUATE, put_giant(path))


# Hostile files: checkpoints


def checkpoint(change: Callable[[dict[str, Any], dict[str, Any]], object]) -> Prepare:
    """A checkpoint with valid hashes whose content is wrong: ``change`` gets its arrays and its state."""

    def prepare(box: Box) -> None:
        from safetensors.numpy import load, save

        folder = next(box.half.glob("checkpoint-*"))
        arrays, state = load((folder / "arrays.safetensors").read_bytes()), json.loads((folder / "state.json").read_bytes())
        change(arrays, state)
        parts(arrays=save(arrays), state=json.dumps(state).encode())(box)

    return prepare


def parts(**contents: bytes | Callable[[Box], bytes]) -> Prepare:
    """Parts of the checkpoint replaced, and the manifest made to fit."""

    def prepare(box: Box) -> None:
        folder = next(box.half.glob("checkpoint-*"))
        manifest = json.loads((folder / "manifest.json").read_bytes())
        for stem, content in contents.items():
            name = {"arrays": "arrays.safetensors", "state": "state.json"}[stem]
            data = content(box) if callable(content) else content
            (folder / name).write_bytes(data)
            manifest[name] = hashlib.sha256(data).hexdigest()
        (folder / "manifest.json").write_text(json.dumps(manifest))

    return prepare


def manifest(content: bytes) -> Prepare:
    return lambda box: (next(box.half.glob("checkpoint-*")) / "manifest.json").write_bytes(content)


def _state(path: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    def change(arrays: dict[str, Any], state: dict[str, Any]) -> None:
        *above, last = path.split(".")
        for key in above:
            state = state[key]
        state[last] = value

    return change


def _array(ending: str, turn: Callable[[Any], Any]) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    def change(arrays: dict[str, Any], state: dict[str, Any]) -> None:
        name = min(name for name in arrays if ending in name)
        arrays[name] = turn(arrays[name])

    return change


def _filled(value: float) -> Callable[[Any], Any]:
    return lambda array: (array * 0 + 1) * array.dtype.type(value)


def checkpoint_cases() -> Iterator[Case]:
    def case(name: str, prepare: Prepare, accepted: bool = False) -> Case:
        return Case("checkpoint", name, TRAIN, prepare, accepted=accepted)

    for name, make in pickles():
        yield Case("pickle as checkpoint", name, TRAIN, parts(arrays=make))
    for name, data in list(broken_tensors().items())[::2]:
        yield case(f"arrays: {name}", parts(arrays=data))
    for name, text in {
        "empty": b"",
        "a list": b"[]",
        "null": b"null",
        "a number": b"1",
        "names of numbers": b'{"arrays.safetensors": 1, "state.json": 2}',
        "nested hashes": b'{"arrays.safetensors": ["x"], "state.json": {"a": 1}}',
        "true": b'{"arrays.safetensors": true, "state.json": true}',
        "names with paths": b'{"../../../../OUTSIDE/victim.txt": "x"}',
        "deep": b"[" * 100_000 + b"]" * 100_000,
        "not UTF-8": b"\xff\xfe\x00",
        "an int of many digits": b"1" + b"0" * 100_000,
        "a pickle": pickle.dumps(Touch("CANARY")),
        "YAML": _TAGS["os.system"].encode(),
    }.items():
        yield case(f"manifest: {name}", manifest(text))
        if name not in ("names of numbers", "nested hashes", "true", "names with paths"):
            yield case(f"state: {name}", parts(state=text))
    for path, value in (
        ("counters", None),
        ("counters", {"episode": 10**30}),
        ("counters", {"__class__": "os.system", "__dict__": {"episode": 1}}),
        ("counters.episode", -1),
        ("counters.episode", True),
        ("counters.episode", "1"),
        ("counters.episode", 1.5),
        ("counters.episode", None),
        ("counters.episode", 10**30),
        ("counters.updates", 10**30),
        ("counters.updates", "many"),
        ("counters.updates", -(10**30)),
        ("counters.decisions", [1]),
        ("counters.wall_s", "soon"),
        ("counters.wall_s", float("nan")),
        ("counters.train", "x"),
        ("replay", []),
        ("replay.added", -1),
        ("replay.added", 10**30),
        ("replay.added", True),
        ("replay.added", "20"),
        ("replay.added", 1e300),
        ("replay.generator", {"bit_generator": "os.system", "state": {}}),
        ("replay.generator", {"bit_generator": "MT19937", "state": {"key": [1] * 624, "pos": 10**9}}),
        ("replay.generator.state", {"state": -1, "inc": 10**60}),
        ("replay.generator.uinteger", 2**80),
        ("replay.generator.has_uint32", 7),
        ("noise", "loud"),
        ("noise.state", []),
        ("noise.state", [float("nan")] * 3),
        ("noise.state", [1e400] * 3),
        ("noise.state", ["os.system"] * 3),
        ("noise.state", [[0, 0, 0]] * 3),
        ("noise.state", [{"_target_": "os.system"}] * 3),
        ("noise.generator", None),
        ("env", 1),
        ("env.generator", {"_target_": "os.system"}),
        ("env.generator", None),
    ):
        yield case(f"state: {path}={value!r:.60}", checkpoint(_state(path, value)))
    changes = {
        "NaN everywhere": _filled(float("nan")),
        "infinite": _filled(float("inf")),
        "one more row": lambda array: array.repeat(2, axis=0),
        "no rows": lambda array: array[:0],
        "three axes": lambda array: array[None, None],
        "float64": lambda array: array.astype("float64"),
        "whole numbers": lambda array: array.astype("int64"),
        "booleans": lambda array: array > 0,
    }
    for kind, ending in (("parameters", "agent/"), ("rows", "replay/rows")):
        for name, turn in changes.items():
            yield case(f"{kind}: {name}", checkpoint(_array(ending, turn)))
    yield case("without arrays", checkpoint(lambda arrays, state: arrays.clear()))
    yield case("without rows", checkpoint(lambda arrays, state: arrays.pop("replay/rows")))
    yield case("without counters", checkpoint(lambda arrays, state: state.pop("counters")))

    def renamed(name: str) -> Prepare:
        return lambda box: next(box.half.glob("checkpoint-*")).rename(box.half / name)

    yield case("another episode in its name", renamed("checkpoint-000099"))
    yield case("a giant in its name", renamed("checkpoint-" + "9" * 200))
    yield case("other digits in its name", renamed("checkpoint-\u00b2"))
    yield case("only a file", every(renamed("x"), put("half/toy/seed0/checkpoint-000001", b"x")))
    yield case(
        "a terabyte of arrays", lambda box: put_giant(str(next(box.half.glob("checkpoint-*")) / "arrays.safetensors"))(box)
    )
    yield case("a terabyte of state", lambda box: put_giant(str(next(box.half.glob("checkpoint-*")) / "state.json"))(box))


# Hostile files: links, pipes, folders, tables


def place_cases() -> Iterator[Case]:
    half = "half/toy/seed0"
    names = {
        TRAIN: [
            *(f"{half}/{name}" for name in ("config.yaml", "config.yaml.tmp", "progress.csv", "progress.csv.tmp", ".lock")),
            *(f"{half}/{name}" for name in ("policy.safetensors.tmp", "checkpoint-000001", "checkpoint-000002")),
            *(f"{half}/{name}" for name in ("checkpoint-000002.tmp", "checkpoint-000001/manifest.json")),
            *(f"{half}/{name}" for name in ("checkpoint-000001/state.json", "checkpoint-000001/arrays.safetensors")),
        ],
        EVALUATE: [f"{RUN}/{name}" for name in ("config.yaml", "policy.safetensors", "evaluation.csv", "evaluation.csv.tmp")],
        RENDER: [f"{RUN}/episode.gif"],
        REPORT: [
            *(f"{RUN}/{name}" for name in ("progress.csv", "evaluation.csv")),
            *(
                f"results/{name}"
                for name in ("paper.csv", "table1.md", "table1.md.tmp", "table1.csv.tmp", "learning_curves.png")
            ),
        ],
        ("train", *TOY, "results_dir=half", "overwrite=true"): [f"{half}/{name}" for name in ("config.yaml", ".lock", "x")],
    }
    for words, wheres in names.items():
        how = "overwriting " if "overwrite=true" in words and words[0] == "train" else ""
        for where in wheres:
            what = f"{how}{words[0]}: {where}"
            name = where.rpartition("/")[2]
            targets = ["OUTSIDE/victim.txt"] if "." in name else ["OUTSIDE/folder"]
            targets += ["OUTSIDE/new.txt"] if name in (".lock", "episode.gif", "progress.csv", "evaluation.csv.tmp") else []
            targets += ["/dev/zero"] if name in ("config.yaml", "policy.safetensors", "manifest.json", "paper.csv") else []
            for target in targets:
                group = "link as result" if name in ("evaluation.csv", "table1.md", "learning_curves.png") else "link"
                yield Case(group, f"{what} -> {target}", words, put_link(where, target), accepted=True)
            yield Case("pipe", what, words, put_pipe(where), accepted=True)
            yield Case("folder", what, words, put_folder(where), accepted=True)
    link = put_link("results/toy/seed0", "OUTSIDE/folder")
    yield Case("link", "the run itself, to a foreign folder", EVALUATE, link)
    yield Case(
        "link", "tensorboard", (*TRAIN, "tensorboard=true"), put_link(f"{half}/tensorboard", "OUTSIDE/folder"), accepted=True
    )
    for target in ("OUTSIDE/folder", "OUTSIDE/new"):
        many = ("train", "-m", *TOY, "results_dir=half", "resume=true")
        yield Case("link", f".hydra of many runs -> {target}", many, put_link("half/.hydra", target), accepted=True)
    for name in ("progress.csv", "evaluation.csv"):
        yield Case("giant", f"report: {name}", REPORT, put_giant(f"{RUN}/{name}"))
    yield Case(
        "giant",
        "report: paper.csv",
        REPORT,
        every(put("results/paper.csv", "method,success_rate\n"), put_giant("results/paper.csv")),
    )
    yield Case("giant", "train: progress.csv", TRAIN, put_giant(f"{half}/progress.csv"))
    yield Case("giant", "evaluate: config.yaml", EVALUATE, put_giant(f"{RUN}/config.yaml"))


def report_cases() -> Iterator[Case]:
    def good(name: str) -> Callable[[Box], list[str]]:
        return lambda box: (box.run / name).read_text().splitlines()

    def table(name: str, change: Callable[[list[str]], list[str]]) -> Prepare:
        return lambda box: (box.run / name).write_text("\n".join(change(good(name)(box))) + "\n")

    def cell(value: str, column: int) -> Callable[[list[str]], list[str]]:
        def change(lines: list[str]) -> list[str]:
            cells = lines[1].split(",")
            cells[column] = value
            return [lines[0], ",".join(cells), *lines[2:]]

        return change

    for name in ("progress.csv", "evaluation.csv"):
        for value in ("=1+1", "=cmd|' /C calc'!A0", "@SUM(1)", "nan", "inf", "-1e999", "1e300", "0x10", "", "True", "9" * 5000):
            # An empty or a wrong value in a column that the report does not use does not concern it; column 0 does.
            yield Case("table", f"{name}: {value[:20]}", REPORT, table(name, cell(value, 0)))
        yield Case("table", f"{name}: a row too short", REPORT, table(name, lambda lines: [*lines, "1,2"]))
        yield Case("table", f"{name}: a row too long", REPORT, table(name, lambda lines: [*lines, lines[-1] + ",1"]))
        yield Case("table", f"{name}: a quote left open", REPORT, table(name, lambda lines: [*lines, '"' + lines[-1]]))
        yield Case("table", f"{name}: a quote inside", REPORT, table(name, lambda lines: [lines[0], '"1"x' + lines[1]]))
        yield Case("table", f"{name}: no header", REPORT, table(name, lambda lines: lines[1:]))
        yield Case("table", f"{name}: a cell of a megabyte", REPORT, table(name, cell("1" * 2**20, 0)))
        for what, data in {
            "empty": b"",
            "NULs": b"\0\0\n\0",
            "not UTF-8": b"\xff\xfe",
            "a pickle": pickle.dumps(Touch("CANARY")),
        }.items():
            yield Case("table", f"{name}: {what}", REPORT, put(f"{RUN}/{name}", data))
    header = "method,success_rate\n"
    for what, text in {
        "text": "A,x\n",
        "above one": "A,2\n",
        "NaN": "A,nan\n",
        "formula": "=1+1,=1+1\n",
        "short": "A\n",
    }.items():
        yield Case("table", f"paper.csv: {what}", REPORT, put("results/paper.csv", header + text))
    for name in (
        "=HYPERLINK(1)",
        "@SUM(1)",
        "+1+1",
        "-1+1",
        "a|b",
        "<script>",
        "$\\input{x}$",
        "\x1b[2J",
        "a\nb",
        "%s{0}",
        "CANARY",
    ):

        def rename(box: Box, name: str = name) -> None:
            (box.run.parent).rename(box.cwd / "results" / name)

        def formulas(box: Box) -> str | None:
            for path in sorted((box.cwd / "results").glob("*.csv")):
                if any(line.startswith(("=", "@", "+", "-")) for line in path.read_text().splitlines()):
                    return f"a formula in {path.name}"
            return None

        yield Case("table", f"a run named {name!r}", REPORT, rename, accepted=True, check=formulas)
    for name in ("seed-1", "seed1e9", "seed" + "9" * 200, "seed\u0663"):

        def other_seed(box: Box, name: str = name) -> None:
            shutil.copytree(box.run, box.run.parent / name)

        yield Case("table", f"a folder named {name[:20]}", REPORT, other_seed, accepted=True)


def position_cases() -> Iterator[Case]:
    words = (*EVALUATE, "positions=p.csv", "out=results/out.csv")
    header = "x_m,y_m,z_m\n"
    for what, data in {
        "NaN": header + "nan,0,0.03\n",
        "infinite": header + "inf,0,0.03\n",
        "text": header + "x,y,z\n",
        "code": header + "__import__('os').system('touch CANARY'),0,0\n",
        "formula": header + "=1+1,0,0.03\n",
        "too few": header + "0.2\n",
        "too large": header + "1e308,0,0.03\n",
        "beyond floats": header + "1" * 5000 + ",0,0.03\n",
        "no header": "0.2,0,0.03\n",
        "no row": header,
        "empty": "",
        "UTF-16": (header + "0.2,0,0.03\n").encode("utf-16"),
        "NULs": header + "0.2\0,0,0.03\n",
        "not UTF-8": b"x_m,y_m,z_m\n\xff\n",
        "a cell of a megabyte": header + "0" * 2**20 + ",0,0\n",
        "a quote left open": header + '"0.2,0,0.03\n' + "x" * 200_000,
        "a pickle": pickle.dumps(Touch("CANARY")),
    }.items():
        yield Case("positions", what, words, put("p.csv", data))
    for what, prepare in {
        "pipe": put_pipe("p.csv"),
        "folder": put_folder("p.csv"),
        "giant": put_giant("p.csv"),
        "zeros": put_link("p.csv", "/dev/zero"),
    }.items():
        yield Case("positions", what, words, prepare)


def files() -> Iterator[Case]:
    """Every hostile file with the command that reads it."""
    yield from yaml_cases()
    yield from policy_cases()
    yield from checkpoint_cases()
    yield from place_cases()
    yield from report_cases()
    yield from position_cases()


# Hostile configurations


_HYDRA = (
    f"+hydra.callbacks.x._target_={PAYLOAD}.Callback",
    f"++hydra.callbacks={{x:{{_target_:{PAYLOAD}.Callback}}}}",
    f"+hydra.job_logging={{version:1,handlers:{{h:{{'()':{PAYLOAD}.run}}}},root:{{handlers:[h]}}}}",
    "++hydra.hydra_logging={version:1,handlers:{h:{class:logging.FileHandler,filename:CANARY}},root:{handlers:[h]}}",
    "++hydra.launcher._target_=hydra_plugins.hostile.run",
    f"hydra.callbacks.x._target_={PAYLOAD}.Callback",
    f"hydra.callbacks={{x:{{_target_:{PAYLOAD}.Callback}}}}",
    f"hydra.launcher._target_={PAYLOAD}.run",
    f"hydra.launcher={{_target_:{PAYLOAD}.run}}",
    f"hydra.sweeper._target_={PAYLOAD}.run",
    f"hydra.sweeper={{_target_:{PAYLOAD}.run}}",
    "hydra.sweeper.params={seed:1}",
    "hydra/launcher=../../evil",
    "hydra/launcher=OUTSIDE/evil",
    "hydra/launcher=submitit_local",
    "hydra/launcher=[basic,joblib]",
    "hydra/sweeper=evil",
    "hydra/callbacks=evil",
    "hydra/job_logging=default",
    "hydra/hydra_logging=colorlog",
    "hydra/output=default",
    "hydra/env=default",
    "hydra/help=default",
    "hydra.job_logging={version:1,handlers:{h:{class:logging.FileHandler,filename:CANARY}},root:{handlers:[h]}}",
    f"hydra.job_logging={{version:1,handlers:{{h:{{'()':{PAYLOAD}.run}}}},root:{{handlers:[h]}}}}",
    "hydra.hydra_logging={version:1,handlers:{h:{class:logging.FileHandler,filename:CANARY}},root:{handlers:[h]}}",
    "hydra.searchpath=[file://OUTSIDE]",
    f"hydra.searchpath=[pkg://{PAYLOAD}]",
    "hydra.run.dir=OUTSIDE",
    "hydra.sweep.dir=OUTSIDE",
    "hydra.sweep.subdir=../../../outside",
    "hydra.output_subdir=../../outside",
    "hydra.job.chdir=true",
    "hydra.job.name=../../outside/x",
    "hydra.job.env_set.LD_PRELOAD=OUTSIDE/evil.so",
    "hydra.job.env_copy=[HOME]",
    "hydra.job.config.override_dirname.item_sep=/",
    "hydra.mode=MULTIRUN",
    "hydra.mode=RUN",
    "hydra.verbose=true",
    "hydra.runtime.output_dir=OUTSIDE",
    "hydra.launcher.n_jobs=\u00b2",
    "hydra.launcher.n_jobs=--5",
    "hydra.launcher.n_jobs=2",
    "hydra={}",
    "hydra=null",
    " hydra.run.dir=OUTSIDE",
    "\thydra.sweep.dir=OUTSIDE",
    "\n+hydra.sweep.dir=OUTSIDE",
    "'hydra.sweep.dir'=OUTSIDE",
    "HYDRA.sweep.dir=OUTSIDE",
    "hydra@x=default",
    "hydra/launcher@_global_=basic",
)
_WORDS = (
    "+x._target_=os.system",
    f"+x={{_target_:{PAYLOAD}.run}}",
    "++servo._target_=os.system",
    f"++hydra.callbacks.x._target_={PAYLOAD}.Callback",
    "~servo",
    "~hydra.launcher",
    "~hydra",
    f"servo._target_={PAYLOAD}.run",
    f"servo={{_target_:{PAYLOAD}.run}}",
    f"servo={PAYLOAD}.run",
    "servo.name=os.system",
    "servo.name=[a]",
    "servo.name={a:b}",
    "agent.name=__import__",
    "noise.name=../../evil",
    "reward.name=null",
    "buffer.hold.name=os.system",
    "buffer.hold=null",
    "buffer.hold=[1]",
    "buffer={}",
    "buffer=[adaptive,uniform]",
    "sim=null",
    "sim.urdf=OUTSIDE/evil.urdf",
    "experiment=../../evil",
    f"experiment={'../' * 20}OUTSIDE/evil",
    "experiment=OUTSIDE/evil",
    "experiment=${oc.env:HOSTILE_CHOICE}",
    f"experiment=glob({'../' * 20}OUTSIDE/*)",
    f"experiment=choice(A,{'../' * 20}OUTSIDE/evil)",
    f"experiment='{'../' * 20}OUTSIDE/evil'",
    f"buffer={'../' * 20}OUTSIDE/evil",
    f"reward@_global_={'../' * 20}OUTSIDE/evil",
    "experiment=[A,../../evil]",
    "experiment=/etc/passwd",
    "experiment=A@hydra",
    "experiment@hydra=A",
    "buffer=../evil",
    "buffer@hydra.launcher=adaptive",
    "buffer@_global_=adaptive",
    "reward@hydra.callbacks.x=plain",
    "agent@hydra=ddpg",
    "name=../../x",
    "name=OUTSIDE/x",
    "name=..",
    "name=a/../../../x",
    "name='a\\tb\u0000c'",
    "name=[a,b]",
    "name={a:b}",
    "name=null",
    f"name={'x' * 5000}",
    "seed=../../x",
    "seed=-1",
    "seed=1e400",
    "seed=true",
    "seed=nan",
    f"seed={'9' * 5000}",
    "results_dir=null",
    "results_dir=[a,b]",
    "results_dir=1",
    "results_dir={a:b}",
    "results_dir='a\u0000b'",
    "results_dir=/dev/null",
    "results_dir=/proc/self/fd",
    f"results_dir={'x' * 5000}",
    "name=${oc.env:HOME}",
    "name=${oc.env:HOSTILE_TRAVERSAL}",
    "name=${oc.decode:'{_target_: os.system}'}",
    "name=${oc.decode:${oc.env:HOSTILE_TAG}}",
    "name=${oc.create:{_target_:os.system}}",
    f"name=${{oc.deprecated:{PAYLOAD}}}",
    "name=${hydra:runtime.cwd}",
    "name=${hydra:callbacks}",
    "name=${eval:'1+1'}",
    "name=${python:os.system}",
    "name=${shell:'touch CANARY'}",
    "name=${name}",
    "name=${servo}",
    "name=${oc.dict.values:servo}",
    f"name={'${' * 300}x{'}' * 300}",
    f"agent.hidden={'[' * 3000}{']' * 3000}",
    "agent.hidden=[1e400]",
    "agent.hidden=[-1]",
    "agent.hidden=[true,true]",
    "agent.hidden=[1000000000,1000000000]",
    "batch_size=1000000000000",
    "buffer.capacity=1000000000000",
    "buffer.capacity=-1",
    "buffer.capacity=true",
    "control_hz=[20]",
    "control_hz=null",
    "time_limit_s=nan",
    "agent.gamma=nan",
    "agent.gamma=[]",
    "agent.actor_lr=inf",
    "agent.tau=x",
    "tensorboard=[1]",
    "overwrite=yes_please",
    "resume=[1]",
    "simulate_beside={}",
    "=",
    "==",
    "=x",
    "a",
    "",
    " ",
    "\u202e=1",
    "\udcff=1",
    "name=\udcff/../../../x",
    "seed=range(1,3,0)",
    "seed=glob(*)",
    "experiment=glob(*,exclude=[A])",
    "seed=choice(1,2)",
    "seed=interval(0,1)",
    "seed=shuffle(range(3))",
    "seed=int(os.system)",
    "seed=eval(1)",
    "seed=extend_list(1)",
    "seed=sort(1,2,key=os.system)",
    "@OUTSIDE/arguments",
)
_OPTIONS = (
    ("--config-dir", "OUTSIDE"),
    ("--config-dir=OUTSIDE",),
    ("-cd", "OUTSIDE"),
    ("--config-path=OUTSIDE",),
    ("-cp", "OUTSIDE"),
    ("--config-name=evil",),
    ("-cn", "evil"),
    ("--experimental-rerun=OUTSIDE/config.pickle",),
    ("--experimental-rerun", "OUTSIDE/config.pickle"),
    ("--run",),
    ("-r",),
    ("--package=hydra",),
    ("-p", "hydra"),
    ("--info", "all"),
    ("-i",),
    ("--resolve", "-c", "job"),
    ("--hydra-help",),
    ("--version",),
    ("--multirun=1",),
    ("--cfg=hydra",),
    ("-mi",),
    ("--", f"hydra.callbacks.x._target_={PAYLOAD}.Callback"),
    ("-sc", "install=bash"),
    ("--shell-completion=install=bash",),
)
#: Hydra's settings alone never run anything unless many runs are asked for, so those are fed both ways.
_FEW_RUNS = (
    *(word for word in TOY if not word.startswith(("episodes", "experiences", "warmup", "max_decisions"))),
    *("episodes=1", "experiences_per_episode=4", "warmup_experiences=2", "max_decisions_per_episode=8"),
    "results_dir=results/many",
)

_EVIL = f"""\
# @package _global_
hydra:
  callbacks:
    x: {{_target_: {PAYLOAD}.Callback}}
  sweep: {{dir: OUTSIDE/sweep}}
name: evil
"""


def evil(box: Box) -> None:
    """What hostile command lines name: configurations, a pickled configuration, a file of arguments."""
    for path in (box.outside / "evil.yaml", box.outside / "train.yaml", box.cwd / "evil.yaml", box.root / "evil.yaml"):
        path.write_text(box.fill(_EVIL))
    (box.outside / "config.pickle").write_bytes(pickle.dumps(Touch(box.fill("CANARY"))))
    (box.outside / "hydra.pickle").write_bytes(pickle.dumps(Touch(box.fill("CANARY"))))
    (box.outside / "arguments").write_text(f"hydra.callbacks.x._target_={PAYLOAD}.Callback\n")


def command_lines() -> Iterator[Case]:
    environment = {
        "HOME": "OUTSIDE/home",
        "HOSTILE_TRAVERSAL": "../../outside/x",
        "HOSTILE_CHOICE": "../" * 20 + "OUTSIDE/evil",
        "HOSTILE_TAG": "!!python/object/apply:os.system [true]",
    }
    for word in _HYDRA:
        # A number of processes is the one thing besides the launcher that may be set, so it may be accepted.
        fine = word.startswith("hydra.launcher.n_jobs=2")
        for flags in ((), ("-m",)):
            group = "Hydra's settings" + ", many runs" * bool(flags)
            yield Case(group, word, ("train", *flags, *_FEW_RUNS, word), evil, accepted=fine)
    for word in _WORDS:
        name = word.partition("=")[0]
        fine = name in ("name", "seed", "results_dir") and "._target_" not in word
        harmless = fine or word == "buffer={}"
        named = (word.partition("=")[2],) if name == "results_dir" and "\0" not in word else ()
        yield Case("override", word[:80], ("train", *_FEW_RUNS, word), evil, environment, harmless, allowed=named)
        if word.startswith(("+", "~", "experiment", "seed=c", "name=$", "name=.", "name=O", "@", "buffer@")):
            many = ("train", "-m", *_FEW_RUNS, word)
            yield Case("override", f"-m {word[:80]}", many, evil, environment, harmless, allowed=named)
    for command in ("evaluate", "report", "render"):
        for word in (
            f"hydra.callbacks.x._target_={PAYLOAD}.Callback",
            "+x._target_=os.system",
            "results_dir='a\u0000b'",
            "results_dir=[1]",
            f"{'run' if command != 'report' else 'x'}=OUTSIDE/folder",
            f"{'run' if command != 'report' else 'x'}='a\u0000b'",
            f"{'run' if command != 'report' else 'x'}=[1,2]",
            f"{'policy' if command != 'report' else 'x'}=OUTSIDE/config.pickle",
            "hold=os.system",
            "reward@common_reward=../../evil",
            "position=[nan,nan,nan]",
            "workers=-1",
        ):
            run = () if command == "report" or word.startswith("run") else (f"run={RUN}",)
            extra = ("episodes=1",) if command == "render" else ()
            unused = command == "render" and word.startswith("results_dir")
            yield Case("override", f"{command} {word[:60]}", (command, *run, *extra, word), evil, accepted=unused)
    for options in _OPTIONS:
        yield Case("option", " ".join(options), ("train", *_FEW_RUNS, *options), evil)
        if "OUTSIDE" in options[0] + options[-1]:
            words = ("-sc", "query=bash", *options)
            yield Case("option", f"-sc and {' '.join(options)}", words, evil, {"COMP_LINE": "uarm-rl train "}, accepted=True)
    for line in (
        "uarm-rl train --config-dir=OUTSIDE experiment=",
        f"uarm-rl train hydra.callbacks.x._target_={PAYLOAD}.Callback ",
        "uarm-rl train hydra.searchpath=[file://OUTSIDE] experiment=",
        "uarm-rl train experiment=../../",
        "uarm-rl train $(touch CANARY) `touch CANARY`",
        "uarm-rl \x1b[2J",
        "uarm-rl train " + "[" * 5000,
    ):
        completion = {"COMP_LINE": line, "COMP_POINT": str(len(line))}
        yield Case("completion", line[:60], ("-sc", "query=bash"), evil, completion, accepted=True)
    for name, value in (
        ("HYDRA_FULL_ERROR", "1"),
        ("HYDRA_MAIN_MODULE", PAYLOAD),
        ("HYDRA_CONFIG_DIR", "OUTSIDE"),
        ("MPLBACKEND", f"module://{PAYLOAD}"),
        ("PYTHONIOENCODING", "ascii"),
        ("COMP_LINE", "uarm-rl train -sc"),
        ("TQDM_DISABLE", "CANARY"),
        ("OPENBLAS_NUM_THREADS", "-1"),
        ("COLUMNS", "9" * 50),
        ("TMPDIR", "OUTSIDE"),
    ):
        words = REPORT if name in ("MPLBACKEND", "COLUMNS", "TMPDIR") else ("train", "-m", *_FEW_RUNS)
        yield Case("environment", name, words, evil, {name: value}, accepted=True)


def starts() -> Iterator[Case]:
    """A working directory full of traps: modules, plugins, configurations that a start could pick up."""
    trap = f"import {PAYLOAD}\n"
    modules = (
        "uarm_rl/__init__",
        "uarm_rl/cli",
        "sitecustomize",
        "usercustomize",
        "hydra",
        "yaml",
        "numpy",
        "torch",
        "conf/__init__",
    )
    code = every(*(put(f"{name}.py", trap) for name in (*modules, "hydra_plugins/hostile/__init__", "hydra_plugins/hostile")))
    conf = every(
        *(put(f"{folder}/train.yaml", _EVIL) for folder in (".", "conf", ".hydra", "uarm_rl/conf")),
        put(".hydra/config.yaml", _EVIL),
        put(".hydra/overrides.yaml", f"- hydra.callbacks.x._target_={PAYLOAD}.Callback\n"),
    )
    style = (
        f"backend: module://{PAYLOAD}\ntext.usetex: True\ntext.latex.preamble: \\immediate\\write18{{touch CANARY}}\n"
        "axes.prop_cycle: cycler('color', [().__class__.__base__.__subclasses__()])\n"
        "animation.ffmpeg_path: CANARY\nsavefig.directory: OUTSIDE\n"
    )
    for words in (("train", "-m", *_FEW_RUNS), EVALUATE, REPORT):
        traps = every(code, conf, put("matplotlibrc", style), put("pyvenv.cfg", "home = OUTSIDE\n"))
        yield Case("start in a hostile folder", " ".join(words[:2]), words, traps, accepted=True, fresh=True)


def configurations() -> Iterator[Case]:
    """Every hostile command line, environment and working directory."""
    yield from command_lines()
    yield from starts()


# Running a case


def child(case: Case, box: Box, control: Callable[[], Any] | None) -> None:
    """In the forked process: become the command."""
    os.setsid()
    enter(box, case.environment)
    sys.argv = ["uarm-rl", *map(box.fill, case.words)]
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))
    from tqdm import tqdm

    from uarm_rl import cli

    tqdm.set_lock(threading.RLock())  # its own is shared with the other cases, and kept by those that are killed
    if control:
        control()
    WATCH.arm(box.root / "events", [box.cwd / name for name in ("results", "half", *case.allowed)])
    code = 0
    try:
        cli.main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 70
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def enter(box: Box, environment: Mapping[str, str]) -> None:
    os.chdir(box.cwd)
    os.environ.update({name: box.fill(value) for name, value in environment.items()}, HOSTILE_CANARY=box.fill("CANARY"))
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(box.root / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)


def alone(root: Path, words: Sequence[str]) -> None:
    """In an interpreter of its own: what the installed command does, with the hook armed before it is imported."""
    box = Box(root)
    WATCH.arm(root / "events", [box.cwd / "results", box.cwd / "half", Path(os.environ["MPLCONFIGDIR"])], starting=True)
    sys.argv = ["uarm-rl", *words]
    from uarm_rl.cli import main as command

    command()


def start(case: Case, box: Box, control: Callable[[], Any] | None, payload: Path) -> int:
    """Begin a case in a process group of its own; its process id."""
    if not case.fresh:
        if process := os.fork():
            return process
        try:
            child(case, box, control)
        finally:
            os._exit(71)
    if process := os.fork():
        return process
    try:
        os.setsid()
        enter(box, case.environment)
        environment = os.environ | {"PYTHONPATH": str(payload)}
        words = [sys.executable, __file__, "--alone", str(box.root), *map(box.fill, case.words)]
        os.execve(sys.executable, words, environment)
    finally:
        os._exit(71)


def snapshot(root: Path, inside: Iterable[Path]) -> dict[str, str]:
    """Kind, content and target of everything below ``root`` that is not ``inside``."""
    state = {}
    for folder, names, names_of_files in os.walk(root):
        names[:] = [name for name in names if Path(folder) / name not in inside]
        for name in (*names, *names_of_files):
            path = os.path.join(folder, name)
            seen = os.lstat(path)
            content = os.readlink(path) if os.path.islink(path) else ""
            if stat.S_ISREG(seen.st_mode):
                with open(path, "rb") as file:
                    content = f"{seen.st_size} bytes, {hashlib.sha256(file.read(1 << 20)).hexdigest()}"
            state[path] = f"{seen.st_mode:o} {content}"
    return state


def complaints(case: Case, box: Box, status: int | None, before: dict[str, str]) -> list[str]:
    """What is wrong with how a case ended; empty if nothing."""
    found = (box.root / "events").read_text(errors="replace").splitlines() if (box.root / "events").exists() else []
    found = [f"executed or wrote: {line}" for line in dict.fromkeys(found)][:5]
    after = snapshot(box.root, _inside(case, box))
    for name in ("events", "stdout", "stderr"):
        after.pop(str(box.root / name), None)
    found += [
        f"changed outside: {Path(path).relative_to(box.root)}"
        for path in sorted(before.keys() | after.keys())
        if before.get(path) != after.get(path)
    ][:5]
    errors = (box.root / "stderr").read_text(errors="replace") if (box.root / "stderr").exists() else ""
    lines = [line for line in errors.replace("\r", "\n").splitlines() if line.strip()]
    sentences = [line for line in lines if line.startswith("error: ")]
    if status is None:
        return [*found, "hung"]
    if os.WIFSIGNALED(status):
        return [*found, f"died of {signal.Signals(os.WTERMSIG(status)).name}"]
    code = os.WEXITSTATUS(status)
    if "Traceback (most recent call last)" in errors:
        found.append("traceback")
    if code == 0 and not case.accepted:
        found.append("accepted")
    if code and (len(sentences) != 1 or lines[-1] != sentences[0]):
        found.append(f"{len(sentences)} error lines" if len(sentences) != 1 else "something behind the error line")
    if any("this is a bug" in line for line in sentences):
        found.append("an error without a type")
    if any(len(line) > LONGEST_LINE for line in sentences):
        found.append("an endless error line")
    if any(not character.isprintable() for line in sentences for character in line):
        found.append("control characters in the error line")
    if wrong := case.check(box):
        found.append(wrong)
    return found


def _inside(case: Case, box: Box) -> list[Path]:
    return [box.cwd / name for name in ("results", "half", *case.allowed)]


class Result(NamedTuple):
    """How a case ended."""

    group: str
    what: str
    control: str
    complaints: list[str]
    last_line: str
    seconds: float


def play(cases: Iterable[tuple[Case, str]], template: Path, folder: Path, payload: Path) -> Iterator[Result]:
    """Run cases, each with the name of a control or none, as many beside each other as there are cores and one more."""
    waiting = list(enumerate(cases))[::-1]
    running: dict[int, tuple[Case, str, Box, dict[str, str], float]] = {}
    while waiting or running:
        while waiting and len(running) <= len(os.sched_getaffinity(0)):
            number, (case, control) = waiting.pop()
            box = Box(folder / str(number))
            shutil.copytree(template, box.root, symlinks=True)
            case.prepare(box)
            before = snapshot(box.root, _inside(case, box))
            broken = CONTROLS[control].apply if control else None
            running[start(case, box, broken, payload)] = case, control, box, before, time.perf_counter()
        for process, (case, control, box, before, began) in list(running.items()):
            seconds = time.perf_counter() - began
            done, status = os.waitpid(process, os.WNOHANG)
            if not done and seconds < LIMIT_S:
                continue
            with suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)  # it and what it left behind
            if not done:
                os.waitpid(process, 0)
            del running[process]
            found = complaints(case, box, status if done else None, before)
            errors = (box.root / "stderr").read_bytes()[-2000:].decode(errors="replace").strip().splitlines()
            yield Result(case.group, case.what, control, found, errors[-1][:300] if errors else "", round(seconds, 2))
            for path, _, _ in os.walk(box.root):
                os.chmod(path, 0o700)
            shutil.rmtree(box.root)
        time.sleep(0.005)


# Controls: what the harness must catch


class Control(NamedTuple):
    """A broken variant of the package, and the groups of cases that it should fall for."""

    apply: Callable[[], Any]
    groups: tuple[str, ...]


def unsafe_yaml() -> None:
    """Configurations read with YAML's Python tags."""
    import yaml

    mock.patch.object(yaml, "safe_load", yaml.unsafe_load).start()


def unpickled() -> None:
    """Policies and checkpoints read with ``torch.load``."""
    import io

    import torch

    from uarm_rl.learn import checkpoint as module
    from uarm_rl.task.policy import ActorPolicy

    def load(data: bytes) -> Any:
        return torch.load(io.BytesIO(data), weights_only=False)

    mock.patch.object(ActorPolicy, "load", lambda path: load(path.read_bytes())).start()
    mock.patch.object(module, "load", load).start()


def unchecked_words() -> None:
    """Hydra's own settings let through."""
    from uarm_rl import cli

    mock.patch.object(cli, "check", return_value=None).start()


def following_links() -> None:
    """A results file opened where it is, links and all."""
    from uarm_rl import files as module

    mock.patch.object(module, "replace", lambda path, data: path.write_bytes(data)).start()


CONTROLS = {
    "unsafe yaml": Control(unsafe_yaml, ("yaml tag",)),
    "unpickled": Control(unpickled, ("pickle as policy", "pickle as checkpoint")),
    "following links": Control(following_links, ("link as result",)),
    "unchecked words": Control(unchecked_words, ("Hydra's settings, many runs",)),
}
GROUPS: dict[str, tuple[Callable[[], Iterator[Case]], tuple[str, ...]]] = {
    "hostile files": (files, ("unsafe yaml", "unpickled", "following links")),
    "hostile configurations and overrides": (configurations, ("unchecked words",)),
}


# The process that runs the cases


def make_template(template: Path, payload: Path) -> None:
    """A finished and evaluated run, the same run half done, and a module that must not be imported."""
    from uarm_rl import cli, configuration
    from uarm_rl.commands import evaluate as commands_evaluate
    from uarm_rl.commands import render as commands_render
    from uarm_rl.commands import report as commands_report
    from uarm_rl.commands import train as commands_train
    from uarm_rl.learn import checkpoint as module

    box = Box(template)
    box.cwd.mkdir(parents=True)
    (box.outside / "folder").mkdir(parents=True)
    (box.outside / "victim.txt").write_text("precious\n")
    (box.outside / "folder" / "keep.txt").write_text("precious\n")
    payload.mkdir()
    text = "import os\nopen(os.environ['HOSTILE_CANARY'], 'w').close()\nrun = Run = Callback = dict\n"
    (payload / f"{PAYLOAD}.py").write_text(text)
    sys.path.append(str(payload))
    os.chdir(box.cwd)
    write = module.write

    def stop_there(*arguments: Any) -> None:
        write(*arguments)
        raise KeyboardInterrupt

    with mock.patch.object(module, "write", stop_there), suppress(KeyboardInterrupt):
        commands_train.run(configuration.compose("train", TRAIN[1:]))
    shutil.copytree("half", "results")
    commands_train.run(configuration.compose("train", (*TRAIN[1:-2], "resume=true", "results_dir=results")))
    shutil.copytree("results", "rest")
    commands_evaluate.run(configuration.compose("evaluate", EVALUATE[1:]))
    # Everything that a case may import is imported once; what these leave behind is not in the template.
    commands_report.run(configuration.compose("report", ("results_dir=results",)))
    commands_render.run(configuration.compose("render", RENDER[1:]))
    sys.argv = ["uarm-rl", "train", "-m", *_FEW_RUNS]
    cli.main()
    shutil.copy(RUN + "/evaluation.csv", "rest/toy/seed0")
    shutil.rmtree("results")
    os.rename("rest", "results")
    for path in template.rglob(".lock"):
        path.unlink()


def serve(folder: Path, every_nth: int, control_nth: int) -> None:
    """Make the template, run the cases, and write their results as JSON lines to ``folder / "results"``."""
    sys.dont_write_bytecode = True
    # What matplotlib and torch keep from one start to the next is theirs.
    os.environ["MPLCONFIGDIR"] = os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(folder / "cache")
    payload, template = folder / "payload", folder / "template"
    make_template(template, payload)
    gc.freeze()
    (folder / "cases").mkdir()
    cases: list[tuple[Case, str]] = []
    for make, controls in GROUPS.values():
        listed = list(make())
        cases += [(case, "") for case in listed[::every_nth]]
        for name in controls:
            cases += [(case, name) for case in [case for case in listed if case.group in CONTROLS[name].groups][::control_nth]]
    with open(folder / "results", "w", encoding="utf-8") as file:
        for result in play(cases, template, folder / "cases", payload):
            file.write(json.dumps(result) + "\n")
            file.flush()


# The table


def run(every_nth: int, control_nth: int, tell: Callable[[str], object]) -> list[Result]:
    """All cases (or every nth) and every nth case of each control, in a process of their own."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-B", __file__, "--serve", folder, str(every_nth), str(control_nth)]
        done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"the cases could not be run:\n{done.stdout[-3000:]}")
        with open(Path(folder) / "results", encoding="utf-8") as file:
            results = [Result(*json.loads(line)) for line in file]
    for result in results:
        if result.complaints and not result.control:
            tell(f"{result.group}: {result.what}: {'; '.join(result.complaints)} [{result.last_line}]")
    return results


def table(every_nth: int = 1, control_nth: int = 3, tell: Callable[[str], object] = print) -> Iterator[Any]:
    """The rows for the table of ``tests.torture``; ``tell`` gets a line for each case that failed."""
    from tests.torture import Row

    results = run(every_nth, control_nth, tell)
    for title, (make, controls) in GROUPS.items():
        names = {(case.group, case.what) for case in make()}
        mine = [result for result in results if not result.control and (result.group, result.what) in names]
        words = []
        for name in controls:
            tried = [result for result in results if result.control == name]
            caught = sum(any(words.startswith(("executed", "changed")) for words in result.complaints) for result in tried)
            words.append(f"{'' if caught else 'NOT CAUGHT: '}{name}: {caught} of {len(tried)} seen")
        words.sort(key=lambda text: not text.startswith("NOT"))
        yield Row(title, len(mine), sum(bool(result.complaints) for result in mine), "a list", ", ".join(words))


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; 1 if a case failed or a control was not caught, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=1, help="take every nth case")
    parser.add_argument("--controls", type=int, default=3, help="take every nth case of a control")
    parser.add_argument("--out", type=Path, help="CSV file for the table")
    arguments = parser.parse_args(argv)
    rows = list(table(arguments.every, arguments.controls, partial(print, flush=True)))
    for row in rows:
        print(f"{row.what:58} {row.trials:6} trials  {row.failures:3} failures  {row.bound:12} {row.control}", flush=True)
    if arguments.out:
        from uarm_rl.csvfile import write_rows

        write_rows(arguments.out, rows[0]._fields, [row._asdict() for row in rows])
    return int(any(row.failures or row.control.startswith("NOT") for row in rows))


WATCH = Watch()

if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        sys.addaudithook(WATCH)
        serve(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
    elif sys.argv[1:2] == ["--alone"]:
        sys.addaudithook(WATCH)
        alone(Path(sys.argv[2]), sys.argv[3:])
    else:
        sys.exit(main())
