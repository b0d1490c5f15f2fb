"""Finding the one object: by colour, by marker, or a sentence why not."""

from __future__ import annotations

from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drawing import SCALE, as_taken
from uarm_rl.real.vision.detection import (
    MARKER_FAMILIES,
    ColourDetector,
    Detection,
    MarkerDetector,
    TargetNotFoundError,
    annotate,
)

RED_BGR = (30, 30, 220)
BLUE_BGR = (220, 60, 30)
RED = ColourDetector((170, 120, 60), (10, 255, 255))
BLUE = ColourDetector((100, 120, 60), (130, 255, 255))


def discs(*centres, radius=18, colour=RED_BGR, noise=3.0):
    """Discs at sub-pixel places on a grey table."""
    large = np.full((240 * SCALE, 320 * SCALE, 3), (150, 145, 140), np.uint8)
    for u, v in centres:
        place = (round(((u + 0.5) * SCALE - 0.5) * 256), round(((v + 0.5) * SCALE - 0.5) * 256))
        cv2.circle(large, place, round(radius * SCALE * 256), colour, -1, cv2.LINE_8, 8)
    return as_taken(cv2.resize(large, (320, 240), interpolation=cv2.INTER_AREA), noise)


@given(st.floats(30, 290), st.floats(30, 210), st.floats(8, 25))
@settings(max_examples=40)
def test_the_centre_of_a_colour_is_found_to_a_fraction_of_a_pixel(u, v, radius):
    seen = RED.detect(discs((u, v), radius=radius))
    assert seen.centre_px == pytest.approx((u, v), abs=0.3)
    assert np.abs(np.linalg.norm(seen.outline_px - (u, v), axis=1) - radius).max() < 2.0


def test_red_goes_around_the_end_of_the_hues():
    for colour in ((30, 60, 220), (60, 30, 220)):  # a little to orange, a little to violet
        assert RED.detect(discs((100, 100), colour=colour)).centre_px == pytest.approx((100, 100), abs=0.3)
    assert BLUE.detect(discs((100, 100), colour=BLUE_BGR)).centre_px == pytest.approx((100, 100), abs=0.3)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (discs(), "no pixel has the colour"),
        (discs((100, 100), colour=BLUE_BGR), "no pixel has the colour"),
        (discs((100, 100), radius=4), "no blob of its colour has 150 square pixels"),
        (discs((80, 100), (200, 120)), "2 things in view have the object's colour"),
        (discs((80, 100), (200, 120), (200, 50)), "3 things"),
        (discs((5, 100)), "cut off by the edge"),
        (discs((310, 230)), "cut off by the edge"),
    ],
)
def test_no_object_or_several(image, words):
    with pytest.raises(TargetNotFoundError, match=words):
        RED.detect(image)


def test_specks_do_not_count():
    image = discs((160, 120))
    generator = np.random.default_rng(0)
    image[generator.integers(0, 240, 60), generator.integers(0, 320, 60)] = RED_BGR
    assert RED.detect(image).centre_px == pytest.approx((160, 120), abs=0.3)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_any_picture_gives_one_object_or_a_sentence(seed):
    image = np.random.default_rng(seed).integers(0, 256, (60, 80, 3), np.uint8)
    with suppress(TargetNotFoundError):
        u, v = RED.detect(cv2.blur(image, (5, 5)) if seed % 2 else image).centre_px
        assert 0 <= u < 80
        assert 0 <= v < 60


@pytest.mark.parametrize(
    ("low", "high", "area", "words"),
    [
        ((0, 0), (10, 255, 255), 100, "three numbers each"),
        ((0, 0, 0), (180, 255, 255), 100, r"hsv_high\[0\] must be a whole number from 0 to 179, got 180"),
        ((0, -1, 0), (10, 255, 255), 100, r"hsv_low\[1\]"),
        ((0, 1.5, 0), (10, 255, 255), 100, r"hsv_low\[1\]"),
        ((0, 200, 0), (10, 100, 255), 100, "the saturation goes from 200 up to 100"),
        ((0, 0, 200), (10, 255, 100), 100, "the value goes from 200 up to 100"),
        ((0, 0, 0), (10, 255, 255), 0, "min_area_px must be"),
    ],
)
def test_a_colour_that_is_none(low, high, area, words):
    with pytest.raises(ValueError, match=words):
        ColourDetector(low, high, area)


