"""The driver of the real arm against the emulated firmware: connecting, moving, sucking."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from tests.bench import HOME, Bench
from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.firmware_3_2 import MarlinFirmware
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.emulator.realism import Settings
from uarm_rl.real.audit import Limits, UnsafeCommandError
from uarm_rl.real.handshake import NotReadyError
from uarm_rl.real.link import BadReplyError, CommandRefusedError, LinkLostError, NoReplyError, open_link
from uarm_rl.real.swift_arm import PumpError, PumpState, SwiftArm
from uarm_rl.task import kinematics
from uarm_rl.task.arm import Arm


def test_it_is_an_arm():
    arm: Arm = Bench().connect()
    arm.close()


# Connecting


def test_the_first_thing_said_is_pump_off():
    bench = Bench()
    bench.connect()
    assert bench.lines() == ["M2231 V0", "P2203", "P2234", "P2400", "P2231", "M17", "P2200"]


def test_another_tool_mode_is_set_back_and_verified():
    bench = Bench(Settings(tool_mode=3))
    bench.connect()
    assert bench.lines()[3:6] == ["P2400", "M2400 S0", "P2400"]


@pytest.mark.parametrize("firmware", ["V4.5.0", "V4.8.0", "V4.10.0", "V4.11.0"])
def test_firmware_that_is_accepted(firmware):
    with Bench(Settings(firmware=firmware)).connect() as arm:
        assert f"V{'.'.join(map(str, arm.firmware))}" == firmware
        arm.home()
        assert arm.read_joints() == pytest.approx(HOME, abs=0.002)


@pytest.mark.parametrize("firmware", ["V3.2.0", "V4.4.1", "V5.0.0", "V2.1"])
def test_firmware_that_is_refused(firmware):
    bench = Bench(Settings(firmware=firmware))
    with pytest.raises(NotReadyError, match=rf"runs firmware {firmware}; this driver needs V4.5.0 or later"):
        bench.connect()
    assert bench.lines()[-2:] == ["M2231 V0", "P2231"]


@pytest.mark.parametrize(
    ("settings_", "faults", "error", "words"),
    [
        (Settings(power_12v=False), (), NotReadyError, "no 12 V power; plug in"),
        (Settings(tool_mode=3), (Fault("error", "M2400", data=b"ok"),), NotReadyError, "stays in tool mode 3"),
        (Settings(), (Fault("silence"),), NoReplyError, "this is the arm's port"),
        (Settings(), (Fault("error", "P2203", data=b"ok"),), NotReadyError, "no version given"),
        (Settings(), (Fault("error", "P2200", data=b"ok B900.0 L0 R0"),), BadReplyError, "cannot reach"),
        (Settings(), (Fault("error", "M17", data=b"E20"),), CommandRefusedError, "does not know the command"),
        (Settings(), (Fault("unplug", "P2234"),), LinkLostError, "check the USB cable"),
    ],
)
def test_an_arm_that_is_not_ready(settings_, faults, error, words):
    bench = Bench(settings_, faults=faults)
    with pytest.raises(error, match=words):
        bench.connect()
    assert bench.joints.angles == pytest.approx(PARKED_DEG, abs=0.05)
    assert "M2231 V0" in bench.lines()[-2:]


def test_firmware_3_2_is_recognised_and_refused():
    bench = Bench(Settings(firmware="V3.2.0"), firmware=MarlinFirmware)
    with pytest.raises(NotReadyError, match=r"V3.2.0.*says ok before a move has ended; update it"):
        bench.connect()
    assert bench.lines()[0] == "M2231 V0"


@pytest.mark.parametrize("keywords", [{"feed": 0.0}, {"feed": 31.0}, {"feed": math.nan}, {"control_hz": 0}, {"speed": 0}])
def test_constructor_values_are_checked(keywords):
    with pytest.raises(ValueError, match="must be"):
        Bench(**keywords).connect()


@pytest.mark.parametrize("wrong", [{"z_m": (0.1, 0.0)}, {"max_step_rad": 0.0}, {"max_speed_deg_s": math.inf}])
def test_limits_are_checked(wrong):
    with pytest.raises(ValueError, match="limits"):
        Limits(**wrong)


def test_an_arm_that_runs_already_needs_no_banner():
    bench = Bench()
    bench.port.firmware.advance(2.0)  # the banner goes to nobody
    with bench.connect() as arm:
        assert arm.read_joints() == pytest.approx(kinematics.from_motor_deg(*PARKED_DEG), abs=0.002)


# Moving


def test_one_decision_is_one_line_and_lasts_until_the_arm_stands():
    bench = Bench()
    arm = bench.connect()
    arm.home()
    position = arm.read_joints()
    start, start_s = len(bench.port.written), bench.port.clock()
    target = position[0] + 0.15, position[1], position[2]
    arm.command_joints(target)
    assert bench.port.clock() == start_s
    assert arm.advance() == 7
    assert bench.port.clock() - start_s == pytest.approx(0.352 + 0.014, abs=0.03)  # 0.15 rad of one joint at F 20
    assert arm.read_joints() == pytest.approx(target, abs=0.002)
    assert [line.split()[0] for line in bench.lines(start)] == ["G2206", "P2200"]
    assert re.fullmatch(r"G2206 B[\d.]+ L[\d.]+ R[\d.]+ F20.0", bench.lines(start)[0])


def test_a_refused_move_leaves_an_arm_that_works():
    bench = Bench(faults=(Fault("error", "G2206", nth=2, data=b"E22"),))
    arm = bench.connect()
    arm.home()
    arm.command_joints((HOME[0] + 0.1, HOME[1], HOME[2]))
    with pytest.raises(CommandRefusedError, match="outside the limits") as caught:
        arm.advance()
    assert caught.value.code == "E22"
    assert arm.read_joints() == pytest.approx(HOME, abs=0.002)
    arm.command_joints((HOME[0] + 0.2, HOME[1], HOME[2]))
    arm.advance()
    assert arm.read_joints()[0] == pytest.approx(0.2, abs=0.002)


def test_a_move_that_was_never_confirmed_is_the_last():
    arm = Bench(faults=(Fault("lost", "G2206"),)).connect()
    with pytest.raises(NoReplyError, match="did not answer within"):
        arm.home()
    with pytest.raises(NoReplyError, match="never confirmed its last move; close the connection"):
        arm.command_joints(HOME)


def test_advance_at_rest_lets_a_control_period_pass():
    bench = Bench(control_hz=10.0)
    arm = bench.connect()
    start_s = bench.port.clock()
    assert arm.advance() == 1
    assert bench.port.clock() - start_s == pytest.approx(0.1, abs=0.03)


def test_on_a_fast_emulator_the_arms_own_time_counts():
    bench = Bench(speed=4.0)
    arm = bench.connect()
    arm.home()
    start_s = arm.time_s()
    arm.command_joints((HOME[0] + 0.15, HOME[1], HOME[2]))
    assert arm.advance() == pytest.approx(29, abs=2)  # 0.366 s of the program, 1.46 s of the arm
    arm.rest(0.8)
    assert arm.time_s() - start_s == pytest.approx(1.46 + 0.8, abs=0.15)


def test_encoders_and_pump_are_left_alone_in_motion(monkeypatch):
    bench = Bench()
    write, motion = bench.port.write, bench.port.firmware.machine
    monkeypatch.setattr(bench.port, "write", lambda data: (_refuse_in_motion(data, motion.motion.moving), write(data))[1])
    arm = bench.connect()
    arm.home()
    for use in (arm.read_joints, arm.pump_on, arm.pump_off, arm.home, lambda: arm.command_joints(HOME)):
        arm.command_joints((HOME[0], HOME[1] + 0.1, HOME[2]))
        use()


def _refuse_in_motion(data, moving):
    assert not moving, data


def test_homing_from_a_sagged_arm_lifts_it_off_the_table():
    bench = Bench(start=(60.0, 55.0, 74.0))  # the cup about 4 mm below the table
    with bench.connect() as arm:
        with pytest.raises(UnsafeCommandError, match="closer to the table"):
            arm.command_joints(np.add(arm.read_joints(), (0.1, 0.0, 0.0)).tolist())
        arm.home()
        assert kinematics.cup_position(arm.read_joints()) == pytest.approx(kinematics.HOME_CUP_M, abs=5e-4)


def test_lost_steps_are_told_and_gone_after_homing(caplog):
    bench = Bench()
    with bench.connect() as arm:
        arm.home()
        bench.port.firmware.machine.motion.position = (95.0, 101.0, 8.0)  # somebody pushes the arm by 5 degrees
        bench.port.firmware.advance(bench.port.clock() + 0.1)
        arm.read_joints()
        assert "5.0 degrees from where it was sent" in caplog.text
        arm.home()
        assert arm.read_joints() == pytest.approx(HOME, abs=0.002)


def test_the_pump():
    bench = Bench()
    with bench.connect() as arm:
        assert arm.pump_state() is PumpState.STOPPED
        arm.pump_on()
        assert arm.pump_state() is PumpState.PUMPING
        bench.joints.sealed = True
        assert arm.pump_state() is PumpState.HOLDING
        arm.pump_off()
        assert not bench.joints.sucking
        arm.pump_on()
    assert not bench.joints.sucking  # the end switches it off


@pytest.mark.parametrize("method", ["pump_on", "pump_off"])
def test_a_pump_that_does_not_obey(method):
    nth = 2 if method == "pump_on" else 3
    bench = Bench(faults=(Fault("error", "M2231", nth=nth, data=b"ok"),))
    arm = bench.connect()
    if method == "pump_off":
        arm.pump_on()
    with pytest.raises(PumpError, match=r"did not st(art|op)"):
        getattr(arm, method)()
    arm.close()
    assert not bench.joints.sucking


# On real terminals


def test_a_session_on_a_real_terminal():
    joints = KinematicJoints(PARKED_DEG)
    with PtyServer(Firmware(joints=joints), speed=20.0) as server:
        with SwiftArm(open_link(server.path)) as arm:
            arm.home()
            for angle in (0.1, 0.2, 0.1):
                arm.command_joints((angle, HOME[1], HOME[2]))
                arm.advance()
                assert arm.read_joints() == pytest.approx((angle, HOME[1], HOME[2]), abs=0.002)
            arm.pump_on()
            assert joints.sucking
        assert not joints.sucking
