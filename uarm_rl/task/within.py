"""The control steps within a held decision, each as the decision that might have begun there.

What is right to store of a moving arm? Let a decision command the reference c in state s, and be released k control steps
later in state e. In the state s_j after j of them the arm is under the same command; the action a_j that commands c from there,
relative to where the joints are *then*, would have changed nothing: a servo that keeps nothing of a command but its reference
moves on as it did, and the hold, if it counts from s_j, releases at the same e. So (s_j, a_j) is a decision that was really
carried out, of k - j control steps; its reward is the task's own, from s_j to e, and its future begins at e, discounted by
k - j control steps or, per decision, once. Its target is as correct as that of the whole decision.

Not every control step has such a decision. Left out are those from which the hold would have released earlier or later (the
last one, where it waits for two; all of a hold of fixed length, whose rest is shorter than it), and those whose action is out
of range. With a servo that begins its move anew at every command, nothing would be right. In the whole state the transitions
are exact; in the 20 numbers, which lack the velocity, a moving s_j looks like an arm at rest, and that is what a study of them
is about.

Storing what lies within an action is how options are learned from (intra-option learning: Sutton, Precup and Singh 1999,
section 6) and how TempoRL learns from all parts of a skip (Biedenkapp et al. 2021).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl.task.arm import JointPositions
from uarm_rl.task.hold import Hold
from uarm_rl.task.observation import Observation
from uarm_rl.task.reward import DistanceReward


class Moment(NamedTuple):
    """What was there after a control step."""

    observation: Observation
    joints: JointPositions
    cup_m: Sequence[float]
    object_m: Sequence[float]
    depth_m: float  # of the cup below the object's upper surface
    travel_rad: float  # since the control step before
    change_rad: float  # of that, between the two
    control_steps: int  # since the command


class Within(NamedTuple):
    """A decision within a decision, that ends with it."""

    observation: Observation
    action: NDArray[np.float32]
    reward: float
    control_steps: int  # from here to the end


def decisions_within(
    moments: Sequence[Moment],
    action_from: Callable[[JointPositions], NDArray[np.float64]],
    hold: Hold,
    reward: DistanceReward,
    *,
    ended: bool,
) -> list[Within]:
    """Those of ``moments``, all control steps of a decision, that a decision might have begun at, in their order.

    ``action_from`` gives the action that commands the decision's reference from other joints; ``ended`` tells that something
    else than the hold has ended it (a success, an object lost, the time).
    """
    found: list[Within] = []
    end = moments[-1]
    for number, start in enumerate(moments[:-1], 1):
        rest = moments[number:]
        releases = [hold.releases(one.control_steps - start.control_steps, one.travel_rad, one.change_rad) for one in rest]
        action = action_from(start.joints)
        if any(releases[:-1]) or not (releases[-1] or ended) or np.abs(action).max() > 1.0:
            continue
        press_m = max(one.depth_m for one in rest)
        terms = reward(start.cup_m, start.object_m, end.cup_m, end.object_m, press_m)
        steps = end.control_steps - start.control_steps
        found.append(Within(start.observation, action.astype(np.float32), terms.total, steps))
    return found
