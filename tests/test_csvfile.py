"""CSV files as people have them: what spreadsheets save is read, and what is refused is named; one declaration of columns."""

import math
from pathlib import Path

import pytest

from uarm_rl import columns, csvfile
from uarm_rl.columns import OBSERVATIONS, POSITIONS
from uarm_rl.csvfile import CsvError
from uarm_rl.report.report import report
from uarm_rl.task import positions

PLAIN = "x_m,y_m,z_m\n0.25,0.1,0.03\n0.2,-0.1,0.03\n"
DECIMAL_COMMAS = PLAIN.replace(",", ";").replace(".", ",")
ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "data",
    [
        PLAIN.encode(),
        PLAIN.encode("utf-8-sig"),
        PLAIN.encode("utf-16"),
        b"\xfe\xff" + PLAIN.encode("utf-16-be"),
        PLAIN.encode("utf-32"),
        PLAIN.replace("\n", "\r\n").encode(),
        PLAIN.replace("\n", "\r").encode(),
        PLAIN.replace(",", ";").encode(),
        PLAIN.replace(",", "\t").encode(),
        DECIMAL_COMMAS.encode("utf-8-sig"),
        DECIMAL_COMMAS.replace(";", "\t").encode("utf-16"),
        PLAIN.replace(",", ", ").encode(),
        PLAIN.replace(",", " , ").encode(),
        PLAIN.replace(",", '", "').replace("\n", '"\n').replace("x", '"x').replace("0.2", '"0.2').encode(),
        f"sep=;\n{DECIMAL_COMMAS}".encode(),
        PLAIN.replace("\n", "\n\n").encode(),
        f"\n{PLAIN}\n , , \n".encode(),
        PLAIN.replace("\n", ",\n").encode(),
        PLAIN.replace("-", "\N{MINUS SIGN}").encode(),
        b"name,z_m,y_m,x_m\na,0.03,0.1,0.25\nb,0.03,-0.1,0.2\n",
    ],
)
def test_positions_are_read_as_spreadsheets_save_them(tmp_path, data):
    path = tmp_path / "mine.csv"
    path.write_bytes(data)
    assert positions.load(path).tolist() == [[0.25, 0.1, 0.03], [0.2, -0.1, 0.03]]


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (
            PLAIN.replace(",", "|").encode(),
            r"lacks the column x_m; line 1 has 'x_m\|y_m\|z_m'; a file of its kind has",
        ),
        (
            PLAIN.replace("x_m", "x_mm").replace(",", ";").encode(),
            "line 1 has 'x_mm', 'y_m', 'z_m', separated by semicolons",
        ),
        (PLAIN.replace("x", "X").encode(), "lacks the column x_m; line 1 has 'X_m'"),
        (b"# mine\n" + PLAIN.encode(), "line 1 has '# mine'"),
        (PLAIN.replace("0.25", "0,25").encode(), "line 2: 4 values for 3 columns"),
        (PLAIN.replace(".", ",").encode(), "line 2: 6 values for 3 columns; numbers with decimal commas need semicolons"),
        (PLAIN.replace("0.25", '"0,25"').encode(), "line 2: x_m is '0,25' and must be a finite number"),
        (DECIMAL_COMMAS.replace("0,25", "1.000,25").encode(), "line 2: x_m is '1.000,25'"),
        (PLAIN.replace("0.25", "0.2_5").encode(), "line 2: x_m is '0.2_5'"),
        (PLAIN.replace("0.25", "0.25 m").encode(), "line 2: x_m is '0.25 m'"),
        (PLAIN.replace("0.25", "").encode(), "line 2: x_m is ''"),
        (b"x_m,y_m,z_m,x_m\n1,2,3,4\n", "has the column x_m twice in line 1"),
        (PLAIN.encode() + b'0.2,"0.1,0.03\n', "cannot be read .line 4: unexpected end of data"),
        (PLAIN.encode() + "0.2,0.1,0.03,für".encode("latin-1"), "line 4 is not UTF-8: .*; save it as CSV in UTF-8"),
        (PLAIN.encode("utf-16-le"), "line 1 holds a zero byte, as UTF-16 without its mark does"),
        (b"PK\x03\x04...", "is a spreadsheet or an archive and no CSV file; save it as CSV"),
    ],
)
def test_what_is_refused_says_what_was_found_where_and_what_is_expected(tmp_path, data, sentence):
    path = tmp_path / "mine.csv"
    path.write_bytes(data)
    with pytest.raises(CsvError, match=sentence):
        positions.load(path)


def test_a_run_that_went_through_a_spreadsheet_gives_the_same_report(tmp_path):
    committed = ROOT / "results" / "uniform-plain" / "seed0"
    for name in ("plain", "saved"):
        folder = tmp_path / name / "uniform-plain" / "seed0"
        folder.mkdir(parents=True)
        for file in ("evaluation.csv", "progress.csv"):
            text = (committed / file).read_text()
            data = text.encode() if name == "plain" else text.replace(",", ";").replace(".", ",").encode("utf-16")
            (folder / file).write_bytes(data)
        report(tmp_path / name, {})
    for file in (path.name for path in (tmp_path / "plain").iterdir() if path.is_file()):
        assert (tmp_path / "saved" / file).read_bytes() == (tmp_path / "plain" / file).read_bytes()


def test_rows_are_added_to_a_file_that_a_spreadsheet_has_saved_and_nothing_of_it_is_lost(tmp_path):
    path = tmp_path / "seen.csv"
    row = dict.fromkeys(OBSERVATIONS, "0.5") | {"picture": "a.png"}
    csvfile.append_rows(path, OBSERVATIONS, [row])
    with_remark = [f"{line};{remark}" for line, remark in zip(path.read_text().split(), ("remark", "by hand"), strict=True)]
    path.write_text("\r\n".join(with_remark).replace(",", ";").replace("0.5", "0,5"), encoding="utf-8-sig", newline="")
    csvfile.append_rows(path, OBSERVATIONS, [row])
    numbers = ",".join(["0.5"] * 8)
    assert path.read_text() == f"{','.join(OBSERVATIONS)},remark\na.png,{numbers},by hand\na.png,{numbers},\n"


def test_an_optional_or_newer_column_may_be_absent(tmp_path):
    path = tmp_path / "old.csv"
    old = [name for name, column in columns.EVALUATION.items() if not column.since]
    csvfile.write_rows(path, old, [dict.fromkeys(old, 1)])
    values = csvfile.read(path, columns.EVALUATION).values
    assert values["hold"] == [""]
    assert math.isnan(values["sigma"][0])
    assert values["success"] == [1.0]
    with pytest.raises(CsvError, match="lacks the column x_m"):
        csvfile.read(path, POSITIONS)
