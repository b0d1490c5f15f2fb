"""A training environment whose step is in two halves: send an action, receive what came of it.

Between the two the learner takes its gradient step. ``InlineEnv`` simulates when asked to receive;
``SubprocessEnv`` simulates on another core meanwhile. Both compute the same numbers.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from uarm_rl.task.arm import ArmError
from uarm_rl.task.env import UArmSuctionEnv

MakeEnv = Callable[[], UArmSuctionEnv]


class InlineEnv:
    """The environment in this process."""

    def __init__(self, make_env: MakeEnv, seed: int) -> None:
        self._env = make_env()
        self._env.reset(seed=seed)
        self._action: Any = None

    def reset(self, *, home: bool) -> Any:
        return self._env.reset(options={"home": home})[0]

    def send(self, action: Any) -> None:
        self._action = action

    def receive(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._env.step(self._action)

    def generator_state(self) -> dict[str, Any]:
        """State of the generator that places the objects; with ``home`` resets it is the environment's only memory."""
        return dict(self._env.np_random.bit_generator.state)

    def set_generator_state(self, state: dict[str, Any]) -> None:
        self._env.np_random.bit_generator.state = state

    def close(self) -> None:
        self._env.close()


class SubprocessEnv:
    """The environment in a process of its own. Raises :class:`ArmError` if that process fails or dies."""

    def __init__(self, make_env: MakeEnv, seed: int) -> None:
        context = multiprocessing.get_context("spawn")  # PyBullet and torch do not survive a fork
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, make_env, seed), daemon=True)
        self._process.start()
        theirs.close()

    def _ask(self, call: str, *arguments: Any) -> Any:
        self._post(call, *arguments)
        return self._answer()

    def _post(self, call: str, *arguments: Any) -> None:
        try:
            self._pipe.send((call, arguments))
        except OSError as error:
            raise ArmError("the process that simulates has died; the last checkpoint is good, resume from it") from error

    def _answer(self) -> Any:
        try:
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise ArmError("the process that simulates has died; the last checkpoint is good, resume from it") from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def reset(self, *, home: bool) -> Any:
        return self._ask("reset", home)

    def send(self, action: Any) -> None:
        self._post("step", action)

    def receive(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self._answer()
        return observation, reward, terminated, truncated, info

    def generator_state(self) -> dict[str, Any]:
        state: dict[str, Any] = self._ask("generator_state")
        return state

    def set_generator_state(self, state: dict[str, Any]) -> None:
        self._ask("set_generator_state", state)

    def close(self) -> None:
        self._pipe.close()  # the other side reads the end of the file and leaves
        self._process.join(timeout=5.0)
        if self._process.is_alive():
            self._process.kill()


def _serve(pipe: Connection, make_env: MakeEnv, seed: int) -> None:
    """Answer calls until the other side closes the pipe. Ctrl-C and SIGTERM are the parent's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    env: InlineEnv | None = None
    try:
        while True:
            call, arguments = pipe.recv()
            try:
                env = env or InlineEnv(make_env, seed)
                pipe.send(_perform(env, call, arguments))
            except Exception as error:  # every failure belongs to the parent, which knows what to do
                pipe.send(error)
    except (EOFError, OSError):
        pass
    finally:
        if env is not None:
            env.close()


def _perform(env: InlineEnv, call: str, arguments: tuple[Any, ...]) -> Any:
    if call == "step":
        env.send(*arguments)
        observation, reward, terminated, truncated, info = env.receive()
        del info["trace"]  # nobody beyond the pipe reads it
        return observation, reward, terminated, truncated, info
    if call == "reset":
        return env.reset(home=arguments[0])
    if call == "generator_state":
        return env.generator_state()
    env.set_generator_state(*arguments)
    return None
