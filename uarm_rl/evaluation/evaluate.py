"""Test a policy on fixed layouts, an object's position and what is in the way: one episode and one row each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

from uarm_rl import workers
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.layouts import Layout
from uarm_rl.task.policy import Policy
from uarm_rl.task.rollout import Episode, run_episode


def evaluate(
    make_env: Callable[[], UArmSuctionEnv],
    policy: Policy,
    layouts: Sequence[Layout],
    *,
    processes: int,
    ghost: bool = False,
) -> Iterator[Episode]:
    """One episode for each of ``layouts``, in their order; with ``ghost`` the target is told and no object is there.

    ``make_env`` must be picklable if ``processes`` > 1. Every episode begins in a world built anew, so it does not depend
    on their number.
    """
    if processes == 1:
        env = make_env()
        try:
            for layout in layouts:
                yield _episode(env, policy, layout, ghost)
        finally:
            env.close()
        return
    with ProcessPoolExecutor(processes, workers.CONTEXT, _begin, (make_env, policy, ghost)) as pool:
        yield from pool.map(_work, layouts)


_worker: tuple[UArmSuctionEnv, Policy, bool]


def _begin(make_env: Callable[[], UArmSuctionEnv], policy: Policy, ghost: bool) -> None:
    global _worker
    workers.begin()
    _worker = make_env(), policy, ghost


def _work(layout: Layout) -> Episode:
    env, policy, ghost = _worker
    return _episode(env, policy, layout, ghost)


def _episode(env: UArmSuctionEnv, policy: Policy, layout: Layout, ghost: bool = False) -> Episode:
    # Nothing is drawn as in training.
    return run_episode(env, policy, options={**layout.options(), "ghost": ghost, "tolerance_m": env.tolerance_m})


def successes(env: UArmSuctionEnv, policy: Policy, layouts: Iterable[Layout]) -> Iterator[bool]:
    """Whether the policy succeeds in each of ``layouts``, one after the other."""
    return (_episode(env, policy, layout).success for layout in layouts)
