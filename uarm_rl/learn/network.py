"""Fully connected networks with their backward pass written out, on flat parameter vectors.

Autograd is the largest overhead of an update as small as this one. Written out, only the gradients that are used are
computed. Tests hold them to ``torch.autograd``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Operation = Callable[..., Tensor]


def _total(rows: Tensor, out: Tensor) -> Tensor:
    return torch.sum(rows, -2, out=out)


def _one_by_one(operation: Operation, rows: Sequence[int]) -> Operation:
    """The operation on these rows of what it is given."""

    def on_rows(*given: Tensor, out: Tensor) -> Tensor:
        for row in rows:
            operation(*(tensor[row] for tensor in given), out=out[row])
        return out

    return on_rows


class Network:
    """A fully connected network, ReLU after each hidden layer, linear at the output.

    Parameters and their gradients live in two flat vectors given by the caller; layers are views of them. With matrices, a row
    for each of several networks, these work side by side: whatever goes in and comes out has their number before its shape.
    One call multiplies for all; or for each of ``rows``, which may change, one after the other, with the bytes of a network on
    its own. (On a processor that is as fast, at this size.)
    """

    def __init__(
        self, sizes: Sequence[int], parameters: Tensor, gradient: Tensor | None = None, rows: Sequence[int] | None = None
    ) -> None:
        batched = parameters.ndim > 1 and rows is None
        operations: list[Operation] = [torch.bmm, torch.baddbmm, _total] if batched else [torch.mm, torch.addmm, _total]
        if rows is not None:
            operations = [_one_by_one(operation, rows) for operation in operations]
        self._product, self._affine, self._total = operations
        self.layers = self._views(sizes, parameters)
        self._gradients = [] if gradient is None else self._views(sizes, gradient)
        self._inputs: list[Tensor] = []
        self._buffers: dict[tuple[str, int], Tensor] = {}

    @staticmethod
    def size(sizes: Sequence[int]) -> int:
        """Number of parameters of a network with these layer widths."""
        return sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))

    @staticmethod
    def _views(sizes: Sequence[int], flat: Tensor) -> list[tuple[Tensor, Tensor]]:
        views, start = [], 0
        for inputs, outputs in itertools.pairwise(sizes):
            weight = flat[..., start : start + inputs * outputs].view(*flat.shape[:-1], inputs, outputs)
            start += inputs * outputs
            views.append((weight, flat[..., start : start + outputs]))
            start += outputs
        return views

    def initialise(self, generator: torch.Generator, final: float) -> None:
        """Uniform in +-1/sqrt(inputs), the last layer in +-``final`` (Lillicrap et al. 2016, section 7)."""
        for weight, bias in self.layers:
            bound = final if weight is self.layers[-1][0] else 1.0 / math.sqrt(weight.shape[-2])
            weight.uniform_(-bound, bound, generator=generator)
            bias.uniform_(-bound, bound, generator=generator)

    def forward(self, x: Tensor) -> Tensor:
        """Output for a batch, shape (n, outputs), valid until the next call; the layers' inputs are kept for ``backward``."""
        self._inputs = []
        for number, (weight, bias) in enumerate(self.layers):
            if number:
                x.relu_()
            self._inputs.append(x)
            out = self._buffer("forward", number, x, weight.shape[-1])
            x = self._affine(bias.unsqueeze(-2), x, weight, out=out)
        return x

    def backward(self, gradient: Tensor) -> None:
        """Write the gradients of the parameters, given the loss's ``gradient`` at the last output."""
        for number in reversed(range(len(self.layers))):
            into_weight, into_bias = self._gradients[number]
            self._product(self._inputs[number].mT, gradient, out=into_weight)
            self._total(gradient, out=into_bias)
            if number:
                gradient = self._through(number, gradient)

    def input_gradient(self, gradient: Tensor, first: int) -> Tensor:
        """The loss's gradient at the inputs from column ``first`` on, given it at the last output."""
        for number in reversed(range(1, len(self.layers))):
            gradient = self._through(number, gradient)
        weight = self.layers[0][0][..., first:, :]
        return self._product(gradient, weight.mT, out=self._buffer("backward", 0, gradient, weight.shape[-2]))

    def _through(self, number: int, gradient: Tensor) -> Tensor:
        """From the output of layer ``number`` to the output of the layer before, across its ReLU."""
        weight = self.layers[number][0]
        buffer = self._buffer("backward", number, gradient, weight.shape[-2])
        self._product(gradient, weight.mT, out=buffer)
        torch.ops.aten.threshold_backward.grad_input(buffer, self._inputs[number], 0, grad_input=buffer)
        return buffer

    def _buffer(self, direction: str, number: int, like: Tensor, columns: int) -> Tensor:
        """Memory for one layer's result, the same in every update: fresh pages from the system cost as much as a product."""
        buffer = self._buffers.get((direction, number))
        if buffer is None or buffer.shape[:-1] != like.shape[:-1]:
            buffer = self._buffers[direction, number] = like.new_empty((*like.shape[:-1], columns))
        return buffer
