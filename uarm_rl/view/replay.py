"""Recorded episodes as pages that need no server: the arms beside each other, to be turned and scrubbed."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from typing import TYPE_CHECKING, Final, NamedTuple

from uarm_rl.view.scene import TABLE_M, ArmView  # first: it says in a sentence if viser is not installed

# isort: split
import viser

if TYPE_CHECKING:
    from uarm_rl.task.kinematics import Vector

_REST_S: Final = 1.0  # at the end, before it begins again
_GAP_M: Final = 0.02  # between two tables
_DATA: Final = re.compile(r'(window\.__VISER_EMBED_DATA__=")([^"]*)(")')


class Episode(NamedTuple):
    """One arm's episode: a state each ``step_s``, with joint1..joint3 (rad), cup and target (m), shape (n, 3) each.

    Who has ended earlier than another rests.
    """

    title: str
    rgb: tuple[int, int, int]
    joints_rad: Vector
    cups_m: Vector
    targets_m: Vector


class Replays(NamedTuple):
    """viser's own page, cut in two where the recording belongs, and recordings, as base64."""

    before: str
    after: str
    recordings: list[str]


def record(replays: Sequence[Sequence[Episode]], *, step_s: float, object_size_m: float = 0.03) -> Replays:
    """A recording of each of the ``replays``: its episodes run beside each other, from left to right.

    The same episodes make the same bytes.
    """
    pages = [_record(episodes, step_s, object_size_m) for episodes in replays]
    parts = [_DATA.split(page) for page in pages]
    (before, opening, _, closing, after), *_ = parts
    return Replays(before + opening, closing + after, [part[2] for part in parts])


def _record(episodes: Sequence[Episode], step_s: float, object_size_m: float) -> str:
    """One recording as viser's page, in a server of its own: one that was used before remembers, in any order, what it lost."""
    with redirect_stdout(StringIO()):  # viser says unasked where it serves, which here nobody looks at
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            return _played(server, episodes, step_s, object_size_m)
        finally:
            server.stop()


def _played(server: viser.ViserServer, episodes: Sequence[Episode], step_s: float, object_size_m: float) -> str:
    width = TABLE_M[1] + _GAP_M
    server.initial_camera.fov = math.radians(35.0)
    server.initial_camera.position = (0.9 + 0.35 * len(episodes), 0.0, 0.75)
    server.initial_camera.look_at = (0.1, 0.0, 0.1)
    arms = []
    for number, episode in enumerate(episodes):
        # Seen from the front, where the camera is, y points to the right.
        place = (0.0, width * (number - (len(episodes) - 1) / 2.0), 0.0)
        arm = ArmView(server, f"/arm{number}", place_m=place, object_size_m=object_size_m, title=episode.title)
        arm.draw_path(episode.cups_m, episode.rgb)
        arms.append(arm)
    serializer = server.get_scene_serializer()
    for step in range(max(len(episode.joints_rad) for episode in episodes)):
        for arm, episode in zip(arms, episodes, strict=True):
            if step < len(episode.joints_rad):
                arm.pose(episode.joints_rad[step])
                arm.put_object(episode.targets_m[step])
                arm.mark_target(episode.targets_m[step])
        serializer.insert_sleep(step_s)
    serializer.insert_sleep(_REST_S)
    return str(serializer.as_html())
