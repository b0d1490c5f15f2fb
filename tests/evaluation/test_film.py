"""Films: every control step, its words and marks, and files that show again what was seen."""

from __future__ import annotations

from contextlib import closing
from functools import partial

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from uarm_rl import configuration
from uarm_rl.evaluation.film import film, write_film
from uarm_rl.task.policy import InverseKinematicsPolicy
from uarm_rl.task.rollout import Episode, run_episode

SIZE = (128, 96)
TARGET = (0.25, 0.1, 0.03)


@pytest.fixture(scope="module")
def filmed():
    """Pictures with their words and marks, the same without, the episode, and where the target is in the picture."""
    settings = configuration.compose("train", ("buffer=adaptive",))
    make = partial(configuration.build_env, settings, time_limit_s=4.0, render_mode="rgb_array_list", picture_size=SIZE)
    policy, reset = InverseKinematicsPolicy(0.15), {"options": {"object_position": TARGET}}
    with closing(make()) as env:
        pixel = partial(env.arm.pixel, *SIZE)
        pictures, successes = film(env, policy, [reset, reset], control_hz=20, pixel=pixel)
        episode = run_episode(env, policy, **reset)
        assert (successes, episode.success) == (2, True)
        return pictures, env.render(), episode, pixel(TARGET)


def test_there_is_a_picture_a_control_step_and_a_rest_on_the_last(filmed):
    pictures, plain, episode, _ = filmed
    assert isinstance(episode, Episode)
    assert len(plain) == len(episode.trace)
    assert len(pictures) == 2 * (len(plain) + 10)
    once = pictures[: len(pictures) // 2]
    for picture, bare in zip(once, plain, strict=False):  # below the words
        np.testing.assert_array_equal(picture[60:, 90:], bare[60:, 90:])
    assert all(np.array_equal(picture, once[-1]) for picture in once[-11:])
    assert not np.array_equal(plain[0], plain[-1])  # the arm has moved


def test_words_and_target_are_drawn_in(filmed):
    pictures, plain, _, (x, y) = filmed
    changed = np.any(pictures[0] != plain[0], axis=2)
    rows, columns = np.nonzero(changed)
    ring = (np.abs(columns - x) < 5) & (np.abs(rows - y) < 5)
    words = (rows < 20) & (columns < 100)
    assert ring.sum() > 5
    assert words.sum() > 20
    assert (ring | words).all()
    words_at_the_end = np.any(pictures[len(plain) - 1] != plain[-1], axis=2)[:20].sum()
    assert words_at_the_end > 1.2 * words.sum()  # "reached"


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_file_shows_again_what_was_seen_and_as_fast(filmed, tmp_path, suffix):
    pictures = filmed[0]
    path = tmp_path / f"film.{suffix}"
    write_film(path, pictures, frames_per_second=20)
    assert list(tmp_path.iterdir()) == [path]
    shown, duration_s = read(path)
    assert duration_s == pytest.approx(len(pictures) / 20, abs=0.01)
    for seen, picture in ((shown[0], pictures[0]), (shown[-1], pictures[-1])):
        assert seen.shape == picture.shape
        assert np.abs(seen.astype(float) - picture).mean() < 4.0
    assert np.abs(shown[0].astype(float) - pictures[-1]).mean() > 4.0  # which the wrong picture would not pass


def read(path):
    if path.suffix == ".gif":
        with Image.open(path) as image:
            frames = [(np.asarray(frame.convert("RGB")), frame.info["duration"]) for frame in ImageSequence.Iterator(image)]
        return [frame for frame, _ in frames], sum(duration for _, duration in frames) / 1000
    capture = cv2.VideoCapture(str(path))
    rate, shown = capture.get(cv2.CAP_PROP_FPS), []
    while (frame := capture.read())[0]:
        shown.append(cv2.cvtColor(frame[1], cv2.COLOR_BGR2RGB))
    return shown, len(shown) / rate
