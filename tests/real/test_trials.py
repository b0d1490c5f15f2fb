"""Trials on the arm, in virtual time: what is done, in which order, and what counts as what."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from tests import hostile_arm
from tests.bench import PLACE, TASK, Bench, Workbench, judge
from uarm_rl import configuration
from uarm_rl.columns import TRIALS
from uarm_rl.commands.run_real import rehearse
from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.emulator.realism import Settings
from uarm_rl.real.audit import Limits
from uarm_rl.real.link import Link
from uarm_rl.real.search import CameraSearch
from uarm_rl.real.swift_arm import PumpState, SwiftArm
from uarm_rl.real.trials import GivenTarget, ObjectNotFoundError, run_trials, scattered
from uarm_rl.real.vision.camera import CameraError, OpenMVCamera
from uarm_rl.real.vision.camera_model import CalibrationError, nominal
from uarm_rl.real.vision.detection import MarkerDetector
from uarm_rl.task import kinematics, positions
from uarm_rl.task.arm import ArmError
from uarm_rl.task.obstacles import Box, boxes
from uarm_rl.task.policy import InverseKinematicsPolicy


def bench(joints=None, policy=None, **keywords):
    """An arm in virtual time in front of ``joints``."""
    here = Bench(Settings(tick_s=0.01), **keywords)
    here.port.firmware.machine.joints = here.joints = joints or Workbench()
    return here


def trials(here, arm, count=1, search=None, policy=None, put_down=None, task=TASK):
    results = run_trials(
        arm, policy or InverseKinematicsPolicy(0.15), search or GivenTarget(PLACE), task, put_down, trials=count
    )
    return [trial.row for trial in results]


# The loop, in virtual time


def test_picks_carries_and_puts_down():
    here = bench()
    other = np.array([0.18, -0.12, 0.03])
    with here.connect() as arm:
        rows = trials(here, arm, put_down=lambda place: other)
        assert arm.pump_state() is PumpState.STOPPED
    (row,) = rows
    assert set(row) <= set(TRIALS)
    assert (row["success"], row["reached"], row["reason"], row["firmware"]) == (True, True, "", "V4.10.0")
    assert 2.0 < row["time_s"] < 10.0
    assert row["final_distance_m"] <= 0.005
    assert row["decisions"] >= 4
    assert here.joints.top == pytest.approx(other, abs=0.004)
    here.judge()
    lines = here.lines()
    on, off = lines.index("M2231 V1"), len(lines) - lines[::-1].index("M2231 V0")
    assert sum(line.startswith("G2206") for line in lines[on:off]) >= 8  # lifted, carried, lowered with the pump on


def test_the_dwell_counts_the_arms_time():
    """Arriving counts once, standing there for 0.5 s the rest: the flag comes 0.5 s after the arrival and not at it."""
    here = bench()
    with here.connect() as arm:
        env = TASK.env(arm)
        arm.home()
        env.reset(options={"object_position": kinematics.HOME_CUP_M, "home": False})
        begun_s = arm.time_s()
        flag = False
        while not flag:
            _, _, flag, truncated, _ = env.step(np.zeros(3, np.float32))
            assert not truncated
        assert 0.45 <= arm.time_s() - begun_s < 1.5


class Still:
    def act(self, observation):
        return np.zeros(3, np.float32)


class Diver:
    """Goes down, whatever is there."""

    def act(self, observation):
        return np.array([0.0, 1.0, 0.0], np.float32)


class Nowhere:
    def find(self, arm, guess_m):
        raise ObjectNotFoundError("the object is not in view")


@pytest.mark.parametrize(
    ("keywords", "joints", "words"),
    [
        ({"policy": Still()}, {}, r"did not stay within reach of the target; it ended \d+\.\d mm away"),
        ({"policy": Diver()}, {}, "asked for something unsafe: the cup would .* closer to the table"),
        ({"search": Nowhere()}, {}, "the object is not in view"),
        ({"search": GivenTarget(np.array([0.05, 0.0, 0.03]))}, {}, r"cannot come down onto \(50, 0, 30\) mm"),
        ({}, {"top": (0.2, 0.07, 0.03)}, "did not seal on the object, pressed 5 mm"),
        ({}, {"slips_at_m": 0.05}, "fell off while it was lifted"),
    ],
)
def test_failures_count_and_the_trials_go_on(keywords, joints, words):
    here = bench(Workbench(**joints))
    with here.connect() as arm:
        rows = trials(here, arm, count=2, **keywords)
        assert arm.pump_state() is PumpState.STOPPED
        assert kinematics.cup_position(arm.read_joints())[2] > 0.03 or "search" in keywords
    assert [row["trial"] for row in rows] == [1, 2]
    for row in rows:
        assert not row["success"]
        assert re.search(words, row["reason"]), row["reason"]
    here.judge()


@pytest.mark.parametrize(
    "joints", [{"top": (0.2, 0.07, 0.03)}, {"seals_below_m": 0.0245 - 0.03, "slips_at_m": 0.0}, {"slips_at_m": 0.05}]
)
def test_nothing_is_dropped_from_a_height(joints):
    """After a pump that was on, the next thing is either the lift of what is sealed, or the pump goes off low down."""
    here = bench(Workbench(**joints))
    with here.connect() as arm:
        assert not trials(here, arm)[0]["success"]
    heights_mm, on = [], False
    for line in here.lines():
        if move := re.fullmatch(r"G2206 B(\S+) L(\S+) R(\S+) F\S+", line):
            heights_mm.append(1000 * kinematics.cup_position(kinematics.from_motor_deg(*map(float, move.groups())))[2])
        elif line == "M2231 V1":
            on = True
        elif line == "M2231 V0" and on:
            assert heights_mm[-1] < 30.5
            on = False
    assert heights_mm[-2] > 85.0  # it rose afterwards; the last move parks
    assert not on


def test_encoders_that_flicker_cost_no_time():
    """The firmware's ok ends a decision: the encoders are asked once, whatever their noise is."""
    periods = []
    for noise_deg in (0.0, 0.015, 0.2):
        here = Bench(Settings(tick_s=0.01, encoder_noise_deg=noise_deg, noise_seed=1))
        with here.connect() as arm:
            env = TASK.env(arm)
            env.reset(options={"object_position": np.array([0.24, 0.0, 0.03])})
            begun = len(here.port.written)
            taken = [
                env.step(np.array(action, np.float32))[-1]["control_steps"]
                for action in ([0.5, 0, 0], [-0.9, 0, 0], [0.2, 0.2, 0])
            ]
            assert [line for line in here.lines(begun) if line == "P2200"] == ["P2200"] * 3
        periods.append(taken)
    assert periods[0] == periods[1]
    assert np.abs(np.subtract(periods[2], periods[0])).max() <= 1  # a reference begins where the encoders say


