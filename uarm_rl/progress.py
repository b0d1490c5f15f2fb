"""Progress of long work: a bar on a terminal; elsewhere, as in a log file, a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, Final, TypeVar

from tqdm import tqdm

#: A bar shows a sign of life after so many seconds.
SILENCE_S: Final = 5.0
#: Lines are so far apart; the last one always comes.
LINE_EVERY_S: Final = 30.0

T = TypeVar("T")


def say(text: str) -> None:
    """A line of text on stderr that bars leave alone."""
    if sys.stderr.isatty():
        tqdm.write(text, file=sys.stderr)
    else:
        print(text, file=sys.stderr, flush=True)


class Bar(tqdm):  # type: ignore[type-arg]  # tqdm's own class cannot be given one
    """A bar on stderr, moved by ``update``."""

    silence_s = SILENCE_S
    _ticked_t = 0.0  # beside ``last_print_t``, from which tqdm has the rate

    def tick(self) -> None:
        """Show that time passes where one step takes long."""
        now = time.time()
        if not self.disable and now - max(self.last_print_t, self._ticked_t) >= self.silence_s:
            self._ticked_t = now
            self.refresh()


class _Lines(Bar):
    """Where nothing moves: each sight of the bar is a line, as in ``mine/seed0: 40 of 1500 episodes, 02:10, 1:19:00 to go``."""

    silence_s = LINE_EVERY_S
    _shown: tuple[object, object] | None = None  # what the last line said, but for its times
    _shown_t = 0.0

    def __init__(self, **words: Any) -> None:
        words |= {"mininterval": LINE_EVERY_S, "miniters": 1, "delay": 1e-9}  # a delay: nothing is shown before the first step
        super().__init__(**words, bar_format="{desc}: {n_fmt} of {total_fmt} {unit}s, {elapsed}, {remaining} to go{postfix}")

    def display(self, *_: Any, **__: Any) -> None:
        if time.time() - self._shown_t >= self.silence_s:  # a sign of life and a step may come one after the other
            self._print()

    def _print(self) -> None:
        self._shown, self._shown_t = (self.n, self.postfix), time.time()
        print(self, file=self.fp, flush=True)

    def clear(self, *_: Any, **__: Any) -> None:
        """What is written stays."""

    def close(self) -> None:
        if not self.disable:
            if self._shown != (self.n, self.postfix):
                self._print()
            self.sp = None  # so that nothing is drawn over it
        super().close()


def progress(total: int, unit: str, label: str, *, done: int = 0, line: int | None = None) -> Bar:
    """A context that shows how many of ``total`` are done, ``done`` already; ``line`` is that of a terminal, from 0."""
    words: dict[str, Any] = {"total": total, "unit": unit, "desc": label, "initial": done, "position": line, "smoothing": 0.1}
    return Bar(**words, dynamic_ncols=True, mininterval=0.5) if sys.stderr.isatty() else _Lines(**words)


def shown(things: Iterable[T], total: int, unit: str, label: str) -> Iterator[T]:
    """The things one after the other, with their progress shown."""
    with progress(total, unit, label) as bar:
        for thing in things:
            yield thing
            bar.update()
