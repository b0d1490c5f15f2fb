"""The report's pictures, as a person would put them in a paper: from curves to PNG, nothing read and nothing computed."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import pandas as pd

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from uarm_rl.report import Method


def picture(draw: Callable[[Figure], None]) -> bytes:
    """A PNG as wide as a column of a paper, the same bytes every time and whatever matplotlibrc says."""
    import matplotlib.style
    from matplotlib.figure import Figure

    small = {"font.size": 7, "figure.labelsize": 7, "axes.titlesize": 7, "axes.linewidth": 0.6, "lines.linewidth": 0.8}
    with matplotlib.style.context(["default", small, {"axes.grid": True, "grid.linewidth": 0.3}]):
        figure = Figure(figsize=(3.5, 4.4), dpi=300, layout="constrained")
        draw(figure)
        handles = {
            label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        if handles:
            figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=2, frameon=False)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def draw_rewards(figure: Figure, methods: Sequence[Method], curves: Mapping[str, pd.DataFrame]) -> None:
    """The paper's Fig. 3, one row of panels a method: over each other, four curves of 100 points hide each other."""
    grid = figure.subplots(len(methods), 2, sharex=True, sharey="col")
    for method, row in zip(methods, grid, strict=True):
        for axes, value in zip(row, ("common_return", "return"), strict=True):
            _draw(axes, method, curves[method.folder], "position", value)
            axes.axhline(curves[method.folder][f"{value}_mean"].mean(), color="black", linewidth=0.6, linestyle="--")
            _mark_empty(axes, "not evaluated")
        row[0].set_ylabel(method.label, rotation=0, weight="bold", ha="right", va="center")
    grid[0, 0].set_title("same reward for all methods")
    grid[0, 1].set_title("method's own reward")
    figure.supxlabel("Test position (number)")
    figure.supylabel("Return (sum of rewards, no unit); dashed: mean over positions")


def draw_learning(figure: Figure, methods: Sequence[Method], curves: Mapping[str, pd.DataFrame], *, smoothed_over: int) -> None:
    """How success on the validation positions and the return of training grow with the stored experiences."""
    above, below = figure.subplots(2, 1, sharex=True)
    for axes, value in ((above, "validation_success_rate"), (below, "smoothed_return")):
        for method in methods:
            _draw(axes, method, curves[method.folder], "experiences", value)
        _mark_empty(axes, "no data of A, B, C or D")
    above.set(ylabel="Success on validation positions (%)", ylim=(-0.03, 1.03))
    above.yaxis.set_major_formatter(lambda rate, _: f"{100 * rate:.0f}")
    below.set(ylabel=f"Return of a training episode\n(own reward, mean of {smoothed_over} episodes)")
    below.set(xlabel="Stored experiences (thousands)")
    below.xaxis.set_major_formatter(lambda experiences, _: f"{experiences / 1000:g}")


def _draw(axes: Axes, method: Method, curve: pd.DataFrame, x: str, value: str) -> None:
    """The mean over seeds as a line, in a band from the smallest to the largest seed."""
    curve = curve.dropna(subset=[f"{value}_mean"])
    if len(curve):
        label = f"{method.label}: {method.buffer}, {method.reward}"
        marker = "." if len(curve) < 100 else ""  # a line of one point would not be seen
        axes.plot(curve[x], curve[f"{value}_mean"], color=method.colour, marker=marker, markersize=2, label=label)
        axes.fill_between(curve[x], curve[f"{value}_min"], curve[f"{value}_max"], color=method.colour, alpha=0.25, linewidth=0)


def _mark_empty(axes: Axes, words: str) -> None:
    if not axes.collections:
        axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", backgroundcolor="white")
