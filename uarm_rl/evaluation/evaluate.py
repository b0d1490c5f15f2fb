"""Test a policy on fixed object positions: one episode and one row a position."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

from uarm_rl import workers
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.kinematics import Vector
from uarm_rl.task.policy import Policy
from uarm_rl.task.rollout import Episode, run_episode


def evaluate(
    make_env: Callable[[], UArmSuctionEnv],
    policy: Policy,
    positions_m: Vector,
    *,
    processes: int,
    ghost: bool = False,
) -> Iterator[Episode]:
    """One episode for each of ``positions_m`` (shape (n, 3)), in their order; with ``ghost`` nothing solid is there.

    ``make_env`` must be picklable if ``processes`` > 1. Every episode begins in a world built anew, so it does not depend
    on their number.
    """
    if processes == 1:
        env = make_env()
        try:
            for position in positions_m:
                yield _episode(env, policy, position, ghost)
        finally:
            env.close()
        return
    with ProcessPoolExecutor(processes, workers.CONTEXT, _begin, (make_env, policy, ghost)) as pool:
        yield from pool.map(_work, positions_m)


_worker: tuple[UArmSuctionEnv, Policy, bool]


def _begin(make_env: Callable[[], UArmSuctionEnv], policy: Policy, ghost: bool) -> None:
    global _worker
    workers.begin()
    _worker = make_env(), policy, ghost


def _work(position_m: Vector) -> Episode:
    env, policy, ghost = _worker
    return _episode(env, policy, position_m, ghost)


def _episode(env: UArmSuctionEnv, policy: Policy, position_m: Vector, ghost: bool = False) -> Episode:
    options = {"object_position": position_m, "ghost": ghost, "tolerance_m": env.tolerance_m}  # nothing drawn as in training
    return run_episode(env, policy, options=options)


def successes(env: UArmSuctionEnv, policy: Policy, positions_m: Sequence[Vector] | Vector) -> Iterator[bool]:
    """Whether the policy reaches each of ``positions_m``, one after the other."""
    return (_episode(env, policy, position).success for position in positions_m)
