"""The emulated camera: its pictures agree with the projection to a fraction of a pixel, its bytes with the protocol."""

from __future__ import annotations

import os
import select
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.drawing import base_to_pixel
from tests.emulator.test_physics import configured
from uarm_rl import configuration
from uarm_rl.emulator.camera import SnapCamera
from uarm_rl.emulator.faults import CameraFault
from uarm_rl.emulator.memory_port import MemoryPort
from uarm_rl.emulator.pty import PtyServer
from uarm_rl.real.vision.camera import OpenMVCamera
from uarm_rl.real.vision.camera_model import nominal
from uarm_rl.task import kinematics

Workplace = pytest.importorskip("uarm_rl.emulator.emulate").Workplace  # which needs PyBullet
TOP_M = (0.25, 0.03, 0.03)
HALF_M = 0.015
PHOTO_MM = (200, 0, 160)


@pytest.fixture(scope="module")
def stickered():
    """A workplace with a red square on the object, the arm in the photo pose."""
    with at_photo_pose("look=sticker") as place:
        yield place


@pytest.fixture(scope="module")
def tagged():
    with at_photo_pose("look=tag", "image_size=[640,480]") as place:
        yield place


def at_photo_pose(*overrides, cup_mm=PHOTO_MM):
    place = Workplace(**configured("object_position=[0.25,0.03,0.03]", *overrides))
    firmware = place.firmware
    firmware.advance(2.0)
    firmware.advance(2.0, "G0 X{} Y{} Z{} F100\n".format(*cup_mm).encode())
    assert firmware.advance(6.0).endswith(b"ok\n")
    return place


def tag_corners(picture):
    """Where the outline of the black square is, (4, 2): found by the detector, then refined against the picture."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
    assert numbers is not None
    assert numbers.ravel().tolist() == [0]
    return corners[0].reshape(4, 2).astype(np.float64)


def middle(corners_px):
    """Where the diagonals cross, straightened: the pixel of the tag's middle."""
    calibration = nominal((640, 480))
    a, b, c, d = calibration.lens.image_plane(corners_px)
    share = np.linalg.solve(np.column_stack([c - a, b - d]), b - a)[0]
    return calibration.lens.pixels([[*(a + share * (c - a)), 1.0]])[0]


def outline_px(place, top_m, yaw_rad):
    """The edge of the object's upper surface as the projection has it."""
    along = np.linspace(-HALF_M, HALF_M, 40)
    edge = np.full_like(along, HALF_M)
    x, y = np.hstack([(along, -edge), (edge, along), (along[::-1], edge), (-edge, along[::-1])])
    turned = np.cos(yaw_rad) * x - np.sin(yaw_rad) * y, np.sin(yaw_rad) * x + np.cos(yaw_rad) * y
    points = np.column_stack([*turned, np.zeros_like(x)]) + top_m
    return base_to_pixel(points, kinematics.from_motor_deg(*place.world.motor_deg()), nominal())


def centroid(polygon_px):
    x, y = polygon_px.T
    across = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = ((x + np.roll(x, -1)) * across).sum(), ((y + np.roll(y, -1)) * across).sum()
    return np.array(sums) / (3.0 * across.sum())


def redness_centre(picture):
    blue, green, strong = (picture[:, :, channel].astype(float) for channel in range(3))
    weight = strong - np.maximum(green, blue)
    weight[weight < 8.0] = 0.0
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


@settings(max_examples=25)
@given(st.floats(0.19, 0.35), st.floats(-0.09, 0.12), st.floats(0.03, 0.08), st.floats(-np.pi, np.pi))
def test_pictures_agree_with_the_projection(stickered, x_m, y_m, height_m, yaw_rad):
    """To a fraction of a pixel, wherever in the picture, and at any height, the object lies."""
    top_m = np.array([x_m, y_m, height_m])
    expected = outline_px(stickered, top_m, yaw_rad)
    assume(expected.min() > 4 and np.all(expected.max(axis=0) < (315, 235)))
    stickered.world.place_object(top_m, yaw_rad)
    assert np.linalg.norm(redness_centre(stickered.picture()) - centroid(expected)) < 0.4


