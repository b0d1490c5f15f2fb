"""The command line: its words, the command that they name, and one sentence for whatever goes wrong."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from uarm_rl.checks import UsageError
from uarm_rl.commands.errors import explain, printable
from uarm_rl.commands.help import config_name, help_text, overview
from uarm_rl.commands.words import as_overrides, check
from uarm_rl.configuration import Settings, compose, plain

if TYPE_CHECKING:
    from omegaconf import DictConfig


def main(words: Sequence[str] | None = None) -> None:
    """Run the command that ``words`` (default: ``sys.argv``) name.

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
        _fail("interrupted; what was saved before is whole", 130)
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
    if not words or words[0] in ("-h", "--help"):
        print(overview())
    elif words[0] == "--version":
        from uarm_rl import __version__

        print(f"uarm-rl {__version__}")
    elif words[0] in ("-sc", "--shell-completion"):
        _complete(words[1:])
    else:
        words = [words[0], *as_overrides(words[1:])]
        check(words)
        _run(words[0], words[1:])


def _complete(words: list[str]) -> None:
    """Answer the shell. Hydra knows how to ask it; what there is to offer, this program knows better."""
    if len(words) != 1 or not re.fullmatch(r"(install|uninstall|query)=(bash|fish|zsh)", words[0]):
        raise UsageError("-sc takes install=SHELL or uninstall=SHELL, where SHELL is bash, fish or zsh")
    if words[0].startswith("query="):
        from uarm_rl.commands.completion import candidates

        print("\n".join(candidates(os.environ.get("COMP_LINE", ""))))
    else:
        import hydra

        hydra.main(config_path="pkg://uarm_rl.conf", config_name="train", version_base="1.3")(lambda cfg: None)()


def _run(command: str, words: list[str]) -> None:
    overrides = [word for word in words if not word.startswith("-")]
    if {"-h", "--help"} & set(words):
        print(help_text(command))
    elif {"-c", "--cfg"} & set(words):
        import yaml

        settings = compose(command, [word for word in overrides if word != "job"], incomplete=True)
        print(yaml.safe_dump(settings, sort_keys=False), end="")
    elif {"-m", "--multirun"} & set(words):
        _run_many(command, overrides)
    else:
        _task(command)(compose(command, overrides))


def _task(command: str) -> Callable[[Settings], None]:
    run: Callable[[Settings], None] = import_module(f"uarm_rl.commands.{config_name(command)}").run
    return run


class _Failure(NamedTuple):
    sentence: str
    code: int


def _run_many(command: str, overrides: list[str]) -> None:
    """Every combination of the overrides' values, one after the other or through another launcher of Hydra's.

    A job that fails is named at once and does not keep the others from running; the first failure decides the exit code.
    """
    last = dict(word.partition("=")[::2] for word in overrides)
    for word in overrides:
        name, _, value = word.partition("=")
        if last[name] != value:
            print(f"note: {name} is given twice, and {name}={last[name]} counts; {name}=A,B is a run of each", file=sys.stderr)
    local = [word for word in overrides if not word.startswith("hydra")]
    if command == "train":
        _refuse_collisions(_jobs(command, _place, local), overrides)
    failures = [failure for failure in _jobs(command, partial(_job, command), overrides) if failure]
    if failures:
        raise SystemExit(failures[0].code)


def _jobs(command: str, task: Callable[[DictConfig], Any], overrides: list[str]) -> list[Any]:
    """What ``task`` returns for each job. It must not raise: Hydra would print a sentence of its own."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    results_dir = next((word.partition("=")[2] for word in reversed(overrides) if word.startswith("results_dir=")), "results")
    for path in (Path(results_dir) / ".hydra", Path(results_dir) / ".hydra" / "multirun.yaml"):
        if path.is_symlink():
            raise UsageError(f"{path} is a link, and Hydra would write through it; remove it")
    with hydra.initialize_config_module("uarm_rl.conf", version_base="1.3"):
        engine = GlobalHydra.instance().hydra
        assert engine is not None
        batches = engine.multirun(config_name(command), task, overrides, with_log_configuration=False)
        return [job.return_value for batch in batches for job in batch]


def _job(command: str, cfg: DictConfig) -> _Failure | None:
    from hydra.core.hydra_config import HydraConfig

    try:
        _task(command)(plain(cfg))
    except SystemExit as stop:
        return _Failure("stopped", stop.code if isinstance(stop.code, int) else 1)
    except Exception as error:
        failure = _Failure(*explain(error))
        job = " ".join(HydraConfig.get().overrides.task)
        print(f"failed: {job}: {printable(failure.sentence)}", file=sys.stderr, flush=True)
        return failure
    return None


def _place(cfg: DictConfig) -> tuple[str, str] | None:
    """A job and the folder that it would train in; ``None`` for one that will fail and say why."""
    from hydra.core.hydra_config import HydraConfig

    try:
        settings = plain(cfg)
        return " ".join(HydraConfig.get().overrides.task), "{results_dir}/{name}/seed{seed}".format(**settings)
    except Exception:
        return None


def _refuse_collisions(places: list[tuple[str, str] | None], overrides: list[str]) -> None:
    """Raises :class:`UsageError` if two jobs would train in one folder."""
    taken: dict[str, str] = {}
    for job, folder in filter(None, places):
        if other := taken.get(folder):
            swept = [name for name, _, value in (word.partition("=") for word in overrides) if "," in value and "." in name]
            example = "name=${buffer.name}-${reward.name}" + "".join(f"-{name.split('.')[-1]}${{{name}}}" for name in swept)
            raise UsageError(
                f"the jobs {other!r} and {job!r} would both train in {folder}; put what tells them apart into the name: "
                f"{shlex.quote(example)}"
            )
        taken[folder] = job


if __name__ == "__main__":
    main()