def test_what_the_policy_does_not_get_is_fetched_for_the_next_trial():
    here = bench()
    places = [np.array([0.18, -0.12, 0.03]), np.array([0.22, 0.1, 0.03])]
    with here.connect() as arm:
        rows = trials(here, arm, policy=Still(), put_down=lambda place: places[0])
        assert here.joints.top == pytest.approx(places[0], abs=0.004)
        rows += trials(here, arm, search=GivenTarget(places[0]), put_down=lambda place: places[1])
    assert [row["success"] for row in rows] == [False, True]
    assert "did not stay within reach" in rows[0]["reason"]
    assert here.joints.top == pytest.approx(places[1], abs=0.004)


def test_the_cup_is_pressed_deeper_until_it_seals():
    here = bench(Workbench(seals_below_m=-0.0035))
    with here.connect() as arm:
        assert trials(here, arm)[0]["success"]
    tops = [line for line in here.lines() if line.startswith("G2206")]
    heights = [
        1000 * kinematics.cup_position(kinematics.from_motor_deg(*map(float, re.findall(r"[BLR](\S+)", line))))[2]
        for line in tops
    ]
    assert min(heights) == pytest.approx(26.0, abs=0.3)


def test_an_object_lost_on_the_way_was_held_all_the_same():
    here = bench(Workbench(slips_at_m=0.089))
    with here.connect() as arm:
        here.joints.slips_at_m = math.inf
        rows = trials(here, arm, put_down=lambda place: setattr(here.joints, "slips_at_m", 0.05) or place)
    assert rows[0]["success"]
    assert "fell off on the way" in rows[0]["reason"]


