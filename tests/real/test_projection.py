"""From pixel to arm and back: signs and sizes by hand, round trips for anything, boxes where they were drawn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drawing import base_to_pixel, draw_box, pose
from uarm_rl.real.vision.camera_model import nominal
from uarm_rl.real.vision.detection import ColourDetector
from uarm_rl.real.vision.projection import (
    base_from_camera,
    base_from_cup,
    locate_box,
    look_at,
    pixel_to_base,
)
from uarm_rl.task import kinematics

NOMINAL = nominal()
PHOTO = kinematics.inverse((0.2, 0.0, 0.16))
MIDDLE = (159.5, 119.5)
RED = ColourDetector((170, 120, 60), (10, 255, 255))


def with_distortion(calibration, *distortion):
    return replace(calibration, lens=replace(calibration.lens, distortion=np.array(distortion)))


def straight(image_size=(320, 240)):
    """The nominal camera without distortion, where everything can be told by hand."""
    return with_distortion(nominal(image_size), 0.0, 0.0, 0.0, 0.0, 0.0)


def test_the_middle_of_the_picture_is_below_the_mount():
    """UFACTORY's own demo adds 69.9 mm ahead and 15.1 mm to the left at the middle of the picture."""
    np.testing.assert_allclose(pixel_to_base(MIDDLE, PHOTO, NOMINAL, 0.0), (0.2695, 0.015, 0.0), atol=1e-12)


@pytest.mark.parametrize(
    ("pixel", "ahead", "left"),
    [((159.5, 19.5), 100, 0), ((159.5, 219.5), -100, 0), ((59.5, 119.5), 0, 100), ((259.5, 119.5), 0, -100)],
)
def test_up_is_ahead_and_left_is_left(pixel, ahead, left):
    scale = (0.16 + 0.037 - 0.03) / (320 * 2.8 / 3.84)  # height over focal length: metres per pixel
    expected = (0.2695 + ahead * scale, 0.015 + left * scale, 0.03)
    np.testing.assert_allclose(pixel_to_base(pixel, PHOTO, straight(), 0.03), expected, atol=1e-12)


