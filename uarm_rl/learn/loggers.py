"""Where the rows of a training go besides ``progress.csv``, which is always written: into tools to watch many runs with.

Each is made at once and opened when the training begins; only then is its library imported. Without a word nothing leaves
the machine. A training that is resumed is a second run there, from the experiences on at which it goes on.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from uarm_rl import checks

#: Takes the numbers of an episode by their columns in ``progress.csv``, and how many experiences there are.
Write = Callable[[Mapping[str, float], int], None]


class Logger(Protocol):
    """``needs`` is the module that it cannot do without, and the extra that installs it; empty for none."""

    needs: str

    def opened(self, run_dir: Path, settings: Mapping[str, Any]) -> AbstractContextManager[Write]:
        """A context for one run, whose ``settings`` are flat, with their dotted names."""
        ...


class LoggerError(Exception):
    """A place that no log can be written to; the message is a sentence."""


def numbers(row: Mapping[str, object]) -> dict[str, float]:
    """What of an episode's row is a number."""
    return {name: value for name, value in row.items() if isinstance(value, (int, float))}


class Csv:
    """``progress.csv`` and nothing else."""

    needs = ""

    @contextmanager
    def opened(self, run_dir: Path, settings: Mapping[str, Any]) -> Iterator[Write]:
        yield lambda row, experiences: None


class TensorBoard:
    """Event files in the run's folder, for ``tensorboard --logdir results``."""

    needs = "tensorboard"

    @contextmanager
    def opened(self, run_dir: Path, settings: Mapping[str, Any]) -> Iterator[Write]:
        from torch.utils.tensorboard import SummaryWriter

        with SummaryWriter(_plain(run_dir / "tensorboard")) as writer:

            def write(row: Mapping[str, float], experiences: int) -> None:
                for name, value in row.items():
                    writer.add_scalar(name, value, experiences)

            yield write


class WeightsAndBiases:
    """``mode`` offline: a folder in the run's, for ``wandb sync``; online: the account that ``wandb login`` named."""

    needs = "wandb"

    def __init__(self, project: str, mode: str) -> None:
        self._words = {
            "project": checks.text("logger.project", project),
            "mode": checks.one_of("logger.mode", mode, ("offline", "online")),
        }

    @contextmanager
    def opened(self, run_dir: Path, settings: Mapping[str, Any]) -> Iterator[Write]:
        _plain(run_dir / "wandb")
        wandb: Any = import_module("wandb")  # its types would be those of whichever release is there, or of none
        quiet = wandb.Settings(silent=True, console="off", disable_git=True, disable_code=True, x_disable_stats=True)
        words = {**self._words, "dir": str(run_dir), "group": run_dir.parent.name, "name": _name(run_dir)}
        with wandb.init(**words, config=dict(settings), settings=quiet) as run:
            yield lambda row, experiences: run.log(dict(row), step=experiences)


class MLflow:
    """A database file beside the runs, for ``mlflow ui``, or a server: ``uri`` says which."""

    needs = "mlflow"

    def __init__(self, experiment: str, uri: str) -> None:
        self._experiment, self._uri = checks.text("logger.experiment", experiment), checks.text("logger.uri", uri)

    @contextmanager
    def opened(self, run_dir: Path, settings: Mapping[str, Any]) -> Iterator[Write]:
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        mlflow: Any = import_module("mlflow")
        for name in ("alembic", "mlflow"):  # they tell of every step to a new database
            logging.getLogger(name).setLevel(logging.WARNING)
        mlflow.set_tracking_uri(self._uri)
        mlflow.set_experiment(self._experiment)
        with mlflow.start_run(run_name=_name(run_dir)):
            mlflow.log_params(dict(settings))
            yield lambda row, experiences: mlflow.log_metrics(dict(row), step=experiences)


class Trackio:
    """A database file in ``folder``, for ``trackio show``."""

    needs = "trackio"

    def __init__(self, project: str, folder: str) -> None:
        self._project, self._folder = checks.text("logger.project", project), checks.path("logger.folder", folder)

    @contextmanager
    def opened(self, run_dir: Path, settings: Mapping[str, Any]) -> Iterator[Write]:
        os.environ["TRACKIO_DIR"] = str(self._folder.absolute())  # read when it is imported
        trackio: Any = import_module("trackio")
        with redirect_stdout(sys.stderr):  # what it says is no result of the command
            run = trackio.init(
                project=self._project,
                name=_name(run_dir),
                group=run_dir.parent.name,
                config=dict(settings),
                embed=False,
                auto_log_gpu=False,
                auto_log_cpu=False,
            )
        try:
            yield lambda row, experiences: run.log(dict(row), step=experiences)
        finally:
            with redirect_stdout(sys.stderr):
                trackio.finish()


def _name(run_dir: Path) -> str:
    return f"{run_dir.parent.name}/{run_dir.name}"


def _plain(folder: Path) -> Path:
    """A folder inside a run's, if nothing else waits in its place."""
    if folder.is_symlink():
        raise LoggerError(f"{folder} is a link; remove it, or leave logger= out")
    return folder
