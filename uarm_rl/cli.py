"""The command line: its words, the command that they name, and one sentence for whatever goes wrong."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from uarm_rl import checks
from uarm_rl.checks import UsageError
from uarm_rl.commands.errors import explain, printable
from uarm_rl.commands.help import config_name, help_text, overview
from uarm_rl.commands.words import as_overrides, check, given_twice
from uarm_rl.configuration import Settings, combinations, compose, flat, our_hydra, plain, search_space

if TYPE_CHECKING:
    from omegaconf import DictConfig

#: The sentence and the exit code of what failed.
Failure = tuple[str, int]


def main(words: Sequence[str] | None = None) -> None:
    """Run the command that ``words`` name, those behind the program's name if left out.

    Exit codes: 0 done, 1 it failed, 2 the command line is wrong, 130 interrupted.
    """
    _open_what_is_closed()
    try:
        _dispatch(list(sys.argv[1:] if words is None else words))
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more on its way out
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        _fail("interrupted; no file is left half written, and where a command has resume=true it goes on", 130)
    except Exception as error:
        if os.environ.get("UARM_RL_TRACEBACK"):
            raise
        _fail(*explain(error))


def _open_what_is_closed() -> None:
    """Give a standard stream that is closed somewhere to go: the next file opened would get its number, and its words."""
    for name, descriptor in (("stdin", 0), ("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            if null != descriptor:
                os.dup2(null, descriptor)
                os.close(null)
            stream = open(descriptor, "w" if descriptor else "r", encoding="utf-8", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)


def _fail(sentence: str, code: int) -> NoReturn:
    try:
        print(f"error: {printable(sentence)}", file=sys.stderr, flush=True)
    except OSError:  # nobody can be told
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 (Python flushes it on its way out)
    raise SystemExit(code)


def _dispatch(words: list[str]) -> None:
    if _completes(words):
        return
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
    elif words[0] == "--version":
        from uarm_rl import __version__

        print(f"uarm-rl {__version__}")
    else:
        words = [words[0], *as_overrides(words[1:])]
        check(words)
        for sentence in given_twice(words):
            print(f"note: {sentence}", file=sys.stderr)
        _run(words[0], words[1:])


def _run(command: str, words: list[str]) -> None:
    if {"-h", "--help"} & set(words):
        print(help_text(command))
    elif {"-c", "--cfg"} & set(words):
        import yaml

        overrides = tuple(word for word in words if not word.startswith("-") and word != "job")
        print(yaml.safe_dump(compose(command, overrides, incomplete=True), sort_keys=False, allow_unicode=True), end="")
    elif hasattr(_module(command), "search"):
        _module(command).search(*search_space([word for word in words if not word.startswith("-")]))
    elif {"-m", "--multirun"} & set(words) or hasattr(_module(command), "launch"):
        _run_many(command, [word for word in words if not word.startswith("-")])
    else:
        _module(command).run(compose(command, tuple(words)))


def _module(command: str) -> Any:
    """A command's module: ``run(settings)`` carries it out, or ``launch(jobs, words)`` all jobs of a multirun."""
    return import_module(f"uarm_rl.commands.{config_name(command)}")


# Many at once


def _run_many(command: str, overrides: list[str]) -> None:
    """Every combination of the overrides' values, one after the other or through the launcher that ``hydra/launcher`` names.

    A command may also carry them out itself, side by side. A job that fails is named at once and does not keep the others from
    running.
    """
    swept, words = combinations(overrides)
    composed = [compose(command, job) for job in words]
    first = [number for number, settings in enumerate(composed) if settings not in composed[:number]]  # studies overlap
    jobs = [words[number] for number in first]
    labels = [_label(job, swept) for job in jobs]
    _check_outputs(command, labels, [composed[number] for number in first])
    if launch := getattr(_module(command), "launch", None):
        launch([composed[number] for number in first], overrides)
        return
    failures: dict[int, Failure] = {}

    def failed(number: int, error: Exception) -> None:
        failures[number] = _failed(labels[number], error)

    side_by_side = getattr(_module(command), "side_by_side", None)
    if not side_by_side or not side_by_side([composed[number] for number in first], overrides, failed):
        returned = _launched(command, overrides, swept, jobs, composed[0]["results_dir"])
        failures = {number: failure for number, failure in enumerate(returned) if failure is not None}
    if failures:
        names = "; ".join(labels[number] for number in sorted(failures))
        _fail(f"{len(failures)} of {len(jobs)} jobs failed: {names}", failures[min(failures)][1])