def test_the_error_of_rendering_has_no_direction(stickered):
    offsets = []
    for x, y, yaw_rad in np.random.default_rng(0).uniform((0.22, -0.06, -1), (0.32, 0.09, 1), (30, 3)):
        top_m = np.array([x, y, 0.03])
        stickered.world.place_object(top_m, yaw_rad)
        offsets.append(redness_centre(stickered.picture()) - centroid(outline_px(stickered, top_m, yaw_rad)))
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.08
    assert np.std(offsets, axis=0).max() < 0.15


def test_the_lens_bends_the_picture(stickered):
    """A straight projection would be many pixels off at the edge."""
    joints = kinematics.from_motor_deg(*stickered.world.motor_deg())
    top_m = np.array([0.2, 0.09, 0.03])
    stickered.world.place_object(top_m)
    calibration = nominal()
    straight = replace(calibration, lens=replace(calibration.lens, distortion=np.zeros(5)))
    assert np.linalg.norm(base_to_pixel(top_m, joints, straight)[0] - redness_centre(stickered.picture())) > 5.0


@pytest.mark.parametrize("top_m", [(0.27, 0.015, 0.03), (0.32, 0.09, 0.03), (0.22, -0.05, 0.03), (0.27, 0.01, 0.10)])
def test_the_tag_lies_on_the_object(tagged, top_m):
    joints = kinematics.from_motor_deg(*tagged.world.motor_deg())
    tagged.world.place_object(top_m, 0.3)
    expected_px = base_to_pixel(top_m, joints, nominal((640, 480)))[0]
    assert np.linalg.norm(middle(tag_corners(tagged.picture())) - expected_px) < 0.5


def red(picture):
    """Centre of what is red, and how much."""
    blue, green, strong = (picture[:, :, channel].astype(int) for channel in range(3))
    v, u = np.nonzero((strong > 2 * green) & (strong > 2 * blue) & (strong > 60))
    return np.array([u.mean(), v.mean()]) if len(u) else None, len(u)


@pytest.mark.parametrize("look", ["box", "sticker"])
def test_the_object_is_saturated_on_a_grey_table(look):
    with at_photo_pose(f"look={look}") as place:
        picture = place.picture()
        centre_px, area = red(picture)
        joints = kinematics.from_motor_deg(*place.world.motor_deg())
        assert centre_px == pytest.approx(base_to_pixel(TOP_M, joints, nominal())[0], abs=2.0)
        assert 1000 < area < 3000
        table = picture[:40].reshape(-1, 3).astype(int)
        assert np.ptp(table.mean(axis=0)) < 3.0
        assert picture.shape == (240, 320, 3)
        assert picture.dtype == np.uint8


def test_side_faces_shift_the_centre_of_a_painted_box_and_not_that_of_a_sticker():
    """What makes a second look, with the object in the middle of the picture, worth while."""
    off_px = {}
    for look in ("box", "sticker"):
        with at_photo_pose(f"look={look}") as place:
            top_m = np.array([0.32, 0.09, 0.03])
            place.world.place_object(top_m)
            joints = kinematics.from_motor_deg(*place.world.motor_deg())
            off_px[look] = np.linalg.norm(red(place.picture())[0] - base_to_pixel(top_m, joints, nominal())[0])
    assert off_px["sticker"] < 1.5 < 4.0 < off_px["box"]


def test_nothing_is_seen_where_nothing_is():
    with at_photo_pose("look=tag") as place:
        place.world.place_object((0.1, -0.3, 0.03))
        assert red(place.picture())[1] == 0
        assert place.picture().std() < 10.0


