"""An evaluation has the same bytes whichever BLAS kernel sums its products, and with how many threads."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import needs_pybullet, uarm_rl

ROOT = Path(__file__).parents[2]
RUN = ROOT / "results" / "uniform-plain" / "seed1"  # it shakes, which amplifies a last bit
FLAGS = set(Path("/proc/cpuinfo").read_text().split()) if Path("/proc/cpuinfo").exists() else set()
KERNELS = ["Prescott", *(["Haswell", "Zen"] if "avx2" in FLAGS else []), *(["SkylakeX"] if "avx512bw" in FLAGS else [])]


@needs_pybullet
@pytest.mark.parametrize(("kernel", "threads"), [(kernel, "1") for kernel in KERNELS] + [("Prescott", "2")])
def test_an_evaluation_is_the_committed_one(tmp_path, kernel, threads):
    lines = (RUN / "evaluation.csv").read_text().splitlines()[:9]
    positions = (ROOT / "uarm_rl" / "task" / "test_positions.csv").read_text().splitlines()[:9]
    (tmp_path / "eight.csv").write_text("\n".join(positions) + "\n")
    words = ("evaluate", f"run={RUN}", "positions=eight.csv", "out=again.csv", "workers=1")
    surroundings = {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": threads}
    done = uarm_rl(*words, cwd=tmp_path, environment=surroundings)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "again.csv").read_text().splitlines() == lines
