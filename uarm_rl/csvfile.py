"""CSV files written row by row, their columns declared up front."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from uarm_rl import files


class Logbook:
    """Appends rows to a CSV file; each row is written whole and flushed before the next."""

    def __init__(self, path: Path, columns: Sequence[str], *, keep_rows: int = 0) -> None:
        """Begin a file, or with ``keep_rows`` continue one behind its first ``keep_rows`` rows.

        Raises :class:`ValueError` if the file to continue has other columns or fewer rows.
        """
        self.columns = tuple(columns)
        header = _line(self.columns)
        if keep_rows:
            lines = io.StringIO(files.read(path).decode(), newline="").readlines()
            kept = lines[: keep_rows + 1]
            if not lines or lines[0] != header or len(kept) < keep_rows + 1 or not kept[-1].endswith("\n"):
                raise ValueError(f"{path} does not hold the {keep_rows} rows that the checkpoint counts; start anew")
            files.replace(path, "".join(kept).encode())
        else:
            files.replace(path, header.encode())
        # files.replace has just made it, so it is no link. (Held open until close.)
        self._file = open(path, "a", encoding="utf-8", newline="")  # noqa: SIM115

    def add(self, row: Mapping[str, object]) -> None:
        """Append one row; a missing column stays empty, an undeclared one raises :class:`ValueError`."""
        if unknown := set(row) - set(self.columns):
            raise ValueError(f"column {sorted(unknown)[0]!r} was not declared for {self._file.name}")
        self._file.write(_line([row.get(column, "") for column in self.columns]))
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def write_rows(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> None:
    """Write a whole CSV file, replacing an old one atomically."""
    lines = [_line(columns), *(_line([row[column] for column in columns]) for row in rows)]
    files.replace(path, "".join(lines).encode())


def _line(values: Sequence[object]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow([_text(value) for value in values])
    return buffer.getvalue()


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    return f"{value:.9g}" if isinstance(value, float) else str(value)