def test_imperfections_reach_the_picture():
    def seen(*overrides):
        with at_photo_pose(*overrides) as place:
            return place.picture().astype(float)

    plain = seen()
    assert seen("realism.light=0.5").mean() == pytest.approx(0.5 * plain.mean(), rel=0.02)
    graded = seen("realism.light_gradient=0.5")[:, :, 1]
    assert graded[:, -20:].mean() / graded[:, :20].mean() == pytest.approx(1.25 / 0.75, rel=0.05)
    assert (seen("realism.noise=5") - plain)[:40].std() == pytest.approx(5.0, rel=0.1)
    assert np.abs(np.diff(seen("realism.blur_px=3")[:, :, 2], axis=1)).max() < 0.5 * np.abs(np.diff(plain[:, :, 2])).max()
    shifts = [red(seen(*mount))[0] - red(plain)[0] for mount in (("realism.mount_offset_mm=5",), ("realism.mount_tilt_deg=3",))]
    assert all(np.linalg.norm(shift) > 2.0 for shift in shifts)


def test_pictures_repeat_with_the_seed_and_differ_from_each_other():
    runs = []
    for seed in (0, 0, 1):
        with at_photo_pose("realism=default", f"seed={seed}") as place:
            runs.append([place.picture().tobytes() for _ in range(2)])
    assert runs[0] == runs[1] != runs[2]
    assert runs[0][0] != runs[0][1]  # noise


# The protocol


def picture(seed=0):
    generator = np.random.default_rng(seed)
    return cv2.resize(generator.integers(0, 255, (12, 16, 3), np.uint8), (160, 120))


def counting():
    """Pictures that differ."""
    seeds = iter(range(1000))
    return lambda: picture(next(seeds))


def answer(camera, request=b"snap", wait_s=1.0):
    return camera.advance(camera.now_s, request) + camera.advance(camera.now_s + wait_s)


def jpeg_of(data):
    (length,) = struct.unpack("<I", data[:4])
    assert len(data) == 4 + length
    return data[4:]


def test_a_request_brings_length_and_jpeg():
    jpeg = jpeg_of(answer(SnapCamera(picture)))
    assert jpeg.startswith(b"\xff\xd8")
    assert jpeg.endswith(b"\xff\xd9")
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded.astype(int) - picture()).mean() < 3.0
    frame = jpeg.index(b"\xff\xc0")
    assert jpeg[frame + 11] == 0x11  # colour as fine as brightness


def test_every_request_takes_a_new_picture_and_its_time():
    camera = SnapCamera(counting(), snap_s=0.04)
    assert answer(camera, wait_s=0.03) == b""
    first = camera.advance(0.05)
    second, third = camera.advance(0.05, b"snapsnap") + camera.advance(0.1), camera.advance(0.2)
    pictures = [jpeg_of(data) for data in (first, second, third)]
    assert len(set(pictures)) == 3


def test_other_groups_are_ignored_and_a_lost_byte_shifts_everything_until_5_s_of_silence():
    camera = SnapCamera(picture)
    assert answer(camera, b"help") == b""
    assert answer(camera, b"nap") == b""
    assert answer(camera) == b""
    assert answer(camera) == b""
    assert answer(camera, b"", 5.0) == b""
    assert jpeg_of(answer(camera))


