"""Policies: a trained actor as one small file and one numpy forward pass, and the inverse-kinematics baseline.

Needs neither torch nor PyBullet, so that it runs on the lab machine beside the arm.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks, files
from uarm_rl.task import kinematics, observation

Array = NDArray[np.float32]
Numbers = NDArray[np.float32] | NDArray[np.float64]
Layers = Sequence[tuple[Numbers, Numbers]]

_FORMAT = "uarm-rl policy 1"  # the one key of the file's metadata: with two, their order would be random
_MAX_BYTES = 64 * 1024 * 1024


class PolicyFileError(ValueError):
    """A policy file that is not what it claims to be; the message is a sentence."""


class Policy(Protocol):
    """Whatever turns an observation into an action."""

    def act(self, observation: Array) -> Array:
        """Greedy action in [-1, 1] for one observation; shapes (3,) and (20,), unless the environment has others."""
        ...


@dataclass(frozen=True)
class PolicyCard:
    """What a policy file says of itself: how the policy is to be run, and how it was trained.

    ``hold``, ``servo``, ``cup`` and ``observation`` are configuration groups, chosen by their ``name``; lengths in metres,
    angles in radians. What is as it always was is not written, so that older versions read what they can run.
    """

    max_delta_rad: float
    control_hz: int
    hold: dict[str, Any]
    servo: dict[str, Any]
    tolerance_m: float
    dwell_s: float
    buffer: str
    reward: str
    episodes: int
    seed: int
    observation: dict[str, Any] = field(default_factory=lambda: {"name": "paper"})
    actions: str = "joint"  # what they are relative to
    cup: dict[str, Any] = field(default_factory=lambda: {"name": "rigid"})

    def __post_init__(self) -> None:
        checks.number("max_delta_rad", self.max_delta_rad, low=0.0, high=math.pi, open_low=True)
        checks.integer("control_hz", self.control_hz, low=1)
        checks.number("tolerance_m", self.tolerance_m, low=0.0, open_low=True)
        checks.number("dwell_s", self.dwell_s, low=0.0)
        for group in ("hold", "servo", "cup"):
            checks.text(f"{group}.name", checks.mapping(group, getattr(self, group)).get("name"))
        for name in ("buffer", "reward"):
            checks.text(name, getattr(self, name))
        for name in ("episodes", "seed"):
            checks.integer(name, getattr(self, name), low=0)
        observation.kind(self.observation)
        checks.text("actions", self.actions)

    @property
    def inputs(self) -> int:
        """How many numbers the policy sees."""
        return observation.kind(self.observation).size

    @property
    def outputs(self) -> int:
        """How many numbers its actions have: a learned hold adds one to the joints' three."""
        return 4 if self.hold["name"] == "learned" else 3

    def written(self) -> dict[str, Any]:
        """What is written into a file: all but what has its default."""
        values = asdict(self)
        for one in fields(self):
            usual = one.default if one.default_factory is MISSING else one.default_factory()
            if values[one.name] == usual:
                del values[one.name]
        return values

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> PolicyCard:
        """The card of a file; what an older file lacks has its default.

        Raises :class:`ValueError` with a sentence for a key that is missing, cannot be used, or is not known: a later version
        wrote it, for a policy that this one may not run as meant.
        """
        given = checks.mapping("the card", values).keys()
        if missing := [
            one.name for one in fields(cls) if one.default is one.default_factory is MISSING and one.name not in given
        ]:
            raise ValueError(f"its card lacks {missing[0]}")
        if unknown := sorted(given - {one.name for one in fields(cls)}):
            raise ValueError(f"its card has a key that this version does not know, {unknown[0]}")
        return cls(**values)


