"""Progress: a bar that a terminal draws over and over, and whole lines now and then where there is none."""

from __future__ import annotations

import io
from contextlib import redirect_stderr

import pytest

from uarm_rl import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(params=[io.StringIO, Terminal])
def stream(request) -> io.StringIO:
    return request.param()


def work(stream: io.StringIO, steps: int = 4) -> None:
    with redirect_stderr(stream), progress.progress(10, "episode", "mine/seed0", done=2) as bar:
        for step in range(steps):
            if step == 2:
                progress.say("warning: something")
            bar.set_postfix_str(f"success {step}", refresh=False)
            bar.update()
            bar.tick()


def test_a_terminal_has_a_bar_and_a_file_has_lines_alone(stream, monkeypatch):
    monkeypatch.setattr(progress._Lines, "silence_s", 0.0)
    work(stream)
    text = stream.getvalue()
    assert "warning: something\n" in text
    assert "\r" in text if stream.isatty() else "\r" not in text and "\x1b" not in text
    if not stream.isatty():
        lines = text.splitlines()
        assert all(line == "warning: something" or line.startswith("mine/seed0: ") for line in lines)
        assert [line.split(",")[0] for line in lines if line.startswith("mine")] == [
            f"mine/seed0: {number} of 10 episodes" for number in (3, 4, 5, 6)
        ]
        assert lines[-1].endswith(" to go, success 3")


@pytest.mark.parametrize("stream", [io.StringIO], indirect=True)
def test_a_step_and_a_sign_of_life_together_are_one_line(stream):
    with redirect_stderr(stream), progress.progress(10, "episode", "mine/seed0") as bar:
        bar.last_print_t -= 100.0  # as if so many seconds had passed
        bar.tick()
        bar.update()
    assert [line[:16] for line in stream.getvalue().splitlines()] == ["mine/seed0: 0 of", "mine/seed0: 1 of"]


@pytest.mark.parametrize("stream", [io.StringIO], indirect=True)
def test_quick_work_is_one_line_and_no_work_one_too(stream):
    work(stream)
    assert [line[:22] for line in stream.getvalue().splitlines()] == ["warning: something", "mine/seed0: 6 of 10 ep"]
    with redirect_stderr(stream):
        assert list(progress.shown("", 0, "position", "none")) == []
    assert stream.getvalue().splitlines()[2:] == ["none: 0 of 0 positions, 00:00, ? to go"]


def test_what_is_shown_comes_through(stream):
    with redirect_stderr(stream):
        assert list(progress.shown("abc", 3, "letter", "spelling")) == ["a", "b", "c"]
    assert "spelling: " in stream.getvalue()
    assert stream.getvalue().endswith("\n")
