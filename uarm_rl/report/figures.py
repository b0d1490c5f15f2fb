"""The report's pictures, as a person would put them in a paper: from curves to PNG, nothing read and nothing computed."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import pandas as pd

from uarm_rl.report import tables
from uarm_rl.report.tables import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from uarm_rl.report.records import Line, Method


class _Style(NamedTuple):
    """Told apart by colour, and without colour by line and marker."""

    colour: str = "black"
    line: Line = ":"
    marker: str = "^"


#: The buffers of the ablations, in further colours of Okabe and Ito; the paper's two as in methods C and D.
_BUFFERS: Final = {
    "adaptive": _Style("#009E73", "-", "o"),
    "uniform": _Style("#CC79A7", "--", "s"),
    "steady_only": _Style("#56B4E9", "-.", "D"),
    "unstuck_only": _Style("#D55E00", ":", "v"),
    "fixed_hold": _Style("#0072B2", (0, (6, 1, 1, 1, 1, 1)), "P"),
    "every_step": _Style("#777777", (0, (8, 2)), "^"),
    "learned_hold": _Style("#E69F00", (0, (3, 2)), "X"),
    "steady_speed": _Style("#E69F00", (0, (3, 2)), "X"),
}
#: Of ends of attempts, from good to bad: without colour by their hatching.
_ENDS: Final = (("#009E73", ""), ("#E69F00", "///"), ("#BBBBBB", "..."))
_MARKERS: Final = ("o", "s", "D", "v", "^", "P", "X")
_DECADE: Final = 10.0
_WIDEST_MM: Final = 20.0  # of the tolerances that a curve is drawn for
_INTERVAL: Final = "bars: 95 % interval"
_BAND: Final = "line: mean of seeds, band: their range"


def picture(draw: Callable[[Figure], None], words: str, height_in: float = 4.4) -> Picture:
    """A figure as wide as a column of a paper, the same bytes every time and whatever matplotlibrc says.

    ``words`` say what it shows.
    """
    import matplotlib
    import matplotlib.style
    from matplotlib.figure import Figure

    small = {"font.size": 7, "figure.labelsize": 7, "axes.titlesize": 7, "axes.linewidth": 0.6, "lines.linewidth": 0.8}
    with matplotlib.style.context(["default", small, {"axes.grid": True, "grid.linewidth": 0.3}]):
        figure = Figure(figsize=(3.5, height_in), dpi=300, layout="constrained")
        draw(figure)
        handles = {
            label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        if handles:
            figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=2, frameon=False)
        png, svg = io.BytesIO(), io.StringIO()
        figure.savefig(png, format="png", metadata={"Software": None})
        figure.set_layout_engine("none")  # as it is
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": words}):
            figure.savefig(svg, format="svg", metadata={"Date": None}, transparent=True)
    return Picture(words, png.getvalue(), svg.getvalue())


def draw_rewards(figure: Figure, methods: Sequence[Method], curves: Mapping[str, pd.DataFrame]) -> None:
    """The paper's Fig. 3, one row of panels a method: over each other, four times 100 points hide each other.

    The positions have no order, so the points are not joined.
    """
    grid = figure.subplots(len(methods), 2, sharex=True, sharey="col", squeeze=False)
    for method, row in zip(methods, grid, strict=True):
        for axes, value in zip(row, ("common_return", "return"), strict=True):
            if value == "return" and not method.reward:
                axes.set_axis_off()  # a controller has no reward of its own
                continue
            curve = curves[method.folder]
            low, high = curve[f"{value}_min"], curve[f"{value}_max"]
            axes.vlines(curve["position"], low, high, color=method.colour, linewidth=0.6, alpha=0.5)
            axes.plot(curve["position"], curve[f"{value}_mean"], color=method.colour, marker=".", markersize=2, linestyle="")
            axes.axhline(curve[f"{value}_mean"].mean(), color="black", linewidth=0.6, linestyle="--")
        row[0].set_ylabel(method.label, rotation=0, weight="bold", ha="right", va="center")
    grid[0, 0].set_title("same reward for all, a\nsum over control steps:\nhaste, not success")
    grid[0, 1].set_title("method's own reward,\na sum over\nits decisions")
    figure.supxlabel("Test position (number)\npoint: mean of seeds, bar: their range, dashed: mean over positions")
    figure.supylabel("Return (sum of rewards, no unit)")


def draw_learning(figure: Figure, methods: Sequence[Method], curves: Mapping[str, pd.DataFrame], *, smoothed_over: int) -> None:
    """How success on the validation positions and the return of training grow with the stored experiences."""
    from matplotlib.ticker import SymmetricalLogLocator

    above, below = figure.subplots(2, 1, sharex=True)
    for axes, value in ((above, "validation_success_rate"), (below, "smoothed_return")):
        for method in methods:
            _draw(axes, method, curves[method.folder], "experiences", value)
    _success_axis(above, "Success on\nvalidation positions (%)")
    if far := max(map(abs, below.get_ylim())) > 10.0:  # the first episodes go far down
        below.set_yscale("symlog", linthresh=10.0)
        below.yaxis.set_major_locator(SymmetricalLogLocator(base=10.0, linthresh=10.0, subs=(1.0, 2.0, 5.0)))
    scale = "; symlog:\nlinear from -10 to 10" if far else ""
    below.set(ylabel=f"Return of a training episode\n(own, mean of {smoothed_over} episodes{scale})")
    below.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    below.set(xlabel=f"Stored experiences (thousands)\n{_BAND}")
    below.xaxis.set_major_formatter(lambda experiences, _: f"{experiences / 1000:g}")


def draw_tolerance(figure: Figure, methods: Sequence[Method], table: pd.DataFrame) -> None:
    """How success on the test positions falls with the tolerance."""
    axes = figure.subplots()
    for number, method in enumerate(methods):
        rows = table[table["method"] == method.label]
        style = _Style(method.colour, method.line, _MARKERS[number % len(_MARKERS)])
        _points(axes, _aside(number, len(methods)) * 1000.0 * rows["tolerance_m"], rows, style, method.words)
    axes.set(
        xlabel=f"Tolerance (mm), moved aside a little; {_INTERVAL}\nat 1 mm the engine is measured too, see tolerance.md",
        xscale="log",
    )
    _ticks(axes, sorted({1000.0 * tolerance_m for tolerance_m in table["tolerance_m"]}))
    _success_axis(axes, "Success on the test positions (%)")


def draw_paper_fit(figure: Figure, methods: Sequence[Method], curves: Mapping[str, pd.DataFrame], points: pd.DataFrame) -> None:
    """Success at every tolerance, and at the fitted one beside the paper's values."""
    axes = figure.subplots()
    low, fitted, high = (1000.0 * points[f"tolerance_{name}m"].iloc[0] for name in ("low_", "", "high_"))
    axes.axvspan(low, min(high, _WIDEST_MM), color="0.85", linewidth=0)
    for number, method in enumerate(methods):
        curve, row = curves[method.label], points[points["method"] == method.label]
        distances, rates = [*curve["tolerance_mm"], _WIDEST_MM], [*curve["success_rate"], curve["success_rate"].iloc[-1]]
        axes.step(distances, rates, where="post", color=method.colour, linestyle=method.line)
        marker = _MARKERS[number % len(_MARKERS)]
        place = fitted * 1.05 ** (number - (len(methods) - 1) / 2)
        _points(axes, pd.Series([place]), row, _Style(method.colour, method.line, marker), method.words)
        axes.plot(place, row["paper_success_rate"], marker=marker, fillstyle="none", color="black", markersize=5, linestyle="")
    axes.set(
        xlabel=f"Tolerance (mm)\nat the fitted {fitted:.1f} mm (grey: its 95 % interval), moved aside:\n"
        f"filled: ours, {_INTERVAL}; hollow: the paper's",
        xscale="log",
        xlim=(1, _WIDEST_MM),
    )
    _ticks(axes, [1, 2, 5, 10, _WIDEST_MM])
    _success_axis(axes, "Success on the test positions (%)")


