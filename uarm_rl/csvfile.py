"""CSV files: one reader, which takes them as spreadsheets save them, and one writer; their columns are in ``columns``."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from uarm_rl import files
from uarm_rl.columns import Column, Columns

_SEPARATORS: Final = {",": "commas", ";": "semicolons", "\t": "tabs"}
#: How a file begins that is no UTF-8: longer marks first, because UTF-32's begins like UTF-16's.
_MARKS: Final = {
    b"\xff\xfe\x00\x00": "utf-32",
    b"\x00\x00\xfe\xff": "utf-32",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}


class CsvError(ValueError):
    """A sentence: which file and line cannot be read, what was found there and what is expected."""


class Table(NamedTuple):
    """What a file holds: the line of each row, and the values of each column, ``nan`` or ``""`` where there are none."""

    lines: list[int]
    values: dict[str, list[Any]]


class Raw(NamedTuple):
    """The cells of a file as they stand there, without the spaces around them."""

    header: list[str]
    rows: list[tuple[int, list[str]]]
    separator: str


def read(path: Path, columns: Columns) -> Table:
    """The named columns of a CSV file: numbers of their kind, or text; a column that is optional or newer may be absent.

    Takes UTF-8 and what a byte-order mark announces, commas, semicolons or tabs between the columns, decimal commas
    except between commas, spaces around the cells, empty lines, every kind of line end, and further columns. Raises
    :class:`CsvError`, or :class:`OSError` if there is no such plain file.
    """
    raw = _raw(path, columns)
    places = {name: raw.header.index(name) for name in columns if name in raw.header}
    table: dict[str, list[Any]] = {name: [] for name in columns}
    for line, row in raw.rows:
        for name, column in columns.items():
            text = row[places[name]] if name in places else ""
            table[name].append(_value(text, column, raw.separator, name in places, f"{path}, line {line}"))
    return Table([line for line, _ in raw.rows], table)


class Logbook:
    """Appends rows to a CSV file; each row is written whole and flushed before the next."""

    def __init__(self, path: Path, columns: Iterable[str], *, keep_rows: int = 0) -> None:
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


def write_rows(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a whole CSV file, replacing an old one atomically."""
    files.replace(path, content(columns, rows))


def append_rows(path: Path, columns: Columns, rows: Iterable[Mapping[str, object]]) -> None:
    """Add rows to a CSV file, or begin one; one that was saved otherwise gets commas and points, its further columns stay.

    The file is replaced atomically. Raises what :func:`read` does for what is there.
    """
    header, old = list(columns), list[dict[str, str]]()
    if path.exists() and path.stat().st_size:
        raw = _raw(path, columns)
        header = [*raw.header, *(name for name in columns if name not in raw.header)]
        for _, row in raw.rows:
            cells = zip(raw.header, row, strict=True)
            old.append({name: _pointed(cell, raw.separator) if name in columns else cell for name, cell in cells})
    write_rows(path, header, [{**dict.fromkeys(header, ""), **row} for row in (*old, *rows)])


def content(columns: Iterable[str], rows: Iterable[Mapping[str, object]], *, digits: int = 9) -> bytes:
    """The bytes of a CSV file; numbers have so many significant digits."""
    names = list(columns)
    return "".join([_line(names), *(_line([row[name] for name in names], digits) for row in rows)]).encode()


def _line(values: Sequence[object], digits: int = 9) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow([_text(value, digits) for value in values])
    return buffer.getvalue()


def _text(value: object, digits: int) -> str:
    if value is None or value != value:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


# Reading


