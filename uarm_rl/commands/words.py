"""The words of a command line: which are allowed, and ``--name value`` as ``name=value``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Final, NamedTuple

from uarm_rl.checks import UsageError, how_to_add
from uarm_rl.commands import COMMANDS
from uarm_rl.configuration import groups
from uarm_rl.files import CONFIG

#: Hydra's own options are no settings; the command line decides which of them it takes. (``run`` is a setting here.)
_HYDRAS: Final = (
    "help|hydra-help|version|cfg|resolve|package|multirun|shell-completion|config-path|config-name|config-dir|"
    "experimental-rerun|info"
)
_OPTION: Final = re.compile(rf"--(?!(?:{_HYDRAS})(?:=|$))([a-z][\w.@/-]*)(?:=(.*))?", re.DOTALL)
#: Options that tell of one thing each, and may come once for every such thing.
_REPEATED: Final = ("obstacle",)
_NUMBER: Final = re.compile(r"-\.?\d.*")
#: Values that Hydra reads without quotes: words, numbers, paths, lists.
_PLAIN: Final = re.compile(r"[\w./:,+@%$\[\]{} -]+", re.ASCII)
_REFERENCE: Final = re.compile(r"\$\{[\w.]+\}")
#: What is Hydra's own grammar, and stays as it is: quotes, calls, lists.
_GRAMMAR: Final = re.compile(r"""['"\\()\[\]{}]""")


def as_overrides(words: list[str]) -> list[str]:
    """``--name value`` as ``name=value``, the one spelling that is read further on, with quotes where Hydra needs them.

    ``--dry-run`` is ``dry_run=true``, ``--target 0.2 0 0.03`` is ``target=[0.2,0,0.03]``, and a second ``--obstacle`` is one
    more in a list of them.
    """
    overrides: list[str] = []
    repeated: dict[str, list[str]] = {}
    rest = list(words)
    while rest:
        word = rest.pop(0)
        option = _OPTION.fullmatch(word)
        if option is None:
            overrides.append(_readable(word))
            continue
        values = [] if option[2] is None else [option[2]]
        while option[2] is None and rest and not _begins_something(rest[0]):
            values.append(rest.pop(0))
        name = option[1].replace("-", "_")
        text = ",".join(value if _PLAIN.fullmatch(value) else _quoted(value) for value in values)
        text = f"[{text}]" if len(values) > 1 else text if values else "true"
        if name in _REPEATED:
            repeated.setdefault(name, []).append(text)
        else:
            overrides.append(f"{name}={text}")
    for name, given in repeated.items():
        overrides.append(f"{name}={given[0]}" if len(given) == 1 else f"{name}=[{','.join(given)}]")
    return overrides


def _readable(word: str) -> str:
    """``name=value`` with quotes around what only they make readable, as letters beyond ASCII and odd signs."""
    name, equals, value = word.partition("=")
    if not equals or not value or _PLAIN.fullmatch(value) or _GRAMMAR.search(_REFERENCE.sub("", value)):
        return word
    return f"{name}={','.join(map(_quoted, value.split(',')))}"


def _begins_something(word: str) -> bool:
    return (word.startswith("-") and not _NUMBER.fullmatch(word)) or re.match(r"[a-z][\w.@/]*=", word) is not None


def _quoted(value: str) -> str:
    escaped = value.replace("'", "\\'")
    return f"'{escaped}'"


#: What a user of this program needs of Hydra. Its other switches and settings (callbacks, search paths, logging)
#: could run code that a configuration names.
FLAGS: Final = ("-m", "--multirun", "-h", "--help", "-c", "--cfg")


class Launcher(NamedTuple):
    """What carries out the jobs of ``-m``: its module, the extra that brings it, and which settings of it a word may give."""

    module: str
    extra: str
    settings: Mapping[str, str]  # name: a pattern of all its value


_COUNT: Final = "[1-9][0-9]{0,8}"
#: These go into a job's script, so they are words and nothing else.
_NAME: Final = "[A-Za-z0-9][A-Za-z0-9_.-]{0,99}"
_JOBS: Final = {"timeout_min": _COUNT, "cpus_per_task": _COUNT, "mem_gb": _COUNT}
_QUEUE: Final = {
    **_JOBS,
    "array_parallelism": _COUNT,
    "max_num_timeout": _COUNT,
    **dict.fromkeys(("partition", "account", "qos"), _NAME),
}
_RAY: Final = {"ray.init.address": "auto", "ray.init.num_cpus": _COUNT, "ray.remote.num_cpus": _COUNT}
LAUNCHERS: Final = {
    "basic": Launcher("hydra", "", {}),
    "joblib": Launcher("hydra_plugins.hydra_joblib_launcher", "launch", {"n_jobs": f"-1|{_COUNT}"}),
    "submitit_slurm": Launcher("hydra_plugins.hydra_submitit_launcher", "slurm", _QUEUE),
    "submitit_local": Launcher("hydra_plugins.hydra_submitit_launcher", "slurm", _JOBS),
    "ray": Launcher("hydra_plugins.hydra_ray_launcher", "ray", _RAY),
}


def check(words: list[str]) -> None:
    """Raises :class:`UsageError` for words that no command takes, or that could run what a configuration names."""
    command, *rest = words
    if command not in COMMANDS:
        near = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(COMMANDS)}"
        raise UsageError(f"there is no command {command!r}; {hint}")
    for before, word in zip(words, rest, strict=False):
        if word == "job" and before in ("-c", "--cfg"):
            continue
        if before in ("-c", "--cfg"):
            raise UsageError(f"{before} shows the configuration that would be used; write {before} job")
        if word.startswith("-") and word not in FLAGS:
            raise UsageError(f"{word} is no option of uarm-rl {command}; it takes name=value or --name value, -m and --help")
        if word.startswith(("+", "~")):
            raise UsageError(f"{word} adds or removes a setting; settings can only be changed, with name=value")
        if not word.startswith("-") and not re.match(r"[\w./@-]+=", word):
            raise UsageError(f"{word!r} is no setting; {_meant(word, rest)}")
        if word.startswith("hydra"):
            _check_hydras(word, launcher(rest))
        name, _, value = word.partition("=")
        if name.strip("/ ").partition("@")[0] in groups() and not re.fullmatch(r"[\w,()\[\]* ]*", value):
            hint = "put spaces between settings" if "=" in value else "a choice is a name (--help lists them), not a path"
            raise UsageError(f"{word} is no choice of a group; {hint}")