@pytest.mark.parametrize("effect", ["unplug", "power", "reset"])
def test_what_breaks_the_arm_ends_the_trials(effect):
    here = bench(faults=(Fault(effect, "G2206", nth=9, delay_s=0.1),))
    rows = []
    with pytest.raises(ArmError, match=r"check|restarted"), here.connect() as arm:
        for trial in run_trials(arm, Still(), GivenTarget(PLACE), TASK, None, trials=99):
            rows.append(trial.row)
    assert len(rows) < 9
    here.judge()


def test_every_place_can_be_reached_lifted_and_left():
    """From anywhere in the operating range, and back from wherever a policy may have stopped."""
    generator = np.random.default_rng(0)
    with rehearse(lambda line: None) as arm:
        for _ in range(40):
            place = positions.draw(generator, 0.03)
            rows = trials(None, arm, search=GivenTarget(place), put_down=scattered(generator), task=TASK)
            assert rows[0]["success"], rows[0]["reason"]


def test_past_obstacles_the_object_goes_from_place_to_place_whatever_the_policy_does():
    """A policy that stays where it is gets nothing; the object is fetched and carried on, every way of it audited."""
    obstacles = (Box((0.22, 0.12, 0.06), (0.04, 0.04, 0.12)), Box((0.20, -0.13, 0.04), (0.06, 0.06, 0.08)))
    generator, within = np.random.default_rng(0), Limits(obstacles=obstacles)
    put_down = scattered(generator, within.carrying(TASK.object_size_m))
    places = []

    def noted(place):
        places.append(put_down(place))
        return places[-1]

    with rehearse(lambda line: None, limits=within) as arm:
        begin, task = GivenTarget(np.array([0.1, -0.25, 0.03])), dataclasses.replace(TASK, time_limit_s=0.5)
        rows = trials(None, arm, count=12, search=begin, policy=Still(), put_down=noted, task=task)
        assert arm.carried_m is None
    assert [row["success"] for row in rows] == [False] * 12
    assert len(places) >= 12
    for place in places:
        assert all(math.dist(place[:2], box.centre_m[:2]) > 0.04 for box in obstacles)


# With a camera, over PyBullet, in virtual time


def workplace(*overrides):
    settings = configuration.compose("emulate", overrides)
    emulate = pytest.importorskip("uarm_rl.emulator.emulate")  # which needs PyBullet
    return emulate.Workplace(**{key: value for key, value in settings.items() if key not in ("results_dir", "speed")})


def look_for_it(place, detector=None, whole_object=True, size_m=(0.03, 0.03, 0.03), limits=None):
    """The search with the workplace's camera, and an arm; both on ports in memory."""
    port = MemoryPort(place.camera)
    camera = OpenMVCamera(port, clock=port.clock)
    colour = configuration.compose("run-real", ())["detector"]
    search = CameraSearch(
        camera,
        detector or configuration.build("detector", colour),
        nominal(),
        object_size_m=size_m,
        whole_object=whole_object,
    )
    place.arm_port = port = MemoryPort(place.firmware)
    return SwiftArm(Link(port, "workplace", clock=port.clock), limits=limits), search


