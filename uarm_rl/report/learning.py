"""The reward figure, the learning curves, and one episode of an arm that waits beside one that does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import pandas as pd

from uarm_rl.checks import command
from uarm_rl.report import figures, tables
from uarm_rl.report.records import METHODS, RETURNS, TRACES, Method, Runs, read
from uarm_rl.report.tables import Section

SMOOTHING_EPISODES: Final = 20
TRACES_FILE: Final = "evaluation-traces.csv"


def rewards(shown: Sequence[Method], evaluations: Mapping[str, pd.DataFrame]) -> Section:
    """The paper's Fig. 3: the reward of each method on each test position."""
    curves = {folder: tables.over_seeds(rows, "position", RETURNS) for folder, rows in evaluations.items()}
    drawn = [method for method in shown if len(curves[method.folder])]
    if not drawn:
        return Section(remarks=["no reward figure: no run has been evaluated yet"])
    return Section(
        {
            "reward_curve.csv": tables.csv(tables.stacked(shown, curves)),
            "reward_curve.png": figures.picture(
                lambda figure: figures.draw_rewards(figure, drawn, curves),
                "The reward of each method on each test position",
                1.2 + 0.8 * len(drawn),
            ),
        }
    )


def learning(shown: Sequence[Method], progress: Mapping[str, pd.DataFrame]) -> Section:
    """Experiences, validation success and smoothed return after each episode, over seeds."""
    curves = {}
    for folder, rows in progress.items():
        returns = rows.groupby("seed")["episode_return"]
        smoothed = returns.transform(lambda one_seed: one_seed.rolling(SMOOTHING_EPISODES, min_periods=1).mean())
        values = ("validation_success_rate", "smoothed_return")
        experiences = {"experiences": ("experiences", "mean")}
        curve = tables.over_seeds(rows.assign(smoothed_return=smoothed), "episode", values, **experiences)
        curve["experiences"] = curve["experiences"].round().astype(int)
        curves[folder] = curve
    drawn = [method for method in shown if len(curves[method.folder])]
    if not drawn:
        return Section(remarks=["no learning curves: no run has finished an episode yet"])
    return Section(
        {
            "learning_curves.csv": tables.csv(tables.stacked(shown, curves)),
            "learning_curves.png": figures.picture(
                lambda figure: figures.draw_learning(figure, drawn, curves, smoothed_over=SMOOTHING_EPISODES),
                "Validation success and return while the methods learn",
                4.8,
            ),
        }
    )


def shaking(results_dir: Path, shown: Sequence[Method], runs: Runs) -> Section:
    """shaking.png: what A and B (or else C and D) do on the same position, from the traces of the lowest seed.

    Of the recorded positions it is the one that takes the uniform method longest: an arm that shakes comes to no end.
    """
    a, b, c, d = shown[: len(METHODS)]
    pairs = [(a, b), (c, d)]
    for pair in pairs:
        recorded = [[run / TRACES_FILE for run in runs[method.folder] if (run / TRACES_FILE).exists()] for method in pair]
        if all(recorded):
            traces = {method: pd.DataFrame(read(paths[0], TRACES)) for method, paths in zip(pair, recorded, strict=True)}
            common = sorted(set.intersection(*(set(trace["position"]) for trace in traces.values())))
            if common:
                durations_s = traces[pair[1]].groupby("position")["time_s"].max()
                position = int(durations_s[common].idxmax())
                chosen = {method: trace[trace["position"] == position] for method, trace in traces.items()}
                words = "One episode of an arm that waits beside one that does not: its tip and its joints"
                picture = figures.picture(lambda figure: figures.draw_shaking(figure, chosen, position=position), words)  # noqa: B023
                return Section({"shaking.png": picture})
    if not all(runs[method.folder] for method in pairs[0]) and not all(runs[method.folder] for method in pairs[1]):
        return Section()  # nothing to compare
    record = command(results_dir, "evaluate traces=3")
    return Section(remarks=[f"no shaking.png: {TRACES_FILE} is missing for A and B, or C and D; {record} records it"])
