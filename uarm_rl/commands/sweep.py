"""Search for good settings, by the success on the validation positions, with Optuna.

Examples:
  uarm-rl sweep experiment=C episodes=100 'agent.actor_lr=tag(log,interval(1e-5,1e-3))'   one setting, on a logarithmic scale
  uarm-rl sweep experiment=C 'agent.tau=interval(1e-3,2e-2)' batch_size=64,128,256 sweep.trials=50
  uarm-rl sweep experiment=C 'agent.tau=interval(1e-3,2e-2)' sweep.study=mine             the same line elsewhere helps
"""

from __future__ import annotations

import json
import re
import shlex
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from filelock import FileLock

from uarm_rl import checks, csvfile, locks, signals
from uarm_rl.checks import UsageError, command
from uarm_rl.columns import PROGRESS, pick
from uarm_rl.commands.errors import explain, printable
from uarm_rl.configuration import Settings, compose
from uarm_rl.files import PRUNED

if TYPE_CHECKING:
    import optuna

#: What is searched: by the setting's name ``{"choices": [...]}``, or ``{"low", "high", "log", "whole"}``.
Space = Mapping[str, Mapping[str, Any]]

#: The objective is the mean of so many last validations: one of 50 positions moves by chance.
_LAST: Final = 3
#: A trial that nobody holds is somebody's that died; younger ones (s) may be about to be held.
_YOUNG_S: Final = 10.0
#: Settings that say how trials are carried out, not what comes of them.
_TRANSIENT: Final = ("resume", "overwrite", "results_dir", "simulate_beside", "stacked", "device", "logger")


class StudyError(Exception):
    """A study that cannot be continued as it is asked; the message is a sentence."""


def search(space: Space, words: Sequence[str]) -> None:
    """Make the trials that are missing. ``words`` are all that is not searched."""
    if not find_spec("optuna"):
        raise UsageError(f"sweep needs an extra; {checks.how_to_add('sweep')}")
    if not space:
        raise UsageError("sweep searches nothing; give a setting several values, choice(a,b) or interval(1e-5,1e-3)")
    first = {name: of["choices"][0] if "choices" in of else of["low"] for name, of in space.items()}
    settings = compose("sweep", [*words, *_as_words(first)])
    how = settings["sweep"]
    trials = checks.integer("sweep.trials", how["trials"], low=1, high=1_000_000)
    checks.boolean("sweep.prune", how["prune"])
    if not re.fullmatch(r"\w[\w.-]*", checks.text("sweep.study", how["study"])):
        raise ValueError(f"sweep.study must be a name of letters, digits and . - _, got {how['study']!r:.60}")
    if settings["overwrite"]:
        raise UsageError("sweep never deletes a trial; take sweep.study=NAME for another study instead of overwrite=true")
    from uarm_rl.commands import train

    train.check(_trials(settings, how["study"], 0))
    folder = checks.path("results_dir", settings["results_dir"]) / how["study"]
    folder.mkdir(parents=True, exist_ok=True)
    with _quiet():
        study = _study(folder, space, words, settings)
        while (trial := _next(study, folder, space, trials)) is not None:
            _carry_out(study, trial, folder, space, words, how)
    _tell(study, folder)


def _trials(settings: Settings, study: str, number: int) -> Settings:
    """The settings of ``uarm-rl train`` for a trial."""
    kept = {key: value for key, value in settings.items() if key != "sweep"}
    return kept | {"name": f"trial{number:04d}", "results_dir": str(Path(settings["results_dir"]) / study), "resume": True}


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Optuna's own lines, and without its remarks on what is young in it."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield


