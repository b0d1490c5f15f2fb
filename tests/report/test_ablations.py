"""The studies below ablations/: each run is known by its configuration, each question answered, what is missing told."""

from __future__ import annotations

import csv
import re

import yaml

from tests.report.runs import add_ablations, add_evaluation, add_progress, add_study_run, lines, remarks, write_config
from uarm_rl.configuration import compose
from uarm_rl.report import ablations
from uarm_rl.report.report import report
from uarm_rl.studies import studies

USUAL = compose("train")


def test_ablations_answer_each_question(tmp_path):
    add_ablations(tmp_path)
    text = report(tmp_path, USUAL)  # no run of the paper is needed
    folder = tmp_path / "ablations"
    with open(folder / "ablations.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("question", "run", "buffer", "seeds", "success_rate", "ci_low", "ci_high"),
        *("object_displacement_m", "object_displacement_low", "object_displacement_high"),
        *("training_displacement_m", "control_steps_per_decision", "servo_rise_s", "sigma", "setting"),
    ]

    def of(question: str, column: str) -> list[str]:
        return [row[column] for row in rows if row["question"] == question]

    assert of("halves", "buffer") == ["uniform", "unstuck_only", "steady_only", "adaptive"]
    assert of("halves", "success_rate") == ["0.25", "0.5", "0.75", "1"]
    assert of("fixed_hold", "buffer") == ["uniform", "fixed_hold", "adaptive"]
    assert of("fixed_hold", "control_steps_per_decision") == ["1", "11", "11"]
    assert of("servo", "servo_rise_s") == ["0.039", "0.039", "0.163", "0.163", "0.163", "0.327", "0.327"]
    both = ["adaptive", "uniform"]
    assert of("servo", "buffer") == [*both, *both, "uniform, 3 episodes", *both]
    assert of("sigma", "sigma") == ["0", "-5", "-20"]
    assert of("sigma", "training_displacement_m") == ["0.0015"] * 3  # 3 mm in each of two episodes, of four objects
    assert of("constants", "setting") == ["default", "default", "gamma 0.99", "dwell 0.25 s", "dwell 0.25 s"]
    assert set(of("servo", "setting") + of("sigma", "setting")) == {""}
    assert of("constants", "success_rate") == ["0.25", "1", "0.75", "1", "0.5"]
    assert of("sigma", "object_displacement_m") == ["0.001", "0.001", "0.0005"]
    markdown = (folder / "ablations.md").read_text()
    assert [line for line in markdown.splitlines() if line.startswith("| sigma-20")] == [
        "| sigma-20-adaptive | 1 | 75 % (30.1 to 95.4 %) | -20 | 11 | 0.5 | 1.5 |"
    ]
    assert "| dwell0.25-uniform | 1 | 50 % (15 to 85 %) | dwell 0.25 s | 1 | 1.0 | 1.5 |" in markdown.splitlines()
    pictures = ["halves", "fixed_hold", "servo", "sigma", "constants"]
    assert re.findall(r"!\[.*\]\((.*)\)", markdown) == [f"{picture}.png" for picture in pictures]
    for picture in pictures:
        assert (folder / f"{picture}.png").read_bytes().startswith(b"\x89PNG")
    (missing,) = remarks(text, "ablations, missing runs: ")
    lacking = {study: int(count) for count, study in re.findall(r"(\d+) of (\w+)", missing)}
    assert {"servo": 6, "long_servo": 1, "dwell": 2, "beta": 10}.items() <= lacking.items()
    assert not {"halves", "fixed_hold", "reference"} & lacking.keys()
    command = f"train -m resume=true experiment={','.join(lacking)}"
    assert missing.endswith(f"; `uarm-rl {command} results_dir={folder}` makes up for it")
    assert "not trained: A (adaptive-plain)" in text


