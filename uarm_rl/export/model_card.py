"""The model card of a policy: what it is for, how it was trained and tested, and how to run it (Mitchell et al. 2019)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

from uarm_rl import columns, csvfile
from uarm_rl.columns import pick
from uarm_rl.report.statistics import wilson_interval
from uarm_rl.task.policy import PolicyCard

#: Evaluations in a run's folder, the standard one first.
_TESTS: Final = ("evaluation.csv", "heldout.csv", "mujoco.csv", "pybullet.csv", "tolerance-*.csv", "hold-*.csv")
_COLUMNS: Final = {
    **pick(columns.MEASURED, "success", "time_s"),
    **pick(columns.CONDITIONS, "tolerance_m", "hold", "engine"),
}
_WHERE: Final = {"evaluation": "test positions", "heldout": "1000 held-out positions"}


class Export(NamedTuple):
    """The exported file beside which the card lies, and the SHA-256 of it and of the policy that it was made of."""

    file: str
    sha256: str
    policy_sha256: str


def model_card(card: PolicyCard, settings: Mapping[str, Any], run_dir: Path, export: Export) -> str:
    """The card as Markdown, from the policy's own card, the run's configuration and the evaluations in its folder.

    Raises :class:`uarm_rl.csvfile.CsvError` for an evaluation that is damaged.
    """
    files = [path for pattern in _TESTS for path in sorted(run_dir.glob(pattern)) if not path.stem.endswith("-traces")]
    return _TEXT.format(
        name=f"{settings['name']}, seed {card.seed}",
        file=export.file,
        sha256=export.sha256,
        policy_sha256=export.policy_sha256,
        method=f"{card.buffer} buffer, {card.reward} reward",
        training=_table(("Setting", "Value"), _training(card, settings)),
        tests=_table(
            ("Test", "Success (95 % interval)", "Median time (s)", "Tolerance (mm)", "Hold", "Engine"), map(_test, files)
        )
        if files
        else "This policy has not been tested: `uarm-rl evaluate` does it.\n",
        tolerance_mm=f"{1e3 * card.tolerance_m:g}",
        dwell_s=f"{card.dwell_s:g}",
        control_hz=card.control_hz,
        hold=_group(card.hold),
        max_delta_rad=f"{card.max_delta_rad:g}",
    )


def _training(card: PolicyCard, settings: Mapping[str, Any]) -> list[tuple[str, ...]]:
    agent, sim = settings["agent"], settings["sim"]
    return [
        ("agent", f"{agent['name']}, hidden layers {', '.join(map(str, agent['hidden']))}, gamma {agent['gamma']:g}"),
        ("episodes", f"{card.episodes} of {settings['experiences_per_episode']} stored experiences"),
        ("buffer, hold", f"{card.buffer}, {_group(card.hold)}"),
        ("reward", _group(settings["reward"])),
        ("servo", _group(card.servo)),
        ("engine", str(sim["name"])),
        (
            "object",
            f"a box of {1e3 * sim['object_size_m']:g} mm and {1e3 * sim['object_mass_kg']:g} g; cup {settings['cup']['name']}",
        ),
        ("share of episodes without a solid object", f"{settings['ghost_share']:g}"),
    ]


def _group(group: Mapping[str, Any]) -> str:
    values = ", ".join(f"{key} {value}" for key, value in group.items() if key != "name")
    return f"{group['name']}{f' ({values})' if values else ''}"


def _test(path: Path) -> tuple[str, ...]:
    """The row of one evaluation, whose conditions are the same in all its lines."""
    values = csvfile.read(path, _COLUMNS).values
    successes, number = int(sum(values["success"])), len(values["success"])
    low, high = wilson_interval(successes, number) if number else (0.0, 1.0)
    times = [time for time, success in zip(values["time_s"], values["success"], strict=True) if success]
    (tolerance_m, hold, engine), *_ = zip(*(values[name] for name in ("tolerance_m", "hold", "engine")), strict=True)
    return (
        f"{path.stem} ({_WHERE.get(path.stem, f'{number} positions')})",
        f"{successes} of {number} ({100 * low:.1f} to {100 * high:.1f} %)",
        f"{median(times):.2f}" if times else "-",
        f"{1e3 * tolerance_m:g}" if tolerance_m == tolerance_m else "-",
        hold or "-",
        engine or "pybullet",
    )


def _table(headings: Sequence[str], rows: Any) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


_TEXT: Final = """\
---
license: mit
library_name: onnx
pipeline_tag: reinforcement-learning
tags: [reinforcement-learning, robotics, ddpg, uarm-swift-pro]
---

# {name}

A policy that brings the suction cup of a uArm Swift Pro to an object: a fully connected actor, trained with DDPG in simulation
({method}) by uarm-rl, after Xing & Chang, *Deep Reinforcement Learning Based Robot Arm Manipulation with
Efficient Training Data through Simulation* (ICCAS 2019, arXiv 1907.06884).

`{file}`, SHA-256 `{sha256}`
made of `policy.safetensors`, SHA-256 `{policy_sha256}`

## How to run it

    import json, numpy, onnxruntime
    session = onnxruntime.InferenceSession("{file}")
    action = session.run(["action"], {{"observation": observation}})[0]  # (batch, 20) to (batch, 3), float32
    what = json.loads(session.get_modelmeta().custom_metadata_map["uarm-rl"])  # every number's name and unit

Raw numbers go in, the scaling is inside. A joint's next reference is its angle now plus {max_delta_rad} rad times its action,
cut at its limits. The policy is asked anew when its hold releases: {hold}, in control steps of 1/{control_hz} s.
Success is the cup within {tolerance_mm} mm of the centre of the object's upper surface for {dwell_s} s.

## How it was trained

{training}
## How it was tested

{tests}
Intervals are Wilson's. The positions of the first test were used for nothing else.

## What it is not

It has seen one object, lying on a table within the arm's reach, and a simulated arm. It knows no obstacles and no limits of
its own: on a real arm everything it asks for must be checked before it is sent, as `uarm-rl run-real` does.
"""
