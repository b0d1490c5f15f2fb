"""The emulated firmware says, byte by byte and in time, what the released firmware was seen to say."""

from __future__ import annotations

import os
import select
import time
from contextlib import suppress

import pytest

from uarm_rl.emulator.faults import Fault
from uarm_rl.emulator.firmware import PARKED_DEG, Firmware
from uarm_rl.emulator.firmware_3_2 import MarlinFirmware
from uarm_rl.emulator.geometry import POINT_B_DEG
from uarm_rl.emulator.motion import KinematicJoints
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.emulator.realism import Settings

BOOTED_S = 2.0


class Terminal:
    """Somebody who types at the emulated arm and looks at the clock."""

    def __init__(self, settings=None, start=POINT_B_DEG, faults=(), firmware=Firmware):
        self.joints = KinematicJoints(start)
        self.firmware = firmware(settings, self.joints, faults=faults)
        self.now_s = 0.0
        self.banner = self.wait(BOOTED_S)

    def wait(self, seconds):
        self.now_s += seconds
        return self.firmware.advance(self.now_s).decode("latin-1")

    def send(self, text, wait_s=5.0):
        """Type ``text``; returns what comes within ``wait_s``."""
        sent = self.firmware.advance(self.now_s, text.encode("latin-1")).decode("latin-1")
        return sent + self.wait(wait_s)

    def time_until(self, text, reply, limit_s=10.0):
        """Type ``text``; returns the seconds until ``reply`` is complete."""
        start_s, seen = self.now_s, self.send(text, 0.0)
        while reply not in seen:
            assert self.now_s - start_s < limit_s, seen
            seen += self.wait(0.001)
        return self.now_s - start_s


def test_boot_text():
    assert Terminal().banner == (
        "angle offset:0.0000\r\ndevice name : SwiftPro\r\nsoft ver : V4.10.0\r\napi ver : V4.0.5\r\n"
        "work mode : 0\r\n@1\n@5 V1\n"
    )
    assert "soft ver : V4.5.0\r\napi ver : V4.0.4\r\n" in Terminal(Settings(firmware="V4.5.0")).banner
    assert "@5" not in Terminal(Settings(power_12v=False)).banner