def draw_holds(figure: Figure, table: pd.DataFrame) -> None:
    """Success of each method under each hold; bold is the one it was trained with."""
    axes = figure.subplots()
    labels, tested = (list(dict.fromkeys(table[column])) for column in ("method", "tested_hold"))
    rates = table.pivot(index="method", columns="tested_hold", values="success_rate").loc[labels, tested]
    image = axes.imshow(100.0 * rates, vmin=0.0, vmax=100.0, cmap="cividis", aspect="auto")
    figure.colorbar(image, label="Success on the test positions (%)")
    seeds = table.groupby("method")["seeds"].max()
    for row in tables.records(table):
        x, y = tested.index(row["tested_hold"]), labels.index(row["method"])
        colour = "0.1" if row["success_rate"] > 0.5 else "white"  # no black, which is the page's own colour
        weight = "bold" if row["tested_hold"] == row["trained_hold"] else "normal"
        axes.text(x, y, tables.percent(row["success_rate"]), ha="center", va="center", color=colour, weight=weight)
    axes.set_xticks(range(len(tested)), tested)
    axes.set_yticks(range(len(labels)), [f"{label}\n{_seeds(seeds[label])}" for label in labels])
    axes.grid(visible=False)
    axes.set(xlabel="Tested with (bold: trained with)", ylabel="Method")


