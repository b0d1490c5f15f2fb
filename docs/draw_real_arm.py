"""Draw the pictures of docs/real_arm.md beside it: `python docs/draw_real_arm.py`, with the extras `real` and PyBullet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from uarm_rl.configuration import build_env, compose
from uarm_rl.real.vision import projection
from uarm_rl.real.vision.camera_model import nominal
from uarm_rl.sim.simulated_arm import CAMERA, Camera, Scene, SimulatedArm
from uarm_rl.task import kinematics

HERE = Path(__file__).parent
SIZE = 480, 400
#: The arm and what is in front of it.
FRONT: Camera = CAMERA.fitted(np.array([(-0.07, 0.0, 0.0), (0.0, 0.0, 0.3), (0.27, 0.03, 0.0), (0.2, 0.0, 0.2)]), *SIZE)
#: From the side, so that x is seen in full.
SIDE = CAMERA._replace(target_m=(0.12, 0.0, 0.09), distance_m=0.9, azimuth_deg=90.0, elevation_deg=-12.0)
INK = (40, 44, 52)
HOME = tuple(kinematics.HOME_JOINTS_RAD.tolist())
BOX_M = 0.2, 0.0, 0.03
AWAY = (0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # an object that no picture shows
TOGETHER_M = 0.002  # how far bellows that are pressed give


def font(size: int) -> ImageFont.FreeTypeFont:
    """The font of the figures."""
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)


def over(cup_m: Sequence[float]) -> Any:
    """The joints with the cup there."""
    return kinematics.inverse(cup_m).tolist()


def box(top_m: Sequence[float]) -> Any:
    """The pose of the box with the centre of its upper surface there."""
    x, y, z = top_m
    return x, y, z - BOX_M[2] / 2.0, 1.0, 0.0, 0.0, 0.0


def captioned(pictures: Sequence[Any], captions: Sequence[str]) -> Image.Image:
    """Pictures beside each other, each with words under it."""
    width, height = SIZE
    sheet = Image.new("RGB", (width * len(pictures), height + 44), "white")
    draw = ImageDraw.Draw(sheet)
    for number, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        sheet.paste(Image.fromarray(np.asarray(picture, np.uint8)), (width * number, 0))
        draw.text((width * (number + 0.5), height + 20), caption, INK, font(21), anchor="mm")
    return sheet


def jog(arm: SimulatedArm) -> Image.Image:
    """Home, faint, and where each joint goes; far more than the 5 degrees of the commands, to be seen."""
    pictures = []
    for joint, degrees in enumerate((30.0, 25.0, -25.0)):
        moved = list(HOME)
        moved[joint] += math.radians(degrees)
        one, other = (arm.draw(Scene(joints, AWAY), *SIZE, FRONT).astype(float) for joints in (HOME, moved))  # type: ignore[arg-type]
        pictures.append(0.3 * one + 0.7 * other)
    return captioned(pictures, ["--joint 1 --degrees 30", "--joint 2 --degrees 25", "--joint 3 --degrees -25"])


def target(arm: SimulatedArm) -> Image.Image:
    """Where the box stands, with the distances that the command is told."""
    picture = Image.fromarray(arm.draw(Scene(over((0.2, 0.0, 0.08)), box(BOX_M)), *SIZE, SIDE))
    draw = ImageDraw.Draw(picture)

    def line(start_m: Sequence[float], end_m: Sequence[float], words: str, dx: float, dy: float) -> None:
        (x0, y0), (x1, y1) = (SIDE.pixel(*SIZE, point) for point in (start_m, end_m))
        draw.line((x0, y0, x1, y1), INK, 2)
        for x, y in ((x0, y0), (x1, y1)):
            draw.ellipse((x - 4, y - 4, x + 4, y + 4), INK)
        draw.text(((x0 + x1) / 2 + dx, (y0 + y1) / 2 + dy), words, INK, font(19), anchor="mm")

    line((0.0, -0.11, 0.0), (0.2, -0.11, 0.0), "200 mm from the base's axis", 0, 18)
    line((0.235, -0.015, 0.0), (0.235, -0.015, 0.03), "30 mm", 40, 0)
    return captioned([picture], ["--target 0.2 0 0.03"])


def boards() -> Any:
    """What the camera sees of the printed chessboard, tilted in three ways."""
    lens = nominal().lens
    width, height = lens.image_size
    seen = np.full((height, width), 255, np.uint8)
    for tilt, middle in (
        ((0.5, 0.1, 0.1), (-0.06, -0.03)),
        ((-0.1, 0.6, -0.2), (0.06, -0.03)),
        ((0.5, -0.4, 0.3), (0.0, 0.055)),
    ):
        for row in range(7):
            for column in range(row % 2, 10, 2):
                corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float) + (column - 5, row - 3.5, 0)
                pixels, _ = cv2.projectPoints(
                    0.012 * corners, np.array(tilt), np.array((*middle, 0.25)), lens.camera_matrix, lens.distortion
                )
                cv2.fillPoly(seen, [pixels.round().astype(np.int32)], (0,), cv2.LINE_AA)
    scaled = cv2.resize(seen, (SIZE[0] - 20, round((SIZE[0] - 20) * height / width)), interpolation=cv2.INTER_AREA)
    picture = np.full((SIZE[1], SIZE[0], 3), 225, np.uint8)
    top = (SIZE[1] - len(scaled)) // 2
    picture[top : top + len(scaled), 10 : 10 + scaled.shape[1]] = scaled[..., np.newaxis]
    return picture


def calibrate(arm: SimulatedArm) -> Image.Image:
    """The board, the touch, and the poses that look at what was touched."""
    mark = 0.2, 0.03, 0.0
    camera = nominal()
    middle = (np.array(camera.lens.image_size) - 1.0) / 2.0
    poses = [
        projection.look_at(mark, camera, height_m, middle * (1.0 + np.array(offset))).tolist()
        for height_m, offset in ((0.1, (-0.55, -0.5)), (0.17, (0.55, 0.5)))
    ]
    looks = [arm.draw(Scene(pose, AWAY), *SIZE, FRONT) for pose in poses]
    touch = arm.draw(Scene(over((0.2, 0.03, 0.001)), AWAY), *SIZE, FRONT)
    pictures = []
    for picture in (touch, np.mean(looks, axis=0)):
        marked = Image.fromarray(picture.astype(np.uint8))
        x, y = FRONT.pixel(*SIZE, (0.2, 0.03, 0.0))
        ImageDraw.Draw(marked).ellipse((x - 9, y - 5, x + 9, y + 5), outline=(180, 30, 20), width=3)
        pictures.append(marked)
    return captioned([boards(), *pictures], ["hold the board tilted", "touch the mark with the cup", "the arm looks at it"])


def trial(arm: SimulatedArm) -> Image.Image:
    """The four parts of a trial."""
    x, y, top = BOX_M
    scenes = [
        Scene(over((x - 0.03, y, 0.16)), box(BOX_M)),
        Scene(over((x - 0.01, y, top + 0.04)), box(BOX_M)),
        Scene(over((x, y, top - TOGETHER_M)), box(BOX_M), TOGETHER_M),
        Scene(over((x, y, top + 0.08)), box((x, y, top + 0.08))),
    ]
    return captioned([arm.draw(scene, *SIZE, FRONT) for scene in scenes], ["look", "approach", "press and suck", "lift"])


def main() -> None:
    """Draw them all."""
    settings = compose("train", ("sim=pybullet",))
    env = build_env(settings, time_limit_s=None)
    assert isinstance(env.arm, SimulatedArm)
    for name, draw in (("jog", jog), ("target", target), ("calibrate", calibrate), ("trial", trial)):
        draw(env.arm).quantize(128).save(HERE / f"{name}.png", optimize=True)
    env.close()


if __name__ == "__main__":
    main()
