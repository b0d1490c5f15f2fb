"""The commands, one module each: its docstring is its help, ``run(settings)`` carries it out.

A command may say with ``output(settings)`` to which file or folder it would write: jobs of a multirun must not share one.
``run_real.py`` is ``uarm-rl run-real`` with the configuration ``conf/run_real.yaml``. A new command is a module here, a line
in ``COMMANDS`` and a configuration file. ``errors.py`` turns exceptions into sentences.
"""

from typing import Final

COMMANDS: Final = (
    "train",
    "evaluate",
    "report",
    "render",
    "run-real",
    "jog",
    "doctor",
    "calibrate-camera",
    "calibrate-hand-eye",
    "emulate",
)
