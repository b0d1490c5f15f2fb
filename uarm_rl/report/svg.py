"""A figure's SVG as a part of a page: without the page's own names in it, in the page's own colours, and short."""

from __future__ import annotations

import html
import re
from typing import Final

_FRAME: Final = re.compile(r"<svg .*?viewBox=\"([^\"]+)\".*?>(.*)</svg>", re.DOTALL)
#: What Matplotlib writes and a page does without.
_NEEDLESS: Final = re.compile(r"<metadata>.*?</metadata>|<style type=.*?</style>|<!--.*?-->", re.DOTALL)
_ID: Final = re.compile(r' id="([^"]+)"')
_NUMBER: Final = re.compile(r"-?\d+\.\d+")
_PATH: Final = re.compile(r' d="([^"]*)"')
_FONTS: Final = re.compile(r"font: ((?:[\w.]+ )*?)([\d.]+px) [^;\"]*")


def inline(svg: str, name: str, words: str) -> str:
    """The drawing for an HTML document; ``name`` keeps its ids apart from those of others, ``words`` say what it shows.

    Black becomes the colour of the text, so that it can be read on a dark ground too.
    """
    frame = _FRAME.search(svg)
    assert frame, "Matplotlib writes a viewBox"
    box, drawing = frame.groups()
    drawing = _NEEDLESS.sub("", drawing).replace("xlink:href", "href").replace("#000000", "currentColor")
    drawing = drawing.replace("fill: #d9d9d9", "fill: currentColor; fill-opacity: 0.15")  # a band of grey
    used = {*re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', drawing)}
    targets = {one for pair in used for one in pair if one}
    drawing = _ID.sub(lambda match: f' id="{name}-{match[1]}"' if match[1] in targets else "", drawing)
    drawing = re.sub(r'(url\(#|href="#)', rf"\1{name}-", drawing)
    drawing = _PATH.sub(lambda match: f' d="{_short(match[1])}"', drawing)
    drawing = _FONTS.sub(r"font: \1\2 var(--figure)", drawing)
    drawing = re.sub(r">\s+<", "><", drawing)
    return f'<svg viewBox="{box}" role="img" aria-label="{html.escape(words)}">{drawing.strip()}</svg>'


def _short(path: str) -> str:
    """A path to a hundredth of a point, on one line."""
    return " ".join(_NUMBER.sub(lambda match: f"{float(match[0]):.2f}".rstrip("0").rstrip("."), path).split())
