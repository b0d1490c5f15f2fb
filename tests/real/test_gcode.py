"""Commands to bytes, lines to replies."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uarm_rl.real import gcode
from uarm_rl.real.gcode import Alarm, Boot, Command, Noise, Reply, Report, decode, encode


@pytest.mark.parametrize(
    ("number", "command", "line"),
    [
        (1, gcode.PUMP_OFF, b"#1 M2231 V0\n"),
        (2, gcode.MOTORS_ON, b"#2 M17\n"),
        (3, gcode.SUCTION_MODE, b"#3 M2400 S0\n"),
        (4, Command("G2206", 90, 100.9902, 8.0774, 20), b"#4 G2206 B90.000 L100.990 R8.077 F20.0\n"),
        (5, Command("G2206", 90, 100, -0.0001, 20), b"#5 G2206 B90.000 L100.000 R0.000 F20.0\n"),
        (9999, Command("G2206", 180, 135.6, 119.9, 250), b"#9999 G2206 B180.000 L135.600 R119.900 F250.0\n"),
    ],
)
def test_encode(number, command, line):
    assert encode(number, command) == line


@pytest.mark.parametrize("name", ["G0", "M2500", "M2401", "M2410", "M2215", "S1100", "@", "$X", "P2200\n#1 M2231 V1", ""])
def test_only_the_white_list_can_be_encoded(name):
    with pytest.raises(ValueError, match="not among the commands"):
        Command(name)


@pytest.mark.parametrize(
    "values",
    [(90, 100, 8), (90, 100, 8, 20, 1), (math.nan, 100, 8, 20), (90, math.inf, 8, 20), (90, 100, 8, 0), (181, 100, 8, 20)],
)
def test_values_are_checked(values):
    with pytest.raises(ValueError, match="G2206"):
        Command("G2206", *values)


@pytest.mark.parametrize("number", [0, -1, 10000])
def test_request_numbers_are_checked(number):
    with pytest.raises(ValueError, match="request number"):
        encode(number, gcode.READ_PUMP)


@given(st.integers(1, gcode.MAX_NUMBER), st.sampled_from(sorted(gcode.COMMANDS)), st.data())
def test_every_line_fits_the_firmware(number, name, data):
    words = gcode.COMMANDS[name].words
    line = encode(number, Command(name, *(data.draw(st.floats(word.low, word.high)) for word in words)))
    assert len(line) < 50
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert not set(line) & set(b"@?!~;()\r\x18e")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        # Firmware 4.10
        (b"$1 ok\n", Reply(1, True)),
        (b"$1 ok V1\n", Reply(1, True, None, "V1", {"V": "1"})),
        (b"$2 ok V4.10.0", Reply(2, True, None, "V4.10.0", {"V": "4.10.0"})),
        (b"$3 ok B90.0000 L-3.5 R8", Reply(3, True, None, "B90.0000 L-3.5 R8", {"B": "90.0000", "L": "-3.5", "R": "8"})),
        (b"$4 E22\n", Reply(4, False, "E22")),
        (b"$4 E26 V3\n", Reply(4, False, "E26", "V3")),
        (b"$7\n", Reply(7, False)),
        (b"$7 \n", Reply(7, False)),
        (b"value:0      value2:0$28 ok V0\n", Reply(28, True, None, "V0", {"V": "0"})),
        (b"ok @9 V0\n", Reply(None, True, None, "@9 V0", {"V": "0"})),
        (b"ok\n", Reply(None, True)),
        (b"E23 buffer full\r", Reply(None, False, "E23", "buffer full")),
        (b"error: E23\n", Reply(None, False, "E23")),
        (b"@1\n", Report(1)),
        (b"@5 V0\r\n", Report(5, {"V": "0"})),
        (b"@6 N0 V1\n", Report(6, {"N": "0", "V": "1"})),
        (b"soft ver : V4.10.0\r\n", Boot("V4.10.0")),
        (b"angle offset:0.0000\r\n", Boot()),
        (b"ALARM: Abort during cycle\r\n", Alarm("ALARM: Abort during cycle")),
        (b"['$H'|'$X' to unlock]\r\n", Alarm("['$H'|'$X' to unlock]")),
        (b"sscanf 1\r\n", Noise("sscanf 1")),
        # Firmware 3.2
        (b"$5 ok \r\n", Reply(5, True)),
        (b"$5 ok E22 unreachable\r\n", Reply(5, False, "E22", "unreachable")),
        (b"$5 E22 \r\n", Reply(5, False, "E22")),
        (b"start\n", Boot()),
        (b'echo:Unknown command: "M9999"\n', Noise('echo:Unknown command: "M9999"')),
        # Neither
        (b"#1 M2231 V0\n", Noise("#1 M2231 V0")),
        (b"x$1 ok\n", Noise("x$1 ok")),
        (b"$12345678901 ok\n", Noise("$12345678901 ok")),
        (b"", Noise("")),
    ],
)
def test_decode(line, message):
    assert decode(line) == message


@settings(max_examples=500)
@given(st.binary(max_size=300) | st.from_regex(rb"(\$\d{0,12}|@|ok|E\d|value:\d)[ -~]{0,40}", fullmatch=True))
def test_decode_never_fails(line):
    message = decode(line)
    if isinstance(message, Reply):
        assert not (message.ok and message.code)
        assert all(value is None or math.isfinite(value) for value in map(message.value, "BLRV"))


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "", "x", "1e999"])
def test_a_value_is_finite_or_none(text):
    assert Reply(1, True, words={"V": text}).value("V") is None


@pytest.mark.parametrize(
    ("text", "version"),
    [("V4.10.0", (4, 10, 0)), ("V3.2.0", (3, 2, 0)), ("4.5", (4, 5, 0)), ("V4", None), ("", None), ("V4.x.0", None)],
)
def test_version(text, version):
    assert gcode.version(text) == version


@pytest.mark.parametrize("code", [None, "E20", "E21", "E22", "E23", "E24", "E25", "E26", "E27", "E99"])
def test_every_error_has_words(code):
    assert len(gcode.explain(code)) > 20
