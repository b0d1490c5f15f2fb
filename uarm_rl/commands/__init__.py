"""The commands, one module each: its docstring is its help, ``run(settings)`` carries it out.

Read ``train.py`` first. ``uarm-rl run-real`` is ``run_real.py`` with the configuration ``conf/run_real.yaml``: a new command is
a module here, a line in ``COMMANDS`` and a configuration file. A command may say with ``output(settings)`` to which file or
folder it would write: jobs of a multirun must not share one. One that always has many jobs has ``launch(jobs, words)`` instead
of ``run``, one that searches ``search(space, words)``; one that can carry out many itself has ``side_by_side(jobs, words,
failed)`` too. What the commands share:

- ``words.py``: which words a command line may have; ``help.py`` and ``completion.py``: what there is to write
- ``errors.py``: exceptions as sentences
- ``submitted.py``: the lists of what was submitted to a cluster, and what its queue says
- ``arm_settings.py``: the camera that a configuration names

Uses every other wing; only ``cli.py`` uses this one.
"""

from typing import Final

COMMANDS: Final = (
    "train",
    "evaluate",
    "report",
    "runs",
    "submit",
    "status",
    "sweep",
    "render",
    "watch",
    "export",
    "export-model",
    "run-real",
    "jog",
    "doctor",
    "calibrate-camera",
    "calibrate-hand-eye",
    "emulate",
)