# Request, reply: tables 5.3 and 5.5 to 5.7 of the facts, from the calibration pose, one after another.
@pytest.mark.parametrize(
    ("request_text", "reply"),
    [
        ("#1 P2200\n", "$1 ok B90.0000 L32.7589 R88.9805\n"),
        ("#1 P2201\n", "$1 ok SwiftPro\n"),
        ("#1 P2202\n", "$1 ok V3.3.1\n"),
        ("#1 P2203\n", "$1 ok V4.10.0\n"),
        ("#1 P2204\n", "$1 ok V4.0.5\n"),
        ("#1 P2205\n", "$1 ok V508CB17684DE\n"),
        ("#1 P2206 N0\n", "$1 ok V90.0000\n"),
        ("#1 P2206 N1\n", "$1 ok V32.7589\n"),
        ("#1 P2206 N2\n", "$1 ok V88.9805\n"),
        ("#1 P2206 N3\n", "$1 ok V89.1000\n"),
        ("#1 P2206 N4\n", "$1 E21\n"),
        ("#1 P2220\n", "$1 ok X192.1500 Y0.0000 Z-49.0600\n"),
        ("#1 P2221\n", "$1 ok S192.1500 R90.0000 H-49.0600\n"),
        ("#1 P2231\n", "$1 ok V0\n"),
        ("#1 P2232\n", "$1 ok V0\n"),
        ("#1 P2233\n", "$1 ok V0\n"),
        ("#1 P2234\n", "$1 ok V1\n"),
        ("#1 P2235\n", "$1 ok V0\n"),
        ("#1 P2236 N0\n", "$1 ok V1\n"),
        ("#1 P2240 N1\n", "$1 ok V0\n"),
        ("#1 P2241 N1\n", "$1 ok V0\n"),
        ("#1 P2242\n", "$1 ok B2000 L2000 R2000\n"),
        ("#1 P2243\n", "$1 ok B2000 L2000 R2000\n"),
        ("#1 P2244\n", "$1 ok V0\n"),
        ("#1 P2400\n", "$1 ok V0\n"),
        ("#34P2203\n", "$34 ok V4.10.0\n"),
        ("#31 p2203\r", "$31 ok V4.10.0\n"),
        ("#0 P2203\n", "$0 ok V4.10.0\n"),
        ("P2203\n", "ok V4.10.0\n"),
        ("#1 (comment) P2203 ; more\n", "$1 ok V4.10.0\n"),
        ("#1 P9999\n", "$1 ok\n"),
        ("#1 S9999\n", "$1 ok\n"),
        ("#1 G9999\n", "$1 E20\n"),
        ("#1 M9999\n", "$1 E20\n"),
        ("#1 M2200\n", "$1 E20\n"),
        ("#1 G2203\n", "$1 E20\n"),
        ("#1 M2245 Vname\n", "$1 E20\n"),
        ("#1 hello\n", "$1\n"),
        ("#1 G4\n", "$1\n"),
        ("#1 G1 X200 Y0 Z150\n", "$1\n"),
        ("#1 G1 X200 Y0 Z150 F-5\n", "$1\n"),
        ("hello\n", ""),
        ("\n", ""),
        ("#1 G2202 N0 V100\n", "sscanf 1\r\n$1 E21\n"),
        ("#1 G2202 N4 V100 F50\n", "$1 E21\n"),
        ("#1 M2222 X200 Y0 Z150\n", "sscanf 1\r\n$1 E21\n"),
        ("#1 M204 P200 T200 R200\n", "sscanf 1\r\n$1 E21\n"),
        ("#1 M2222 X200 Y0 Z150 P0\n", "$1 ok V1\n"),
        ("#1 M2222 X500 Y0 Z150 P0\n", "$1 ok V0\n"),
        ("#1 M2222 X200 Y90 Z150 P1\n", "$1 ok V1\n"),
        ("#1 M2222 X200 Y90 Z-200 P1\n", "$1 ok V0\n"),
        ("#1 M2220 X500 Y0 Z150\n", "$1 ok B  NAN L  NAN R  NAN\n"),
        ("#1 M2220 X200 Y0 Z150\n", "$1 ok B90.0000 L100.9902 R8.0774\n"),
        ("#1 M2221 B90 L50 R50\n", "$1 ok X263.2519 Y0.0000 Z20.0264\n"),
        ("#1 G0 X500 Y0 Z150 F50\n", "$1 E22\n"),
        ("G0 X500 Y0 Z150 F50\n", "E22\n"),
        ("#1 G2206 B90 L80 R120 F50\n", "$1 E22\n"),
        ("#1 G2206 B90 L100 R75 F50\n", "$1 E22\n"),  # the coupled limit
        ("#1 G2206 B90 L-3 R60 F50\n", "$1 ok\n"),
        ("#1 G2206 B90 L80 R40 F0\n", "$1 ok\n"),
        ("#1 G2202 N3 V90 F50\n", "$1 ok\n"),
        ("#1 G2202 N3 V400 F50\n", "$1 ok\n"),  # ignored in silence
        ("#1 G2202 N0 V45 F50\n", "$1 ok\n"),
        ("#1 G2202 N0 V190 F50\n", "$1 E22\n"),
        ("#1 G1 X200 Y0 Z150 F50\n", "$1 ok\n"),
        ("#1 G0 Z150 F50 X200 Y0\n", "$1 ok\n"),  # in any order
        ("#1 G0 X-100 Y0 Z150 F50\n", "$1 E22\n"),  # behind the arm
        ("#1 G2201 S200 R90 H150 F50\n", "$1 ok\n"),
        ("#1 G2201 S200 R190 H150 F50\n", "$1 E22\n"),
        ("#1 G2204 X10 Y0 Z50 F50\n", "$1 ok\n"),
        ("#1 G2204 X500 Y0 Z50 F50\n", "$1 E22\n"),
        ("#1 G2204 X10 Y0 F50\n", "sscanf 1\r\n$1 E21\n"),
        ("#1 G2205 S10 R-10 H50 F50\n", "$1 ok\n"),
        ("#1 G2004 P1000\n", "$1 ok\n"),
        ("#1 G90\n", "$1 ok\n"),
        ("#1 G91\n", "$1 ok\n"),
        ("#1 G92\n", "$1 ok\n"),
        ("#1 M17\n", "$1 ok\n"),
        ("#1 M18\n", "$1 ok\n"),
        ("#1 M2019\n", "$1 ok\n"),
        ("#1 M2201 N0\n", "$1 ok\n"),
        ("#1 M2201 N4\n", "$1 E21\n"),
        ("#1 M2202 N3\n", "$1 ok\n"),
        ("#1 M204 A10\n", "$1 ok\n"),
        ("#1 M2120 V0\n", "$1 ok\n"),
        ("#1 M2121\n", "$1 ok\n"),
        ("#1 M2122 V1\n", "$1 ok\n"),
        ("#1 M2123 V1\n", "$1 ok\n"),
        ("#1 M2124 V1\n", "$1 ok\n"),
        ("#1 M2213 V0\n", "$1 ok\n"),
        ("#1 M2232 V1\n", "$1 ok\n"),
        ("#1 M2233 V0\n", "$1 ok\n"),
        ("#1 M2234 V1\n", "$1 ok\n"),
        ("#1 M2240 N1 V1\n", "$1 ok\n"),
        ("#1 M2241 N1 V1\n", "$1 ok\n"),
        ("#1 S1000 V0\n", "$1 ok\n"),
        ("#1 M2203 N0\n", "$1 ok V1\n"),
        ("#1 M2231 V1\n", "$1 ok\n"),
        ("#1 M2231 V2\n", "$1 ok\n"),  # the valve alone
        ("#1 M2231 V3\n", "$1 E21\n"),
        ("#1 M2400 S0\n", "$1 ok\n"),
        ("#1 M2210 F1000 T200\n", "$1 ok\n"),
        ("#1 M2210 F1000\n", "sscanf 1\r\n$1 E21\n"),
        ("?", "<Idle,MPos:0.000,0.000,0.000,WPos:0.000,0.000,0.000>\r\n"),
        ("!", "ok @9 V0\n"),
        ("~", "ok\n"),
        ("\x18", "ok\n"),
        ("#1 P2203 " + 80 * "x" + "\n", "error: E23\n\r\n"),
    ],
)
def test_request_and_reply(request_text, reply):
    assert Terminal().send(request_text) == reply


