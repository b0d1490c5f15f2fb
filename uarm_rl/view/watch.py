"""A page that shows an arm live: the arm in 3-D, words, curves, a camera's picture, and how fast it goes.

The page has no way to the arm: what its buttons change is read here, by whoever plays something back on it.
"""

from __future__ import annotations

import io
import math
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from uarm_rl.sim.simulated_arm import Scene
from uarm_rl.task import kinematics
from uarm_rl.task.kinematics import Vector
from uarm_rl.view.guard import guarded_server
from uarm_rl.view.scene import ArmView, viser

_PATIENCE_S: Final = 0.05  # how soon a button is obeyed
_SPEEDS: Final = ("0.1 x", "0.25 x", "0.5 x", "1 x", "2 x", "4 x")
_REFERENCE_RGB: Final = (230, 120, 0)
_EYE_M: Final = (1.02, -0.63, 0.66)
_CENTRE_M: Final = (0.13, 0.0, 0.09)
_NARROW_M: Final = 0.6  # is seen from side to side in a narrow window,
_UPWARDS: Final = 0.42  # with the centre so far from the window's to its upper edge
_SERIES_RGB: Final = ("#0072B2", "#D55E00")


def _make_room(client: viser.ClientHandle) -> None:
    """Move the arm to the upper part of a narrow window, whose lower part the panel covers."""
    if client.camera.aspect >= 1.0:
        return
    forward = np.array(_CENTRE_M) - _EYE_M
    distance_m = float(np.linalg.norm(forward))
    up = np.array([0.0, 0.0, 1.0]) - forward * forward[2] / distance_m**2
    half_height_m = _NARROW_M / 2.0 / client.camera.aspect
    with client.atomic():
        client.camera.fov = 2.0 * math.atan(half_height_m / distance_m)
        client.camera.look_at = _CENTRE_M - _UPWARDS * half_height_m * up / np.linalg.norm(up)


class Page:
    """A page with an arm. ``stop`` ends every wait; ``plays``: it has buttons that start, pause, go on and set the pace."""

    def __init__(self, server: viser.ViserServer, stop: threading.Event, *, object_size_m: float, plays: bool) -> None:
        self._server, self._stop = server, stop
        self.arm = ArmView(server, object_size_m=object_size_m, hose=True)
        self.arm.pose(kinematics.HOME_JOINTS_RAD)  # until there is something to show
        server.scene.configure_default_lights(cast_shadow=False)  # they reach no further than a part of the table
        server.initial_camera.fov = math.radians(35.0)
        server.initial_camera.position, server.initial_camera.look_at = _EYE_M, _CENTRE_M
        server.on_client_connect(_make_room)
        self._reference: Any = None
        self._words = server.gui.add_markdown("")
        self._said = ""
        self._paused, self._skips, self._due_s = False, threading.Event(), 0.0
        self._curves: dict[str, Any] = {}
        self._picture: Any = None
        self._speed: Any = None
        if plays:
            self._pause = server.gui.add_button("Pause")
            self._pause.on_click(lambda _: self._toggle())
            server.gui.add_button("Next position").on_click(lambda _: self._skips.set())
            self._speed = server.gui.add_dropdown("Speed", _SPEEDS, initial_value="1 x")

    def _toggle(self) -> None:
        self._paused = not self._paused
        self._pause.label = "Start" if self._paused else "Pause"

    @property
    def stopped(self) -> bool:
        """Whether all is to end."""
        return self._stop.is_set()

    @property
    def watched(self) -> bool:
        """Whether anybody has the page open."""
        return bool(self._server.get_clients())

    def skips(self) -> bool:
        """Whether the next position was asked for since the last time that this was asked."""
        asked = self._skips.is_set()
        self._skips.clear()
        return asked

    def wait(self, seconds: float) -> bool:
        """Let so much of the arm's time pass, at the pace that was chosen, longer while paused; false if all is to end.

        Time that was lost before, in drawing, is caught up with.
        """
        pace = float(self._speed.value.split()[0]) if self._speed else 1.0
        self._due_s = max(self._due_s, time.monotonic() - 2.0 * _PATIENCE_S) + seconds / pace
        while not self._stop.is_set() and not self._skips.is_set():
            left_s = self._due_s - time.monotonic()
            if left_s <= 0.0 and not self._paused:
                break
            self._stop.wait(_PATIENCE_S if self._paused else min(left_s, _PATIENCE_S))
        return not self._stop.is_set()

    def say(self, text: str) -> None:
        """Markdown above the buttons."""
        if text != self._said:
            self._said = self._words.content = text

    def show(self, scene: Scene, target_m: Vector) -> None:
        """Show a scene of the simulation, and mark the target."""
        with self._server.atomic():
            self.arm.pose(scene.joints_rad, scene.compression_m)
            self.arm.put_object_at((scene.object[:3], scene.object[3:]))
            self.arm.put_obstacles(scene.obstacles)
            self.arm.mark_target(target_m)

    def show_arm(
        self, joints_rad: Vector, target_m: Any, reference_m: Any, *, object_size_m: Sequence[float], holds: bool
    ) -> None:
        """Show a real arm: the target, if it is known, with the object under it, and where the cup was sent to.

        What it ``holds``, unless it stands on its place still, hangs from the cup.
        """
        with self._server.atomic():
            self.arm.pose(joints_rad)
            self.arm.size_object(object_size_m)
            self.arm.put_object(self.arm.cup_m() if holds and target_m is None else target_m)
            self.arm.mark_target(target_m)
            if self._reference is None:
                sphere = self._server.scene.add_icosphere("/reference", 0.004, color=_REFERENCE_RGB)
                self._reference = sphere
            self._reference.position = tuple(map(float, reference_m))

    def draw_curve(self, title: str, x: Vector, y: Vector, unit: str) -> None:
        """Draw a curve, or draw it anew, over the episodes."""
        data = (np.asarray(x, float), np.asarray(y, float))
        # viser's chart loses a range that it finds itself when the page turns dark, so it is told.
        scales = {"x": viser.uplot.Scale(time=False, range=(0.0, float(data[0][-1]))), "y": viser.uplot.Scale(auto=True)}
        if title in self._curves:
            self._curves[title].data, self._curves[title].scales = data, scales
            return
        colour = _SERIES_RGB[len(self._curves) % len(_SERIES_RGB)]
        self._curves[title] = self._server.gui.add_uplot(
            data,
            (viser.uplot.Series(label="episode"), viser.uplot.Series(label=unit, stroke=colour, width=2)),
            title=title,
            scales=scales,
            aspect=2.0,
        )

    def show_picture(self, png: bytes) -> None:
        """Show a camera's picture; one that cannot be read is left out."""
        from PIL import Image, UnidentifiedImageError

        try:
            picture = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
        except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError):
            return
        if self._picture is None:
            self._picture = self._server.gui.add_image(picture, label="Camera", format="jpeg")
        else:
            self._picture.image = picture


@contextmanager
def page(port: int, stop: threading.Event, *, title: str, object_size_m: float, plays: bool) -> Iterator[tuple[Page, str]]:
    """A page, and its address with the secret in it; see :mod:`uarm_rl.view.guard`."""
    with guarded_server(port, title) as (server, address):
        yield Page(server, stop, object_size_m=object_size_m, plays=plays), address
