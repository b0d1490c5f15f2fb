"""Gathering for the calibrations: folders, tables, and a live session with the emulated arm and a drawn camera."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.bench import Bench
from tests.drawing import base_to_pixel, draw_dot, draw_plate, pose
from uarm_rl.columns import OBSERVATIONS
from uarm_rl.real.collecting import (
    append_observations,
    calibrate_intrinsics_from_folder,
    collect_board_pictures,
    collect_observations,
    read_observations,
    write_picture,
)
from uarm_rl.real.link import LinkLostError
from uarm_rl.real.vision import projection
from uarm_rl.real.vision.camera import CameraError, StillImages
from uarm_rl.real.vision.camera_model import CalibrationError, Observation, nominal, nominal_intrinsics
from uarm_rl.real.vision.detection import ColourDetector, TargetNotFoundError
from uarm_rl.real.vision.hand_eye_fit import calibrate_hand_eye
from uarm_rl.real.vision.lens_fit import Board
from uarm_rl.task import kinematics

LENS = nominal_intrinsics()
RED = ColourDetector((170, 120, 60), (10, 255, 255), min_area_px=60.0)
BOARD = Board(columns=9, rows=6, square_m=0.012)


def board_picture(number):
    squares = np.indices((9, 12)).sum(axis=0) % 2
    squares[[0, -1]] = squares[:, [0, -1]] = 1
    texture = np.where(np.kron(squares, np.ones((20, 20))) > 0, 235, 25).astype(np.uint8)
    axis, tilt = 2.4 * number, 0.35 + 0.1 * (number % 3)
    turned = pose((tilt * math.cos(axis), tilt * math.sin(axis), 0.0), (0.0, 0.0, 0.0))
    place = pose((0.0, 0.0, 0.0), (0.02 * math.cos(number), 0.015 * math.sin(2 * number), 0.15))
    return draw_plate(texture, (0.144, 0.108), place @ turned, LENS)


@pytest.fixture(scope="module")
def boards(tmp_path_factory):
    """A folder of twelve pictures of the board, one of nothing in between."""
    folder = tmp_path_factory.mktemp("boards")
    for number in range(12):
        write_picture(folder / f"{number:02d}.png", board_picture(number))
    write_picture(folder / "05b.png", np.zeros((240, 320, 3), np.uint8))
    return folder


def test_the_lens_from_a_folder(boards):
    lens, report = calibrate_intrinsics_from_folder(boards, BOARD, "test camera")
    assert lens.camera == "test camera"
    assert lens.camera_matrix[0, 0] == pytest.approx(LENS.camera_matrix[0, 0], rel=0.01)
    assert "not found in 05b.png" in report
    assert "11.png: 54 corners" in report


def test_a_folder_without_pictures(tmp_path):
    with pytest.raises(CameraError, match="holds no pictures"):
        calibrate_intrinsics_from_folder(tmp_path, BOARD, "test camera")


def test_board_pictures_are_collected_live(boards, tmp_path):
    asked = []

    def ask(text):
        asked.append(text)
        return "done" if len(asked) == 8 else ""

    with StillImages(boards) as camera:
        collect_board_pictures(camera, BOARD, tmp_path / "new", ask, count=10)
        assert len(list((tmp_path / "new").glob("*.png"))) == 6  # seven were taken, one shows nothing
        assert "not visible" in asked[7]
        collect_board_pictures(camera, BOARD, tmp_path / "new", lambda text: "", count=10)  # goes on
    assert len(list((tmp_path / "new").glob("*.png"))) == 10


def test_a_board_picture_that_was_deleted_leaves_a_gap(boards, tmp_path):
    with StillImages(boards) as camera:
        collect_board_pictures(camera, BOARD, tmp_path, lambda text: "", count=5)
        kept = {path.name: path.read_bytes() for path in tmp_path.glob("*.png") if path.name != "board02.png"}
        (tmp_path / "board02.png").unlink()
        collect_board_pictures(camera, BOARD, tmp_path, lambda text: "", count=5)
    assert sorted(path.name for path in tmp_path.iterdir()) == [*sorted(kept), "board06.png"]
    assert all((tmp_path / name).read_bytes() == data for name, data in kept.items())


# Tables


def some_observations():
    return [
        Observation((100.125, 50.5), (0.1, -0.2, 0.3), (0.2, 0.01, 0.03)),
        Observation((200.0, 60.0), (0.1, -0.2, 0.3), (0.25, -0.01, 0.03)),
    ]


def test_a_table_gives_back_its_observations(tmp_path):
    path = tmp_path / "new" / "touches.csv"
    for observation in some_observations():
        append_observations(path, [observation])
    assert read_observations(path, LENS) == some_observations()
    assert path.read_text().startswith(",".join(OBSERVATIONS) + "\n")


def test_marks_are_found_in_the_pictures_of_a_table(tmp_path):
    joints = kinematics.inverse((0.2, 0.0, 0.15))
    mark = (0.27, 0.02, 0.03)
    write_picture(tmp_path / "one.png", draw_dot(joints, nominal(), mark))
    row = ["one.png", "", "", *map(str, joints), *map(str, mark)]
    (tmp_path / "touches.csv").write_text(",".join(OBSERVATIONS) + "\n" + ",".join(row) + "\n")
    (seen,) = read_observations(tmp_path / "touches.csv", LENS, RED)
    expected = base_to_pixel(mark, joints, nominal())[0]
    assert seen.pixel_px == pytest.approx(expected, abs=0.3)
    with pytest.raises(CalibrationError, match="640 x 480"):
        read_observations(tmp_path / "touches.csv", nominal_intrinsics((640, 480)), RED)
    with pytest.raises(CalibrationError, match="line 2: there is neither a pixel"):
        read_observations(tmp_path / "touches.csv", LENS)
    write_picture(tmp_path / "one.png", np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(TargetNotFoundError, match=r"line 2, one\.png: the object is not in view"):
        read_observations(tmp_path / "touches.csv", LENS, RED)
    (tmp_path / "one.png").unlink()
    with pytest.raises(CameraError, match=r"one\.png cannot be read"):
        read_observations(tmp_path / "touches.csv", LENS, RED)


HEADER = "u_px,v_px,joint1_rad,joint2_rad,joint3_rad,x_m,y_m,z_m\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty and lacks the column picture"),
        (HEADER, "has no rows"),
        ("u_px,v_px\n1,2\n", "lacks the column joint1_rad; line 1 has 'u_px', 'v_px', separated by commas"),
        (HEADER + "1,2,0,0,0,0.2,0.1,up\n", "line 2: z_m is 'up' and must be a finite number"),
        (HEADER + "1,2,0,0,0,0.2,0.1,0\n1,2,0,0,0,nan,0.1,0\n", "line 3: x_m is 'nan'"),
        (HEADER + "1,2,0,0\n", "line 2: 4 values for 8 columns"),
        (HEADER + "1,,0,0,0,0.2,0.1,0\n", "line 2: one of u_px and v_px is empty"),
        (HEADER + ",,0,0,0,0.2,0.1,0\n", "line 2: there is neither a pixel"),
    ],
)
def test_a_table_that_is_none(text, words, tmp_path):
    (tmp_path / "touches.csv").write_text(text)
    with pytest.raises(CalibrationError, match=words):
        read_observations(tmp_path / "touches.csv", LENS)


def test_no_table(tmp_path):
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_observations(tmp_path / "nothing.csv", LENS)
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_observations(tmp_path / "binary.csv", LENS)


# The live session: the real driver, the emulated firmware, and a camera that draws what it would see


class Desk:
    """The camera at the emulated arm's hand, and the user who places marks and drives the cup onto them."""

    name = "drawn camera"

    def __init__(self, bench, true, generator):
        self.bench, self.true, self.generator = bench, true, generator
        self.mark = None
        self.asked = []
        self.image_size = true.lens.image_size

    def joints(self):
        return kinematics.from_motor_deg(*self.bench.joints.motor_deg())

    def read(self):
        image = draw_dot(self.joints(), self.true, self.mark)
        return image if self.image_size == (320, 240) else cv2.resize(image, self.image_size)

    def close(self):
        pass

    def ask(self, text):
        self.asked.append(text)
        if "put it at a new place" in text:
            turn, radius = self.generator.uniform(-0.5, 0.5), self.generator.uniform(0.2, 0.33)
            self.mark = np.array([radius * math.cos(turn), radius * math.sin(turn), 0.03])
            self.aim = self.mark + (*self.generator.normal(0.0, 0.0007, 2), 0.0)  # the user's eye
        off_mm = 1000.0 * (self.aim - kinematics.cup_position(self.joints()))
        if np.abs(off_mm).max() < 0.6:
            return "touch"
        if np.abs(off_mm[:2]).max() >= 0.6:
            off_mm[2] = max(off_mm[2], -15.0)  # sideways first
        x, y, z = np.clip(off_mm, -40.0, 40.0)
        return f"x {x:.1f}, y {y:.1f} z{z:+.1f}"