# Table 1.7: motor angles, cup, whether firmware 4.10 and 4.5 go there.
@pytest.mark.parametrize(
    ("motor_deg", "cup_mm", "legal", "legal_before_4_8"),
    [
        ((90, 100.9902, 8.0774), (200.0, 0, 150.0), True, True),
        ((90, 123.6172, 0.4184), (150.0, 0, 150.0), True, True),
        ((90, 118, 50), (105.2333, 0, 36.6348), True, True),
        ((90, 32.758930, 88.980537), (192.15, 0, -49.06), True, True),
        ((90, 90, 0.5), (228.654, 0, 173.5341), True, True),
        ((90, 29.5, 0.5), (352.3054, 0, 101.4228), True, True),
        ((135, 80, 30), (164.0867, 164.0867, 93.3566), True, True),
        ((45, 80, 30), (164.0867, -164.0867, 93.3566), True, True),
        ((90, 45, 75), (211.4117, 0, -20.09), True, True),
        ((90, 55.9357, 71.4307), (200.0, 0, 0), True, True),
        ((109.6538, 40.3782, 41.3348), (280.0, 100.0, 20.0), True, True),
        ((45, 111.6799, 16.4119), (120.0, -120.0, 120.0), True, True),
        ((90, -3, 60), (291.1303, 0, -112.1189), True, False),
        ((90, 100, -3), (203.7722, 0, 181.0731), True, False),
    ],
)
def test_the_firmwares_own_kinematics(motor_deg, cup_mm, legal, legal_before_4_8):
    arm, older = Terminal(), Terminal(Settings(firmware="V4.5.0"))
    b, left, right = motor_deg
    answer = arm.send(f"#1 M2221 B{b} L{left} R{right}\n")
    assert [float(word[1:]) for word in answer.split()[2:]] == pytest.approx(cup_mm, abs=0.002)
    answer = arm.send("#2 M2220 X{} Y{} Z{}\n".format(*cup_mm))
    assert [float(word[1:]) for word in answer.split()[2:]] == pytest.approx(motor_deg, abs=0.002)
    for terminal, allowed in ((arm, legal), (older, legal_before_4_8)):
        assert terminal.send(f"#3 G2206 B{b} L{left} R{right} F100\n") == ("$3 ok\n" if allowed else "$3 E22\n")