def _raw(path: Path, columns: Columns) -> Raw:
    """The file's cells, once it is sure that the columns which it must have are there, each once, and every row is whole."""
    expected = f"a file of its kind has the columns {', '.join(columns)}"
    lines = io.StringIO(_decoded(path, files.read(path), expected), newline="").readlines()
    first = 1
    if lines and lines[0].strip().lower() in {f"sep={separator}" for separator in _SEPARATORS}:  # Excel's own remark
        first = 2
    head = lines[first - 1] if len(lines) >= first else ""
    separator = max(_SEPARATORS, key=lambda one: sum(cell.strip().strip('"') in columns for cell in head.split(one)))
    reader = csv.reader(lines[first - 1 :], delimiter=separator, skipinitialspace=True, strict=True)
    try:
        cells = [(reader.line_num + first - 1, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise CsvError(f"{path} cannot be read (line {reader.line_num + first - 1}: {error}); {expected}") from error
    rows = [(line, row) for line, row in cells if any(row)]
    if not rows:
        raise CsvError(f"{path} is empty and lacks the column {next(iter(columns))}; {expected}")
    (line, header), *rows = rows
    _check_header(path, line, header, columns, separator, expected)
    width = len(header)
    for line, row in rows:
        if len(row) < width or any(row[width:]):
            raise CsvError(f"{path}, line {line}: {len(row)} values for {width} columns{_many_commas(separator, row, width)}")
    return Raw(header, [(line, row[:width]) for line, row in rows], separator)


def _decoded(path: Path, data: bytes, expected: str) -> str:
    if data.startswith(b"PK\x03\x04"):
        raise CsvError(f"{path} is a spreadsheet or an archive and no CSV file; save it as CSV; {expected}")
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "utf-8-sig")
    if encoding == "utf-8-sig" and b"\x00" in data:
        where = f"line {_line_of(data, data.index(0))} holds a zero byte, as UTF-16 without its mark does"
        raise CsvError(f"{path} cannot be read ({where}); save it as CSV in UTF-8; {expected}")
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        where = f"line {_line_of(data, error.start)} is not {encoding.removesuffix('-sig').upper()}: {error.reason}"
        raise CsvError(f"{path} cannot be read ({where}); save it as CSV in UTF-8; {expected}") from error


def _line_of(data: bytes, place: int) -> int:
    return data[:place].count(b"\n") + 1


def _check_header(path: Path, line: int, header: list[str], columns: Columns, separator: str, expected: str) -> None:
    """Raises :class:`CsvError` if a column is missing or there twice."""
    needed = [name for name, column in columns.items() if not (column.optional or column.since)]
    if missing := [name for name in needed if name not in header]:
        found = ", ".join(repr(name) for name in header[:20])
        apart = f", separated by {_SEPARATORS[separator]}" if len(header) > 1 else ""
        raise CsvError(
            f"{path} lacks the column {missing[0]}; line {line} has {found}{apart}; {expected}, with commas, semicolons or "
            "tabs between them"
        )
    if twice := [name for name in columns if header.count(name) > 1]:
        raise CsvError(f"{path} has the column {twice[0]} twice in line {line}; {expected}, each once")


def _many_commas(separator: str, row: list[str], width: int) -> str:
    many = separator == "," and len(row) == 2 * width
    return "; numbers with decimal commas need semicolons or tabs between the columns" if many else ""


def _value(text: str, column: Column, separator: str, there: bool, where: str) -> float | str:
    """One cell as a number of its column's kind, or as it is."""
    if column.kind.allows is None:
        return text
    if not text and (column.empty or not there):
        return math.nan
    value = _number(_pointed(text, separator))
    if not column.kind.allows(value):
        words = f"empty or {column.kind.words}" if column.empty else column.kind.words
        raise CsvError(f"{where}: {column.name} is {text!r} and must be {words}")
    return value


def _pointed(text: str, separator: str) -> str:
    """A number as programs write it; between commas a comma is no decimal one, and two of them are none anywhere."""
    if separator != "," and text.count(",") == 1 and "." not in text:
        text = text.replace(",", ".")
    return text.replace("\N{MINUS SIGN}", "-")


def _number(text: str) -> float:
    try:
        value = math.inf if "_" in text else float(text or "inf")
    except ValueError:
        return math.inf
    return value if math.isfinite(value) else math.inf