def _meant(word: str, words: list[str]) -> str:
    """What a word that is no setting may have been meant as."""
    if spaced := re.search(r"([a-z][\w./@-]*)(?: +=| *= +) *(\S+)", " ".join(words)):
        return f"write {spaced[1]}={spaced[2]}, without spaces"
    if (folder := Path(word)).is_dir():
        return f"did you mean {'run' if (folder / CONFIG).exists() else 'results_dir'}={word}?"
    return "write name=value, without spaces, or --name value"


def given_twice(words: Iterable[str]) -> list[str]:
    """A sentence for every setting that has two values: the last one counts, as with other programs' options."""
    values: dict[str, list[str]] = {}
    for name, _, value in (word.partition("=") for word in words if not word.startswith("-")):
        values.setdefault(name, []).append(value)
    return [
        f"{name} is given twice, and {name}={given[-1]} counts; -m {name}={','.join(dict.fromkeys(given))} is a run of each"
        for name, given in values.items()
        if len(set(given)) > 1
    ]


def launcher(words: Iterable[str]) -> str:
    """The name of the launcher that the words choose."""
    return ["basic", *(word.partition("=")[2] for word in words if word.startswith("hydra/launcher="))][-1]


def _check_hydras(word: str, chosen: str) -> None:
    """Raises :class:`UsageError` for a word of Hydra's own that is not of the few that are taken."""
    name, _, value = word.partition("=")
    if name == "hydra/launcher" and value in LAUNCHERS:
        if not _is_there(LAUNCHERS[value].module):
            raise UsageError(f"the launcher {value} is not installed; {how_to_add(LAUNCHERS[value].extra)}")
        return
    setting, settings = name.removeprefix("hydra.launcher."), LAUNCHERS[chosen].settings if chosen in LAUNCHERS else {}
    if setting == name or not any(setting in launcher.settings for launcher in LAUNCHERS.values()):
        if name == "hydra/sweeper":
            raise UsageError(f"{word} is not for the command line; uarm-rl sweep searches, with Optuna")
        own = ", ".join(f"hydra.launcher.{one}" for one in settings)
        raise UsageError(
            f"{word} is not for the command line; of Hydra's own settings only hydra/launcher={'|'.join(LAUNCHERS)} is"
            f"{f', and of this launcher {own}' if own else ''}"
        )
    if setting not in settings:
        having = [launcher for launcher, one in LAUNCHERS.items() if setting in one.settings]
        raise UsageError(f"{name} is for hydra/launcher={' or '.join(having)}, and the launcher here is {chosen}")
    if not re.fullmatch(settings[setting], value):
        kind = {_COUNT: "a whole number above 0", _NAME: "a name"}.get(settings[setting], settings[setting].split("|")[0])
        raise UsageError(f"{name} must be {kind}, got {value!r:.60}")


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of the package around it
        return False
