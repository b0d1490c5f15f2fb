"""The world behind the emulated firmware: motors, play, suction, the object; and the command that opens its terminals."""

from __future__ import annotations

import copy
import functools
import math
import os
import re
import select
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from uarm_rl import configuration
from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.realism import Settings
from uarm_rl.real.ports import camera_beside, emulated_speed, is_emulated
from uarm_rl.sim.cup import Bellows
from uarm_rl.task import kinematics, positions
from uarm_rl.task.obstacles import boxes, leaves_room

emulate = pytest.importorskip("uarm_rl.emulator.emulate")  # which needs PyBullet
physics = pytest.importorskip("uarm_rl.emulator.physics")
SIM = {key: value for key, value in configuration.compose("emulate")["sim"].items() if key != "name"}
TICK_S = 1.0 / 240.0
TOP_M = (0.25, 0.03, 0.03)
INSIDE_M = SIM["object_size_m"] / 2.0 - physics.CUP_RADIUS_M  # the lip is all on the object


@functools.cache
def composed(*groups):
    values = configuration.compose("emulate", ("realism=none", *groups))
    return {name: value for name, value in values.items() if name not in ("results_dir", "speed")}


def configured(*overrides):
    """The keywords of a workplace, from ``conf/``; values are changed here, which is faster than composing."""
    groups = [override for override in overrides if override.startswith(("realism=", "faults="))]
    values = copy.deepcopy(composed(*groups))
    for override in overrides:
        if override not in groups:
            names, _, value = override.partition("=")
            *folders, name = names.split(".")
            functools.reduce(dict.__getitem__, folders, values)[name] = yaml.safe_load(value)
    return values


class Driven(physics.World):
    """A world whose motors a test turns."""

    def __init__(self, *places, **keywords):
        super().__init__(iter([(place, 0.0) for place in places or (TOP_M,)]), **SIM, **keywords)
        self.asked_deg = PARKED_DEG

    def hold(self, seconds, motor_deg=None):
        for _ in range(round(seconds / TICK_S)):
            self.drive(motor_deg or self.asked_deg, TICK_S)

    def go(self, cup_m):
        """Turn the motors until the cup is at ``cup_m``, and wait a moment."""
        self.turn(kinematics.to_motor_deg(kinematics.inverse(cup_m)))

    def turn(self, end, speed_deg_s=60.0):
        """Turn the motors, and wait a moment."""
        start = self.asked_deg
        steps = math.ceil(math.dist(start, end) / speed_deg_s / TICK_S) + 1
        for step in range(1, steps + 1):
            self.drive(tuple(a + step / steps * (b - a) for a, b in zip(start, end, strict=True)), TICK_S)
        self.asked_deg = end
        self.hold(0.2)

    def go_above(self, top_m, gap_m):
        self.go((top_m[0], top_m[1], 0.08))
        self.go((top_m[0], top_m[1], top_m[2] + gap_m))


@pytest.fixture
def world():
    with Driven() as one:
        yield one


def cup_m(world):
    return world.cup_pose()[:3, 3]


# Motors


@settings(max_examples=15)
@given(st.tuples(*[st.floats(0, 1)] * 3))
def test_joints_follow_the_motors_and_the_hand_stays_level(share):
    low, high = kinematics.JOINT_LIMITS_RAD.T
    joints = np.array(kinematics.clip_to_limits(*(low + share * (high - low))))
    assume(kinematics.cup_position(joints)[2] > 0.005)  # above the table
    with Driven((0.0, 0.6, 0.03)) as world:
        asked_deg = kinematics.to_motor_deg(joints)
        for step in range(1, 241):
            world.drive(tuple(a + step / 240 * (b - a) for a, b in zip(PARKED_DEG, asked_deg, strict=True)), TICK_S)
        world.hold(0.3, asked_deg)
        assert world.motor_deg() == pytest.approx(asked_deg, abs=0.02)
        assert cup_m(world) == pytest.approx(kinematics.cup_position(joints), abs=2e-4)
        pose = world.cup_pose()
        assert pose[:3, 2] == pytest.approx((0, 0, 1), abs=1e-3)
        assert pose[:2, 0] == pytest.approx((math.cos(joints[0]), math.sin(joints[0])), abs=1e-3)


