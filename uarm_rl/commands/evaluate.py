"""Test trained policies on the 100 fixed positions.

Examples:
  uarm-rl evaluate                                    every trained run that has no evaluation yet
  uarm-rl evaluate policy=ik                          the inverse-kinematics controller, as a reference
  uarm-rl evaluate run=results/adaptive-penalty/seed0 tolerance_m=0.002 out=strict.csv
  uarm-rl evaluate positions=heldout out=heldout.csv  that file in the folder of every trained run
  uarm-rl evaluate sim=mujoco out=mujoco.csv          the same in the other engine
  uarm-rl evaluate until=time_limit out=settled.csv   how near the cup comes to stay: success at every tolerance
  uarm-rl evaluate object=ghost out=ghost.csv         with nothing solid there for the cup to lean on
"""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Any

from uarm_rl import checks, columns, csvfile, files, signals, workers
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build, build_env, compose, slots_of
from uarm_rl.csvfile import write_rows
from uarm_rl.evaluation.evaluate import evaluate
from uarm_rl.evaluation.measures import Row, measure, settled_distance_m, trace_rows
from uarm_rl.files import CONFIG, POLICY
from uarm_rl.progress import shown
from uarm_rl.sim.servo import rise_time_s
from uarm_rl.task import layouts, positions
from uarm_rl.task.env import dwell_steps
from uarm_rl.trained import in_engine, load_policy, read_run

log = logging.getLogger(__name__)

_NAMED = 2  # of many runs that have nothing to do


def run(settings: Settings) -> None:
    """Test policies on fixed positions and write one CSV row a position."""
    with signals.interrupt_once():  # a polite kill too lets the processes end in order
        _run(settings)


def _run(settings: Settings) -> None:
    workers.one_thread()
    results_dir = checks.path("results_dir", settings["results_dir"])
    positions.check_named(str(settings["positions"]))
    changed = [
        key for key, usual in (("positions", "test"), ("object", "solid"), ("until", "success")) if settings[key] != usual
    ]
    changed += [key for key in ("tolerance_m", "time_limit_s", "hold", "sim", "cup") if settings.get(key) is not None]
    file = checks.text("out", settings["out"] or "evaluation.csv")
    if changed and (not settings["out"] or (file == "evaluation.csv" and not settings["run"])):
        raise UsageError(
            f"{changed[0]} changes the test, so give out=FILE for its result; evaluation.csv is for the standard test"
        )
    if settings["run"]:
        run_dir = checks.path("run", settings["run"])
        run_settings = read_run(run_dir)
        _evaluate_run(settings, run_dir, run_settings, checks.place_of(Path(file)) if settings["out"] else run_dir / file)
        return
    if Path(file).name != file:
        raise UsageError(
            f"out={file} takes the result of one run, so give run=DIR too; out=NAME.csv without a folder is that file in "
            "the folder of every run"
        )
    if not file.endswith(".csv") or file == "progress.csv":
        raise UsageError(f"out={file} is no name for an evaluation in a run's folder; take another that ends in .csv")
    # The baseline has no training: it does the task of a default one, in a folder beside the runs.
    ik = settings["policy"] == "ik"
    run_dirs = [results_dir / "ik" / "seed0"] if ik else _trained_runs(results_dir)
    done = [run_dir for run_dir in run_dirs if not _is_due(settings, run_dir / file)]
    engine = (f"sim={settings['sim']['name']}",) if settings.get("sim") else ()
    for run_dir in run_dirs:
        if run_dir not in done:
            _evaluate_run(settings, run_dir, compose("train", engine) if ik else read_run(run_dir), run_dir / file)
    if done:
        others = f" and {len(done) - _NAMED} more" if len(done) > _NAMED else ""
        names = ", ".join(map(str, done[:_NAMED])) + others
        print(f"evaluated already, {file} is there (out=NAME.csv is for another test): {names}")


def output(settings: Settings) -> Path:
    """The file of one run, or that of every run's folder, whose name is then a star."""
    file = Path(checks.text("out", settings["out"] or "evaluation.csv"))
    if settings["run"]:
        return file if settings["out"] else checks.path("run", settings["run"]) / file
    return checks.path("results_dir", settings["results_dir"]) / "*" / file


def _traces(out: Path) -> Path:
    return out.with_name(f"{out.stem}-traces.csv")


def _is_due(settings: Settings, out: Path) -> bool:
    """Whether the result, or the traces that are wanted beside it, have still to be made."""
    wanted = [out, _traces(out)] if checks.integer("traces", settings["traces"], low=0) else [out]
    return bool(settings["overwrite"]) or not all(path.exists() for path in wanted)


def _tested(out: Path) -> list[tuple[float, float]]:
    """Success and time of each position in a result that is there."""
    values = csvfile.read(out, columns.pick(columns.EVALUATION, "success", "time_s")).values
    return list(map(_outcome, values["success"], values["time_s"]))


def _outcome(success: Any, time_s: Any) -> tuple[float, float]:
    return float(success), round(time_s, 6)  # a file has nine digits


