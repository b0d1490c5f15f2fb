"""Policies: a trained actor as one small file and one numpy forward pass, and the inverse-kinematics baseline.

Needs neither torch nor PyBullet, so that it runs on the lab machine beside the arm.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from uarm_rl import files
from uarm_rl.task import kinematics, observation

Array = NDArray[np.float32]
Layers = Sequence[tuple[Array, Array]]

FILE: Final = "policy.safetensors"  # its name in a run folder

_FORMAT = "uarm-rl policy 1"  # the one key of the file's metadata: with two, their order would be random
_MAX_BYTES = 64 * 1024 * 1024


class PolicyFileError(ValueError):
    """A policy file that is not what it claims to be; the message is a sentence."""


class Policy(Protocol):
    """Whatever turns an observation into an action."""

    def act(self, observation: Array) -> Array:
        """Greedy action, shape (3,), in [-1, 1], for one observation, shape (20,)."""
        ...


def scale(raw: Array) -> Array:
    """Observations, shape (..., 20), brought to about unit range by the fixed scaling."""
    scaled: Array = (raw - observation.OFFSET) / observation.SCALE
    return scaled


class ActorPolicy:
    """A fully connected actor: ReLU after each hidden layer, tanh at the output.

    ``layers`` holds a (weight (inputs, outputs), bias (outputs,)) pair per layer, float32; they may be views of a
    learner's parameters, which the policy then follows. ``metadata`` is what a user of the policy has to know:
    ``max_delta_rad`` and the ``hold`` it was trained with.
    """

    def __init__(self, layers: Layers, *, offset: Array, scale: Array, metadata: dict[str, Any]) -> None:
        self.layers = tuple(layers)
        self.offset = offset
        self.scale = scale
        self.metadata = metadata
        self._hidden = [np.empty(bias.shape, np.float32) for _, bias in self.layers]

    def act(self, observation: Array) -> Array:
        x = (observation - self.offset) / self.scale
        for (weight, bias), hidden in zip(self.layers[:-1], self._hidden, strict=False):
            np.dot(x, weight, out=hidden)
            hidden += bias
            x = np.maximum(hidden, 0.0, out=hidden)
        weight, bias = self.layers[-1]
        action: Array = np.tanh(np.dot(x, weight) + bias)
        return action

    def save(self, path: Path) -> None:
        """Write the policy as one safetensors file, replacing an old one atomically."""
        files.replace(path, self._encode())

    def _encode(self) -> bytes:
        """The file's bytes: a function of the policy, so that any other bytes are refused when read."""
        from safetensors.numpy import save

        tensors = {"offset": self.offset, "scale": self.scale}
        for number, (weight, bias) in enumerate(self.layers):
            tensors[f"weight{number}"], tensors[f"bias{number}"] = weight, bias
        tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
        text = json.dumps(self.metadata, sort_keys=True)
        digest = hashlib.sha256(save(tensors) + text.encode()).hexdigest()
        return save(tensors, metadata={_FORMAT: json.dumps({"policy": self.metadata, "sha256": digest}, sort_keys=True)})

    @classmethod
    def load(cls, path: Path) -> ActorPolicy:
        """Read a policy file. Raises :class:`PolicyFileError` for anything else, :class:`OSError` if unreadable."""
        from safetensors import SafetensorError
        from safetensors.numpy import load

        data = files.read(path, at_most=_MAX_BYTES)
        try:
            tensors = load(data)
            header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
            if _FORMAT not in header:
                raise PolicyFileError(f"{path} is no policy of uarm-rl: its format is {', '.join(header)}, not {_FORMAT}")
            metadata = json.loads(header[_FORMAT])["policy"]
            count = sum(name.startswith("weight") for name in tensors)
            layers = [(tensors[f"weight{number}"], tensors[f"bias{number}"]) for number in range(count)]
            policy = cls(layers, offset=tensors["offset"], scale=tensors["scale"], metadata=metadata)
            whole = policy._encode() == data
        except (SafetensorError, KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
            if isinstance(error, PolicyFileError):
                raise
            whole = False
        if not whole:
            raise PolicyFileError(f"{path} is truncated, damaged or no policy of uarm-rl; train it again")
        policy._check(path)
        return policy

    def _check(self, path: Path) -> None:
        widths = [observation.SIZE, *(weight.shape[-1] if weight.ndim == 2 else -1 for weight, _ in self.layers)]
        shapes = all(
            weight.shape == (inputs, outputs) and bias.shape == (outputs,)
            for (weight, bias), inputs, outputs in zip(self.layers, widths, widths[1:], strict=False)
        )
        arrays = [self.offset, self.scale, *(array for layer in self.layers for array in layer)]
        if not (self.layers and shapes and widths[-1] == 3 and self.offset.shape == self.scale.shape == (observation.SIZE,)):
            raise PolicyFileError(f"{path} is a policy for another arm: it needs 20 inputs and 3 outputs, has layers {widths}")
        if not all(array.dtype == np.float32 and np.isfinite(array).all() for array in arrays) or (self.scale == 0).any():
            raise PolicyFileError(f"{path} holds weights that are not finite float32 numbers; train it again")
        if not isinstance(self.metadata, dict) or not {"max_delta_rad", "hold"} <= self.metadata.keys():
            raise PolicyFileError(f"{path} lacks max_delta_rad or hold in its metadata; train it again")


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
