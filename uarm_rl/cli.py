"""The command line: its words, the command that they name, and one sentence for whatever goes wrong."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from uarm_rl.checks import UsageError
from uarm_rl.commands import COMMANDS
from uarm_rl.commands.errors import explain, printable
from uarm_rl.commands.help import config_name, help_text, overview
from uarm_rl.commands.words import as_overrides, check
from uarm_rl.configuration import Settings, compose, plain

if TYPE_CHECKING:
    from omegaconf import DictConfig


def main() -> None:
    """Run the command that ``sys.argv`` names. Exit codes: 0 done, 1 it failed, 2 the command line is wrong."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: one observation is no work for two threads
    try:
        _dispatch(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        _fail("interrupted; what was saved before is whole", 130)
    except Exception as error:
        if os.environ.get("UARM_RL_TRACEBACK"):
            raise
        _fail(*explain(error))


def _dispatch(words: list[str]) -> None:
    if _completes(words):
        return
    if not words or words[0] in ("-h", "--help"):
        print(overview())
    elif words[0] == "--version":
        from uarm_rl import __version__

        print(f"uarm-rl {__version__}")
    else:
        words = [words[0], *as_overrides(words[1:])]
        check(words)
        _run(words[0], words[1:])


def _fail(sentence: str, code: int) -> None:
    print(f"error: {printable(sentence)}", file=sys.stderr)
    raise SystemExit(code)


def _run(command: str, words: list[str]) -> None:
    if {"-h", "--help"} & set(words):
        print(help_text(command))
    elif {"-c", "--cfg"} & set(words):
        import yaml

        overrides = tuple(word for word in words if not word.startswith("-") and word != "job")
        print(yaml.safe_dump(compose(command, overrides), sort_keys=False), end="")
    elif {"-m", "--multirun"} & set(words):
        _run_many(command, [word for word in words if not word.startswith("-")])
    else:
        _task(command)(compose(command, tuple(words)))


def _task(command: str) -> Callable[[Settings], None]:
    run: Callable[[Settings], None] = import_module(f"uarm_rl.commands.{config_name(command)}").run
    return run


def _run_many(command: str, overrides: list[str]) -> None:
    """Every combination of the overrides' values, one after the other or through ``hydra/launcher=joblib``.

    A job that fails is named at once and does not keep the others from running; the first failure is raised at the end.
    """
    import hydra
    from hydra.core.hydra_config import HydraConfig

    def task(cfg: DictConfig) -> None:
        try:
            _task(command)(plain(cfg))
        except Exception as error:
            job = " ".join(HydraConfig.get().overrides.task)
            print(f"failed: {job}: {printable(explain(error)[0])}", file=sys.stderr)
            raise

    results_dir = next((word.partition("=")[2] for word in reversed(overrides) if word.startswith("results_dir=")), "results")
    for path in (Path(results_dir) / ".hydra", Path(results_dir) / ".hydra" / "multirun.yaml"):
        if path.is_symlink():
            raise UsageError(f"{path} is a link, and Hydra would write through it; remove it")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # exceptions come through to main(), which explains them
    sys.argv = [sys.argv[0], "--multirun", *overrides]
    hydra.main(config_path="pkg://uarm_rl.conf", config_name=config_name(command), version_base="1.3")(task)()


def _completes(words: list[str]) -> bool:
    """Answer the shell's completion queries: commands here, everything behind a command by Hydra."""
    if not words or words[0] not in ("-sc", "--shell-completion"):
        return False
    if len(words) != 2 or not re.fullmatch(r"(install|uninstall|query)=(bash|fish|zsh)", words[1]):
        raise UsageError("-sc takes install=SHELL or uninstall=SHELL, where SHELL is bash, fish or zsh")
    import hydra

    line = os.environ.get("COMP_LINE", "").split(" ")
    if words[1].startswith("query=") and len(line) == 2:
        print("\n".join(name for name in COMMANDS if name.startswith(line[1])))
        return True
    command = line[1] if len(line) > 2 and line[1] in COMMANDS else "train"
    if len(line) > 2:
        os.environ["COMP_LINE"] = " ".join([line[0], *line[2:]])
    hydra.main(config_path="pkg://uarm_rl.conf", config_name=config_name(command), version_base="1.3")(lambda cfg: None)()
    return True


if __name__ == "__main__":
    main()
