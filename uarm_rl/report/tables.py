"""From rows to the report's tables, and what a section is made of, for files and page alike: what all sections share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from uarm_rl import csvfile
from uarm_rl.report import statistics
from uarm_rl.report.records import Method

#: The column of a run's log that says how well its policy does on the validation positions.
RATE: Final = "validation_success_rate"

_BOOTSTRAP_SEED: Final = 20190701  # any fixed number: the same files give the same interval
#: Draws times positions: a thousand positions get by with fewer draws than a hundred, in the same time.
_BOOTSTRAP_WORK: Final = 1_000_000


class Table(NamedTuple):
    """A table for readers, whose first ``left`` columns are words and whose others are numbers; cells are Markdown."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int = 1
    title: str = ""  # on the page, above what is folded

    def markdown(self) -> str:
        """The table as Markdown."""
        rule = ["---"] * self.left + ["---:"] * (len(self.headings) - self.left)
        return "".join("| " + " | ".join(row) + " |\n" for row in (self.headings, rule, *self.rows))


class Heading(NamedTuple):
    """The title of what follows in a document."""

    words: str

    def markdown(self) -> str:
        """The heading as Markdown."""
        return f"## {self.words}\n"


class Shown(NamedTuple):
    """A picture of the same section, by its file's name, in a document that lies beside it."""

    file: str

    def markdown(self) -> str:
        """The picture's place in Markdown."""
        return f"![{Path(self.file).stem}]({self.file})\n"


class Photo(NamedTuple):
    """A picture that was there before, for the page alone: what it shows, its media type, its bytes."""

    words: str
    kind: str
    data: bytes

    def markdown(self) -> str:
        """What it shows."""
        return f"{self.words}\n"


class Replay(NamedTuple):
    """One recording for a stage: who is to be seen, where, how it ended, and the recording itself, as base64."""

    who: str
    where: str
    outcome: str
    recording: str


class Stage(NamedTuple):
    """Replays in 3-D, for the page alone: the viewer's page before and after the recording's place, and what it can show."""

    before: str
    after: str
    replays: Sequence[Replay]

    def markdown(self) -> str:
        """How each ended."""
        return "".join(f"- {one.who}, {one.where}: {one.outcome}\n" for one in self.replays)


Part = str | Table | Heading | Shown | Photo | Stage


class Document:
    """Paragraphs in Markdown, tables, headings and pictures, one below the other."""

    def __init__(self, *parts: Part) -> None:
        self.parts = parts

    def encode(self) -> bytes:
        """The bytes of a Markdown file."""
        return "\n".join(f"{part}\n" if isinstance(part, str) else part.markdown() for part in self.parts).encode()


class Picture(NamedTuple):
    """A figure: what it shows, in words, and the same drawn as PNG and as SVG."""

    words: str
    png: bytes
    svg: str

    def encode(self) -> bytes:
        """The bytes of a PNG file."""
        return self.png


Content = bytes | Document | Picture


@dataclass
class Section:
    """A part of the report: its files, by their names, remarks on what is missing and which command makes it, its text.

    ``page`` is what the page has beside the files.
    """

    contents: dict[str, Content] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    text: str = ""
    page: Document = field(default_factory=Document)

    def files(self) -> dict[str, bytes]:
        """The bytes of its files, by their names."""
        return {name: one if isinstance(one, bytes) else one.encode() for name, one in self.contents.items()}


def shown(path: Path) -> Path:
    """``path`` relative to the current folder if it lies below it."""
    return path.absolute().relative_to(Path.cwd()) if path.absolute().is_relative_to(Path.cwd()) else path


def generator() -> np.random.Generator:
    """The randomness of one bootstrap: the same every time."""
    return np.random.default_rng(_BOOTSTRAP_SEED)


def outcomes(rows: pd.DataFrame, value: str = "success") -> NDArray[np.float64]:
    """A column of an evaluation as an array, shape (seeds, positions)."""
    array: NDArray[np.float64] = rows.pivot(index="seed", columns="position", values=value).to_numpy(np.float64)
    return array


def resamples(rows: pd.DataFrame) -> int:
    """How often to draw for a bootstrap over these rows."""
    return min(10_000, _BOOTSTRAP_WORK // max(1, rows["position"].nunique()))


def success(rows: pd.DataFrame) -> dict[str, Any]:
    """``seeds``, ``success_rate``, ``ci_low`` and ``ci_high`` of one method's evaluation; NaN where nothing is known."""
    low, high = math.nan, math.nan
    if len(rows):
        low, high = statistics.success_interval(outcomes(rows), generator(), resamples=resamples(rows))
    return {"seeds": rows["seed"].nunique(), "success_rate": rows["success"].mean(), "ci_low": low, "ci_high": high}


def over_seeds(rows: pd.DataFrame, key: str, values: Sequence[str], **further: tuple[str, str]) -> pd.DataFrame:
    """For each ``key`` the number of seeds, and mean, min and max over them of each value."""
    spread = {f"{value}_{how}": (value, how) for value in values for how in ("mean", "min", "max")}
    groups = rows.astype({key: int}).groupby(key, as_index=False)
    table: pd.DataFrame = groups.agg(seeds=("seed", "nunique"), **further, **spread)
    return table


def curve(progress: pd.DataFrame) -> pd.DataFrame:
    """Validation success over seeds, episode by episode: seeds that were cut short have stored a few experiences less."""
    validated = progress.dropna(subset=[RATE])
    spent = {name: (name, "mean") for name in ("experiences", "control_steps")}
    return over_seeds(validated, "episode", [RATE], **spent)


def stacked(methods: Sequence[Method], curves: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The curves of all methods, one below the other, told apart by the first column."""
    table: pd.DataFrame = pd.concat([curves[method.folder] for method in methods])
    table.insert(0, "method", [method.label for method in methods for _ in range(len(curves[method.folder]))])
    return table


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows as dicts."""
    return [{str(column): value for column, value in row.items()} for row in table.to_dict("records")]


def csv(table: pd.DataFrame) -> bytes:
    """The bytes of a CSV file, with six significant digits."""
    return csvfile.content(table.columns, records(table), digits=6)


def percent(rate: float, unit: str = " %") -> str:
    """A rate for readers: ``97.5 %``, ``-`` if it is not known."""
    return "-" if math.isnan(rate) else f"{round(100.0 * rate, 1):g}{unit}"


def number(value: float, decimals: int) -> str:
    """A number for readers, ``-`` if it is not known."""
    return "-" if math.isnan(value) else f"{value:.{decimals}f}"


def success_text(row: Mapping[str, Any]) -> str:
    """``success`` in one cell: ``97 % (91.5 to 99 %)``."""
    rate, low, high = row["success_rate"], row["ci_low"], row["ci_high"]
    return f"{percent(rate)} ({percent(low, '')} to {percent(high)})" if row["seeds"] else "-"


def aligned(headings: Sequence[str], rows: Sequence[Sequence[str]], *, left: int = 1) -> str:
    """The table in columns of equal width, with the brackets of the headings on a second line."""
    names, _, brackets = zip(*(heading.partition(" (") for heading in headings), strict=True)
    lines = [names, [bracket.rstrip(")") for bracket in brackets], *rows]
    sides = "<" * left + ">" * (len(names) - left)
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = ["  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True)) for row in lines]
    text.insert(2, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in text)
