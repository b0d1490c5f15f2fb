"""A training environment whose step is in two halves, so that the learner can work while the arm moves.

``InlineEnv`` simulates when it is waited for; ``SubprocessEnv`` simulates on another core meanwhile. Both compute the same
numbers. The halves have the names of Gymnasium's vector environments.
"""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from uarm_rl import checks, workers
from uarm_rl.task.arm import ArmError
from uarm_rl.task.env import UArmSuctionEnv

MakeEnv = Callable[[], UArmSuctionEnv]
Step = tuple[Any, float, bool, bool, dict[str, Any]]


class InlineEnv:
    """The environment in this process."""

    def __init__(self, make_env: MakeEnv, seed: int) -> None:
        self._env = make_env()
        self._env.reset(seed=seed)
        self._action: Any = None

    def reset(self, *, home: bool) -> Any:
        """The first observation after a reset, with the arm brought home or left where it is."""
        return self._env.reset(options={"home": home})[0]

    def step_async(self, action: Any) -> None:
        """Begin a decision."""
        self._action = action

    def step_wait(self) -> Step:
        """What came of it, as Gymnasium's ``step`` returns it."""
        return self._env.step(self._action)

    def state(self) -> dict[str, Any]:
        """What a resume needs, JSON: the generator that places objects is all that outlives a reset with ``home``."""
        return {"generator": self._env.np_random.bit_generator.state}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over another environment's state; :class:`ValueError` if it is none."""
        self._env.np_random.bit_generator.state = checks.generator_state("env.generator", state["generator"])

    def close(self) -> None:
        """Let go of the environment."""
        self._env.close()


class SubprocessEnv:
    """The environment in a process of its own. Raises :class:`ArmError` if that process fails or dies."""

    def __init__(self, make_env: MakeEnv, seed: int) -> None:
        self._pipe, theirs = workers.CONTEXT.Pipe()
        self._process = workers.CONTEXT.Process(target=_serve, args=(theirs, make_env, seed), daemon=True)
        self._process.start()
        theirs.close()

    def reset(self, *, home: bool) -> Any:
        return self._ask("reset", home=home)

    def step_async(self, action: Any) -> None:
        self._post("step", action)

    def step_wait(self) -> Step:
        answer: Step = self._answer()
        return answer

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = self._ask("state")
        return state

    def restore(self, state: dict[str, Any]) -> None:
        self._ask("restore", state)

    def close(self) -> None:
        self._pipe.close()  # the other side reads the end of the file and leaves
        self._process.join(timeout=5.0)
        if self._process.is_alive():
            self._process.kill()

    def _ask(self, call: str, *arguments: Any, **keywords: Any) -> Any:
        self._post(call, *arguments, **keywords)
        return self._answer()

    def _post(self, call: str, *arguments: Any, **keywords: Any) -> None:
        try:
            self._pipe.send((call, arguments, keywords))
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


AsyncEnv = InlineEnv | SubprocessEnv


def _serve(pipe: Connection, make_env: MakeEnv, seed: int) -> None:
    """Answer calls until the other side closes the pipe."""
    workers.begin()
    env: InlineEnv | None = None
    try:
        while True:
            call, arguments, keywords = pipe.recv()
            try:
                env = env or InlineEnv(make_env, seed)
                if call == "step":
                    env.step_async(*arguments)
                    call, arguments = "step_wait", ()
                pipe.send(getattr(env, call)(*arguments, **keywords))
            except Exception as error:  # every failure belongs to the parent, which knows what to do
                pipe.send(error)
    except (EOFError, OSError):
        pass
    finally:
        if env is not None:
            env.close()