@pytest.mark.parametrize(
    ("effect", "keywords", "check"),
    [
        ("silence", {}, lambda good, bad, after: bad == after == b""),
        ("lost", {}, lambda good, bad, after: bad == b"" and jpeg_of(after)),
        ("late", {"delay_s": 1.5}, lambda good, bad, after: bad == b"" and len(after) > len(good)),
        ("slow", {"delay_s": 0.1}, lambda good, bad, after: 0 < len(bad) <= 640),
        ("truncated", {}, lambda good, bad, after: struct.unpack("<I", bad[:4])[0] > len(bad) and jpeg_of(after)),
        ("dropped", {}, lambda good, bad, after: struct.unpack("<I", bad[:4])[0] == len(bad) - 3 and jpeg_of(after)),
        ("corrupt", {}, lambda good, bad, after: jpeg_of(bad) and jpeg_of(after)),
        ("length", {"data": b"\xff\xff\xff\x7f"}, lambda good, bad, after: bad[:8] == b"\xff\xff\xff\x7f\xff\xd8\xff\xe0"),
        ("text", {"data": b">>> "}, lambda good, bad, after: bad[:4] == b">>> " and jpeg_of(bad[4:]) and jpeg_of(after)),
        ("trailing", {"data": b">>> "}, lambda good, bad, after: bad[-4:] == b">>> " and jpeg_of(bad[:-4])),
        ("frozen", {}, lambda good, bad, after: good == bad == after),
        ("size", {}, lambda good, bad, after: len(jpeg_of(bad)) < len(jpeg_of(good))),
    ],
)
def test_faults(effect, keywords, check):
    camera = SnapCamera(counting(), faults=(CameraFault(effect, nth=2, **keywords),))
    good, bad, after = (answer(camera) for _ in range(3))
    assert jpeg_of(good)
    assert check(good, bad, after)
    assert effect == "frozen" or good != bad


def test_an_unplugged_camera_says_nothing_more():
    camera = SnapCamera(picture, faults=(CameraFault("unplug", nth=2, delay_s=0.3),))
    assert answer(camera)
    assert answer(camera, wait_s=0.4)
    assert answer(camera) == b""
    assert camera.unplugged


@pytest.mark.parametrize("name", ["camera_text", "camera_size", "camera_length", "garbage", "reset"])
def test_the_shipped_faults_build(name):
    with Workplace(**configured(f"faults={name}")) as place:
        place.firmware.advance(0.1)
        answer(place.camera)


def test_the_camera_driver_reads_the_emulated_camera():
    with at_photo_pose("realism=default") as place:
        port = MemoryPort(place.camera)
        with OpenMVCamera(port, clock=port.clock) as camera:
            seen = camera.read()
            assert not camera.frozen
        assert np.abs(seen.astype(float) - place.picture()).mean() < 5.0


def test_a_picture_passes_a_terminal_whole():
    """Larger than what a terminal buffers, with bytes that a terminal not in raw mode would change."""
    camera = SnapCamera(lambda: cv2.resize(picture(), (640, 480)), jpeg_quality=100)
    expected = answer(camera)
    assert len(expected) > 30_000
    with PtyServer(camera, reset_on_open=False) as server:
        descriptor = os.open(server.path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(descriptor, b"snap")
            data = b""
            while len(data) < len(expected):
                assert select.select([descriptor], [], [], 20.0)[0]
                data += os.read(descriptor, 65536)
        finally:
            os.close(descriptor)
    assert data == expected


def test_a_calibration_file_is_the_truth_about_the_camera(tmp_path):
    turned = nominal((640, 480))
    mount = turned.cup_from_camera.copy()
    mount[:2, 3] += (0.01, -0.02)
    path = tmp_path / "camera.json"
    type(turned)(**{**vars(turned), "cup_from_camera": mount}).save(path)
    with at_photo_pose(f"calibration={path}", "look=sticker") as place:
        centre_px, _ = red(place.picture())
        joints = kinematics.from_motor_deg(*place.world.motor_deg())
        known = type(turned).load(path)
        assert centre_px == pytest.approx(base_to_pixel(TOP_M, joints, known)[0], abs=2.0)
        assert np.linalg.norm(centre_px - base_to_pixel(TOP_M, joints, nominal((640, 480)))[0]) > 20.0


def test_every_realism_and_fault_composes():
    conf = configuration.compose("emulate")
    assert set(conf["faults"]) == {"arm", "camera"}
    assert conf["realism"].keys() == configuration.compose("emulate", ("realism=none",))["realism"].keys()