@pytest.mark.parametrize(
    ("request_text", "reply"),
    [
        ("#1 P2203\n", "$1 ok V4.5.0\n"),
        ("#1 P2204\n", "$1 ok V4.0.4\n"),
        ("#1 P2235\n", "$1 ok\n"),  # unknown P
        ("#1 P2244\n", "$1 ok\n"),
        ("#1 M2124 V1\n", "$1 E20\n"),
        ("#1 M2231 V2\n", "$1 E21\n"),
        ("#1 M2231 V1\n#2 P2231\n", "$1 ok\n$2 ok V1\n"),  # without debug text
        ("#1 G2206 B90 L80 R40 F50\n", "$1 ok\n"),
    ],
)
def test_request_and_reply_of_4_5(request_text, reply):
    assert Terminal(Settings(firmware="V4.5.0")).send(request_text) == reply


def test_the_tool_mode_is_one_digit_and_survives_a_reset():
    arm = Terminal()
    assert arm.send("#1 M2400 S10\n") == "$1 ok\n"
    assert arm.send("#2 P2400\n") == "$2 ok V1\n"
    arm.firmware.reset()
    assert "work mode : 1\r\n" in arm.wait(BOOTED_S)


def test_a_dwell_answers_at_once_and_holds_back_what_follows():
    arm = Terminal()
    assert arm.send("#1 G2004 P1000\n#2 M2231 V0\n#3 P2234\n", 0.5) == "$1 ok\n$3 ok V1\n"
    assert arm.wait(1.0) == "$2 ok\n"


def test_relative_moves_start_at_the_parsers_position():
    arm = Terminal()
    arm.send("G0 X200 Y0 Z100 F50\nG91\n")
    assert arm.send("#1 G0 X10 Y0 Z0 F50\n") == "$1 ok\n"
    x_mm = float(arm.send("#2 P2220\n").split()[2].removeprefix("X"))
    assert x_mm == pytest.approx(210.0, abs=0.3)


def test_a_move_reads_back_quantised():
    arm = Terminal()
    assert arm.send("#1 G0 X200 Y0 Z150 F50\n") == "$1 ok\n"
    assert arm.send("#2 P2220\n") == "$2 ok X200.0515 Y0.0000 Z149.8931\n"
    assert arm.send("#3 P2221\n") == "$3 ok S200.0515 R90.0000 H149.8931\n"
    assert arm.send("?") == "<Idle,MPos:0.853,-1.011,0.000,WPos:0.853,-1.011,0.000>\r\n"


def test_missing_axes_come_from_the_parser():
    arm = Terminal()
    arm.send("G0 X200 Y0 Z150 F50\n")
    arm.send("#1 G2206 B90 L70 R40 F50\n")
    assert arm.send("#2 G0 Z100\n") == "$2 ok\n"
    assert arm.send("#3 P2220\n").startswith("$3 ok X200.")
    assert Terminal().send("#1 G0 Z100 F50\n") == "$1 E22\n"  # the parser starts at (0, 0, 0)


@pytest.mark.parametrize(
    ("feed", "change", "expected_s"),
    [  # a joint, or all three, by 0.15 rad = 8.594 degrees; first byte to the end of the motion
        (10, (8.594, 0, 0), 0.658),
        (20, (8.594, 0, 0), 0.352),
        (30, (8.594, 0, 0), 0.261),
        (100, (8.594, 0, 0), 0.204),
        (10, (8.594, 8.594, 8.594), 1.123),
        (20, (8.594, 8.594, 8.594), 0.574),
        (30, (8.594, 8.594, 8.594), 0.398),
    ],
)
def test_speed_law(feed, change, expected_s):
    arm = Terminal(start=(90.0, 90.0, 30.0))
    b, left, right = (at + d for at, d in zip(arm.firmware.machine.motion.position, change, strict=True))
    took_s = arm.time_until(f"#1 G2206 B{b:.4f} L{left:.4f} R{right:.4f} F{feed}\n", "$1 ok\n")
    assert took_s == pytest.approx(expected_s + 0.0137, abs=0.015)


def test_replies_wait_for_standstill_in_a_burst_and_the_pump_does_not():
    arm = Terminal()
    assert arm.send("#1 G0 X200 Y0 Z150 F50\n#2 M2231 V1\n#3 G0 X250 Y0 Z100 F50\n#4 P2234\n", 0.05) == "$4 ok V1\n"
    assert arm.joints.sucking
    assert arm.send("", 5.0) == "$1 ok\n$2 ok\n$3 ok\n"
    assert arm.send("#5 P2231\n") == "value:0      value2:0$5 ok V1\n"
    arm.joints.sealed = True
    assert arm.send("#6 P2231\n") == "value:0      value2:0$6 ok V2\n"


