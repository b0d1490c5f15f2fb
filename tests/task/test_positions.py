"""Where the object may lie: the committed files and files of users."""

from __future__ import annotations

import hashlib
from importlib import resources

import numpy as np
import pytest

from uarm_rl.task import positions

SHA256 = {
    "test_positions.csv": "61fb4ae9f1887b8495a613ec31f1e8a94181e5f344fb08a874d051def5ac8811",
    "validation_positions.csv": "6755be32e6fc0d6fd931749f5544f896287c0fb52bac950a98d453b5783e86eb",
    "heldout_positions.csv": "850d960ec2240c3e78198f786a33f6308e913014d1ba0ea7a76d89155e9b1da2",
}


@pytest.mark.parametrize("name", positions.FILES)
def test_committed_positions_have_not_changed(name):
    data = (resources.files("uarm_rl.task") / name).read_bytes()
    assert hashlib.sha256(data).hexdigest() == SHA256[name]


@pytest.mark.parametrize("name", positions.FILES)
def test_committed_positions_are_the_draw_that_they_claim_to_be(name):
    held = positions.load_packaged(name)
    assert len(held) == positions.FILES[name][0]
    assert len(np.unique(held, axis=0)) == len(held)
    np.testing.assert_array_equal(held[:, 2], positions.OBJECT_HEIGHT_M)
    np.testing.assert_allclose(held, positions.draw_file(name), atol=1e-9)
    assert all(positions.in_operating_range(position) for position in held)


def test_test_and_validation_positions_are_disjoint():
    test, validation = positions.load_packaged("test_positions.csv"), positions.load_packaged("validation_positions.csv")
    assert np.linalg.norm(test[:, None] - validation[None], axis=2).min() > 1e-4


def test_draws_fill_the_operating_range():
    generator = np.random.default_rng(0)
    drawn = np.array([positions.draw(generator, 0.03) for _ in range(400)])
    radius, angle = np.hypot(drawn[:, 0], drawn[:, 1]), np.degrees(np.arctan2(drawn[:, 1], drawn[:, 0]))
    assert radius.min() >= positions.MIN_RADIUS_M
    assert radius.max() > 0.33
    assert angle.min() < -80
    assert angle.max() > 80
    assert abs(np.median(angle)) < 10


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("x_m,y_m\n0.2,0\n", "lacks the column z_m"),
        ("", "is empty and lacks the column x_m"),
        ("x_m,y_m,z_m\n", "holds no positions"),
        ("x_m,y_m,z_m\n0.2,0,0.03\n0.2,nan,0.03\n", "line 3: y_m is 'nan' and must be a finite number"),
        ("x_m,y_m,z_m\n0.2,zero,0.03\n", "line 2: y_m is 'zero'"),
        ("x_m,y_m,z_m\n0.2,0\n", "line 2: 2 values for 3 columns"),
        ("x_m,y_m,z_m\n0.9,0,0.03\n", "line 2: the cup cannot reach"),
    ],
)
def test_a_bad_file_is_refused_with_its_line(tmp_path, text, sentence):
    path = tmp_path / "mine.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=sentence):
        positions.load(path)


def test_what_is_saved_is_what_is_loaded(tmp_path):
    held = positions.load_packaged("validation_positions.csv")
    positions.save(tmp_path / "copy.csv", held)
    np.testing.assert_array_equal(positions.load(tmp_path / "copy.csv"), held)


def test_an_object_of_another_height_stands_in_the_same_places():
    as_drawn, higher = positions.load_named("validation"), positions.load_named("validation", 0.04)
    assert np.array_equal(as_drawn[:, :2], higher[:, :2])
    assert set(higher[:, 2]) == {0.04}