def _trained_runs(results_dir: Path) -> list[Path]:
    trained = sorted(path.parent for path in checks.results_folder(results_dir).glob(f"*/seed*/{POLICY}"))
    begun = [path.parent for path in results_dir.glob(f"*/seed*/{CONFIG}") if path.parent not in trained]
    if not trained and begun:
        raise UsageError(f"{begun[0]} is not trained to its end; the line that began it, with resume=true, goes on with it")
    if not trained:
        raise UsageError(
            f"{results_dir} holds no trained run; make one with {checks.command(results_dir, 'train')}, or name another "
            "folder: results_dir=DIR"
        )
    return trained


def _evaluate_run(settings: Settings, run_dir: Path, run_settings: Settings, out: Path) -> None:
    if out.is_dir():
        raise UsageError(f"{out} is a folder; name the file of the evaluation with out=FILE.csv")
    if not _is_due(settings, out):
        raise UsageError(f"{out} exists already; out=FILE writes elsewhere")
    files.check_place(out)
    run_settings = _under_test(settings, run_settings)
    settling = checks.one_of("until", settings["until"], ("success", "time_limit")) == "time_limit"
    thing = checks.one_of("object", settings["object"], ("solid", "ghost"))
    slots = slots_of(run_settings)
    where = layouts.load_named(str(settings["positions"]), slots, run_settings["sim"]["object_size_m"])
    policy = load_policy(run_dir, settings["policy"], run_settings)
    time_limit_s = run_settings["time_limit_s"]
    endless = {"dwell_s": time_limit_s + 1.0} if settling else {}  # who has to stay longer than there is time never succeeds
    make = partial(build_env, run_settings | endless, time_limit_s=time_limit_s)
    make().close()  # a bad value shows here, as a sentence, and not in a worker
    processes = workers.cores() if settings["workers"] is None else checks.integer("workers", settings["workers"], low=1)
    traced = checks.integer("traces", settings["traces"], low=0)
    tested = [] if settings["overwrite"] or not out.exists() else _tested(out)
    if tested:  # only the traces are missing
        where = where[:traced]
    common_reward = build("reward", settings["common_reward"])
    control_hz = run_settings["control_hz"]
    conditions = _conditions(run_settings) | {"object": thing}
    window = dwell_steps(run_settings["dwell_s"], control_hz)
    rows: list[Row] = []
    traces: list[Row] = []
    episodes = evaluate(make, policy, where, processes=min(processes, len(where)), ghost=thing == "ghost")
    for number, episode in enumerate(shown(episodes, len(where), "position", str(run_dir))):
        row = measure(number, episode, common_reward, control_hz=control_hz) | conditions
        if settling:
            settled_m = settled_distance_m(episode.trace, window)
            row |= {"settled_distance_m": settled_m, "success": settled_m <= run_settings["tolerance_m"]}
        rows.append(row)
        if number < traced:
            traces += trace_rows(number, episode, control_hz=control_hz)
    out.parent.mkdir(parents=True, exist_ok=True)
    if tested and tested[: len(rows)] != [_outcome(row["success"], row["time_s"]) for row in rows]:
        raise UsageError(f"{out} comes from another test than this one, so it gets no traces of this; give out=FILE for both")
    if traced:  # first, so that a result that is there has its traces
        write_rows(_traces(out), columns.TRACES, traces)
    if tested:
        print(f"{run_dir}: {len(rows)} positions recorded; {_traces(out)}")
        return
    left_out = [*(() if settling else columns.SETTLED), *(() if slots else columns.TOUCHING)]
    names = [name for name in columns.EVALUATION if name not in left_out]
    write_rows(out, names, [{name: row[name] for name in names} for row in rows])
    successes = sum(bool(row["success"]) for row in rows)
    print(f"{run_dir}: {successes} of {len(rows)} positions reached; {out}, of which uarm-rl report makes tables and pictures")


def _under_test(settings: Settings, run_settings: Settings) -> Settings:
    """A run's settings with what the test changes of them."""
    changed = {key: settings[key] for key in ("tolerance_m", "time_limit_s") if settings[key] is not None}
    changed |= {"cup": settings["cup"]} if settings.get("cup") else {}
    if settings.get("cup") and settings["cup"]["name"] != "rigid" == run_settings["cup"]["name"] and settings["policy"] != "ik":
        log.warning("trained with a rigid cup; one that gives lets the policy sink where it leaned, so expect less of it")
    changed |= {"buffer": run_settings["buffer"] | {"hold": settings["hold"]}} if settings.get("hold") else {}
    return in_engine(run_settings | changed, settings.get("sim"))


def _rise_time_s(servo: Settings) -> float | None:
    return None if servo["name"] == "torque" else rise_time_s(build("servo", servo))


def _conditions(run_settings: Settings) -> Row:
    """Under which conditions a policy is tested, with keys of ``columns.EVALUATION``."""
    return {
        "tolerance_m": run_settings["tolerance_m"],
        "hold": str(build("hold", run_settings["buffer"]["hold"])),
        "control_hz": run_settings["control_hz"],
        "servo_rise_s": _rise_time_s(run_settings["servo"]),
        "sigma": run_settings["reward"]["sigma"],
        "cup": run_settings["cup"]["name"],
        "engine": run_settings["sim"]["name"],
    }