def test_there_is_no_preemption():
    arm = Terminal(start=(90.0, 90.0, 30.0))
    arm.send("#1 G2206 B120 L90 R30 F20\n", 0.3)
    assert arm.send("#2 G2206 B90 L90 R30 F20\n", 1.0) == ""
    assert arm.firmware.machine.motion.position[0] > 110.0  # still on the way to the first target, or just there
    assert arm.wait(5.0) == "$1 ok\n$2 ok\n"


def test_encoder_queries_in_motion_answer_too_early():
    for strict, expected in ((False, "$1 ok\n$2 ok B"), (True, "$2 ok B")):
        arm = Terminal(Settings(false_ok=not strict), start=(90.0, 90.0, 30.0))
        arm.send("#1 G2206 B120 L90 R30 F20\n", 0.3)
        assert arm.send("#2 P2200\n", 0.06).startswith(expected)
        assert arm.firmware.machine.motion.moving
    arm = Terminal(start=(90.0, 90.0, 30.0))
    arm.send("#1 G2206 B120 L90 R30 F20\n", 0.3)
    assert arm.send("#2 P2206 N0\n?", 0.06).count("ok") == 1  # harmless
    assert "<Run," in arm.send("?", 0.01)


@pytest.mark.parametrize(
    ("query", "expected_s"),
    [
        ("#1 P2200\n", 0.040),
        ("#1 P2220\n", 0.040),
        ("#1 P2206 N0\n", 0.0143),
        ("#1 P2203\n", 0.0015),
        ("#1 M17\n", 0.040),
        ("#1 M2123 V1\n", 0.040),
    ],
)
def test_latencies(query, expected_s):
    assert Terminal().time_until(query, "$1 ok") == pytest.approx(expected_s, abs=0.002)


def test_flush_stops_at_once_and_answers_for_moves_that_did_not_happen():
    arm = Terminal(start=(90.0, 90.0, 30.0))
    arm.send("#1 G2206 B150 L90 R30 F20\n#2 G2206 B20 L90 R30 F20\n", 0.5)
    assert arm.send("\x18", 0.1) == "ok\n$1 ok\n$2 ok\n"
    stopped = arm.joints.angles[0]
    assert 91.0 < stopped < 120.0
    assert arm.send("#3 G2206 B90 L90 R30 F20\n") == "$3 ok\n"
    assert arm.joints.angles[0] == pytest.approx(90.0, abs=0.05)


def test_flush_of_older_firmware_locks_it():
    arm = Terminal(Settings(firmware="V4.5.0"), start=(90.0, 90.0, 30.0))
    arm.send("#1 G2206 B150 L90 R30 F20\n", 0.5)
    assert arm.send("\x18", 1.0) == "ALARM: Abort during cycle\r\n['$H'|'$X' to unlock]\r\n"
    assert arm.send("#2 G2206 B90 L90 R30 F20\n") == ""  # swallowed
    assert arm.send("#3 M2231 V0\n") == "$3 ok\n"


def test_feed_hold_and_resume():
    arm = Terminal(start=(90.0, 90.0, 30.0))
    arm.send("#1 G2206 B120 L90 R30 F20\n", 0.5)
    assert arm.send("!", 3.0) == "ok @9 V0\n"
    assert arm.send("?", 0.01).startswith("<Hold,")
    assert arm.send("~", 3.0) == "ok\n$1 ok\n"


def test_too_many_requests():
    arm = Terminal(start=(90.0, 90.0, 30.0))
    text = arm.send("#1 G2206 B120 L90 R30 F20\n", 0.1)
    for number in range(2, 31):
        text += arm.send(f"#{number} M2231 V0\n", 0.01)
    text += arm.wait(5.0)
    assert text.count("E23 buffer full\r\n") == 10
    assert text.count(" ok\n") == 20


def test_bytes_beyond_the_receive_buffer_are_lost():
    arm = Terminal()
    replies = arm.send("#1 P2200\n" + "".join(f"#{n} P2203\n" for n in range(10, 40)))
    assert 10 < replies.count("V4.10.0") < 20


