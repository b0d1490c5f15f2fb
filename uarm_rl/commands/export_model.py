"""Write the arm's model for other programs: as URDF, for ROS and most others, and as MJCF, for MuJoCo.

Examples:
  uarm-rl export-model out=model                      model/uarm_swift_pro.urdf and model/uarm_swift_pro.xml
"""

from __future__ import annotations

from pathlib import Path

from uarm_rl import checks, files
from uarm_rl.checks import UsageError, how_to_add
from uarm_rl.configuration import Settings
from uarm_rl.sim.simulated_arm import urdf


def run(settings: Settings) -> None:
    """Write the models; without MuJoCo, the URDF alone."""
    folder = output(settings)
    source = urdf()
    targets = {suffix: folder / source.with_suffix(suffix).name for suffix in (".urdf", ".xml")}
    for path in targets.values():
        if path.exists() or path.is_symlink():
            raise UsageError(f"{path} exists already; remove it, or choose another folder with out=FOLDER")
    contents = {".urdf": files.read(source)}
    try:
        from uarm_rl.sim.mujoco_arm import mjcf

        contents[".xml"] = mjcf().encode()
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        print(f"without {targets['.xml'].name}, because MuJoCo, which writes it, is not installed; {how_to_add('mujoco')}")
    folder.mkdir(parents=True, exist_ok=True)
    for suffix, content in contents.items():
        files.replace(targets[suffix], content)
        print(targets[suffix])


def output(settings: Settings) -> Path:
    """The folder of the models."""
    return checks.path("out", settings["out"])