def test_a_learned_duration_is_compared_in_equal_simulated_time_too(tmp_path):
    add_study_run(tmp_path, "experiment=fixed_hold", "buffer=uniform")
    add_study_run(tmp_path, "experiment=fixed_hold", "buffer=fixed_hold")
    add_study_run(tmp_path, "experiment=learned_duration", "buffer=learned_hold")
    # Control steps at the two validations, 0.5 and 0.75: 400, 800; 4400, 8800; 600, 1200.
    name = compose("train", ("experiment=learned_duration", "buffer=learned_hold"))["name"]
    add_progress(tmp_path / "ablations", name, 0, "0.5", "0.75", steps_per_decision=1.5)
    report(tmp_path, USUAL)
    with open(tmp_path / "ablations" / "ablations.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["question"] == "duration"]
    told = {row["buffer"]: (row["equal_time_success"], row["equal_time_learned"]) for row in rows}
    assert told == {"uniform": ("0.75", "0.5"), "fixed_hold": ("", "0.75"), "learned_hold": ("0.75", "0.75")}
    markdown = (tmp_path / "ablations" / "ablations.md").read_text()
    assert "| uniform-penalty | 1 | 100 % (34.2 to 100 %) | 75 % | 50 % | 1 |" in markdown


def test_a_folder_may_have_any_name(tmp_path):
    """What tells runs apart is in their configurations."""
    add_ablations(tmp_path)
    folder = tmp_path / "ablations"
    report(tmp_path, USUAL)
    made = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    for number, run in enumerate(sorted(path for path in folder.iterdir() if path.is_dir())):
        run.rename(folder / f"run{100 - number}")
    report(tmp_path, USUAL)
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == made


def test_runs_of_one_name_are_called_by_their_folders_and_strangers_left_out(tmp_path):
    add_study_run(tmp_path, "experiment=reference")
    folder = tmp_path / "ablations"
    settings = yaml.safe_load((folder / "adaptive-penalty" / "seed0" / "config.yaml").read_text())
    retired = {**settings["sim"], "cup_stiffness_n_m": 1500.0}
    for name, changed in {
        "softer": {"reward": {**settings["reward"], "sigma": -2}, "sim": retired},
        "two-changes": {"tolerance_m": 0.01, "dwell_s": 0.25},
        "other-servo": {"servo": {"name": "stepper"}},
        "nonsense": {"buffer": [1, {"name": 2}], "servo": None, "agent": "gamma"},
        "none": {},
    }.items():
        write_config(folder / name / "seed0", settings | changed)
        add_evaluation(folder, name, 0, "11", sigma="-2" if name == "softer" else "-5")
    (folder / "none" / "seed0" / "config.yaml").write_text("- no: mapping\n")
    report(tmp_path, USUAL)
    with open(folder / "ablations.csv", newline="") as file:
        found = {row["run"]: row["question"] for row in csv.DictReader(file) if row["question"] in ("sigma", "constants")}
    assert found == {"softer": "sigma", "adaptive-penalty": "constants"}


def test_every_study_answers_a_question_and_sweeps_what_there_is():
    asked = {study for question in ablations.QUESTIONS.values() for study in question.studies}
    assert asked == studies().keys()
    for name, sweep in studies().items():
        for number in range(max(map(len, sweep.values()))):  # every value once, and no two of one key at a time
            at = {key: values[number % len(values)] for key, values in sweep.items()}
            assert compose("train", (f"experiment={name}", *(f"{key}={value}" for key, value in at.items())))


def test_the_choice_of_constants_sees_validation_positions_of_both_methods_alone(tmp_path):
    ends = {("uniform", 10): 0.1, ("adaptive", 10): 0.9, ("uniform", 1): 0.3, ("adaptive", 1): 0.8, ("uniform", 3): 0.6}
    for (buffer, beta), end in ends.items():
        for seed in (0, 1):
            name = f"beta{beta}-{buffer}"
            add_study_run(tmp_path, "experiment=beta", f"buffer={buffer}", f"reward.beta={beta}", f"seed={seed}")
            shift = 0.0 if buffer == "adaptive" else 0.04 * seed
            rates = ["1", *(f"{end + shift + spread:g}" for spread in (-0.05, 0.05, 0.0))]
            add_progress(tmp_path / "ablations", name, seed, *rates)
    report(tmp_path, USUAL)
    assert lines(tmp_path, "ablations/choice.csv") == [
        "setting,seeds,adaptive,uniform,score,standard_error",
        "default,2,0.9,0.12,0.51,0.01",
        "beta 1,2,0.8,0.32,0.56,0.01",
    ]
    assert "| beta 1 | 2 | 80 % | 32 % | 56 % | 1 % |" in (tmp_path / "ablations" / "choice.md").read_text()


def test_the_curve_of_an_ablation_is_one_even_when_a_seed_has_stored_less(tmp_path):
    for seed, missing in ((0, 0), (1, 20)):
        add_study_run(tmp_path, "experiment=reference", f"seed={seed}")
        add_progress(tmp_path / "ablations", "adaptive-penalty", seed, "0.2", "", f"0.{6 + 2 * seed}", missing=missing)
    report(tmp_path, USUAL)
    assert lines(tmp_path, "ablations/learning_curves.csv")[1:] == [
        "adaptive-penalty,1,2,190,400,0.2,0.2,0.2",
        "adaptive-penalty,3,2,590,1200,0.7,0.6,0.8",
    ]


def test_ablations_say_what_is_missing_and_the_command_for_it(tmp_path, monkeypatch):
    add_evaluation(tmp_path, "A", 0, "11")
    assert not remarks(report(tmp_path, USUAL), "ablations")
    add_study_run(tmp_path, "experiment=fixed_hold", "buffer=fixed_hold")
    add_study_run(tmp_path, "experiment=fixed_hold", "buffer=uniform")
    add_study_run(tmp_path, "experiment=fixed_hold")
    folder = tmp_path / "ablations"
    (folder / "uniform-penalty" / "seed0" / "evaluation.csv").unlink()
    (missing,) = remarks(report(tmp_path, USUAL), "ablations, missing runs: ")
    assert "1 of fixed_hold" in missing
    assert "3 of halves" in missing
    assert ",fixed_hold," not in missing.partition("experiment=")[2]  # which is trained to its end
    assert missing.endswith(f" results_dir={folder}` makes up for it")
    monkeypatch.setattr(ablations, "QUESTIONS", {"fixed_hold": ablations.QUESTIONS["fixed_hold"]})
    assert remarks(report(tmp_path, USUAL), "ablations") == [
        f"ablations, missing runs: 1 of fixed_hold; `uarm-rl evaluate results_dir={folder}` makes up for it"
    ]