def draw_budgets(
    figure: Figure, methods: Sequence[Method], curves: Mapping[str, pd.DataFrame], rate: str, budgets: Mapping[str, str]
) -> None:
    """Validation success against each of four budgets, which differ by powers of ten."""
    grid = figure.subplots(2, 2, sharey=True).flat
    for axes, (budget, words) in zip(grid, budgets.items(), strict=True):
        for method in methods:
            curve = curves[method.folder]
            _draw(axes, method, curve[curve[budget] > 0], budget, rate)  # a run in its warm-up has made no gradient step yet
        spent = pd.concat([curves[method.folder][budget] for method in methods])
        wide = (
            spent.max() > _DECADE * spent[spent > 0].min()
        )  # short runs: a logarithmic axis would have no room for its numbers
        axes.set(xlabel=words, xscale="log" if wide else "linear")
        if not wide:
            axes.set_xlim(left=0.0)
        _success_axis(axes, "")
    figure.supylabel("Success on validation positions (%)")
    figure.supxlabel(_BAND)


def draw_shaking(figure: Figure, traces: Mapping[Method, pd.DataFrame], *, position: int) -> None:
    """One episode of each method: the tip around the object from above, its height, and the joints over time."""
    grid = figure.subplots(3, len(traces), sharex="row", sharey="row", height_ratios=(1.4, 1, 1), squeeze=False)
    above, beside, joints = grid
    for number, (method, trace) in enumerate(traces.items()):
        target = trace[["object_x_m", "object_y_m", "object_z_m"]].to_numpy()
        tip = 1000.0 * (trace[["cup_x_m", "cup_y_m", "cup_z_m"]].to_numpy() - target[0])
        above[number].set_title(method.words)
        above[number].plot(tip[:, 0], tip[:, 1], color=method.colour, linewidth=0.6, marker=".", markersize=1.5)
        above[number].plot(*(1000.0 * (target[[-1], :2] - target[0, :2]).T), "k+", markersize=5)
        above[number].set(xlim=(-40, 40), ylim=(-40, 40), xlabel="x from the\nobject (mm)", aspect="equal")
        beside[number].plot(trace["time_s"], tip[:, 2], color=method.colour)
        beside[number].set(ylim=(-8, 40))
        for joint, style in (("joint1_rad", "-"), ("joint2_rad", "--"), ("joint3_rad", ":")):
            degrees = trace[joint] * 180.0 / math.pi
            joints[number].plot(trace["time_s"], degrees, color=method.colour, linestyle=style)
        joints[number].set(xlabel="Time (s)")
    above[0].set(ylabel="y from the object (mm)")
    beside[0].set(ylabel="Height above\nthe object (mm)")
    joints[0].set(ylabel="Joints 1 (solid),\n2 (dashed),\n3 (dotted) (°)")
    figure.suptitle(f"Test position {position}, the last 40 mm of the way; +: the object at the end", fontsize=7)


