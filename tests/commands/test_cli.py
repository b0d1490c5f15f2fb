"""The command line as a user meets it: whole runs, help, completion, errors; each in a process of its own."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import pytest

from tests.conftest import FAST, uarm_rl

METHODS = {"A": "adaptive-plain", "B": "uniform-plain", "C": "adaptive-penalty", "D": "uniform-penalty"}
QUICK = (*FAST, "episodes=2", "time_limit_s=0.3", "simulate_beside=false")


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A folder with a trained and evaluated run of methods B and C."""
    folder = tmp_path_factory.mktemp("user")
    done = uarm_rl("train", "-m", "experiment=B,C", *QUICK, cwd=folder)
    assert (done.returncode, "error" in done.stderr) == (0, False), done.stderr
    done = uarm_rl("evaluate", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("of 100 positions reached") == 2
    return folder


@pytest.fixture
def copied(trained, tmp_path) -> Path:
    """A copy of the trained folder that a test may spoil."""
    shutil.copytree(trained / "results", tmp_path / "results")
    return tmp_path


def assert_refused(done, code: int, *parts: str) -> None:
    assert done.returncode == code, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for part in parts:
        assert part in lines[0], lines[0]


def test_a_run_holds_its_files(trained):
    for method in ("B", "C"):
        run = trained / "results" / METHODS[method] / "seed0"
        names = {path.name for path in run.iterdir()}
        assert {"config.yaml", "progress.csv", "policy.safetensors", "evaluation.csv"} <= names
        with open(run / "evaluation.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        assert [int(row["position"]) for row in rows] == list(range(100))
        columns = "position,success,return,common_return,time_s,final_distance_m,min_distance_m,object_displacement_m"
        assert list(rows[0])[:11] == [*columns.split(","), "reversals_per_s", "rms_jerk", "tip_travel_last_s_m"]


def test_evaluating_again_gives_the_same_bytes(trained):
    run = "results/adaptive-penalty/seed0"
    done = uarm_rl("evaluate", f"run={run}", "out=again.csv", "workers=1", cwd=trained)
    assert done.returncode == 0, done.stderr
    assert (trained / "again.csv").read_bytes() == (trained / run / "evaluation.csv").read_bytes()


def test_everything_evaluated_is_nothing_to_do(trained):
    done = uarm_rl("evaluate", cwd=trained)
    assert (done.returncode, "evaluated already" in done.stdout) == (0, True)
    done = uarm_rl("evaluate", "results/uniform-plain/seed0", cwd=trained)
    assert_refused(done, 2, "did you mean run=results/uniform-plain/seed0?")


def test_an_evaluation_says_under_which_conditions_it_was_made(trained):
    holds = {"uniform-plain": "fixed(1)", "adaptive-penalty": "until_steady(2..40, 0.001 rad)"}
    sigmas = {"uniform-plain": "0", "adaptive-penalty": "-5"}
    for name, hold in holds.items():
        with open(trained / "results" / name / "seed0" / "evaluation.csv", newline="") as file:
            for row in csv.DictReader(file):
                assert (row["tolerance_m"], row["hold"], row["control_hz"]) == ("0.005", hold, "20")
                assert (row["servo_rise_s"], row["sigma"]) == ("0.327", sigmas[name])


def test_a_file_name_alone_is_that_file_in_the_folder_of_every_run(copied):
    (copied / "three.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.25,-0.1,0.03\n0.2,0,0.03\n")
    words = ("evaluate", "positions=three.csv", "out=three.csv", "hold=fixed", "tolerance_m=0.002", "traces=2")
    done = uarm_rl(*words, cwd=copied)
    assert (done.returncode, done.stdout.count("of 3 positions reached")) == (0, 2), done.stderr
    made = sorted((copied / "results").rglob("three*"))
    assert [path.name for path in made] == ["three-traces.csv", "three.csv"] * 2
    for path in made:
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        if path.name == "three.csv":
            assert [(row["tolerance_m"], row["hold"]) for row in rows] == [("0.002", "fixed(13)")] * 3
        else:
            assert {row["position"] for row in rows} == {"0", "1"}
            assert [row["time_s"] for row in rows if row["position"] == "1"][:3] == ["0", "0.05", "0.1"]
    before = {path: path.read_bytes() for path in made}
    (copied / "results" / "uniform-plain" / "seed0" / "three.csv").unlink()
    done = uarm_rl(*words, cwd=copied)
    assert done.stdout.count("of 3 positions reached") == 1
    assert "evaluated already, three.csv is there" in done.stdout
    assert "results/adaptive-penalty/seed0" in done.stdout.splitlines()[-1]
    assert uarm_rl(*words, "overwrite=true", cwd=copied).stdout.count("of 3 positions reached") == 2
    assert {path: path.read_bytes() for path in made} == before
    assert not (copied / "results" / "ik").exists()
    done = uarm_rl(*words[:3], "policy=ik", cwd=copied)
    assert "3 of 3 positions reached; results/ik/seed0/three.csv" in done.stdout
    assert_refused(uarm_rl("evaluate", "out=results/three.csv", cwd=copied), 2, "give run=DIR too", "out=NAME.csv")
    assert_refused(uarm_rl("evaluate", "positions=heldout", cwd=copied), 2, "positions changes the test")
    assert_refused(uarm_rl("evaluate", "hold=fixed", "out=evaluation.csv", cwd=copied), 2, "hold changes the test")
    for name in ("policy.safetensors", "progress.csv"):
        assert_refused(uarm_rl("evaluate", f"out={name}", "overwrite=true", cwd=copied), 2, f"out={name} is no name")
    assert_refused(uarm_rl(*words, "overwrite=true", "traces=-1", cwd=copied), 2, "traces must be a whole number")


def test_traces_that_are_missing_are_made_without_a_second_evaluation(copied):
    (copied / "two.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.25,-0.1,0.03\n")
    words = ("evaluate", "run=results/uniform-plain/seed0", "positions=two.csv", "out=o.csv")
    assert uarm_rl(*words, "traces=1", cwd=copied).returncode == 0
    first = (copied / "o.csv").read_bytes(), (copied / "o-traces.csv").read_bytes()
    (copied / "o-traces.csv").unlink()
    done = uarm_rl(*words, "tolerance_m=0.04", "time_limit_s=1", "traces=1", cwd=copied)
    assert_refused(done, 2, "o.csv comes from another test than this one")
    assert not (copied / "o-traces.csv").exists()
    done = uarm_rl(*words, "traces=1", cwd=copied)
    assert (done.returncode, "1 positions recorded; o-traces.csv" in done.stdout) == (0, True), done.stderr
    assert ((copied / "o.csv").read_bytes(), (copied / "o-traces.csv").read_bytes()) == first
    assert_refused(uarm_rl(*words, "traces=1", cwd=copied), 2, "o.csv exists already; out=FILE writes elsewhere")


def test_positions_of_ones_own(trained):
    (trained / "mine.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.25,-0.1,0.03\n")
    run = "run=results/uniform-plain/seed0"
    assert_refused(uarm_rl("evaluate", run, "positions=mine.csv", cwd=trained), 2, "give out=FILE")
    done = uarm_rl("evaluate", run, "positions=mine.csv", "tolerance_m=0.02", "out=mine-out.csv", cwd=trained)
    assert "of 2 positions reached" in done.stdout, done.stderr


def test_another_time_limit(trained):
    run = "run=results/uniform-plain/seed0"
    assert_refused(uarm_rl("evaluate", run, "time_limit_s=1", cwd=trained), 2, "time_limit_s changes the test", "out=FILE")
    assert_refused(uarm_rl("evaluate", run, "time_limit_s=0", "out=short.csv", cwd=trained), 2, "time_limit_s must be")
    done = uarm_rl("evaluate", run, "time_limit_s=1", "out=short.csv", cwd=trained)
    assert "0 of 100 positions reached" in done.stdout, done.stderr
    with open(trained / "short.csv", newline="") as file:
        assert {row["time_s"] for row in csv.DictReader(file)} == {"1"}


def test_the_report_is_rebuilt_from_csv_files(copied):
    for path in copied.rglob("policy.safetensors"):
        path.unlink()
    done = uarm_rl("report", cwd=copied)
    assert done.returncode == 0, done.stderr
    results = copied / "results"
    for name in ("table1.csv", "table1.md", "reward_curve.csv", "reward_curve.png", "learning_curves.png"):
        assert (results / name).stat().st_size > 0
    with open(results / "table1.csv", newline="") as file:
        rows = {row["method"].partition(" (")[0]: row for row in csv.DictReader(file)}  # C, or C (mujoco)
    assert rows["C"]["seeds"] == "1"
    assert rows["C"]["paper_success_rate"] not in ("", None)
    assert rows["A"]["success_rate"] == ""  # not trained, so not invented
    tables = (results / "table1.csv").read_bytes(), (results / "reward_curve.csv").read_bytes()
    assert uarm_rl("report", cwd=copied).returncode == 0
    assert tables == ((results / "table1.csv").read_bytes(), (results / "reward_curve.csv").read_bytes())


def test_a_film(trained):
    run = "run=results/adaptive-penalty/seed0"
    done = uarm_rl("render", run, "position=[0.25,0.1,0.03]", "width=96", "height=64", "out=film.gif", cwd=trained)
    assert done.returncode == 0, done.stderr
    from PIL import Image

    with Image.open(trained / "film.gif") as film:
        assert film.n_frames >= 3  # equal ones are merged
        assert film.size == (96, 64)
    assert_refused(uarm_rl("render", run, "out=film.avi", cwd=trained), 2, "must end in .gif or .mp4")


def test_help_explains(tmp_path):
    overview = uarm_rl("--help", cwd=tmp_path).stdout
    assert all(f"  {command} " in overview for command in ("train", "evaluate", "report", "render"))
    for command in ("train", "evaluate", "report", "render"):
        done = uarm_rl(command, "--help", cwd=tmp_path)
        assert (done.returncode, f"uarm-rl {command}" in done.stdout) == (0, True), done.stderr
    text = uarm_rl("train", "--help", cwd=tmp_path).stdout
    for part in ("Examples:", "experiment", "A, B, C, D", "tolerance_m: 0.005  # m;", "results_dir: results"):
        assert part in text
    assert list(tmp_path.iterdir()) == []


def test_help_and_report_load_neither_torch_nor_pybullet(trained):
    code = (
        "import sys; from uarm_rl import cli; cli.main(); "
        "print({'torch', 'pybullet', 'hydra'} & set(sys.modules) - ({'hydra'} if 'report' in sys.argv else set()))"
    )
    import subprocess
    import sys

    for words in (["--help"], ["report"], ["train", "--help"]):
        done = subprocess.run([sys.executable, "-c", code, *words], cwd=trained, capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "set()", words


def test_the_whole_configuration_can_be_seen(tmp_path):
    text = uarm_rl("train", "--cfg", "job", "agent.gamma=0.5", cwd=tmp_path).stdout
    assert "gamma: 0.5" in text
    assert "name: adaptive-penalty" in text
    assert "run: ???" in uarm_rl("render", "--cfg", "job", cwd=tmp_path).stdout  # what is missing is seen as missing


@pytest.mark.parametrize(
    ("words", "code", "parts"),
    [
        (["trian"], 2, ["there is no command 'trian'", "did you mean train?"]),
        (["xyz"], 2, ["choose one of train, evaluate"]),
        (["train", "agent.gama=0.5"], 2, ["no setting 'agent.gama'", "did you mean agent.gamma?"]),
        (["train", "gamma=0.5"], 2, ["no setting 'gamma'", "did you mean agent.gamma?"]),
        (["train", "servo.feed=20"], 2, ["no setting 'servo.feed'; it belongs to servo=stepper"]),
        (["train", "tensorboard=true"], 2, ["no setting 'tensorboard'; did you mean logger=tensorboard?"]),
        (["train", "bufer=adaptive"], 2, ["no setting 'bufer'", "did you mean buffer?"]),
        (["train", "buffer=adaptve"], 2, ["no buffer=adaptve", "did you mean adaptive?", "uniform"]),
        (["train", "buffer="], 2, ["no buffer=;", "uniform"]),
        (["train", "hold=fixed"], 2, ["train has no group 'hold'", "did you mean hold@buffer.hold?"]),
        (["train", "name=${buffer.nme}"], 2, ["${buffer.nme}", "did you mean buffer.name?"]),
        (["train", "seed=0,1"], 2, ["seed=0,1 are several values: with -m there is a run of each"]),
        (["train", "seed=range(3)"], 2, ["seed=range(3) are several values: with -m"]),
        (["train", "agent.gamma=2"], 2, ["agent.gamma must be a number from 0 to 1, got 2"]),
        (["train", "episodes=0"], 2, ["episodes must be a whole number of at least 1, got 0"]),
        (["train", "seed=abc"], 2, ["seed must be a whole number"]),
        (["train", "task=obstacles"], 2, ["task=obstacles needs a name of its own, as in name=obstacles-adaptive-penalty"]),
        (["train", "observation=stack", "hindsight_targets=8"], 2, ["hindsight_targets needs an observation of one moment"]),
        (["train", "servo=torque", "actions=absolute"], 2, ["with servo=torque an action is a torque"]),
        (["train", "experiment=obstacles", "task.slots=4"], 2, ["task.slots must be a whole number from 1 to 3, got 4"]),
        (["train", "tolerance_m=-1"], 2, ["tolerance_m must be a number above 0"]),
        (["train", "a b"], 2, ["'a b' is no setting", "name=value"]),
        (["train", "seed"], 2, ["'seed' is no setting"]),
        (["train", "job"], 2, ["'job' is no setting"]),
        (["train", "episodes", "=", "30"], 2, ["'episodes' is no setting; write episodes=30, without spaces"]),
        (["train", "-m", "seed=", "3"], 2, ["'3' is no setting; write seed=3, without spaces"]),
        (["evaluate", "."], 2, ["'.' is no setting; did you mean results_dir=.?"]),
        (["train", "name='a"], 2, ["name='a cannot be read"]),
        (["train", "+x=1"], 2, ["adds or removes a setting"]),
        (["train", "--config-dir=."], 2, ["is no option"]),
        (["train", "hydra.run.dir=/tmp"], 2, ["is not for the command line"]),
        (["train", "results_dir=/dev/null/x"], 1, ["/dev/null"]),
        (["evaluate"], 2, ["results is not a folder", "uarm-rl train"]),
        (["evaluate", "run=nowhere"], 2, ["there is no run folder nowhere"]),
        (["evaluate", "policy=magic"], 2, ["results is not a folder"]),
        (["evaluate", "policy=ik", "positions=none.csv", "out=x.csv"], 2, ["there is no file none.csv", "test, validation"]),
        (["evaluate", "positions=none.csv"], 2, ["there is no file none.csv", "test, validation"]),
        (["report"], 2, ["results is not a folder"]),
        (["report", "results_dir=nowhere"], 2, ["nowhere is not a folder", "uarm-rl train results_dir=nowhere"]),
        (["report", "results_dir=."], 2, [". holds no run"]),
        (["render"], 2, ["run=VALUE is needed"]),
    ],
)
def test_bad_command_lines_get_one_sentence_and_change_nothing(tmp_path, words, code, parts):
    assert_refused(uarm_rl(*words, cwd=tmp_path), code, *parts)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_spoiled_run_folders_are_named(copied):
    run = copied / "results" / "adaptive-penalty" / "seed0"
    words = ("evaluate", f"run={run}", "overwrite=true")
    before = (run / "evaluation.csv").read_bytes()
    policy = (run / "policy.safetensors").read_bytes()
    (run / "policy.safetensors").write_bytes(policy[: len(policy) // 2])
    assert_refused(uarm_rl(*words, cwd=copied), 1, "policy.safetensors", "truncated, damaged or no policy")
    (run / "policy.safetensors").unlink()
    assert_refused(uarm_rl(*words, cwd=copied), 2, "its training is not finished")
    (run / "config.yaml").write_text("buffer: [")
    assert_refused(uarm_rl(*words, cwd=copied), 2, "config.yaml is damaged")
    (run / "config.yaml").write_text("!!python/object/apply:os.system ['echo pwned']")
    assert_refused(uarm_rl(*words, cwd=copied), 2, "config.yaml is damaged")
    (run / "config.yaml").write_text("[]")
    assert_refused(uarm_rl(*words, cwd=copied), 2, "config.yaml is damaged: it must be a group of settings")
    assert (run / "evaluation.csv").read_bytes() == before


def test_a_nan_position_is_named_with_its_line(copied):
    (copied / "bad.csv").write_text("x_m,y_m,z_m\n0.2,0.1,0.03\n0.2,nan,0.03\n")
    words = ("evaluate", "run=results/uniform-plain/seed0", "positions=bad.csv", "out=x.csv")
    assert_refused(uarm_rl(*words, cwd=copied), 1, "bad.csv, line 3", "must be a finite number")
    assert not (copied / "x.csv").exists()


def test_a_folder_that_takes_no_files_is_named(tmp_path):
    """/proc takes none, whoever asks; a folder's permission bits would not stop root."""
    assert_refused(uarm_rl("train", *QUICK, "results_dir=/proc/results", cwd=tmp_path), 1, "/proc/results")
    done = uarm_rl("evaluate", "policy=ik", "results_dir=/proc/results", cwd=tmp_path)
    assert_refused(done, 1, "/proc/results", "check the path")
    assert "position" not in done.stderr  # before any work


def test_a_film_that_has_no_place_is_not_begun(copied):
    words = ("render", "run=results/uniform-plain/seed0", "out=/proc/a.gif", "episodes=100000")
    assert_refused(uarm_rl(*words, cwd=copied), 1, "/proc/a.gif:", "check the path")


def test_a_finished_run_is_refused_and_kept(trained):
    run = trained / "results" / "adaptive-penalty" / "seed0"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert_refused(
        uarm_rl("train", "experiment=C", *QUICK, cwd=trained), 2, "already holds a finished run", "results_dir=FOLDER"
    )
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_signs_that_hydra_cannot_read_are_quoted_for_it(tmp_path):
    done = uarm_rl("train", "--cfg", "job", "name=Ü#-${buffer.name}", cwd=tmp_path)
    assert "name: Ü#-adaptive\n" in done.stdout, done.stderr
    done = uarm_rl("report", "results_dir=größen & maße", cwd=tmp_path)
    assert_refused(done, 2, "größen & maße")