@pytest.fixture
def desk():
    generator = np.random.default_rng(3)
    mount = nominal().cup_from_camera @ pose((0.02, -0.03, 0.04), (0.0, 0.0, 0.0))
    mount[:3, 3] += (0.004, -0.003, 0.003)
    return Desk(Bench(), replace(nominal(), cup_from_camera=mount), generator)


def test_a_session_makes_a_calibration(desk, tmp_path):
    path = tmp_path / "session" / "touches.csv"
    with desk.bench.connect() as arm:
        arm.home()
        added = collect_observations(arm, desk, RED, nominal(), path, desk.ask, marks=6)
    desk.bench.judge()  # nothing unsafe was ever sent
    observations = read_observations(path, LENS)
    assert len(observations) == added >= 6 * 6
    assert len(list(path.parent.glob("touches-*.png"))) == added
    again = read_observations(path, LENS, RED)  # the pixels are in the table
    assert again == observations
    calibration, report = calibrate_hand_eye(observations, LENS)
    assert calibration.held_out_mm < 3.0, report
    errors = []
    for _ in range(200):
        cup = desk.generator.uniform(0.17, 0.25), desk.generator.uniform(-0.1, 0.1), desk.generator.uniform(0.1, 0.17)
        pixel = desk.generator.uniform((10, 10), (310, 230))
        picks = [projection.pixel_to_base(pixel, kinematics.inverse(cup), each, 0.03) for each in (calibration, desk.true)]
        errors.append(1000.0 * math.dist(*picks))
    assert np.sqrt(np.mean(np.square(errors))) < 1.5, report


