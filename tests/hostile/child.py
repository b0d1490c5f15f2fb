"""One case, in an interpreter of its own: arms the hook and becomes the command line. ``child.py BOX CONTROL WORDS...``"""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).parents[2])  # the checkout; never the working directory, which is hostile

from tests.hostile.controls import CONTROLS  # noqa: E402
from tests.hostile.hook import Watch  # noqa: E402

MEMORY_BYTES = 8 << 30
FILE_BYTES = 1 << 30


def main(box: Path, control: str, words: list[str]) -> None:
    for kind, most in ((resource.RLIMIT_AS, MEMORY_BYTES), (resource.RLIMIT_CORE, 0), (resource.RLIMIT_FSIZE, FILE_BYTES)):
        resource.setrlimit(kind, (most, most))
    if control:
        CONTROLS[control].apply()
    watch = Watch(box / "events", map(Path, os.environ["HOSTILE_INSIDE"].split(os.pathsep)))
    sys.addaudithook(watch)
    sys.argv = ["uarm-rl", *words]
    from uarm_rl.cli import main as command

    command()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