class ActorPolicy:
    """A fully connected actor: ReLU after each hidden layer, tanh at the output.

    ``layers`` holds a (weight (inputs, outputs), bias (outputs,)) pair per layer. They may be views of a learner's float32
    parameters, which the policy then follows and computes with. A policy that was read from a file computes in float64 and
    rounds the action to float32: in which order a processor sums a product then shows in no bit of it.
    """

    def __init__(self, layers: Layers, *, offset: Numbers, scale: Numbers, card: PolicyCard) -> None:
        self.layers = tuple(layers)
        self.offset = offset
        self.scale = scale
        self.card = card
        self._hidden = [np.empty_like(bias) for _, bias in self.layers]

    def act(self, observation: Array) -> Array:
        x = (observation - self.offset) / self.scale
        for (weight, bias), hidden in zip(self.layers[:-1], self._hidden, strict=False):
            np.dot(x, weight, out=hidden)
            hidden += bias
            x = np.maximum(hidden, 0.0, out=hidden)
        weight, bias = self.layers[-1]
        action: Array = np.tanh(np.dot(x, weight) + bias).astype(np.float32, copy=False)
        return action

    def save(self, path: Path) -> None:
        """Write the policy as one safetensors file of float32 numbers, replacing an old one atomically."""
        tensors = {"offset": self.offset, "scale": self.scale}
        for number, (weight, bias) in enumerate(self.layers):
            tensors[f"weight{number}"], tensors[f"bias{number}"] = weight, bias
        exact = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in tensors.items()}
        files.replace(path, encode(exact, self.card.written()))

    @classmethod
    def load(cls, path: Path) -> ActorPolicy:
        """Read a policy file. Raises :class:`PolicyFileError` for anything else, :class:`OSError` if unreadable."""
        from safetensors import SafetensorError
        from safetensors.numpy import load

        data = files.read(path, at_most=_MAX_BYTES)
        try:
            tensors = load(data)
            header = _header(data)["__metadata__"]
            if _FORMAT not in header:
                raise PolicyFileError(f"{path} is no policy of uarm-rl: its format is {', '.join(header)}, not {_FORMAT}")
            sign = json.loads(header[_FORMAT])
            if sign["sha256"] != _digest(data, sign["policy"]):
                raise ValueError("the hash is another")
        except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
            if isinstance(error, PolicyFileError):
                raise
            raise PolicyFileError(f"{path} is truncated, damaged or no policy of uarm-rl; train it again") from None
        try:
            card = PolicyCard.read(sign["policy"])
        except ValueError as error:
            raise PolicyFileError(f"{path} cannot be run as it was trained: {error}; train it again") from None
        _check(path, tensors, card)
        exact = {name: tensor.astype(np.float64) for name, tensor in tensors.items()}
        layers = [(exact[f"weight{number}"], exact[f"bias{number}"]) for number in range(len(tensors) // 2 - 1)]
        return cls(layers, offset=exact["offset"], scale=exact["scale"], card=card)


def encode(tensors: dict[str, Any], card: Any) -> bytes:
    """The bytes of a policy file: the tensors by name, and the card beside their hash."""
    from safetensors.numpy import save

    sign = {"policy": card, "sha256": _digest(save(tensors), card)}
    return save(tensors, metadata={_FORMAT: json.dumps(sign, sort_keys=True)})


def _header(data: bytes) -> dict[str, Any]:
    """The header of a safetensors file: eight bytes of length, then JSON."""
    header: dict[str, Any] = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return header


def _digest(data: bytes, card: Any) -> str:
    """SHA-256 of the tensors of a safetensors file, their names and shapes included, and of a card.

    The header is written out anew, without the metadata: what a later release of safetensors puts around it does not count.
    """
    tensors = {name: tensor for name, tensor in _header(data).items() if name != "__metadata__"}
    header = json.dumps(tensors, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    content = data[8 + int.from_bytes(data[:8], "little") :]
    text = json.dumps(card, sort_keys=True).encode()
    return hashlib.sha256(len(header).to_bytes(8, "little") + header + content + text).hexdigest()


def _check(path: Path, tensors: Mapping[str, Array], card: PolicyCard) -> None:
    """Raises :class:`PolicyFileError` unless the tensors are those of an actor for this arm, as its card says."""
    count = len(tensors) // 2 - 1
    names = {"offset", "scale", *(f"{kind}{number}" for kind in ("weight", "bias") for number in range(count))}
    widths = [card.inputs]
    fits = names == tensors.keys() and count > 0
    for number in range(count) if fits else ():
        weight, bias = tensors[f"weight{number}"], tensors[f"bias{number}"]
        widths.append(weight.shape[-1] if weight.ndim == 2 else -1)
        fits = fits and weight.shape == tuple(widths[-2:]) and bias.shape == (widths[-1],)
    if not fits or widths[-1] != card.outputs or {tensors[name].shape for name in ("offset", "scale")} != {(card.inputs,)}:
        needed = f"{card.inputs} inputs and {card.outputs} outputs"
        raise PolicyFileError(f"{path} is a policy for another arm: it needs {needed}, has layers {widths}")
    sound = all(tensor.dtype == np.float32 and np.isfinite(tensor).all() for tensor in tensors.values())
    if not sound or (tensors["scale"] == 0).any():
        raise PolicyFileError(f"{path} holds weights that are not finite float32 numbers; train it again")


@dataclass(frozen=True)
class InverseKinematicsPolicy:
    """The classical controller: each decision sends the joint difference to the target, cut to the action range.

    The cup first goes above the object and comes down when it is over it, so that it does not sweep the object away.
    """

    max_delta_rad: float
    hover_m: float = 0.03
    aligned_m: float = 0.01

    def act(self, observed: Array) -> Array:
        cup = observed[observation.CUP].astype(np.float64)
        joints = observed[observation.JOINTS].astype(np.float64)
        target = cup + observed[observation.CUP_TO_OBJECT]
        if np.hypot(*(target - cup)[:2]) > self.aligned_m:
            target = target + np.array([0.0, 0.0, self.hover_m])
        try:
            difference = kinematics.inverse(target) - joints
        except kinematics.UnreachableError:  # the object was pushed over the edge: wait
            difference = np.zeros(3)
        return np.clip(difference / self.max_delta_rad, -1.0, 1.0).astype(np.float32)