def test_a_released_motor_refuses_to_move():
    arm = Terminal()
    arm.send("#1 M2202 N0\n")
    assert [arm.send(f"#2 M2203 N{n}\n") for n in range(3)] == ["$2 ok V1\n", "$2 ok V1\n", "$2 ok V0\n"]  # mixed up
    assert arm.send("#3 G2206 B90 L80 R40 F50\n") == "$3 E27\n"
    arm.send("#4 M17\n")
    assert arm.send("#5 G2206 B90 L80 R40 F50\n") == "$5 ok\n"
    older = Terminal(Settings(firmware="V4.5.0"))
    older.send("#1 M2019\n")
    assert older.send("#2 G2206 B90 L80 R40 F50\n", 0.1) == "$2 ok\n"  # and does not move
    assert older.joints.angles == pytest.approx(POINT_B_DEG, abs=0.05)


def test_limits_before_4_8():
    arm = Terminal(Settings(firmware="V4.5.0"))
    assert arm.send("#1 G2206 B90 L-3 R60 F50\n") == "$1 E22\n"


def test_without_12_v_everything_is_ok_and_nothing_moves():
    arm = Terminal(Settings(power_12v=False))
    assert arm.send("#1 P2234\n#2 G2206 B90 L80 R40 F50\n", 0.1) == "$1 ok V0\n$2 ok\n"
    assert arm.joints.angles == pytest.approx(POINT_B_DEG, abs=0.05)


def test_reports():
    arm = Terminal()
    arm.send("#1 M2122 V1\n")
    assert arm.send("#2 G2206 B90 L80 R40 F50\n").endswith("$2 ok\n@9 V0\n")
    arm.joints.pressed = True
    assert arm.send("", 0.1) == "@6 N0 V1\n"
    assert arm.send("#3 M2120 V0.2\n", 1.0).count("@3 X") in (4, 5, 6)
    arm.send("#4 M2120 V0\n")
    assert arm.wait(1.0) == ""


def test_realism_is_configuration():
    slow = Terminal(Settings(latency_s=0.1))
    assert slow.time_until("#1 P2203\n", "$1 ok") == pytest.approx(0.1015, abs=0.002)
    biased = Terminal(Settings(encoder_offset_deg=(1.0, 0.0, 0.0)), start=(90.0, 90.0, 30.0))
    biased.send("#1 G2206 B90 L90 R30 F50\n")
    assert biased.joints.angles[0] == pytest.approx(89.0, abs=0.05)
    loose = KinematicJoints((90.0, 90.0, 30.0), backlash_deg=0.4)
    loose.drive((95.0, 90.0, 30.0), 0.01)
    assert loose.angles[0] == pytest.approx(94.8)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (Fault("silence", "P2203"), ""),
        (Fault("lost", "P2203"), "$2 ok V1\n"),
        (Fault("duplicate", "P2203"), "$1 ok V4.10.0\n$1 ok V4.10.0\n$2 ok V1\n"),
        (Fault("late", "P2203", delay_s=0.5), "$2 ok V1\n$1 ok V4.10.0\n"),
        (Fault("garbage", "P2203", data=b"\xff$\n"), "\xff$\n$1 ok V4.10.0\n$2 ok V1\n"),
        (Fault("error", "P2203", data=b"E25"), "$1 E25\n$2 ok V1\n"),
        (Fault("error", "P2203"), "$1\n$2 ok V1\n"),
        (Fault("slow", "P2203", delay_s=0.01), "$1 ok V4.10.0\n$2 ok V1\n"),
        (Fault("power", "P2203", delay_s=0.5), "$1 ok V4.10.0\n$2 ok V1\n@5 V0\n"),
        (Fault("lost", "P2203", nth=2), "$1 ok V4.10.0\n$2 ok V1\n"),
        (Fault("lost", "any", nth=2), "$1 ok V4.10.0\n"),
        (Fault("lost", "any", times=2), ""),
    ],
)
def test_faults(fault, expected):
    assert Terminal(faults=(fault,)).send("#1 P2203\n#2 P2234\n", 0.9) == expected