def test_an_object_is_found_picked_and_put_down_by_camera():
    with workplace("replace_object=false", "seed=5") as place:
        arm, search = look_for_it(place)
        with arm:
            truth = place.world.object_position()
            results = run_trials(
                arm, InverseKinematicsPolicy(0.15), search, TASK, scattered(np.random.default_rng(1)), trials=2
            )
            first, second = (trial for trial in results)
        for trial in (first, second):
            assert trial.row["success"], trial.row["reason"]
            assert trial.row["camera_misfit_px"] < 2.0
            assert trial.row["camera_disagreement_m"] < 0.01
            assert trial.picture.shape == (240, 320, 3)
        assert [first.row[f"target_{axis}_m"] for axis in "xyz"] == pytest.approx(truth, abs=0.004)
        assert second.row["looks"] == 2  # it looks first where it has put it


def test_behind_a_post_that_bars_some_of_the_views_the_object_is_found_from_others():
    post = [0.22, 0.15, 0.1, 0.03, 0.03, 0.2]
    limits = Limits(obstacles=boxes("obstacle", post))
    with workplace(f"obstacle={post}", "object_position=[0.06,0.27,0.03]", "seed=5") as place:
        arm, search = look_for_it(place, limits=limits)
        with arm:
            sighting = search.find(arm, None)
    assert sighting.target_m == pytest.approx((0.06, 0.27, 0.03), abs=0.004)


@pytest.mark.parametrize("look", ["tag", "sticker"])
def test_a_marker_is_the_middle_of_the_top(look):
    with workplace(f"look={look}", "realism=none", "object_position=[0.24,0.06,0.03]") as place:
        detector = MarkerDetector() if look == "tag" else None
        arm, search = look_for_it(place, detector, whole_object=False)
        with arm:
            sighting = search.find(arm, None)
        assert sighting.target_m == pytest.approx((0.24, 0.06, 0.03), abs=0.001)


@pytest.mark.parametrize(
    ("size_m", "words"),
    [
        ((0.12, 0.02, 0.03), r"has not the shape of the object|cannot be in view"),
        ((0.06, 0.06, 0.03), r"is 5\d% as wide as an object of 60 x 60 x 30 mm; give its true size"),
        ((0.035, 0.035, 0.03), r"is 8\d% as wide as an object of 35 x 35 x 30 mm"),
        ((0.025, 0.025, 0.03), r"is 1[12]\d% as wide as an object of 25 x 25 x 30 mm"),
    ],
)
def test_what_contradicts_the_size_of_the_object_is_not_taken_for_it(size_m, words):
    with workplace("realism=none", "object_position=[0.24,0.06,0.03]") as place:
        arm, search = look_for_it(place, size_m=size_m)
        with arm, pytest.raises(ObjectNotFoundError, match=words):
            search.find(arm, None)


@pytest.mark.parametrize(
    ("fault", "error", "words"),
    [
        ("camera_frozen", CameraError, "picture again and again"),
        ("camera_silence", CameraError, "gave no picture within 15 s: it sent nothing"),
        ("camera_size", CalibrationError, "is for 320 x 240"),
        ("power", ArmError, "lost its 12 V power"),
        ("silence", ArmError, "did not answer within"),
    ],
)
def test_a_fault_in_a_trial_ends_it_in_a_sentence_with_the_pump_off(fault, error, words):
    with workplace("replace_object=false", f"faults={fault}") as place:
        arm, search = look_for_it(place)
        with pytest.raises(error, match=words), arm:
            next(run_trials(arm, InverseKinematicsPolicy(0.15), search, TASK, None, trials=1))
        written = bytes(place.arm_port.written).decode()
        assert "M2231 V0" in written[-130:]
        for line in filter(None, re.sub("[!\x18]", "", written).splitlines()):
            judge(line)


# Hostile wishes and answers; the lead number of each is larger in tests/torture.py


def test_hostile_wishes_put_nothing_unsafe_on_the_wire():
    assert hostile_arm.references(5000) == (5000, 0)
    for control in (hostile_arm.blind(), hostile_arm.careless()):
        with control:
            assert hostile_arm.references(1000)[1] > 10  # it is caught


def test_arms_that_answer_nonsense_never_hang_the_driver():
    assert hostile_arm.streams(500) == (500, 0)
