"""A SLURM without a cluster: `sbatch`, `srun`, `squeue`, `scancel` and `scontrol` for the PATH, which start real processes.

`install` puts them into a folder. A plan says what befalls the tasks of an array: `kill` is a node that dies (SIGKILL; the
queue starts the task again), `die` the same of a queue that does not, `preempt` sends SIGTERM and then what `--signal` asks,
`lose` forgets the task before it began, and a number has it wait so many seconds. What kills does so a moment after the
training began.
"""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path

COMMANDS = ("sbatch", "srun", "squeue", "scancel", "scontrol")
BEGUN = "experiences are to be stored"
LIMIT_S = 120.0  # of a task


def install(folder: Path, plan: Mapping[int, str] | None = None, *, later_s: float = 0.0, full: bool = False) -> dict[str, str]:
    """The environment in which these commands are found. Kills come up to ``later_s`` after a training began."""
    (folder / "bin").mkdir(parents=True, exist_ok=True)
    (folder / "jobs").mkdir(exist_ok=True)
    for name in COMMANDS:
        script = folder / "bin" / name
        script.write_text(f'#!/bin/sh\nexec {sys.executable} {Path(__file__).absolute()} {name} "$@"\n')
        script.chmod(0o755)
    kept = {str(task): what for task, what in (plan or {}).items()}
    (folder / "plan.json").write_text(json.dumps({"plan": kept, "later_s": later_s, "full": full}))
    return {"PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "FAKE_SLURM": str(folder)}


def home() -> Path:
    return Path(os.environ["FAKE_SLURM"])


def is_idle(folder: Path) -> bool:
    """Whether the queue is empty."""
    return not any((folder / "jobs").glob("*.state"))


# The commands


def sbatch(script: str) -> None:
    folder = home()
    if json.loads((folder / "plan.json").read_text())["full"]:
        sys.exit("sbatch: error: Batch job submission failed: Job violates accounting/QOS policy (job submit limit)")
    job = 1000 + len(list(folder.glob("*.sh")))
    shutil.copy(script, folder / f"{job}.sh")  # as SLURM does; the file may change later
    text = (folder / f"{job}.sh").read_text()
    array = re.search(r"--array=.*?0-(\d+)(?:%(\d+))?", text)
    for task in tasks_of(job, array):
        (folder / "jobs" / f"{task}.state").write_text("PENDING")
    command = [sys.executable, __file__, "controller", str(job)]
    with open(folder / "controller.log", "a") as log:
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
    print(f"Submitted batch job {job}")


def tasks_of(job: int, array: re.Match[str] | None) -> list[str]:
    return [f"{job}_{number}" for number in range(int(array[1]) + 1)] if array else [str(job)]


def srun(*words: str) -> None:
    """A step of a job, as this process. Its output goes where it is told to."""
    options, command = [], list(words)
    while command[0].startswith("-"):
        options.append(command.pop(0))
        if options[-1] in ("--output", "--error"):
            options.append(command.pop(0))
    job, task = os.environ["SLURM_JOB_ID"], os.environ["FAKE_TASK"]
    place = options[options.index("--output") + 1]
    for sign, value in (("%A", job), ("%a", task.partition("_")[2]), ("%j", job), ("%t", "0")):
        place = place.replace(sign, value)
    (home() / "jobs" / f"{task}.out").write_text(place)
    (home() / "jobs" / f"{task}.pid").write_text(str(os.getpid()))
    out = os.open(place, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(out, 1)
    os.dup2(out, 2)
    os.execvp(command[0], command)


def squeue(*words: str) -> None:
    given = dict(word.removeprefix("--").split("=", 1) for word in words if "=" in word)
    asked = given["jobs"].split(",")
    states = {path.stem: path.read_text() for path in sorted((home() / "jobs").glob("*.state"))}
    found = {task: state for task, state in states.items() if task in asked or task.partition("_")[0] in asked}
    if not found and len(asked) == 1:
        sys.exit("slurm_load_jobs error: Invalid job id specified")
    for task, state in found.items():
        print(given["format"].replace("%i", task).replace("%T", state))


def scancel(task: str) -> None:
    (home() / "jobs" / f"{task}.state").write_text("COMPLETING")
    os.kill(int((home() / "jobs" / f"{task}.pid").read_text()), signal.SIGTERM)


def scontrol(word: str, task: str) -> None:
    assert word == "requeue"
    (home() / "jobs" / f"{task}.requeue").touch()


# What stands behind them


def controller(job: str) -> None:
    """Carry out a job: start its tasks, so many at a time, and do with them what the plan says."""
    text = (home() / f"{job}.sh").read_text()
    array = re.search(r"--array=.*?0-(\d+)(?:%(\d+))?", text)
    slots = threading.Semaphore(int(array[2]) if array and array[2] else 1000)
    threads = [threading.Thread(target=carry_out, args=(job, task, slots)) for task in tasks_of(int(job), array)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def carry_out(job: str, task: str, slots: threading.Semaphore) -> None:
    state, again = (home() / "jobs" / f"{task}.{kind}" for kind in ("state", "requeue"))
    settings = json.loads((home() / "plan.json").read_text())
    number = task.partition("_")[2] or "0"
    what = settings["plan"].get(number, "0")
    environment = {**os.environ, "SLURM_JOB_ID": job, "FAKE_TASK": task, "SLURM_PROCID": "0", "SLURM_NTASKS": "1"}
    if "_" in task:
        environment |= {"SLURM_ARRAY_JOB_ID": job, "SLURM_ARRAY_TASK_ID": number}
    if what == "lose":
        state.unlink()
        return
    if what.isdecimal():
        time.sleep(float(what))
    while True:
        with slots:
            state.write_text("RUNNING")
            process = subprocess.Popen(["bash", str(home() / f"{job}.sh")], env=environment, start_new_session=True)
            if what in ("kill", "die", "preempt"):
                strike(process, task, what, settings["later_s"])
            process.wait()
        if not again.exists() and what != "kill":
            break
        again.unlink(missing_ok=True)
        state.write_text("PENDING")
        what = "0"
    state.unlink()


def strike(process: subprocess.Popen[bytes], task: str, what: str, later_s: float) -> None:
    place, ends = home() / "jobs" / f"{task}.out", time.monotonic() + LIMIT_S
    while not (place.exists() and Path(place.read_text()).exists() and BEGUN in Path(place.read_text()).read_text()):
        if process.poll() is not None or time.monotonic() > ends:
            return
        time.sleep(0.01)
    time.sleep(random.Random(task).uniform(0.0, later_s))
    if process.poll() is not None:
        return
    if what == "preempt":
        for number in (signal.SIGTERM, signal.SIGUSR2):
            os.kill(int((home() / "jobs" / f"{task}.pid").read_text()), number)
    else:
        os.killpg(process.pid, signal.SIGKILL)


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