def test_reset_and_unplug_in_a_move():
    arm = Terminal(start=(90.0, 90.0, 30.0), faults=(Fault("reset", "G2206", delay_s=0.2),))
    text = arm.send("#1 M2231 V1\n#2 G2206 B150 L90 R30 F20\n", 3.0)
    assert text.startswith("$1 ok\nangle offset")
    assert not arm.joints.sucking
    assert arm.joints.angles[0] < 100.0
    arm = Terminal(faults=(Fault("unplug", "P2203", delay_s=0.2),))
    assert arm.send("#1 P2203\n", 0.1) == "$1 ok V4.10.0\n"
    assert arm.send("#2 P2203\n", 0.5) == ""
    assert arm.firmware.unplugged


@pytest.mark.parametrize(
    "wrong",
    [
        {"effect": "explosion"},
        {"effect": "late", "delay_s": -1.0},
        {"effect": "lost", "nth": 0},
        {"effect": "lost", "times": 0},
    ],
)
def test_wrong_faults_are_refused(wrong):
    with pytest.raises(ValueError, match="fault"):
        Fault(**wrong)


def test_the_same_bytes_in_the_same_time_slices():
    """What is sent does not depend on how often the state machine is asked."""
    texts = []
    for slice_s in (0.003, 0.05):
        arm = Terminal()
        text = arm.send("#1 G2206 B120 L80 R40 F20\n#2 P2206 N0\n", 0.0)
        while arm.now_s < BOOTED_S + 4.0:
            text += arm.wait(slice_s)
        texts.append(text.split("\n")[-2:])
    assert texts[0] == texts[1]


def test_firmware_3_2_speaks_differently():
    arm = Terminal(Settings(firmware="V3.2.0"), firmware=MarlinFirmware)
    assert arm.banner.startswith("start\necho:Marlin")
    assert arm.wait(2.0) == "@5 V1\r\n"
    assert arm.send("#1 P2203\n") == "$1 ok V3.2.0\r\n"
    assert arm.send("#2 P2200\n") == "$2 ok B90.00 L32.76 R88.98\r\n"
    assert arm.send("#3 M2231 V0\n") == "$3 ok\n"
    assert arm.send("#4 G0 X500 Y0 Z150 F5000\n") == "$4 ok E22 unreachable\r\n\r\n"
    assert arm.send("#5 G0 X200 Y0 Z150 F20\n", 0.05) == "$5 ok\n"  # while it moves
    assert arm.send("#6 M2200\n", 0.05) == "$6 ok V1\r\n"
    assert arm.send("#7 G2206 B90 L80 R40 F50\n") == 'echo:Unknown command: "G2206B90L80R40F50"\n'


def _read_until(descriptor, text, limit_s=20.0):
    seen, end_s = b"", time.monotonic() + limit_s
    while text not in seen:
        assert select.select([descriptor], [], [], max(0.0, end_s - time.monotonic()))[0], seen
        seen += os.read(descriptor, 4096)
    return seen


def test_on_a_pseudo_terminal_opening_resets_and_bytes_are_raw():
    with PtyServer(Firmware(joints=KinematicJoints(PARKED_DEG)), speed=20.0) as server:
        descriptor = os.open(server.path, os.O_RDWR | os.O_NOCTTY)
        try:
            assert b"@1\n@5 V1\n" in _read_until(descriptor, b"@5 V1\n")
            os.write(descriptor, b"#1 P2203\n#2 G2206 B90 L101 R8 F50\n")
            assert _read_until(descriptor, b"$2 ok\n") == b"$1 ok V4.10.0\n$2 ok\n"  # no echo
        finally:
            os.close(descriptor)


def test_an_unplugged_pseudo_terminal_ends():
    with PtyServer(Firmware(faults=(Fault("unplug", "P2203"),)), speed=20.0) as server:
        descriptor = os.open(server.path, os.O_RDWR | os.O_NOCTTY)
        try:
            _read_until(descriptor, b"@5 V1\n")
            os.write(descriptor, b"#1 P2203\n")
            assert server.wait(20.0)
            with suppress(OSError):  # EIO, or the end of the file
                while os.read(descriptor, 4096):
                    pass
        finally:
            os.close(descriptor)


def test_what_breaks_behind_the_terminal_is_raised():
    class Broken(KinematicJoints):
        def drive(self, motor_deg, dt_s):
            raise RuntimeError("the world ended")

    with pytest.raises(RuntimeError, match="the world ended"), PtyServer(Firmware(joints=Broken(PARKED_DEG))) as server:
        assert server.wait(20.0)