def draw_runs(figure: Figure, table: pd.DataFrame, curves: Mapping[str, pd.DataFrame], rate: str, *, timed: bool) -> None:
    """A few kinds of run beside each other: success of the final policies, and on the way there, ``timed`` over time too."""
    final, *learning = figure.subplots(2 + timed, 1, height_ratios=(1, 1.4, 1.4)[: 2 + timed])
    spent = {"experiences": "Stored experiences (thousands)", "control_steps": "Control steps of simulated time (thousands)"}
    for number, row in enumerate(tables.records(table)):
        style = _BUFFERS.get(row["buffer"], _Style())
        _points(final, pd.Series([number]), pd.DataFrame([row]), style, _worded(row["buffer"]))
        curve = curves[row["run"]]
        for axes, x in zip(learning, spent, strict=False):
            line = {"color": style.colour, "linestyle": style.line, "marker": style.marker, "markersize": 2}
            axes.plot(curve[x], curve[f"{rate}_mean"], **line)
            axes.fill_between(curve[x], curve[f"{rate}_min"], curve[f"{rate}_max"], color=style.colour, alpha=0.2, lw=0)
    final.set_xticks(range(len(table)), [_seeds(seeds) for seeds in table["seeds"]])
    final.set(xlabel=_INTERVAL)
    final.set_xlim(-0.5, len(table) - 0.5)
    _success_axis(final, "Success on the\ntest positions (%)")
    for axes, words in zip(learning, spent.values(), strict=False):
        axes.set(xlabel=f"{words}\n{_BAND}", xscale="log" if words.startswith("Control") else "linear")
        axes.xaxis.set_major_formatter(lambda count, _: f"{count / 1000:g}")
        _success_axis(axes, "Success on validation\npositions (%)")


def draw_outcomes(figure: Figure, table: pd.DataFrame, ends: Mapping[str, str]) -> None:
    """How attempts ended, a bar a method; ``ends`` are columns of shares with their words, and no attempt has two of them."""
    axes = figure.subplots()
    left, rows = pd.Series(0.0, index=table.index), range(len(table))[::-1]
    for (end, words), (colour, hatch) in zip(ends.items(), _ENDS, strict=False):
        axes.barh(rows, table[end], left=left, color=colour, hatch=hatch, edgecolor="white", linewidth=0, label=words)
        for row, start, share in zip(rows, left, table[end], strict=True):
            if share >= 0.14:  # else there is no room
                box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
                axes.text(start + share / 2, row, tables.percent(share), ha="center", va="center", color="0.1", bbox=box)
        left = left + table[end]
    axes.set_yticks(rows, table["method"])
    axes.grid(visible=False)
    axes.set(xlim=(0, 1), xlabel="Share of the attempts on the test layouts (%)")
    axes.xaxis.set_major_formatter(lambda rate, _: f"{100 * rate:.0f}")


def draw_servo_sweep(figure: Figure, table: pd.DataFrame) -> None:
    """Success of waiting and not waiting for servos from instant to slow."""
    axes = figure.subplots()
    groups = list(table.groupby("buffer"))
    for number, (buffer, rows) in enumerate(groups):
        style = _BUFFERS.get(str(buffer), _Style())
        _points(axes, _aside(number, len(groups)) * rows["servo_rise_s"], rows, style, _worded(str(buffer)))
    axes.set(xlabel=f"Rise time of the servo, 10 to 90 % (s), moved aside a little\n{_INTERVAL}", xscale="log")
    _ticks(axes, sorted(set(table["servo_rise_s"].dropna())))
    _success_axis(axes, "Success on the test positions (%)")


def draw_settings(figure: Figure, table: pd.DataFrame) -> None:
    """Success of waiting and not waiting with one constant changed at a time."""
    axes = figure.subplots()
    settings = list(dict.fromkeys(table["setting"]))
    for buffer, rows in table.groupby("buffer"):
        style = _BUFFERS.get(str(buffer), _Style())._replace(line="")
        places = pd.Series([settings.index(setting) for setting in rows["setting"]], index=rows.index)
        several = rows["seeds"] > 1
        _points(axes, places[several], rows[several], style, str(buffer))
        _points(axes, places[~several], rows[~several], style, f"{buffer}, one seed", fill="none")
    axes.set_xticks(range(len(settings)), settings, rotation=30, ha="right")
    axes.set(xlabel=f"The constant that is not its default; {_INTERVAL}")
    _success_axis(axes, "Success on the test positions (%)")


