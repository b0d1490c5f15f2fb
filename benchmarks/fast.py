"""How long `uarm-rl train experiment=fast` takes from the command to the policy, and how good that is: medians over seeds.

    python benchmarks/fast.py [--seeds 0,1,2,3,4] [--out benchmarks/fast.csv] [WORDS, such as sim=mujoco]

Each seed is trained by the command line itself, start-up included, one after the other, and then tested on the 100 test
positions, which takes no part in the time. ``cpu_s`` is what the training's processes computed: with more than the wall-clock,
two cores had work; with far less than it, somebody else had the cores, and the time says nothing.
"""

from __future__ import annotations

import argparse
import csv
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent


class Row(NamedTuple):
    """One training."""

    seed: int
    wall_s: float
    cpu_s: float
    experiences: int
    validation_successes: int  # of 50
    test_successes: int  # of 100


def uarm_rl(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "uarm_rl", *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def measure(seed: int, words: list[str], results: Path) -> Row:
    before, began = cpu_s(), time.perf_counter()
    uarm_rl("train", "experiment=fast", f"seed={seed}", f"results_dir={results}", *words)
    wall_s, computed_s = time.perf_counter() - began, cpu_s() - before
    run = results / "fast" / f"seed{seed}"
    uarm_rl("evaluate", f"run={run}")
    last = read(run / "progress.csv")[-1]
    reached = [row["success"] for row in read(run / "evaluation.csv")]
    return Row(
        seed,
        round(wall_s, 1),
        round(computed_s, 1),
        int(last["experiences"]),
        round(50 * float(last["validation_success_rate"])),
        reached.count("1"),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2,3,4")
    parser.add_argument("--out", type=Path, default=HERE / "fast.csv")
    parser.add_argument("words", nargs="*", help="further words of the training")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, open(arguments.out, "w", newline="") as file:
        log = csv.writer(file, lineterminator="\n")
        log.writerow(Row._fields)
        rows = []
        for seed in map(int, arguments.seeds.split(",")):
            rows.append(measure(seed, arguments.words, Path(folder)))
            log.writerow(rows[-1])
            file.flush()
            print(", ".join(f"{name} {value}" for name, value in rows[-1]._asdict().items()), flush=True)
    wall_s = statistics.median(row.wall_s for row in rows)
    reached = statistics.median(row.test_successes for row in rows)
    print(f"median of {len(rows)} seeds: {wall_s:.1f} s, {reached:g} of 100 test positions")


if __name__ == "__main__":
    main()
