"""Hostile files, each with the command that reads it."""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from itertools import cycle, product
from typing import Any

from tests.hostile.case import (
    EVALUATE,
    HALF,
    RENDER,
    REPORT,
    RUN,
    TOY,
    TRAIN,
    Box,
    Case,
    Prepare,
    every,
    folder,
    giant,
    link,
    pipe,
    put,
    renamed,
)
from tests.hostile.hook import PAYLOAD
from tests.hostile.tensors import BROKEN

# Configurations: what stands in place of a key of a good one, behind the rest ("": nothing is left out; None: alone)

TAGS = {
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
PLACES = {
    "alone": (None, "TAG\n"),
    "a new key": ("", "extra: TAG\n"),
    "servo": ("servo", "servo: TAG\n"),
    "inside sim": ("sim", "sim: {physics_hz: TAG}\n"),
    "in a list": ("tolerance_m", "tolerance_m: [1, [TAG]]\n"),
    "a key": ("", "? TAG\n: 1\n"),
    "merged": ("", "<<: TAG\n"),  # takes a mapping for what it is, whatever its tag says
    "second document": ("", "---\nTAG\n"),
}
LAUGHS = "l0: &l0 [ha]\n" + "".join(f"l{n}: &l{n} [{', '.join([f'*l{n - 1}'] * 10)}]\n" for n in range(1, 10))
MERGES = "m0: &m0 {a: 1}\n" + "".join(f"m{n}: &m{n} {{<<: [{', '.join([f'*m{n - 1}'] * 10)}]}}\n" for n in range(1, 10))
BOMBS = {
    "billion laughs as servo": ("servo", f"{LAUGHS}servo: *l9\n"),
    "billion laughs as tolerance": ("tolerance_m", f"{LAUGHS}tolerance_m: *l9\n"),
    "billion laughs aside": ("", LAUGHS),
    "laughs as a key": ("", f"{LAUGHS}? *l9\n: 1\n"),
    "a billion merges": ("", MERGES),
    "merged with itself": ("", "r: &r {<<: *r}\n"),
    "recursive group": ("buffer", "buffer: &r {x: *r}\n"),
    "recursive list": ("control_hz", "control_hz: &r [*r]\n"),
    "500 lists deep": ("", f"deep: {'[' * 500}{']' * 500}\n"),
    "100 000 lists deep": ("", f"deep: {'[' * 100_000}{']' * 100_000}\n"),
    "100 000 maps deep": (None, "{a: " * 100_000),
    "an int of a million digits": ("control_hz", f"control_hz: 1{'0' * 10**6}\n"),
    "a sexagesimal int": ("control_hz", f"control_hz: 1{':59' * 10**4}\n"),
}
CODE = {
    "a target as sim": ("sim", "sim: {_target_: os.system}\n"),
    "another urdf": ("sim", "sim: {urdf: OUTSIDE/evil.urdf}\n"),
    "a function as servo": ("servo", "servo: {name: os.system, command: 'touch CANARY'}\n"),
    "a target beside the name": ("servo", f"servo: {{name: second_order, _target_: {PAYLOAD}.run}}\n"),
    "a path as reward": ("reward", "reward: {name: ../../evil}\n"),
    "an attribute": ("reward", "reward: {name: plain, __class__: x}\n"),
    "partial": ("buffer", "buffer: {hold: {name: until_steady, _partial_: true}}\n"),
    "interpolations": ("", "x: ${oc.env:HOME}\nname: ${hydra:runtime.cwd}\n"),
}
OWN_HANDLE = f"%TAG !e! tag:yaml.org,2002:python/\n---\n!e!module:{PAYLOAD} ''\n"


class Call:
    """Unpickling it calls something."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call[0], self.call[1:]


def calls(box: Box) -> dict[str, Call]:
    canary = box.fill("CANARY")
    return {
        "a command": Call(os.system, f"touch {canary}"),
        "Python": Call(exec, f"open({canary!r}, 'w')"),
        "an import": Call(__import__, PAYLOAD),
    }


#: No YAML of a configuration, no JSON of a checkpoint, no CSV.
CONTENTS: dict[str, bytes] = {
    "empty": b"",
    "NULs": b"\0" * 100,
    "not UTF-8": b"name: \xff\xfe\n",
    "a list": b"[1, 2]",
    "a number": b"1",
    "a broken time": b"t: 2001-99-99\n",
    "a broken binary": b"t: !!binary 'x'\n",
    "an escape code": b"\x1b[2J\x1b]0;owned\x07: 1\n",
    "only braces": b"{{{{",
    "a pickle": pickle.dumps(Call(os.system, "touch CANARY")),
    "a name with a path": b'{"../../../../../outside/victim.txt": "x"}',
    "100 000 lists deep": b"[" * 100_000 + b"]" * 100_000,
    "an int of many digits": b"1" + b"0" * 100_000,
    "a cell of a megabyte": b"position,success\n" + b"1" * 2**20 + b",1\n",
    "a quote left open": b'position,success\n"=cmd|calc,1\n' + b"x" * 200_000,
}


def config(key: str | None, text: str) -> Prepare:
    """The run's configuration with ``text`` in place of a key, or of all of it."""

    def prepare(box: Box) -> None:
        import yaml

        path = box.path(f"{RUN}/config.yaml")
        settings = yaml.safe_load(path.read_text())
        settings.pop(key, None)
        good = "" if key is None else yaml.safe_dump(settings, sort_keys=False)
        path.write_text(good + box.fill(text), encoding="utf-8")

    return prepare


def configurations() -> Iterator[Case]:
    commands = cycle((EVALUATE, RENDER, ("evaluate", "results_dir=results", "overwrite=true")))
    for number, (tag, text) in enumerate(TAGS.items()):
        for place, (key, around) in list(PLACES.items())[number % 2 :: 2]:
            prepare = config(key, around.replace("TAG", text))
            yield Case("yaml tag", f"{tag}, {place}", next(commands), prepare, accepted=place == "merged")
    yield Case("yaml tag", "own handle", EVALUATE, config(None, OWN_HANDLE))
    yield Case("yaml tag", "in a run to resume", TRAIN, put(f"{HALF}/config.yaml", TAGS["os.system"]))
    for group, table in (("yaml bomb", BOMBS), ("code in a configuration", CODE)):
        for what, (key, text) in table.items():
            yield Case(group, what, next(commands), config(key, text), accepted=what == "interpolations")
    for what, data in CONTENTS.items():
        yield Case("contents", f"config.yaml: {what}", next(commands), put(f"{RUN}/config.yaml", data))


# Policies and checkpoints


def as_zip(content: object, **how: Any) -> bytes:
    import torch

    buffer = io.BytesIO()
    torch.save(content, buffer, **how)
    return buffer.getvalue()


#: Files that run something when unpickled.
PICKLES: dict[str, Callable[[Call], bytes]] = {
    "pickle 0": lambda call: pickle.dumps(call, 0),
    "pickle 5": lambda call: pickle.dumps(call, 5),
    "torch's zip": lambda call: as_zip({"weight0": call}),
    "torch's old file": lambda call: as_zip(call, _use_new_zipfile_serialization=False),
}


def part(name: str, make: Callable[[Box], bytes]) -> Prepare:
    """A part of the half run's checkpoint replaced, and the manifest made to fit."""

    def prepare(box: Box) -> None:
        data, manifest = make(box), box.path("CHECKPOINT/manifest.json")
        put(f"CHECKPOINT/{name}", data)(box)
        manifest.write_text(json.dumps(json.loads(manifest.read_bytes()) | {name: hashlib.sha256(data).hexdigest()}))

    return prepare


def trained() -> Iterator[Case]:
    commands = cycle((EVALUATE, RENDER))
    policy, arrays = f"{RUN}/policy.safetensors", "arrays.safetensors"
    for kind, number in product(PICKLES, range(3)):

        def make(box: Box, kind: str = kind, number: int = number) -> bytes:
            return PICKLES[kind](list(calls(box).values())[number])

        yield Case("pickle as policy", f"{kind}, {number}", next(commands), lambda box, m=make: put(policy, m(box))(box))
        yield Case("pickle as checkpoint", f"{kind}, {number}", TRAIN, part(arrays, make))
    for what in ("escape code as format", "huge format name", "deep metadata"):  # the first two come back in the sentence
        yield Case("broken tensors", f"policy: {what}", next(commands), put(policy, BROKEN[what]))
        yield Case("broken tensors", f"checkpoint: {what}", TRAIN, part(arrays, lambda box, w=what: BROKEN[w]))
    for what, data in CONTENTS.items():
        yield Case("contents", f"manifest.json: {what}", TRAIN, put("CHECKPOINT/manifest.json", data))
        yield Case("contents", f"state.json: {what}", TRAIN, part("state.json", lambda box, d=data: d))
    for name in ("checkpoint-000099", "checkpoint-" + "9" * 200, "checkpoint-\u00b2"):
        yield Case("checkpoint's name", name[:30], TRAIN, renamed("CHECKPOINT", name))
    only_a_file = every(renamed("CHECKPOINT", "x"), put(f"{HALF}/checkpoint-000001", b"x"))
    yield Case("checkpoint's name", "only a file", TRAIN, only_a_file)


# What may lie where a file is expected: links, pipes, folders, files without end

_OUTPUTS = ("evaluation.csv", "table1.md", "learning_curves.png")  # where a link that is followed is noticed
_NEW = (".lock", "episode.gif", "progress.csv", "evaluation.csv.tmp")
_ENDLESS = ("config.yaml", "policy.safetensors", "manifest.json", "paper.csv", "p.csv")
_TRAINS = "config.yaml config.yaml.tmp progress.csv progress.csv.tmp .lock policy.safetensors.tmp checkpoint-000001 "
_TRAINS += "checkpoint-000002 checkpoint-000002.tmp "
_TRAINS += "CHECKPOINT/manifest.json CHECKPOINT/state.json CHECKPOINT/arrays.safetensors"
_OWN_POSITIONS = (*EVALUATE, "positions=p.csv", "out=results/out.csv")
WHERE = (
    (TRAIN, HALF, _TRAINS),
    (("train", *TOY, "results_dir=half", "overwrite=true"), HALF, "config.yaml .lock x"),
    (EVALUATE, RUN, "config.yaml policy.safetensors evaluation.csv evaluation.csv.tmp"),
    (RENDER, RUN, "episode.gif"),
    (REPORT, RUN, "progress.csv evaluation.csv"),
    (REPORT, "results", "paper.csv table1.md table1.md.tmp table1.csv.tmp learning_curves.png"),
)


def places() -> Iterator[Case]:
    for words, where, names in WHERE:
        for name in names.split():
            path = name if name.startswith("CHECKPOINT") else f"{where}/{name}"
            what = f"{words[0]}{' overwriting' * (words[-1] == 'overwrite=true')}: {path}"
            targets = ["OUTSIDE/victim.txt" if "." in name else "OUTSIDE/folder"]
            targets += ["OUTSIDE/new.txt"] * (name in _NEW) + ["/dev/zero"] * (name in _ENDLESS)
            for target in targets:
                group = "link as result" if name in _OUTPUTS else "link"
                yield Case(group, f"{what} -> {target}", words, link(path, target), accepted=True)
            yield Case("pipe", what, words, pipe(path), accepted=True)
            yield Case("folder", what, words, folder(path), accepted=True)
    for what, prepare in (("a pipe", pipe), ("a folder", folder), ("a terabyte", lambda it: every(put(it, b"x_m"), giant(it)))):
        yield Case("positions", what, _OWN_POSITIONS, prepare("p.csv"))
    yield Case("positions", "zeros", _OWN_POSITIONS, link("p.csv", "/dev/zero"))
    yield Case("link", "the run itself, to a foreign folder", EVALUATE, link(RUN, "OUTSIDE/folder"))
    for name in ("tensorboard", "wandb"):
        yield Case("link", name, (*TRAIN, f"logger={name}"), link(f"{HALF}/{name}", "OUTSIDE/folder"), accepted=True)
    for target in ("OUTSIDE/folder", "OUTSIDE/new"):
        many = ("train", "-m", *TOY, "results_dir=half", "resume=true")
        yield Case("link", f".hydra of many runs -> {target}", many, link("half/.hydra", target), accepted=True)
    for words, path in (
        *((REPORT, f"{RUN}/progress.csv"), (REPORT, f"{RUN}/evaluation.csv"), (TRAIN, f"{HALF}/progress.csv")),
        *((EVALUATE, f"{RUN}/config.yaml"), (RENDER, f"{RUN}/policy.safetensors")),
        *((TRAIN, "CHECKPOINT/arrays.safetensors"), (TRAIN, "CHECKPOINT/state.json")),
    ):
        yield Case("giant", f"{words[0]}: {path}", words, giant(path))


# Tables, and names of runs that end up in tables

NAMES = ["=HYPERLINK(1)", "@SUM(1)", "+1+1", "-1+1", "a|b", "<script>", "$\\input{x}$", "\x1b[2J", "%s{0}", "CANARY"]
SEEDS = ("seed-1", "seed1e9", "seed" + "9" * 200, "seed\u0663")
FORMULAS = ("=1+1", "=cmd|' /C calc'!A0", "@SUM(1)", "__import__('os').system('touch CANARY')")


def formulas(box: Box) -> str | None:
    for path in sorted((box.cwd / "results").glob("*.csv")):
        if any(line.startswith(("=", "@", "+", "-")) for line in path.read_text().splitlines()):
            return f"a formula in {path.name}"
    return None


def tables() -> Iterator[Case]:
    for what, data in CONTENTS.items():
        for words, path in ((REPORT, f"{RUN}/evaluation.csv"), (REPORT, f"{RUN}/progress.csv"), (_OWN_POSITIONS, "p.csv")):
            yield Case("contents", f"{path}: {what}", words, put(path, data))
    for formula in FORMULAS:
        yield Case("table", f"paper.csv: {formula}", REPORT, put("results/paper.csv", f"method,success_rate\nA,{formula}\n"))
        yield Case("table", f"positions: {formula}", _OWN_POSITIONS, put("p.csv", f"x_m,y_m,z_m\n{formula},0,0.03\n"))
    for name in (*NAMES, "a\nb"):
        yield Case("table", f"a run named {name!r}", REPORT, renamed("results/toy", name), accepted=True, check=formulas)
    for name in SEEDS:

        def copied(box: Box, name: str = name) -> None:
            shutil.copytree(box.path(RUN), box.path(RUN).with_name(name))

        yield Case("table", f"a folder named {name[:20]}", REPORT, copied, accepted=True)


def cases() -> Iterator[Case]:
    """Every hostile file."""
    for make in (configurations, trained, places, tables):
        yield from make()
