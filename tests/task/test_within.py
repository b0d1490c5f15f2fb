"""The control steps within a held decision: what is stored of them is a decision that was really carried out."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import make_arm
from uarm_rl import configuration
from uarm_rl.checks import UsageError
from uarm_rl.task.hold import FixedHold, UntilSteady
from uarm_rl.task.within import Moment, decisions_within

ACTION = np.array([0.9, -0.7, 0.4], np.float32)
TARGET = (0.2, 0.1, 0.03)


def test_a_command_that_is_repeated_on_the_way_changes_nothing(engine):
    """What the argument stands on."""
    ways = []
    for again in (False, True):
        arm = make_arm(engine)
        arm.home()
        reference = tuple(joint + 0.1 for joint in arm.read_joints())
        arm.command_joints(reference)
        way = []
        for step in range(12):
            if again and step:
                arm.command_joints(reference)
            arm.advance()
            way.append(arm.read_joints())
        ways.append(way)
        arm.close()
    assert ways[0] == ways[1]


def test_each_is_commanded_rewarded_and_timed_from_where_the_arm_was(make_env, engine):
    env = make_env(f"sim={engine}", "buffer=every_step", keep_within=True)
    env.reset(seed=0, options={"object_position": TARGET})
    start = np.array(env.arm.read_joints())
    *_, info = env.step(ACTION)
    steps, trace = info["control_steps"], env.trace
    within = info["within"]
    assert [one.control_steps for one in within] == list(range(steps - 1, 1, -1))  # all but the last, which two would follow
    reward = configuration.build("reward", configuration.compose("train")["reward"])
    for number, one in enumerate(within):
        joints, cup, thing = np.split(trace[number], [3, 6])
        assert one.observation[15:18] == pytest.approx(joints, abs=1e-6)
        assert one.observation[9:12] == pytest.approx(cup, abs=1e-6)
        assert joints + 0.15 * one.action == pytest.approx(start + 0.15 * ACTION, abs=1e-6)
        assert one.reward == pytest.approx(reward(cup, thing, trace[-1, 3:6], trace[-1, 6:]).total)
    assert "within" not in make_env(f"sim={engine}", "buffer=every_step").reset(seed=0)[1]


def moments(*travels: float, joints: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Moment]:
    """A control step each, in which the arm moved by so much and the cup by a millimetre."""
    return [
        Moment(np.zeros(20), joints, (0.2, 0.0, 0.1 - step / 1000), (0.2, 0.0, 0.03), step / 100, travel, travel, step)
        for step, travel in enumerate(travels, 1)
    ]


def found(hold, travels, *, ended: bool = False, action: float = 0.5, pressing: float = 0.0) -> list:
    reward = configuration.build("reward", configuration.compose("train")["reward"] | {"pressing": pressing})
    return decisions_within(moments(*travels), lambda joints: np.full(3, action), hold, reward, ended=ended)


STEADY = UntilSteady(steady_threshold_rad=0.001, min_control_steps=2, max_control_steps=6)


@pytest.mark.parametrize(
    ("hold", "travels", "ended", "remaining"),
    [
        (STEADY, [0.1, 0.1, 0.1, 0.0], False, [3, 2]),
        (
            STEADY,
            [0.1, 0.1, 0.1, 0.1, 0.1, 0.1],
            False,
            [],
        ),  # released at its longest: from later on it would have lasted longer
        (STEADY, [0.1, 0.1, 0.1], True, [2, 1]),  # a success ends whatever is held
        (FixedHold(4), [0.1, 0.1, 0.1, 0.1], False, []),  # the rest is shorter than the hold
        (FixedHold(2), [0.1, 0.1, 0.1, 0.1], True, [2, 1]),  # from the first on it would have ended earlier
        (FixedHold(1), [0.1], False, []),
    ],
)
def test_those_from_which_the_hold_would_have_released_then(hold, travels, ended, remaining):
    assert [one.control_steps for one in found(hold, travels, ended=ended)] == remaining


def test_what_no_action_reaches_is_left_out():
    assert len(found(STEADY, [0.1, 0.1, 0.0], action=-1.0)) == 1
    assert found(STEADY, [0.1, 0.1, 0.0], action=-1.01) == []


def test_the_deepest_press_is_that_of_the_rest_of_the_way():
    plain, pressed = (found(STEADY, [0.1, 0.1, 0.0], pressing=pressing)[0].reward for pressing in (0.0, -1.0))
    assert plain - pressed == pytest.approx(0.03)


def test_a_servo_that_begins_its_move_anew_is_refused():
    settings = configuration.compose("train", ("buffer=every_step", "servo=stepper"))
    with pytest.raises(UsageError, match="admission=every_step needs servo=second_order"):
        configuration.build_env(settings, time_limit_s=None, keep_within=True)
