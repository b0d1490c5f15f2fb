"""The report's page: whole, in one file, nothing from outside, no file's text taken for HTML, and a browser agrees."""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.browser import CHROMIUM, browser
from tests.report.runs import NAMES, add_evaluation, add_progress, write
from uarm_rl.report import svg
from uarm_rl.report.page import page
from uarm_rl.report.report import report
from uarm_rl.report.tables import Document, Heading, Photo, Picture, Section, Shown, Table

VOID = {"meta", "link", "br", "img", "input", "hr"}
HOSTILE = "<script>alert(1)<"
REASON = "</script><img src=x onerror=alert(1)>"
TWELVE = [[str(number), f"{number % 3} %"] for number in range(20)]


class Page(HTMLParser):
    """What is in a page: every element with its attributes, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, self.getpos()

    def handle_data(self, data):
        self.text += "" if "script" in self.open or "style" in self.open else data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


def add_traces(results: Path, name: str, steps: int) -> None:
    """Two positions, of which the second takes longer."""
    rows = [
        {"position": position, "step": step, "time_s": step / 20, "joint1_rad": step / 50, "joint2_rad": 0.3, "joint3_rad": 0.2}
        | {f"{what}_{axis}_m": 0.2 + 0.001 * step for what in ("cup", "object") for axis in "xyz"}
        for position in (0, 1)
        for step in range(steps + position)
    ]
    write(results / NAMES[name] / "seed0" / "evaluation-traces.csv", rows)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    for name, successes, steps in (("A", "1111", 4), ("B", "0101", 8)):
        add_evaluation(folder, name, 0, successes)
        add_progress(folder, name, 0, "0.5", "0.96")
        add_traces(folder, name, steps)
    add_evaluation(folder, HOSTILE, 0, "1101")
    trial = {"success": 1, "reached": 1, "emulated": 0, "reason": REASON}
    write(folder / "A<b>" / "real" / "trials.csv", [trial | {"trial": number} for number in range(3)])
    (folder / "A<b>" / "real" / 'look"1.png').write_bytes(b"\x89PNG")
    report(folder, {})
    return folder


@pytest.fixture(scope="module")
def made(results: Path) -> str:
    return (results / "report.html").read_text(encoding="utf-8")


def test_the_page_is_whole_and_refers_to_nothing_outside(made):
    parsed = Page(made)
    references = [value for _, attributes in parsed.elements for name, value in attributes.items() if name in ("src", "href")]
    assert references
    assert [value for value in references if not value.startswith(("#", "data:"))] == []
    assert not re.search(r"url\((?!#)|@import", made.partition("<script")[0])
    ids = [attributes["id"] for _, attributes in parsed.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert {value[1:] for value in references if value.startswith("#")} <= set(ids)
    assert {name for name in re.findall(r"url\(#([^)]+)\)", made.partition('<script type="application/json"')[0])} <= set(ids)
    assert parsed.all("html")[0]["lang"] == "en"


def test_table_1_comes_first_with_the_papers_numbers(made):
    titles = re.findall(r"<h2[^>]*>(.*?)</h2>", made)
    assert titles[0] == "Table 1: success beside the paper&#x27;s"
    assert {"Learning", "Replays", "Trials of the arm", "Where the numbers come from"} <= set(titles)
    assert made.index('<th scope="row">A</th>') < made.index("<svg")
    assert "99 %" in made.partition("</table>")[0]


def test_figures_are_drawings_that_say_what_they_show_and_fit_a_dark_ground(made):
    parsed = Page(made)
    drawings = [attributes for attributes in parsed.all("svg")]
    assert len(drawings) == 4  # rewards, learning, shaking, budgets
    assert all(one["role"] == "img" and one["aria-label"] for one in drawings)
    drawn = "".join(re.findall(r"<svg.*?</svg>", made, re.DOTALL))
    assert "currentColor" in drawn
    assert "#000000" not in drawn
    assert "prefers-color-scheme: dark" in made


def test_what_comes_from_files_is_text(made):
    parsed = Page(made)
    assert len(parsed.all("script")) == 2
    assert HOSTILE in parsed.text
    assert REASON in parsed.text
    assert [attributes["alt"] for attributes in parsed.all("img")] == ['look"1.png of A<b>/real']
    assert not {name for _, attributes in parsed.elements for name in attributes if name.startswith("on")}


def test_every_run_is_there_with_its_hashes(made, results):
    import hashlib

    digest = hashlib.sha256((results / NAMES["B"] / "seed0" / "progress.csv").read_bytes()).hexdigest()[:16]
    assert f"<code>{digest}</code>" in made
    assert "Python" in Page(made).text


def test_without_viser_the_page_says_how_to_add_it(tmp_path, monkeypatch):
    for name in ("A", "B"):
        add_evaluation(tmp_path, name, 0, "11")
        add_traces(tmp_path, name, 3)
    monkeypatch.setitem(sys.modules, "viser", None)
    for module in ("uarm_rl.view.replay", "uarm_rl.view.scene"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    sentence = "viser is not installed, which shows the arm in a browser; in the checkout: pip install"
    assert f"report.html has no replays: {sentence}" in report(tmp_path, {})
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert f"There are no replays here: {sentence}" in text
    assert "Methods" not in text


def test_documents_tables_and_pictures_become_html_in_their_order():
    drawing = Picture("what <it> shows", b"png", '<svg viewBox="0 0 9 9" x="1"><path id="a" d="M 1.23456 2&#10;L 3 4"/></svg>')
    document = Document(Heading("Why?"), Table(("Name", "Share"), TWELVE), Shown("x.png"), "**bold** and `code` <b>")
    section = Section({"x.png": drawing, "x.md": document}, page=Document(Photo("seen", "image/png", b"\x89PNG")))
    text = page({"One & two": section, "Nothing": Section()}).decode()
    order = [
        "One &amp; two</h2>",
        "<h3>Why?</h3>",
        "<details><summary>Table of 20 rows",
        "<svg",
        "<strong>bold</strong> and <code>code",
    ]
    assert sorted(order, key=text.index) == order
    assert 'aria-label="what &lt;it&gt; shows"' in text
    assert "Nothing" not in text
    assert document.encode().decode().splitlines()[-3:] == ["![x](x.png)", "", "**bold** and `code` <b>"]
    assert page({"One & two": section}) == page({"One & two": section})


def test_a_drawing_keeps_its_names_to_itself():
    text = (
        '<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg" width="9pt" viewBox="0 0 9 9"><metadata>x</metadata>'
        '<g id="axes_1"><path id="m1" d="M 0.123456 10.00000 \nL 5 6" style="stroke: #000000"/><use xlink:href="#m1"/></g>'
        "<text style=\"font: 700 7px 'DejaVu Sans', sans-serif; text-anchor: end\">x</text></svg>\n"
    )
    drawn = svg.inline(text, "f1", "words")
    assert drawn == (
        '<svg viewBox="0 0 9 9" role="img" aria-label="words"><g><path id="f1-m1" d="M 0.12 10 L 5 6" '
        'style="stroke: currentColor"/><use href="#f1-m1"/></g>'
        '<text style="font: 700 7px var(--figure); text-anchor: end">x</text></svg>'
    )


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium; on Debian: apt-get install chromium")
def test_a_browser_shows_it_sorts_it_and_plays_it(results, tmp_path):
    titles = "document.querySelector('.viewer iframe')?.title"
    column = "[...document.querySelectorAll('#s0 tbody tr')].map(row => row.cells[4].textContent)"
    with browser() as tab:
        tab.open(results / "report.html", width=400, dark=True)
        assert tab.value("document.documentElement.scrollWidth <= innerWidth")
        assert tab.value("getComputedStyle(document.body).backgroundColor") == "rgb(21, 24, 28)"
        before = tab.value(column)
        tab.value("document.querySelectorAll('#s0 thead button')[4].click()")
        after = tab.value(column)
        assert (sorted(before), after[0][:4]) == (sorted(after), "50 %")
        assert tab.value("document.querySelectorAll('#s0 th')[4].ariaSort") == "ascending"
        tab.value("document.querySelector('.stage').scrollIntoView()")
        tab.wait(0.5)
        assert tab.value(titles) == "Replay: A and B, Test position 1"
        tab.value("const one = document.querySelector('.where'); one.selectedIndex = 1; one.dispatchEvent(new Event('change'))")
        assert tab.value(titles) == "Replay: A and B, Test position 0"
        tab.wait(2.0)
        assert tab.problems == []
        assert {url.partition(":")[0] for url in tab.requests} <= {"file", "data", "blob"}