def test_motors_without_current_sag_onto_the_table_and_a_folded_arm_stays(world):
    world.drive(None, TICK_S)
    for _ in range(480):
        world.drive(None, TICK_S)
    assert world.motor_deg() == pytest.approx(PARKED_DEG, abs=3.0)
    world.hold(0.5)
    world.go((0.2, 0.0, 0.15))
    for _ in range(480):
        world.drive(None, TICK_S)
    assert 0.0 < cup_m(world)[2] < 0.03
    assert world.tip_pressed()


def test_an_arm_that_is_held_back_loses_steps_until_the_encoders_are_asked(caplog):
    """Pressed 20 mm into a box: the motors cannot, and afterwards the joints are not where the pulses say."""
    with Driven(cup=Bellows(400.0, 0.005, 0.003)) as world:
        world.go_above(TOP_M, 0.01)
        assert world.lost_deg == [0.0, 0.0, 0.0]
        world.go((*TOP_M[:2], TOP_M[2] - 0.02))
        assert world.hard_presses >= 1
        assert {record.getMessage() for record in caplog.records if record.levelname == "WARNING"} == {
            "the cup presses the object with more than 5 N",
            "the motors lose steps: something holds the arm back",
        }
        lost_deg = np.array(world.lost_deg)
        assert np.abs(lost_deg).max() > 0.5
        world.go((*TOP_M[:2], 0.1))
        assert np.subtract(world.asked_deg, world.motor_deg()) == pytest.approx(lost_deg, abs=0.05)
        world.resynchronise()
        world.asked_deg = world.motor_deg()  # as the firmware does
        world.go((*TOP_M[:2], 0.08))
        assert world.motor_deg() == pytest.approx(world.asked_deg, abs=0.02)


def test_play_is_lost_motion_at_every_reversal():
    with Driven(backlash_deg=1.0) as world:
        world.turn((95.0, 118.0, 50.0))
        assert world.motor_deg()[0] == pytest.approx(94.5, abs=0.02)
        world.turn((94.1, 118.0, 50.0))
        assert world.motor_deg()[0] == pytest.approx(94.5, abs=0.02)
        world.turn((93.0, 118.0, 50.0))
        assert world.motor_deg()[0] == pytest.approx(93.5, abs=0.02)