def answers(*words):
    """A user who types these; and what was shown."""
    shown, left = [], list(words)

    def ask(text):
        shown.append(text)
        return left.pop(0)

    return ask, shown


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("hello", "'hello' is no move"),
        ("", "'' is no move"),
        ("x", "'x' is no move"),
        ("x 5 w 3", "is no move"),
        ("x 51", "50 mm at most"),
        ("x -50, y 50", "moved"),
        ("z -50", "moved"),
        ("X=5", "moved"),
    ],
)
def test_what_the_user_types_is_understood_or_explained(typed, words, desk, tmp_path):
    ask, shown = answers(typed, "done")
    with desk.bench.connect() as arm:
        arm.home()
        before = kinematics.cup_position(arm.read_joints())
        assert collect_observations(arm, desk, RED, nominal(), tmp_path / "touches.csv", ask) == 0
        after = kinematics.cup_position(arm.read_joints())
    assert words in shown[1]
    assert "not moved" not in shown[1]
    assert (math.dist(before, after) > 0.004) == (words == "moved")
    assert not (tmp_path / "touches.csv").exists()


def test_what_the_arm_cannot_do_is_explained(desk, tmp_path):
    ask, shown = answers(*["z -50"] * 4, *["x 50"] * 5, "skip", "done")
    with desk.bench.connect() as arm:
        arm.home()
        collect_observations(arm, desk, RED, nominal(), tmp_path / "touches.csv", ask)
    assert any("not moved" in text and "table" in text for text in shown)
    assert any("not moved" in text and "cannot reach" in text for text in shown)
    assert shown[-1].startswith("skipped. Mark 2 of 9")


def test_a_mark_that_is_never_seen(desk, tmp_path):
    ask, shown = answers("z -50", "z -50", "touch", "done")
    desk.mark = np.array([0.0, 0.3, 0.0])
    with desk.bench.connect() as arm:
        arm.home()
        assert collect_observations(arm, desk, RED, nominal(), tmp_path / "touches.csv", ask) == 0
    assert shown[-1].startswith("seen in 0 pictures, 0 altogether")


def test_a_camera_of_another_size_ends_the_session(desk, tmp_path):
    desk.image_size = (640, 480)
    with desk.bench.connect() as arm, pytest.raises(CalibrationError, match="640 x 480"):
        arm.home()
        collect_observations(arm, desk, RED, nominal(), tmp_path / "touches.csv", desk.ask)


def test_an_arm_that_vanishes_ends_the_session_with_everything_kept(desk, tmp_path, monkeypatch):
    path = tmp_path / "touches.csv"

    def ask(text):
        if "Mark 2" in text:
            monkeypatch.setattr(desk.bench.port, "write", lambda data: (_ for _ in ()).throw(OSError(5, "I/O")))
        return desk.ask(text)

    arm = desk.bench.connect()
    arm.home()
    with pytest.raises(LinkLostError):
        collect_observations(arm, desk, RED, nominal(), path, ask)
    assert len(read_observations(path, LENS)) == len(re.findall("touches-", path.read_text())) > 4


def test_a_touch_picture_that_was_deleted_leaves_a_gap(desk, tmp_path):
    """The last one too: its row still names it."""
    path = tmp_path / "touches.csv"
    with desk.bench.connect() as arm:
        arm.home()
        first = collect_observations(arm, desk, RED, nominal(), path, desk.ask, marks=1)
        (tmp_path / f"touches-{first:03d}.png").unlink()
        (tmp_path / "touches-001.png").unlink()
        second = collect_observations(arm, desk, RED, nominal(), path, desk.ask, marks=1)
    names = [row.split(",")[0] for row in path.read_text().splitlines()[1:]]
    assert len(set(names)) == len(names) == first + second
    assert f"touches-{first + 1:03d}.png" in names