def test_the_cups_frame_turns_with_joint1_alone():
    joints = kinematics.inverse((0.15, 0.15, 0.1))
    transform = base_from_cup(joints)
    np.testing.assert_allclose(transform[:3, 3], (0.15, 0.15, 0.1), atol=1e-12)
    np.testing.assert_allclose(transform[:3, 0], (math.sqrt(0.5), math.sqrt(0.5), 0.0), atol=1e-12)
    np.testing.assert_allclose(transform[:3, 2], (0.0, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(
        pixel_to_base(MIDDLE, joints, NOMINAL, 0.0)[:2] @ (-1.0, 1.0) / math.sqrt(2.0), 0.015, atol=1e-12
    )


def test_distortion_is_opencvs_formula():
    """Brown and Conrady's polynomial, written out."""
    calibration = with_distortion(NOMINAL, -0.3, 0.1, 0.002, -0.001, 0.01)
    x, y = 0.4, -0.3
    k1, k2, p1, p2, k3 = calibration.lens.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    focal = calibration.lens.camera_matrix[0, 0]
    pixel = focal * np.array(bent) + MIDDLE
    np.testing.assert_allclose(calibration.lens.pixels((2 * x, 2 * y, 2.0)), [pixel], atol=1e-9)
    np.testing.assert_allclose(calibration.lens.image_plane(pixel), [(x, y)], atol=1e-9)


def some_calibration(tilt, shift, k1):
    mount = NOMINAL.cup_from_camera @ pose(tilt, (0.0, 0.0, 0.0))
    mount[:3, 3] += shift
    return with_distortion(replace(NOMINAL, cup_from_camera=mount), k1, 0.15, 0.001, 0.0, 0.0)


angles = st.tuples(*[st.floats(-0.15, 0.15)] * 3)
shifts = st.tuples(*[st.floats(-0.01, 0.01)] * 3)
pixels = st.tuples(st.floats(0.0, 319.0), st.floats(0.0, 239.0))
cups = st.tuples(st.floats(0.18, 0.25), st.floats(-0.1, 0.1), st.floats(0.08, 0.17))


@given(pixels, cups, angles, shifts, st.floats(-0.4, 0.1), st.floats(0.0, 0.04))
def test_pixel_to_base_to_pixel(pixel, cup, tilt, shift, k1, height):
    calibration = some_calibration(tilt, shift, k1)
    joints = kinematics.inverse(cup)
    point = pixel_to_base(pixel, joints, calibration, height)
    assert point[2] == pytest.approx(height, abs=1e-12)
    np.testing.assert_allclose(base_to_pixel(point, joints, calibration), [pixel], atol=1e-5)


@given(pixels, cups, angles, shifts, st.floats(-0.4, 0.1))
def test_camera_cup_and_base_agree(pixel, cup, tilt, shift, k1):
    """The same point through the camera's frame by hand."""
    calibration = some_calibration(tilt, shift, k1)
    joints = kinematics.inverse(cup)
    ray = np.array([*calibration.lens.image_plane(pixel)[0], 1.0, 0.0])
    transform = base_from_cup(joints) @ calibration.cup_from_camera
    point = transform[:, 3] + 0.123 * (transform @ ray)
    np.testing.assert_allclose(base_from_camera(joints, calibration), transform)
    np.testing.assert_allclose(pixel_to_base(pixel, joints, calibration, point[2]), point[:3], atol=1e-9)


@pytest.mark.parametrize("height", [0.197, 0.25, math.nan])
def test_a_height_that_the_ray_never_meets(height):
    with pytest.raises(ValueError, match="never meets the height"):
        pixel_to_base(MIDDLE, PHOTO, NOMINAL, height)


def test_no_pixel():
    with pytest.raises(ValueError, match="finite"):
        pixel_to_base((math.nan, 1.0), PHOTO, NOMINAL, 0.0)
    for point in ((0.27, 0.0, 0.3), (math.nan, 0.0, 0.0)):
        with pytest.raises(ValueError, match="not in front of the camera"):
            base_to_pixel(point, PHOTO, NOMINAL)


@given(st.floats(0.23, 0.36), st.floats(-1.2, 1.2), angles)
def test_looking_at_a_point_brings_it_to_the_middle(radius, turn, tilt):
    calibration = some_calibration(tilt, (0.0, 0.0, 0.0), -0.3)
    point = np.array([radius * math.cos(turn), radius * math.sin(turn), 0.03])
    joints = look_at(point, calibration, 0.13)
    assert kinematics.within_limits(joints)
    assert kinematics.cup_position(joints)[2] == pytest.approx(0.13)
    cup_radius = np.hypot(*kinematics.cup_position(joints)[:2])
    if 0.13 < cup_radius < 0.28:  # nothing had to give: radii are tried in steps of 2 mm, which is 2 px
        np.testing.assert_allclose(base_to_pixel(point, joints, calibration)[0], MIDDLE, atol=2.5)


def test_looking_at_a_point_in_another_part_of_the_picture():
    point, pixel = (0.3, 0.05, 0.03), (100.0, 60.0)
    seen = base_to_pixel(point, look_at(point, NOMINAL, 0.13, pixel), NOMINAL)[0]
    np.testing.assert_allclose(seen, pixel, atol=1.5)


def test_a_point_at_the_base_is_seen_as_near_to_the_middle_as_the_arm_can():
    point = np.array([0.17, 0.0, 0.03])
    joints = look_at(point, NOMINAL, 0.15)
    u, v = base_to_pixel(point, joints, NOMINAL)[0]
    assert u == pytest.approx(MIDDLE[0])
    assert MIDDLE[1] < v < 230.0


def test_nowhere_to_look_from():
    with pytest.raises(kinematics.UnreachableError, match="no pose with the cup at 150 mm"):
        look_at((-0.2, 0.0, 0.0), NOMINAL, 0.15)
    with pytest.raises(ValueError, match="not below the camera"):
        look_at((0.2, 0.0, 0.2), NOMINAL, 0.15)


# Boxes. Side faces pull the centre of the outline away from the centre of the top, by 10 mm at the edge of the picture.


def drawn_boxes(size_m, sides, count=25):
    """Boxes all over the picture, seen from usual heights: where they are, and errors (mm) by centre and by outline."""
    generator = np.random.default_rng(5)
    errors = []
    for seed in range(count):
        joints = kinematics.inverse((0.2, generator.uniform(-0.1, 0.1), generator.uniform(0.11, 0.17)))
        pixel = generator.uniform((50, 50), (270, 190))
        top = pixel_to_base(pixel, joints, NOMINAL, size_m[2])
        yaw = generator.uniform(0.0, math.pi)
        image = draw_box(joints, NOMINAL, top, yaw, size_m, sides=sides, noise=3.0, seed=seed)
        seen = RED.detect(image)
        box = locate_box(seen.outline_px, joints, NOMINAL, size_m)
        by_centre = pixel_to_base(seen.centre_px, joints, NOMINAL, size_m[2])
        period = math.pi / 2 if size_m[0] == size_m[1] else math.pi
        off_yaw = (box.yaw_rad - yaw + period / 2) % period - period / 2
        errors.append((1000 * math.dist(by_centre, top), 1000 * math.dist(box.top_m, top), box.misfit_px, abs(off_yaw)))
    return np.array(errors).T


@pytest.mark.parametrize("size_m", [(0.03, 0.03, 0.03), (0.025, 0.025, 0.025), (0.04, 0.025, 0.03)])
def test_a_box_is_found_by_its_whole_outline(size_m):
    by_centre, by_outline, misfit, off_yaw = drawn_boxes(size_m, sides=True)
    assert by_centre.max() > 5.0  # what a plain centre would give
    assert by_outline.max() < 1.0
    assert by_outline.mean() < 0.3
    assert misfit.max() < 1.0
    assert off_yaw.max() < 0.06


def test_a_box_is_found_by_the_outline_of_its_top():
    _, by_outline, misfit, _ = drawn_boxes((0.03, 0.03, 0.03), sides=False)
    assert by_outline.max() < 1.0
    assert misfit.max() < 1.0


def test_the_drawing_and_the_fit_do_not_share_an_error():
    """A box whose outline is told by hand: below the camera, axes along the picture's, only its top is seen."""
    side = 0.03 * (320 * 2.8 / 3.84) / (0.16 + 0.037 - 0.03)
    corners = np.array(MIDDLE) + side / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    box = locate_box(corners, PHOTO, straight())
    np.testing.assert_allclose(box.top_m, (0.2695, 0.015, 0.03), atol=1e-6)
    assert box.misfit_px < 1e-3
    assert min(box.yaw_rad, math.pi / 2 - box.yaw_rad) < 1e-3


def test_another_shape_has_a_misfit():
    joints = PHOTO
    top = pixel_to_base((220.0, 160.0), joints, NOMINAL, 0.03)
    image = draw_box(joints, NOMINAL, top, 0.4, (0.06, 0.02, 0.03))
    assert locate_box(RED.detect(image).outline_px, joints, NOMINAL).misfit_px > 3.0


def test_a_threshold_that_makes_the_outline_wider_does_not_move_the_box():
    top = pixel_to_base((220.0, 160.0), PHOTO, NOMINAL, 0.03)
    outline = RED.detect(draw_box(PHOTO, NOMINAL, top, 0.4)).outline_px
    middle = outline.mean(axis=0)
    wider = outline + 1.5 * (outline - middle) / np.linalg.norm(outline - middle, axis=1)[:, None]
    box, again = (locate_box(points, PHOTO, NOMINAL) for points in (outline, wider))
    assert math.dist(box.top_m, again.top_m) < 5e-4
    assert box.scale == pytest.approx(1.0, abs=0.03)
    assert 1.02 < again.scale < 1.1


@given(st.floats(0.5, 2.0), st.floats(0.0, math.pi))
@settings(max_examples=20, deadline=None)
def test_the_scale_is_how_many_times_as_wide_as_told_the_object_is(times, yaw):
    flat = (0.03, 0.03, 0.001)  # of something flat the outline grows as it does
    told = (0.03 / times, 0.03 / times, 0.001)
    top = pixel_to_base((220.0, 160.0), PHOTO, NOMINAL, 0.001)
    outline = RED.detect(draw_box(PHOTO, NOMINAL, top, yaw, flat)).outline_px
    assert locate_box(outline, PHOTO, NOMINAL, told).scale == pytest.approx(times, rel=0.06)


@given(st.lists(pixels, min_size=3, max_size=20), st.floats(0.01, 0.05))
@settings(max_examples=50)
def test_any_outline_gives_a_box_in_sight(outline, height):
    box = locate_box(outline, PHOTO, NOMINAL, (0.03, 0.03, height))
    assert np.isfinite(box.top_m).all()
    assert box.top_m[2] == pytest.approx(height)
    assert 0.0 <= box.yaw_rad <= math.pi / 2
    assert box.misfit_px >= 0.0


@pytest.mark.parametrize(
    ("outline", "size_m", "words"),
    [
        ([MIDDLE], (0.03, 0.03, 0.03), "at least 3 points"),
        ([(1, 1), (9, 1), (9, 9)], (0.03, 0.0, 0.03), "size_m must be"),
        ([(1, 1), (9, 1), (9, 9)], (0.03, 0.03, 0.3), "never meets the height"),
    ],
)
def test_no_box(outline, size_m, words):
    with pytest.raises(ValueError, match=words):
        locate_box(outline, PHOTO, NOMINAL, size_m)