def test_the_same_happens_whatever_slices_time_comes_in():
    ends = []
    for ticks in (280 * [1], 20 * [7, 2, 5], 8 * [35]):
        with Driven((0.25, 0.03, 1.0)) as world:
            for number in ticks[: len(ticks) // 4]:
                world.drive(PARKED_DEG, number * TICK_S)
            ends.append(world.object_position())
    fallen_m = 1.0 - np.array(ends)[:, 2]
    assert fallen_m == pytest.approx([0.5 * 9.81 * (70 * TICK_S) ** 2] * 3, rel=0.1)


# Suction


def test_a_sealed_cup_lifts_the_object_and_lets_it_fall(world):
    world.go_above(TOP_M, -0.001)
    assert world.tip_pressed()
    assert not world.holding()
    world.suck(True)
    world.hold(0.1)
    assert world.holding()
    world.go((0.25, 0.03, 0.13))
    assert world.object_position()[2] == pytest.approx(0.13, abs=0.003)
    assert not world.tip_pressed()
    world.go((0.2, -0.1, 0.1))  # sideways, fast
    assert world.object_position() == pytest.approx((0.2, -0.1, 0.1), abs=0.003)
    world.suck(False)
    assert not world.holding()
    world.hold(0.5)
    assert world.object_position()[2] == pytest.approx(0.03, abs=1e-3)
    assert cup_m(world)[2] == pytest.approx(0.1, abs=1e-3)


@settings(max_examples=12)
@given(
    st.tuples(st.floats(-0.009, 0.009), st.floats(-0.009, 0.009)),
    st.floats(-math.pi / 4, math.pi / 4),
)
def test_the_whole_lip_must_be_on_the_object(offset_m, yaw_rad):
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    along = max(abs(cos * offset_m[0] + sin * offset_m[1]), abs(-sin * offset_m[0] + cos * offset_m[1]))
    assume(abs(along - INSIDE_M) > 0.0005)
    with Driven() as world:
        world.place_object(TOP_M, yaw_rad)
        world.suck(True)
        world.go_above((TOP_M[0] + offset_m[0], TOP_M[1] + offset_m[1], TOP_M[2]), 0.0)
        assert world.holding() == (along < INSIDE_M)


@pytest.mark.parametrize(("gap_m", "sealed"), [(0.0015, True), (0.003, False), (0.01, False)])
def test_the_lip_must_be_near(world, gap_m, sealed):
    world.suck(True)
    world.go_above(TOP_M, gap_m)
    assert world.holding() == sealed


def test_a_tilted_surface_does_not_seal(world):
    world.go_above(TOP_M, 0.03)
    world.suck(True)
    world.place_object((TOP_M[0] + 0.02, TOP_M[1], 0.03))
    world.go((TOP_M[0], TOP_M[1], 0.02))  # beside it, and the edge of the lip touches
    assert not world.held


def test_the_table_seals_as_well_and_nothing_hangs_on_it(world):
    """The pump's current cannot tell the object from the table."""
    world.suck(True)
    world.go((0.2, -0.1, 0.0005))
    assert world.holding()
    assert not world.held
    world.go((0.2, -0.1, 0.03))
    assert not world.holding()


def test_a_grip_takes_time():
    with Driven(grip_s=0.3) as world:
        world.go_above(TOP_M, -0.001)
        world.suck(True)
        world.hold(0.25)
        assert not world.holding()
        world.hold(0.1)
        assert world.holding()


def test_a_weak_seal_lets_go_of_a_heavy_object():
    with Driven(suction_n=0.4) as world:  # the box weighs 0.49 N
        world.go_above(TOP_M, -0.001)
        world.suck(True)
        world.hold(0.1)
        assert world.holding()
        world.go((0.25, 0.03, 0.12))
        assert not world.holding()
        assert world.object_position() == pytest.approx(TOP_M, abs=0.005)


# Somebody who puts the object elsewhere


def lift_and_let_go(world, top_m=TOP_M):
    world.go_above(top_m, -0.001)
    world.suck(True)
    world.hold(0.1)
    world.go((top_m[0], top_m[1], 0.1))
    world.go((0.2, -0.12, 0.032))
    world.suck(False)
    world.hold(1.0)


def test_the_object_is_put_elsewhere_after_it_was_lifted_once_the_cup_is_clear():
    elsewhere = (0.15, 0.2, 0.03)
    with Driven(TOP_M, elsewhere, replace_object=True) as world:
        lift_and_let_go(world)
        assert world.object_position() == pytest.approx((0.2, -0.12, 0.03), abs=0.003)  # the cup is still there
        world.go((0.2, 0.0, 0.15))
        world.hold(1.0)
        assert world.object_position() == pytest.approx(elsewhere, abs=1e-3)


def test_an_object_that_was_not_lifted_stays():
    with Driven(TOP_M, (0.15, 0.2, 0.03), replace_object=True) as world:
        world.go_above(TOP_M, -0.001)
        world.suck(True)
        world.hold(0.1)
        world.suck(False)
        world.go((0.2, 0.0, 0.15))
        world.hold(1.0)
        assert world.object_position() == pytest.approx(TOP_M, abs=0.003)


def test_without_replacement_the_object_stays_where_it_was_put():
    with Driven(TOP_M, (0.15, 0.2, 0.03)) as world:
        lift_and_let_go(world)
        world.go((0.2, 0.0, 0.15))
        world.hold(1.0)
        assert world.object_position() == pytest.approx((0.2, -0.12, 0.03), abs=0.003)


def test_an_object_too_near_to_be_seen_is_put_back():
    with Driven(TOP_M, (0.15, 0.2, 0.03), replace_object=True, nearest_m=0.2) as world:
        world.hold(0.5)
        world.go_above(TOP_M, -0.001)
        world.suck(True)
        world.hold(0.1)
        world.go((0.18, 0.0, 0.035))  # dragged
        world.suck(False)
        world.go((0.2, 0.0, 0.15))
        world.hold(1.0)
        assert world.object_position() == pytest.approx((0.15, 0.2, 0.03), abs=1e-3)


def test_an_object_out_of_reach_is_put_back():
    with Driven(TOP_M, (0.15, 0.2, 0.03), replace_object=True) as world:
        world.place_object((0.25, 0.03, 0.03))
        world.hold(1.0)
        assert world.object_position() == pytest.approx(TOP_M, abs=1e-3)
        world.place_object((2.0, 0.0, 0.03))  # beside the table
        world.hold(1.5)
        assert world.object_position() == pytest.approx((0.15, 0.2, 0.03), abs=1e-3)


def test_places_are_reachable_and_repeat_with_the_seed():
    found = []
    for seed in (0, 0, 1):
        with emulate.Workplace(**configured(f"seed={seed}")) as place:
            found.append(place.world.object_position())
    assert found[0] == found[1] != found[2]
    assert all(positions.in_operating_range(np.array(top_m)) for top_m in found)
    with emulate.Workplace(**configured("nearest_m=0.3")) as place:
        assert math.hypot(*place.world.object_position()[:2]) >= 0.3


def test_an_obstacle_stops_the_arm_and_no_object_is_put_beside_it():
    row = [0.22, 0.1, 0.1, 0.03, 0.03, 0.2]
    for seed in range(12):
        with emulate.Workplace(**configured(f"seed={seed}", f"obstacle={row}")) as place:
            assert leaves_room(place.world.object_position(), boxes("obstacle", row), 0.015)
    ends = {}
    for obstacle in ("null", str(row)):
        with emulate.Workplace(**configured(f"obstacle={obstacle}", "object_position=[0.2,-0.2,0.03]")) as place:
            place.firmware.advance(3.0)
            for command in ("G0 X220 Y0 Z60 F30", "G0 X150 Y200 Z60 F30"):
                place.firmware.advance(place.firmware.now_s, f"#1 {command}\n".encode())
                place.firmware.advance(place.firmware.now_s + 4.0)
            ends[obstacle] = place.world.motor_deg()[0]
    assert ends["null"] > 140.0
    assert ends[str(row)] < 120.0


# Behind the firmware


def test_imperfections_reach_firmware_and_world():
    realism = ("realism.joint_offset_deg=1", "realism.backlash_deg=0.5", "realism.serial_latency_s=0.1")
    with emulate.Workplace(**configured(*realism)) as place:
        place.firmware.advance(3.0)
        place.firmware.advance(3.0, b"#1 P2200\n")
        assert place.firmware.advance(3.13) == b""
        read = re.findall(r"[BLR](\S+)", place.firmware.advance(3.16).decode())
        off_deg = np.array(read, float) - place.world.motor_deg()
        assert 0.1 < np.abs(off_deg).max() < 4.0
        assert off_deg == pytest.approx(place.firmware.settings.encoder_offset_deg, abs=0.05)


@pytest.mark.parametrize("fault", [Fault("reset", "P2203"), Fault("power", "P2203")])
def test_a_restart_or_a_power_cut_drops_the_object_and_the_arm(fault):
    with Driven() as world:
        firmware = Firmware(Settings(), world, faults=(fault,))
        firmware.advance(2.0)
        for number, command in enumerate(("G0 X250 Y30 Z80 F30", "G0 X250 Y30 Z29 F30", "M2231 V1", "G0 X250 Y30 Z120 F30")):
            firmware.advance(firmware.now_s, f"{command}\n".encode())
            assert firmware.advance(firmware.now_s + 3.0).endswith(b"ok\n"), number
        assert world.held
        firmware.advance(firmware.now_s, b"P2203\n")
        firmware.advance(firmware.now_s + 0.9)
        assert not world.held
        assert cup_m(world)[2] < 0.07  # it lies on the object, or beside it


# The command


def start(*overrides):
    """``emulate`` in a process of its own; returns it and the two paths."""
    code = (
        "from uarm_rl import configuration; from uarm_rl.emulator.emulate import emulate\n"
        f"values = configuration.compose('emulate', {overrides!r}); values.pop('results_dir'); emulate(**values)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    lines = [process.stdout.readline().split() for _ in range(2)]
    assert [name for name, _ in lines] == ["arm:", "camera:"]
    (_, arm), (_, camera) = lines
    assert is_emulated(arm)
    assert camera_beside(arm) == camera
    return process, arm, camera


class Client:
    """A program that knows the arm from its protocol sheet alone."""

    def __init__(self, path):
        self.descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self.seen = b""
        self.number = 0

    def until(self, pattern, limit_s=30.0):
        end_s = time.monotonic() + limit_s
        while not (match := re.search(pattern, self.seen)):
            assert select.select([self.descriptor], [], [], max(0.0, end_s - time.monotonic()))[0], self.seen
            self.seen += os.read(self.descriptor, 4096)
        self.seen = self.seen[match.end() :]
        return match

    def ask(self, command):
        self.number += 1
        os.write(self.descriptor, b"#%d %s\n" % (self.number, command.encode()))
        return self.until(rb"\$%d (.*)\n" % self.number)[1].decode()

    def numbers(self, command):
        return [float(number) for number in re.findall(r"[A-Z](-?[\d.]+)", self.ask(command).removeprefix("ok"))]


def test_an_independent_client_picks_the_object_up():
    process, path, _ = start("object_position=[0.25,0.03,0.03]", "speed=20", "replace_object=false", "cup=bellows")
    client = Client(path)
    client.until(rb"@5 V1\n")
    assert emulated_speed(path) == 20.0
    assert client.ask("P2203") == "ok V4.10.0"
    assert client.ask("P2234") == "ok V1"
    assert client.ask("M17") == "ok"
    waypoints = [client.numbers(f"M2220 X250 Y30 Z{z}") for z in (80, 29, 120)]
    above, down, up = ("G2206 B{:.4f} L{:.4f} R{:.4f} F20".format(*angles) for angles in waypoints)
    assert client.ask(above) == client.ask(down) == client.ask("M2231 V1") == "ok"
    for _ in range(200):
        if client.ask("P2231") == "ok V2":
            break
    else:
        pytest.fail("the pump never reports that it holds")
    assert client.ask(up) == "ok"
    assert client.ask("P2231") == "ok V2"  # still
    assert client.numbers("P2220") == pytest.approx([250.0, 30.0, 120.0], abs=5.0)
    assert client.ask("M2231 V0") == "ok"
    assert client.ask("P2231") == "ok V0"
    assert client.ask(down) == "ok"  # the object lies there again, and stops the cup
    assert client.ask("M2231 V1") == "ok"
    client.ask("G2004 P1000")
    assert client.ask("M2231 V1") == "ok"
    assert client.ask("P2231") == "ok V2"
    os.close(client.descriptor)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=20)[1] == ""
    assert process.returncode == 0


def test_the_command_ends_on_control_c_and_says_what_was_unplugged():
    process, path, _ = start("faults=unplug", "faults.arm=[{effect: unplug, command: P2203}]")
    client = Client(path)
    client.until(rb"@5 V1\n")
    os.write(client.descriptor, b"P2203\n")
    assert process.stdout.readline().startswith("uArm Swift Pro with firmware V4.10.0, object at (")
    assert process.stdout.readline() == "the cable of the arm is unplugged\n"
    os.close(client.descriptor)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20) == ("", "")
    assert process.returncode == 0
    assert not os.path.lexists(path)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("firmware=V5.0", r"firmware is V4\.10, V4\.5 or V3\.2, got 'V5\.0'"),
        ("speed=0", r"speed must be a number above 0 and at most 50, got 0"),
        ("seed=-1", r"seed must be a whole number of at least 0"),
        ("look=sphere", r"look is one of box, sticker, tag, got 'sphere'"),
        ("colour=[300,0,0]", r"colour must be a whole number from 0 to 255, got 300"),
        ("colour=[3]", r"colour must be three numbers, red, green and blue, as in colour=\[217,38,26\], got \[3\]"),
        ("object_position=[1,0,0.03]", r"the cup cannot reach object_position \[1\.0, 0\.0, 0\.03\]"),
        ("nearest_m=1", r"nearest_m must be a number from 0 to 0\.3, got 1"),
        (
            "object_position=[1]",
            r"object_position must be three numbers in metres, as in object_position=\[0\.25",
        ),
        ("image_size=[10,10]", r"image_size must be a whole number from 32 to 1280, got 10"),
        ("realism.backlash_deg=-1", r"realism\.backlash_deg must be a number from 0 to 5, got -1"),
        ("realism.jpeg_quality=30", r"realism\.jpeg_quality must be a whole number from 60 to 100, got 30"),
        ("faults.arm=[{effect: explosion}]", r"a fault's effect is one of silence, late"),
        ("faults.camera=[{effect: reset}]", r"a fault's effect is one of silence, late"),
        ("faults.arm=[{what: reset}]", r"the keys of faults do not fit"),
        ("sim.physics_hz=60", r"sim\.physics_hz must be a whole number from 120 to 10000, got 60"),
    ],
)
def test_bad_values_are_refused_in_a_sentence_before_anything_is_printed(override, sentence, capsys):
    values = configuration.compose("emulate", (override,))
    values.pop("results_dir")
    with pytest.raises(ValueError, match=sentence):
        emulate.emulate(**values)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", ["V4.10", 4.1, "4.10.0", "V4.5", 3.2])
def test_firmware_versions(name):
    with emulate.Workplace(**(configured() | {"firmware": name})) as place:
        place.firmware.advance(10.0)
        place.firmware.advance(10.0, b"P2203\n")
        assert place.firmware.advance(10.1).decode().strip() in ("ok V4.10.0", "ok V4.5.0", "ok V3.2.0")