def _study(folder: Path, space: Space, words: Sequence[str], settings: Settings) -> optuna.Study:
    """The study in the folder, begun if there is none. Raises :class:`StudyError` if that one searches something else."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    usual = compose("train", [word for word in words if not word.startswith("sweep.")])
    kept = {key: value for key, value in usual.items() if key not in _TRANSIENT}
    asked = json.loads(json.dumps({"space": space, "settings": kept}))  # as it is in the file
    with FileLock(folder / ".ask"):
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(folder / "study.journal"))),
            study_name="uarm-rl",
            direction="maximize",
            load_if_exists=True,
            pruner=optuna.pruners.MedianPruner(n_warmup_steps=settings["episodes"] // 4)
            if settings["sweep"]["prune"]
            else optuna.pruners.NopPruner(),
        )
        if not study.user_attrs:
            study.set_user_attr("asked", asked)
        study.sampler = optuna.samplers.TPESampler(seed=settings["seed"] + len(study.trials), constant_liar=True)
    if changed := checks.differences(study.user_attrs["asked"], asked):
        what = "; ".join(line.removeprefix("space.").removeprefix("settings.") for line in changed)
        raise StudyError(f"{folder} holds another study, with {what}; take sweep.study=NAME for this one")
    return study


def _next(study: optuna.Study, folder: Path, space: Space, most: int) -> optuna.Trial | None:
    """A trial to carry out: one whose process died, or a new one; ``None`` if there are enough."""
    import optuna

    running = optuna.trial.TrialState.RUNNING
    with FileLock(folder / ".ask"):
        for dead in [trial for trial in study.get_trials(states=(running,)) if _is_dead(trial, folder)]:
            _hand_back(study, dead)
        trials = study.get_trials()
        waiting = any(trial.state == optuna.trial.TrialState.WAITING for trial in trials)
        if not waiting and sum("continues" not in trial.user_attrs for trial in trials) >= most:
            return None
        trial = study.ask()
        for name, of in space.items():
            if "choices" in of:
                trial.suggest_categorical(name, of["choices"])
            elif of["whole"]:
                trial.suggest_int(name, of["low"], of["high"], log=of["log"])
            else:
                trial.suggest_float(name, of["low"], of["high"], log=of["log"])
        return trial


def _hand_back(study: optuna.Study, trial: Any) -> None:
    """Leave a trial that did not come to its end to whoever asks next."""
    import optuna

    study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    study.enqueue_trial(trial.params, user_attrs={"continues": trial.user_attrs.get("continues", trial.number)})


def _is_dead(trial: Any, folder: Path) -> bool:
    age_s = time.time() - trial.datetime_start.timestamp()
    return age_s > _YOUNG_S and not locks.holder(folder / _name(trial))


def _name(trial: Any) -> str:
    """A trial's folder; one that continues another has that one's."""
    return f"trial{trial.user_attrs.get('continues', trial.number):04d}"


def _carry_out(
    study: optuna.Study, trial: optuna.Trial, folder: Path, space: Space, words: Sequence[str], how: Mapping[str, Any]
) -> None:
    """Train a trial's policy and tell the study how good it is. One that is stopped is left to whoever comes next."""
    import optuna

    from uarm_rl.commands import train
    from uarm_rl.learn.train import Stop

    stop, rates = Stop(), list[float]()
    number = trial.user_attrs.get("continues", trial.number)
    settings = _trials(compose("sweep", [*words, *_as_words(trial.params)]), how["study"], number)
    place = train.output(settings)

    def hear(row: Mapping[str, float], experiences: int) -> None:
        if "validation_success_rate" in row:
            rates.append(row["validation_success_rate"])
            trial.report(_objective(rates), int(row["episode"]))
            stop.requested = stop.requested or trial.should_prune()

    with ExitStack() as stack:
        place.parent.mkdir(parents=True, exist_ok=True)
        stack.enter_context(locks.held(place.parent))
        rates += _validations(place)
        print(f"trial {number}: {shlex.join(_as_words(trial.params))}", flush=True)
        try:
            finished = train.train(settings, stop, hear)
        except Exception as error:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            print(f"failed: trial {number}: {printable(explain(error)[0])}", flush=True)
            return
        if finished:
            study.tell(trial, _objective(_validations(place)))
        elif stop.signal:
            with FileLock(folder / ".ask"):
                _hand_back(study, trial)
        else:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            (place.parent / PRUNED).touch()
            print(f"trial {number} is worse than most at its episode, and ended", flush=True)
    if stop.signal:
        signals.hand_on(stop.signal)
        raise SystemExit(130)


def _validations(place: Path) -> list[float]:
    """The success rates of a run's validations so far."""
    if not (place / "progress.csv").exists():
        return []
    values = csvfile.read(place / "progress.csv", pick(PROGRESS, "validation_success_rate")).values
    return [rate for rate in values["validation_success_rate"] if rate == rate]


def _objective(rates: Sequence[float]) -> float:
    return sum(rates[-_LAST:]) / len(rates[-_LAST:])


def _as_words(parameters: Mapping[str, Any]) -> list[str]:
    return [f"{name}={value}" for name, value in parameters.items()]


def _tell(study: optuna.Study, folder: Path) -> None:
    """How it stands."""
    import optuna

    trials = study.get_trials()
    done = [trial for trial in trials if trial.state == optuna.trial.TrialState.COMPLETE]
    others = {"pruned": "PRUNED", "failed": "FAIL", "running elsewhere": "RUNNING"}
    continued = {trial.user_attrs.get("continues") for trial in trials}
    counts = {
        word: sum(trial.state.name == state and trial.number not in continued for trial in trials)
        for word, state in others.items()
    }
    print(f"{folder}: {len(done)} trials done{''.join(f', {number} {word}' for word, number in counts.items() if number)}")
    if done:
        best = max(done, key=lambda trial: trial.value or 0.0)
        print(f"best: {best.value:.1%} of the validation positions, {folder / _name(best)}")
        print(f"its settings: {shlex.join(_as_words(best.params))}")
    print(f"all of them: {command(folder, 'runs').strip('`')}")