# Markers


def tag(*places, family="APRILTAG_36h11", ids=(0, 0, 0), tilt=0.0):
    """Markers with their corners' middle at sub-pixel places, seen at an angle; and the true middles."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
    large = np.full((240 * SCALE, 320 * SCALE), 200, np.uint8)
    for (u, v), number in zip(places, ids, strict=False):
        texture = cv2.copyMakeBorder(cv2.aruco.generateImageMarker(dictionary, number, 80), 10, 10, 10, 10, 0, value=255)
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 25.0
        far = 1.0 + tilt * corners[:, 1] / 25.0
        corners = corners * far[:, None] + (u, v)
        edges = np.array([(-0.5, -0.5), (99.5, -0.5), (99.5, 99.5), (-0.5, 99.5)], np.float32)
        warp = cv2.getPerspectiveTransform(edges, ((corners + 0.5) * SCALE - 0.5).astype(np.float32))
        cv2.warpPerspective(texture, warp, large.shape[::-1], dst=large, borderMode=cv2.BORDER_TRANSPARENT)
    image = cv2.resize(large, (320, 240), interpolation=cv2.INTER_AREA)
    return as_taken(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), 2.0)


def test_the_middle_of_a_marker_is_where_its_diagonals_cross():
    generator = np.random.default_rng(2)
    off = []
    for _ in range(30):
        place = generator.uniform((40, 40), (280, 200))
        seen = MarkerDetector().detect(tag(place, tilt=generator.uniform(-0.12, 0.12)))
        assert seen.outline_px.shape == (4, 2)
        off.append(seen.centre_px - place)
    assert np.sqrt(np.mean(np.square(off))) < 0.25
    assert np.abs(np.mean(off, axis=0)).max() < 0.1  # half a pixel here is a common mistake


@pytest.mark.parametrize("family", ["APRILTAG_36h11", "APRILTAG_16h5", "4X4_50", "6X6_250"])
def test_families(family):
    assert family in MARKER_FAMILIES
    seen = MarkerDetector(family, id=3).detect(tag((150, 100), family=family, ids=(3,)))
    assert seen.centre_px == pytest.approx((150, 100), abs=0.6)


@pytest.mark.parametrize(
    ("id", "image", "words"),
    [
        (None, discs(), "no APRILTAG_36h11 marker was found; check"),
        (5, tag((100, 100), ids=(7,)), r"no APRILTAG_36h11 marker 5 was found \(markers in view: 7\)"),
        (None, tag((80, 100), (220, 100), ids=(7, 8)), r"2 times APRILTAG_36h11 marker is in view \(ids 7, 8\)"),
        (7, tag((80, 100), (220, 100), ids=(7, 7)), "2 times APRILTAG_36h11 marker 7 is in view"),
    ],
)
def test_no_marker_or_several(id, image, words):
    with pytest.raises(TargetNotFoundError, match=words):
        MarkerDetector(id=id).detect(image)


def test_one_marker_among_others():
    image = tag((80, 100), (220, 100), ids=(7, 8))
    assert MarkerDetector(id=8).detect(image).centre_px == pytest.approx((220, 100), abs=0.6)


@pytest.mark.parametrize(
    ("family", "id", "words"),
    [("APRILTAG_99", None, "choose one of .*APRILTAG_36h11"), ("4X4_50", 50, "id must be"), ("4X4_50", -1, "id must be")],
)
def test_a_marker_that_is_none(family, id, words):
    with pytest.raises(ValueError, match=words):
        MarkerDetector(family, id)


def test_annotations_are_drawn_on_a_copy():
    image = discs((160, 120))
    before = image.copy()
    seen = RED.detect(image)
    drawn = annotate(image, seen, "two\nlines")
    assert (image == before).all()
    assert drawn.shape == image.shape
    u, v = (round(value) for value in seen.centre_px)
    assert tuple(drawn[v, u]) == (0, 255, 0)
    changed = (drawn != image).any(axis=2)
    assert changed[:16].any()
    assert changed[16:32].any()
    assert not (annotate(image, None) != image).any()
    far = Detection((5000.0, -70.0), np.array([[0.0, 0.0], [9999.0, 0.0]]))
    assert annotate(image, far).shape == image.shape
