"""What the commands at the real arm share: the camera that a configuration names."""

from __future__ import annotations

from typing import Any

from uarm_rl.configuration import Settings, build
from uarm_rl.real import session


def open_camera(settings: Settings) -> Any:
    """The configured camera; that of an emulated arm if no other is named."""
    camera = settings["camera"]
    if camera["name"] == "openmv" and camera["port"] is None and settings["port"] and session.is_emulated(settings["port"]):
        camera = camera | {"port": session.emulated_camera(settings["port"])}
    return build("camera", camera)