def _launched(
    command: str, overrides: list[str], swept: frozenset[str], jobs: list[list[str]], results_dir: str
) -> list[Failure | None]:
    """What each job failed with, carried out by the launcher that the overrides name."""
    from hydra._internal.callbacks import Callbacks
    from hydra.core.plugins import Plugins
    from hydra.types import HydraContext, RunMode

    with our_hydra() as hydra:
        ours = [word.replace("hydra.launcher.ray.", "++hydra.launcher.ray.") for word in overrides if word.startswith("hydra")]
        if any(word.startswith("++hydra.launcher.ray.init.address=") for word in ours):
            ours.append("++hydra.launcher.ray.init.object_store_memory=null")  # a cluster that is there has its own
        if any(word.startswith("hydra/launcher=submitit") for word in ours):  # its scripts have the path
            checks.shell_path("results_dir", str(Path(results_dir).absolute()))
        if "results_dir" not in swept:  # where a launcher keeps what it needs
            ours += [word for word in overrides if word.startswith("results_dir=")]
        launcher = Plugins.instance().instantiate_launcher(
            hydra_context=HydraContext(config_loader=hydra.config_loader, callbacks=Callbacks()),
            task_function=partial(_job, command, swept, os.getcwd()),
            config=hydra.compose_config(config_name(command), ours, RunMode.MULTIRUN, with_log_configuration=False),
        )
        return [job.return_value for job in launcher.launch(jobs, initial_job_idx=0)]


def _label(job: Iterable[str], swept: frozenset[str]) -> str:
    """What tells a job from the others."""
    return " ".join(word for word in job if word.partition("=")[0] in swept) or "the only one"


def _check_outputs(command: str, labels: list[str], jobs: list[Settings]) -> None:
    """Raises :class:`UsageError` if two jobs would write to one place, naming them and a way to tell them apart."""
    output = getattr(_module(command), "output", lambda settings: None)
    places: dict[Path | None, list[int]] = {}
    for number, settings in enumerate(jobs):
        places.setdefault(output(settings), []).append(number)
    for place, numbers in places.items():
        if place is not None and len(numbers) > 1:
            raise UsageError(
                f"{len(numbers)} jobs would write to {place}: {'; '.join(labels[number] for number in numbers)}; "
                f"{_apart(place, [flat(jobs[number]) for number in numbers])}"
            )


def _apart(place: Path, jobs: list[Settings]) -> str:
    """What gives each of these jobs, whose settings are flat, a place of its own."""
    different = [key for key, value in jobs[0].items() if any(job.get(key) != value for job in jobs)]
    groups = [key.removesuffix("name") for key in different if key.endswith(".name")]  # whose name says all of the group
    different = [key for key in different if not any(key.startswith(group) and key != f"{group}name" for group in groups)]
    usual = ["buffer.name", "reward.name"] if "name" in jobs[0] else []
    values = "-".join(
        f"${{{key}}}" if key.endswith(".name") else f"{key.rpartition('.')[2]}${{{key}}}"
        for key in dict.fromkeys(usual + different)
    )
    return f"tell their places apart, for example with '{f'name={values}' if usual else f'out={values}{place.suffix}'}'"


def _job(command: str, swept: frozenset[str], folder: str, cfg: DictConfig) -> Failure | None:
    """One job of many, for which paths begin at ``folder``. Also called in processes that a launcher starts, anywhere."""
    from hydra.core.hydra_config import HydraConfig

    try:
        os.chdir(folder)
        _module(command).run(plain(cfg))
    except Exception as error:
        return _failed(_label(HydraConfig.get().overrides.task, swept), error)
    return None


def _failed(label: str, error: Exception) -> Failure:
    """Name a job that failed."""
    if os.environ.get("UARM_RL_TRACEBACK"):
        raise error
    sentence, code = explain(error)
    print(f"failed: {label}: {printable(sentence)}", file=sys.stderr, flush=True)
    return sentence, code


def _completes(words: list[str]) -> bool:
    """Answer the shell's queries: what completes a line, and the lines of shell that make it ask."""
    if not words or words[0] not in ("-sc", "--shell-completion"):
        return False
    match = re.fullmatch(r"(install|uninstall|query)=(bash|fish|zsh)", " ".join(words[1:]))
    if match is None:
        raise UsageError("-sc takes install=SHELL or uninstall=SHELL, where SHELL is bash, fish or zsh")
    if match[1] == "query":
        from uarm_rl.commands.completion import candidates

        print("\n".join(candidates(os.environ.get("COMP_LINE", ""))))
    else:
        plugins = import_module(f"hydra._internal.core_plugins.{match[2]}_completion")
        getattr(getattr(plugins, f"{match[2].capitalize()}Completion")(None), match[1])()
    return True


if __name__ == "__main__":
    main()