def draw_sigma_sweep(figure: Figure, table: pd.DataFrame) -> None:
    """How far the object is moved, while learning and afterwards, and how often the cup arrives, as that is punished more."""
    learning, tested, success = figure.subplots(3, 1, sharex=True)
    places = pd.Series(range(len(table)))
    style = _BUFFERS["adaptive"]
    colour = style.colour
    learning.plot(places, 1000.0 * table["training_displacement_m"], color=colour, marker=".")
    learning.set(ylabel="Moved while learning\n(mm per object)", ylim=(0, None))
    millimetres = 1000.0 * table["object_displacement_m"].to_numpy()
    below = millimetres - 1000.0 * table["object_displacement_low"].to_numpy()
    over = 1000.0 * table["object_displacement_high"].to_numpy() - millimetres
    tested.errorbar(places, millimetres, yerr=(below.clip(0), over.clip(0)), color=colour, marker=".", capsize=2)
    tested.set(ylabel="Moved in the test\n(mm per object)", ylim=(0, None))
    _points(success, places, table, style, "adaptive buffer")
    success.set_xticks(places, [f"{sigma:g}" for sigma in table["sigma"]])
    success.set(xlabel=f"Sigma (1/m), not to scale; {_INTERVAL}")
    _success_axis(success, "Success on the\ntest positions (%)")


def _aside(number: int, count: int) -> float:
    """A factor on a logarithmic axis: bars at one place would hide each other."""
    return float(1.03 ** (number - (count - 1) / 2))


def _seeds(count: int) -> str:
    return "1 seed" if count == 1 else f"{count} seeds"


def _worded(buffer: str) -> str:
    """A buffer's name without its underscore, and what of the adaptive one it has."""
    return {"steady_only": "steady only (waits)", "unstuck_only": "unstuck only (leaves out)"}.get(
        buffer, buffer.replace("_", " ")
    )


def _points(axes: Axes, x: pd.Series[float], rows: pd.DataFrame, style: _Style, label: str, fill: str = "full") -> None:
    """Success rates with their 95 % intervals, joined by the style's line."""
    if len(rows):
        rate = rows["success_rate"].to_numpy()
        below, over = rate - rows["ci_low"].to_numpy(), rows["ci_high"].to_numpy() - rate
        spread = (below.clip(0), over.clip(0))
        bars = axes.errorbar(x, rate, yerr=spread, color=style.colour, linestyle=style.line, capsize=2, elinewidth=0.6)
        bars[0].set(marker=style.marker, fillstyle=fill, markersize=2.5)
        bars.set_label(label)


def _success_axis(axes: Axes, words: str) -> None:
    axes.set(ylabel=words, ylim=(-0.03, 1.03))
    axes.yaxis.set_major_formatter(lambda rate, _: f"{100 * rate:.0f}")


def _ticks(axes: Axes, values: Sequence[float]) -> None:
    """The values themselves on a logarithmic axis, nothing between them."""
    axes.set_xticks(values, [f"{value:.2g}" for value in values])
    axes.set_xticks([], minor=True)


def _draw(axes: Axes, method: Method, curve: pd.DataFrame, x: str, value: str) -> None:
    """The mean over seeds as a line, in a band from the smallest to the largest seed."""
    curve = curve.dropna(subset=[f"{value}_mean"])
    if len(curve):
        marker = "." if len(curve) < 100 else ""  # a line of one point would not be seen
        (drawn,) = axes.plot(curve[x], curve[f"{value}_mean"], color=method.colour, linestyle=method.line, label=method.words)
        drawn.set(marker=marker, markersize=2)
        axes.fill_between(curve[x], curve[f"{value}_min"], curve[f"{value}_max"], color=method.colour, alpha=0.25, linewidth=0)
