"""Files that are no safetensors, or hostile ones: for everything that reads policies or checkpoints."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any


def safetensors(header: dict[str, Any] | bytes, data: bytes = b"", length: int | None = None) -> bytes:
    """A file with any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + data


def one(start: int, end: int, shape: Sequence[int] = (2,), dtype: str = "F32") -> dict[str, Any]:
    return {"weight0": {"dtype": dtype, "shape": list(shape), "data_offsets": [start, end]}}


_SIGN = "uarm-rl policy 1"
_SIGNED = {"__metadata__": {_SIGN: json.dumps({"policy": {"_target_": "os.system"}, "sha256": "0"})}}

BROKEN = {
    "seven bytes": b"1234567",
    "a shell script": b"#!/bin/sh\ntouch CANARY\n",
    "giant header length": safetensors(b"{}", length=2**63),
    "header of 100 MB": safetensors(b" " * 100, length=100_000_001),
    "header a list": safetensors(b"[]"),
    "deep header": safetensors(b"[" * 100_000 + b"]" * 100_000),
    "deep metadata": safetensors(b'{"__metadata__":' + b'{"a":' * 50_000 + b"1" + b"}" * 50_001),
    "deep text in metadata": safetensors({"__metadata__": {_SIGN: '{"policy":' + "[" * 100_000 + "]" * 100_000 + "}"}}),
    "metadata a list": safetensors({"__metadata__": [_SIGN]}),
    "metadata of numbers": safetensors({"__metadata__": {_SIGN: 1}}),
    "metadata no JSON": safetensors({"__metadata__": {_SIGN: "os.system('true')"}}),
    "metadata without policy": safetensors({"__metadata__": {_SIGN: "{}"}}),
    "metadata null": safetensors({"__metadata__": {_SIGN: "null"}}),
    "escape code as format": safetensors({"__metadata__": {"\x1b[2J\x1b]0;owned\x07": "x"}}),
    "huge format name": safetensors({"__metadata__": {"x" * 1_000_000: "x"}}),
    "signed, no tensors": safetensors(_SIGNED),
    "signed, names of attributes": safetensors({"__class__": one(0, 8)["weight0"]} | _SIGNED, b"\0" * 8),
    "offsets beyond the file": safetensors(one(0, 2**40), b"\0" * 8),
    "shape overflows": safetensors(one(0, 8, (2**33, 2**33)), b"\0" * 8),
    "shape of 100 000 axes": safetensors(one(0, 4, (1,) * 100_000), b"\0" * 4),
    "unknown type": safetensors(one(0, 8, (2,), "PICKLE"), b"\0" * 8),
    "bytes behind the end": safetensors(one(0, 8), b"\0" * 8 + b"#!/bin/sh\ntouch CANARY\n"),
}
