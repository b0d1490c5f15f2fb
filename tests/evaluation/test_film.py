"""Films: which control steps they show, their words and marks, two policies beside each other, files that show it again."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from uarm_rl import cli, configuration
from uarm_rl.evaluation.film import Screen, film, head_height, play, write_film
from uarm_rl.sim.simulated_arm import CAMERA
from uarm_rl.task.policy import InverseKinematicsPolicy

SIZE = (128, 128)
HEAD = head_height(*SIZE)
DRAWING = (SIZE[0], SIZE[1] - HEAD)
TARGET = (0.25, 0.1, 0.03)
RUNS = Path(__file__).parents[2] / "results"


def screen(arm, take, title="A"):
    draw = lambda scene: arm.draw(scene, *DRAWING)  # noqa: E731
    return Screen(title, SIZE, [take], draw, partial(CAMERA.pixel, *DRAWING))


@pytest.fixture(scope="module")
def taken():
    """The arm, and an episode of the controller."""
    settings = configuration.compose("train", ("buffer=adaptive",))
    env = configuration.build_env(settings, time_limit_s=4.0, render_mode="rgb_array_list", picture_size=None)
    with closing(env):
        take = play(env, InverseKinematicsPolicy(0.15), {"options": {"object_position": TARGET}})
        assert take.episode.success
        assert len(take.scenes) == len(take.episode.trace)
        yield env.arm, take


@pytest.fixture(scope="module")
def filmed(taken):
    """Every picture, and some without words and marks: the first, one on the way, and the last."""
    arm, take = taken
    pictures = list(film([screen(arm, take)], control_hz=20))
    last = len(take.scenes) - 1
    return pictures, {number: arm.draw(take.scenes[number], *DRAWING) for number in (0, 9, last)}


def test_there_is_a_picture_a_control_step_and_a_rest_on_the_last(filmed):
    pictures, plain = filmed
    last = max(plain)
    assert len(pictures) == last + 1 + 16
    for number, bare in plain.items():  # beside the ring
        assert pictures[number].shape == (SIZE[1], SIZE[0], 3)
        np.testing.assert_array_equal(pictures[number][HEAD:, :60], bare[:, :60])
    assert all(np.array_equal(picture, pictures[-1]) for picture in pictures[-17:])
    assert not np.array_equal(plain[0], plain[last])  # the arm has moved


def test_words_and_target_are_drawn_in(filmed):
    pictures, plain = filmed
    x, y = CAMERA.pixel(*DRAWING, TARGET)
    rows, columns = np.nonzero(np.any(pictures[0][HEAD:] != plain[0], axis=2))
    assert len(rows) > 10
    assert (np.hypot(columns - x, rows - y) < 6).all()
    words = (pictures[0][:HEAD] < 128).any(axis=2)
    assert words.sum() > 40
    reached = pictures[-1][:HEAD].astype(int)
    assert ((reached[:, :, 1] - reached[:, :, 0]) > 60).sum() > 20  # in green
    assert not ((pictures[0][:HEAD, :, 1].astype(int) - pictures[0][:HEAD, :, 0]) > 60).any()


def test_two_are_shown_beside_each_other_and_who_has_ended_rests(taken, filmed):
    arm, take = taken
    short = take._replace(scenes=take.scenes[:5])
    pictures = list(film([screen(arm, short, "B"), screen(arm, take)], control_hz=20, every=4))
    assert len(pictures) == -(-(len(take.scenes) - 1) // 4) + 5
    assert {picture.shape for picture in pictures} == {(SIZE[1], 2 * SIZE[0], 3)}
    left, right = zip(*(np.hsplit(picture, 2) for picture in pictures), strict=True)
    assert all(np.array_equal(picture, left[1]) for picture in left[1:])
    for number in (0, 1, 2):
        np.testing.assert_array_equal(right[number], filmed[0][4 * number])
    np.testing.assert_array_equal(right[-1], filmed[0][-1])


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_a_file_shows_again_what_was_seen_and_as_fast(filmed, tmp_path, suffix):
    pictures = filmed[0]
    path = tmp_path / f"film.{suffix}"
    write_film(path, iter(pictures), frames_per_second=20)
    assert list(tmp_path.iterdir()) == [path]
    shown, duration_s = read(path)
    assert duration_s == pytest.approx(len(pictures) / 20, abs=0.01)
    for seen, picture in ((shown[0], pictures[0]), (shown[-1], pictures[-1])):
        assert seen.shape == picture.shape
        assert np.abs(seen.astype(float) - picture).mean() < 4.0
    assert np.abs(shown[0].astype(float) - pictures[-1]).mean() > 4.0  # which the wrong picture would not pass


def test_the_command_films_two_on_the_same_positions(tmp_path, capsys):
    one, other = RUNS / "adaptive-plain" / "seed0", RUNS / "uniform-plain" / "seed0"
    words = ["episodes=1", "time_limit_s=1", "width=128", "height=64", "pictures_per_second=5", f"out={tmp_path / 'ab.gif'}"]
    cli.main(["render", f"run={one}", "--compare", str(other), *words])
    said = capsys.readouterr().out
    assert "A: adaptive, plain: 0 of 1 episodes successful" in said
    assert "B: uniform, plain: 0 of 1 episodes successful" in said
    shown, duration_s = read(tmp_path / "ab.gif")
    assert shown[0].shape == (64, 128, 3)
    assert duration_s == pytest.approx((1.0 + 1.0), abs=0.21)
    np.testing.assert_array_equal(shown[0][HEAD:, :64], shown[0][HEAD:, 64:])  # the same place, before they move
    assert not np.array_equal(shown[-1][:, :64], shown[-1][:, 64:])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["pictures_per_second=3"], "pictures_per_second must divide control_hz, which is 20 in this run; got 3"),
        ([f"compare={RUNS / 'adaptive-plain' / 'seed0'}/"], "is the run itself; name another one, or compare=ik"),
        (["compare=nowhere/seed0"], "there is no run folder nowhere/seed0"),
    ],
)
def test_what_cannot_be_filmed_is_refused_in_a_sentence(tmp_path, capsys, words, sentence):
    with pytest.raises(SystemExit):
        cli.main(["render", f"run={RUNS / 'adaptive-plain' / 'seed0'}", f"out={tmp_path / 'a.gif'}", *words])
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


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
