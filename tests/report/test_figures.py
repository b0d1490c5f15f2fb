"""What the pictures say, read from matplotlib's figures: legends, axes, how points are told apart, what is joined."""

from itertools import pairwise

import pandas as pd
import pytest
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from uarm_rl.report import figures
from uarm_rl.report.records import METHODS

KNOWN = {"success_rate": 0.5, "ci_low": 0.4, "ci_high": 0.6, "seeds": 3}


@pytest.fixture
def figure() -> Figure:
    return Figure()


def bars(figure: Figure) -> list[ErrorbarContainer]:
    return [bar for axes in figure.axes for bar in axes.containers]


def styles(lines) -> set[tuple[str, str]]:
    return {(line.get_linestyle(), line.get_marker()) for line in lines}


def curves(x: str, *values: str) -> dict[str, pd.DataFrame]:
    spread = {
        f"{value}_{how}": [number, 1.0] for value in values for how, number in (("mean", 0.5), ("min", 0.4), ("max", 0.6))
    }
    return {method.folder: pd.DataFrame({x: [200, 400], **spread}) for method in METHODS}


def test_tolerances_have_bars_that_do_not_lie_on_each_other_and_are_told_apart_without_colour(figure):
    rows = [{"method": method.label, "tolerance_m": at, **KNOWN} for method in METHODS for at in (0.001, 0.005)]
    figures.draw_tolerance(figure, METHODS, pd.DataFrame(rows))
    places = sorted(float(bar[0].get_xdata()[0]) for bar in bars(figure))
    assert all(right > 1.02 * left for left, right in pairwise(places))
    assert places[0] == pytest.approx(1.0, rel=0.06)
    assert len(styles(bar[0] for bar in bars(figure))) == len(METHODS)
    assert {bar.get_label() for bar in bars(figure)} == {method.words for method in METHODS}
    assert "95 % interval" in figure.axes[0].get_xlabel()
    assert "1 mm" in figure.axes[0].get_xlabel()


def test_servos_have_bars_beside_each_other_and_a_name_for_each_buffer(figure):
    rows = [{"buffer": buffer, "servo_rise_s": rise, **KNOWN} for buffer in ("adaptive", "uniform") for rise in (0.04, 0.3)]
    figures.draw_servo_sweep(figure, pd.DataFrame(rows))
    first, second = (bar[0].get_xdata() for bar in bars(figure))
    assert (first != second).all()
    assert len(styles(bar[0] for bar in bars(figure))) == 2
    assert figure.axes[0].get_xlabel().startswith("Rise time of the servo, 10 to 90 % (s)")


def test_a_point_of_one_seed_is_hollow_and_named(figure):
    rows = [
        {"buffer": "adaptive", "setting": "default", **KNOWN},
        {"buffer": "adaptive", "setting": "damping 0.3", **KNOWN, "seeds": 1},
    ]
    figures.draw_settings(figure, pd.DataFrame(rows))
    assert {bar.get_label(): bar[0].get_fillstyle() for bar in bars(figure)} == {
        "adaptive": "full",
        "adaptive, one seed": "none",
    }
    assert [text.get_text() for text in figure.axes[0].get_xticklabels()] == ["default", "damping 0.3"]
    assert bars(figure)[0][0].get_linestyle() == "None"  # settings have no order


def test_holds_show_their_seeds_and_a_scale(figure):
    rows = [
        {"method": "A", "trained_hold": "until steady", "tested_hold": hold, **KNOWN} for hold in ("one step", "until steady")
    ]
    figures.draw_holds(figure, pd.DataFrame(rows))
    axes, scale = figure.axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["A\n3 seeds"]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["one step", "until steady"]
    assert [text.get_weight() for text in axes.texts] == ["normal", "bold"]
    assert scale.get_ylabel() == "Success on the test positions (%)"


def test_rewards_of_positions_without_order_are_not_joined(figure):
    figures.draw_rewards(figure, METHODS, curves("position", "common_return", "return"))
    points = [axes.get_lines()[0] for axes in figure.axes]
    assert len(points) == 8
    assert {(line.get_linestyle(), line.get_marker()) for line in points} == {("None", ".")}
    assert "haste, not success" in figure.axes[0].get_title()


@pytest.mark.parametrize("label", [METHODS[0].label, "real_arm12"])  # a long one leaves the panels little room
def test_the_words_beside_the_rewards_of_one_run_fit_into_the_picture(label):
    drawn = []

    def draw(figure: Figure) -> None:
        figures.draw_rewards(figure, [METHODS[0]._replace(label=label)], curves("position", "common_return", "return"))
        drawn.append(figure)

    figures.picture(draw, "words", 2.0)
    (figure,) = drawn
    for words in (*figure.texts, *(axes.title for axes in figure.axes)):
        box = words.get_window_extent()
        assert 0 <= box.x0 < box.x1 <= figure.bbox.width, words
        assert 0 <= box.y0 < box.y1 <= figure.bbox.height, words


@pytest.mark.parametrize(("lowest", "scale"), [(-40.0, "symlog"), (-4.9, "linear")])
def test_learning_curves_name_their_axis_and_their_band(figure, lowest, scale):
    drawn = curves("experiences", "validation_success_rate", "smoothed_return")
    drawn[METHODS[0].folder]["smoothed_return_min"] = [lowest, 0.0]
    figures.draw_learning(figure, METHODS, drawn, smoothed_over=20)
    above, below = figure.axes
    assert (below.get_yscale(), "symlog" in below.get_ylabel()) == (scale, scale == "symlog")
    figure.draw_without_rendering()
    assert max(len(words.get_text()) for words in below.get_yticklabels()) <= len("-0.25")
    assert "band: their range" in below.get_xlabel()
    assert len({line.get_linestyle() for line in above.get_lines()}) == len(METHODS) == len(above.collections)


def test_a_run_that_has_not_learned_yet_has_a_budget_of_nothing_and_no_warning(recwarn):
    budgets = dict.fromkeys(("experiences", "updates", "decisions", "simulated_s"), "words")
    curve = curves("experiences", "rate")[METHODS[0].folder].assign(updates=0, decisions=1, simulated_s=1)
    drawn = {METHODS[0].folder: curve}
    picture = figures.picture(lambda figure: figures.draw_budgets(figure, METHODS[:1], drawn, "rate", budgets), "words")
    assert (len(picture.png) > 0, len(recwarn)) == (True, 0)


def test_kinds_of_run_are_told_apart_without_colour_and_count_their_seeds(figure):
    table = pd.DataFrame([{"run": buffer, "buffer": buffer, **KNOWN} for buffer in ("uniform", "steady_only", "adaptive")])
    rate = {f"rate_{how}": [0.2, 0.8] for how in ("mean", "min", "max")}
    drawn = {buffer: pd.DataFrame({"experiences": [200, 400], **rate}) for buffer in table["run"]}
    figures.draw_runs(figure, table, drawn, "rate", timed=False)
    final, learning = figure.axes
    assert len(styles(learning.get_lines())) == 3
    assert [text.get_text() for text in final.get_xticklabels()] == ["3 seeds"] * 3
    assert [bar.get_label() for bar in bars(figure)] == ["uniform", "steady only (waits)", "adaptive"]
    assert "95 % interval" in final.get_xlabel()
