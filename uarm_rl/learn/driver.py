"""Who drives trainings: one on its own, or several side by side in a stack.

Side by side, a training goes on until it asks for something; what all of them ask for is then done at once. Actions are the
last to be given, so that the trainings are at the same place of the loop again after any of them was elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from uarm_rl import signals
from uarm_rl.learn.actor_critic import DivergenceError
from uarm_rl.learn.learner import Learner
from uarm_rl.learn.stack import Stack
from uarm_rl.learn.train import Act, Learn, Request, Settle, Stop, T, Training
from uarm_rl.progress import say


def alone(training: Training[T], stop: Stop) -> T:
    """Drive one training to its end, which comes early if it is told to ``stop``; what it returns."""
    answer: Any = None
    with _stop_on_signals([stop]):
        while True:
            try:
                request = _advance(training, answer)
            except StopIteration as end:
                result: T = end.value
                return result
            try:
                answer = _answer(request)
            except BaseException as error:
                answer = error


def _answer(request: Request) -> Any:
    if isinstance(request, Act):
        return request.learner.policy.act(request.observation)
    if isinstance(request, Learn):
        for _ in range(request.updates):
            request.learner.update(request.batch_size, request.progress)
    return None


def together(
    trainings: Sequence[Training[T]],
    stops: Sequence[Stop],
    *,
    batch_size: int,
    device: str,
    batched: bool,
    failed: Callable[[int, Exception], None],
) -> list[T | None]:
    """Drive trainings whose learners can be stacked to their ends; what each returns, ``None`` for one that failed.

    All learn from batches of ``batch_size``; ``device`` and ``batched`` are as of :class:`Stack`. One that fails, diverges or
    is stopped leaves the others; ``failed`` is told its number and its error.
    """
    results: list[T | None] = [None] * len(trainings)
    company = _Company(partial(Stack, batch_size=batch_size, device=device, batched=batched))
    asked: dict[int, Request] = {}
    answers: dict[int, Any] = dict.fromkeys(range(len(trainings)))
    try:
        with _stop_on_signals(stops):
            while answers:
                for number, answer in answers.items():
                    asked.pop(number, None)
                    try:
                        asked[number] = _advance(trainings[number], answer)
                    except StopIteration as end:
                        results[number] = end.value
                    except Exception as error:
                        failed(number, error)
                answers = company.answers(asked)
    finally:
        for training in trainings:
            training.close()
    return results


def _advance(training: Training[T], answer: Any) -> Request:
    return training.throw(answer) if isinstance(answer, BaseException) else training.send(answer)


class _Company:
    """Those that train side by side at the moment, in a stack that is made anew when one has left."""

    def __init__(self, stack_of: Callable[[list[Learner]], Stack]) -> None:
        self._stack_of = stack_of
        self._rows: dict[int, int] = {}  # a training's number: its row in the stack
        self._stack: Stack

    def answers(self, asked: Mapping[int, Request]) -> dict[int, Any]:
        """What is given to whom of those that ask, an error if it is one; of the first kind of request that there is."""
        if asked and asked.keys() != self._rows.keys():
            if bad := self._settled(asked.keys() & self._rows.keys()):
                return bad
            self._rows = {number: row for row, number in enumerate(asked)}
            self._stack = self._stack_of([request.learner for request in asked.values()])
        if settling := [number for number, request in asked.items() if isinstance(request, Settle)]:
            return dict.fromkeys(settling) | self._settled(settling)
        if learning := {number: request for number, request in asked.items() if isinstance(request, Learn)}:
            for turn in range(max(request.updates for request in learning.values())):
                due = {number: request for number, request in learning.items() if request.updates > turn}
                self._stack.update({self._rows[number]: request.progress for number, request in due.items()})
            return dict.fromkeys(learning)
        acting = {self._rows[number]: request.observation for number, request in asked.items() if isinstance(request, Act)}
        actions = self._stack.act(acting) if acting else {}
        answers = {number: actions[row] for number, row in self._rows.items() if row in acting}
        return answers | self._settled(number for number, action in answers.items() if not np.isfinite(action).all())

    def _settled(self, numbers: Iterable[int]) -> dict[int, Any]:
        """Bring these up to date; the errors of those that have diverged."""
        bad = {}
        for number in numbers:
            try:
                self._stack.settle(self._rows[number])
            except DivergenceError as error:
                bad[number] = error
        return bad


@contextmanager
def _stop_on_signals(stops: Sequence[Stop]) -> Iterator[None]:
    """Ctrl-C or another stop asks for one after the decision in hand; a second Ctrl-C interrupts at once."""

    def react(number: int) -> None:
        asked = all(stop.requested for stop in stops)
        if asked and number == signals.STOPS[0]:  # schedulers send several signals, one after the other
            raise KeyboardInterrupt
        if not asked:
            say("stopping and saving; press Ctrl-C again to leave at once")
        for stop in stops:
            stop.requested, stop.signal = True, number

    with signals.heard(react):
        yield
