"""Serial ports: the right device is found, the wrong one is never opened, and every refusal says what to do."""

from __future__ import annotations

import errno
import os
import tty
from types import SimpleNamespace

import pytest
import serial
from serial.tools import list_ports

from uarm_rl.real.ports import ARM, CAMERA, PortError, find_port, open_port


def usb(device, vid=0x2341, pid=0x0042):
    return SimpleNamespace(device=device, vid=vid, pid=pid)


UARM = usb("/dev/ttyACM0")
OLD = usb("/dev/ttyACM1", 0x1209, 0xABD1)
H7 = usb("/dev/ttyACM2", 0x37C5, 0x1204)
UNKNOWN = usb("/dev/ttyACM4", 0x37C5, 0x9999)  # a camera of a later year
BARE = usb("/dev/ttyS0", None, None)


def opened(device, name):
    return open_port(device, str(name), write_timeout_s=0.2)


@pytest.mark.parametrize(
    ("device", "present", "found"), [(ARM, [OLD, UARM, BARE], UARM), (CAMERA, [UARM, OLD], OLD), (CAMERA, [BARE, H7], H7)]
)
def test_a_device_is_found_by_its_usb_id(device, present, found):
    assert find_port(device, present) == found.device


@pytest.mark.parametrize(
    ("device", "present", "words"),
    [
        (ARM, [], r"of the uArm; plug in the USB cable and the power supply, or .*--port .*present: none"),
        (ARM, [H7], "present: /dev/ttyACM2"),
        (ARM, [usb("/dev/ttyACM3"), UARM], "several ports.*: /dev/ttyACM0, /dev/ttyACM3; name the arm's port with --port"),
        (CAMERA, [UARM], "of an OpenMV camera; plug in the camera.*present: /dev/ttyACM0"),
        (CAMERA, [H7, OLD], "several ports.*: /dev/ttyACM1, /dev/ttyACM2; name the camera's port with camera.port=PORT"),
    ],
)
def test_none_or_several(device, present, words):
    with pytest.raises(PortError, match=words):
        find_port(device, present)


@pytest.mark.parametrize(("device", "there"), [(ARM, H7), (ARM, OLD), (ARM, UNKNOWN), (CAMERA, UARM)])
def test_the_other_devices_port_is_refused_before_it_is_opened(device, there, monkeypatch, tmp_path):
    monkeypatch.setattr(serial, "Serial", lambda *_, **__: pytest.fail("opened"))
    alias = tmp_path / "by-id"
    alias.symlink_to(there.device)
    monkeypatch.setattr(list_ports, "comports", lambda: [there])
    for name in (there.device, alias):
        with pytest.raises(PortError, match=f"is the port of .*, not of {device.name}"):
            opened(device, name)


@pytest.mark.parametrize("device", [ARM, CAMERA])
@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.EACCES, "dialout"),
        (errno.EBUSY, "in use by another program; close it"),
        (errno.EAGAIN, "in use by another program"),
        (errno.ENOENT, "there is no port"),
        (errno.EIO, "cannot be opened as the port of"),
    ],
)
def test_why_a_port_does_not_open(device, code, words, monkeypatch):
    def refuse(*_, **__):
        raise serial.SerialException(code, os.strerror(code))

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(PortError, match=words):
        opened(device, "/dev/ttyACM0")


def test_what_is_no_port(tmp_path):
    with pytest.raises(PortError, match="there is no port"):
        opened(ARM, tmp_path / "nothing")
    (tmp_path / "file").touch()
    with pytest.raises(PortError, match="cannot be opened as the port of the uArm"):
        opened(ARM, tmp_path / "file")


def test_a_port_is_opened_for_one_program_alone():
    master, slave = os.openpty()
    tty.setraw(slave)
    first = opened(ARM, os.ttyname(slave))
    try:
        with pytest.raises(PortError, match="in use by another program"):
            opened(ARM, os.ttyname(slave))
    finally:
        first.close()
        os.close(slave)
        os.close(master)
