"""Films of a policy, or of two side by side: the paper's supplemental video."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks, files
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import Policy
from uarm_rl.task.rollout import Episode, run_episode

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

_PAPER: Final[Colour] = (255, 255, 255)
_INK: Final[Colour] = (28, 32, 40)
_REACHED: Final[Colour] = (0, 120, 80)
_NOT_REACHED: Final[Colour] = (190, 50, 30)
_RING: Final[Colour] = (0, 90, 160)
_REST_S: Final = 0.8  # on the last picture of an episode


class Take(NamedTuple):
    """An episode, and what there was to see: a scene for every row of its trace."""

    episode: Episode
    scenes: list[Any]


class Screen(NamedTuple):
    """Where a policy is shown: its name, how a scene of it is drawn, and where in the drawing a point (m) is seen.

    A picture is the drawing below a head of words, see ``head_height``.
    """

    title: str
    size: tuple[int, int]  # of its pictures: width and height
    takes: Sequence[Take]
    draw: Callable[[Any], Picture]
    pixel: Callable[[Sequence[float]], tuple[float, float]]


def head_height(width: int, height: int) -> int:
    """How many rows of a screen's picture of this size are above the drawing."""
    return round(2.9 * _letters(width, height))


def _letters(width: int, height: int) -> int:
    """The height of letters, pixels."""
    return max(10, min(height // 16, width // 19))


def play(env: UArmSuctionEnv, policy: Policy, reset: dict[str, Any]) -> Take:
    """One episode. ``env`` must have been made with ``render_mode="rgb_array_list"``; what it renders are the scenes."""
    return Take(run_episode(env, policy, **reset), env.render())


def film(screens: Sequence[Screen], *, control_hz: int, every: int = 1) -> Iterator[Picture]:
    """Pictures of the takes, one after the other, and of several screens beside each other: of each ``every``-th control step,
    and of the last.

    On every screen stand its title, the time and the distance from cup to target, and the end; a ring marks the target. Who has
    ended before another rests.
    """
    for moments in takes_of(screens, control_hz=control_hz, every=every):
        shown: list[tuple[int, Picture]] = [(-1, np.empty(0, np.uint8))] * len(screens)
        number = moments[0]
        for step in moments[1]:
            for place, screen in enumerate(screens):
                take = screen.takes[number]
                at = min(step, len(take.scenes) - 1)
                if shown[place][0] != at:
                    shown[place] = at, _captioned(screen, take, at, control_hz)
            yield np.hstack([picture for _, picture in shown])


def takes_of(screens: Sequence[Screen], *, control_hz: int, every: int) -> list[tuple[int, list[int]]]:
    """The control steps that a film shows, take by take: its number, and the steps, the last one repeated."""
    shown = []
    for number in range(len(screens[0].takes)):
        last = max(len(screen.takes[number].scenes) for screen in screens) - 1
        rest = [last] * (1 + round(_REST_S * control_hz / every))
        shown.append((number, [*range(0, last, every), *rest]))
    return shown


def _captioned(screen: Screen, take: Take, at: int, control_hz: int) -> Picture:
    """The drawing with a ring where the target is, below its words."""
    from PIL import Image, ImageDraw, ImageFont

    state = take.episode.trace[at]
    drawing = Image.fromarray(screen.draw(take.scenes[at]))
    _ring(drawing, *screen.pixel(state[6:9]))
    width, height = screen.size
    image = Image.new("RGB", (width, height), _PAPER)
    image.paste(drawing, (0, height - drawing.height))
    draw, size = ImageDraw.Draw(image), _letters(width, height)
    margin, line = size / 2, 1.75 * size
    draw.text((margin, 0.4 * size), screen.title, fill=_INK, font=ImageFont.load_default(size))
    font = ImageFont.load_default(0.85 * size)
    words = f"{at / control_hz:.2f} s    {1000.0 * math.dist(state[3:6], state[6:9]):.1f} mm    "
    draw.text((margin, line), words, fill=_INK, font=font)
    if at == len(take.scenes) - 1:
        end, colour = ("reached", _REACHED) if take.episode.success else ("not reached", _NOT_REACHED)
        place = margin + font.getlength(words), line
        draw.text(place, end, fill=colour, font=font, stroke_width=size / 40, stroke_fill=colour)
    return np.asarray(image)


def _ring(image: Any, x: float, y: float) -> None:
    """Draw a ring, smoothly: four times as large first."""
    from PIL import Image, ImageDraw

    radius, width = image.height / 40, max(1.0, image.height / 300)
    box = round(radius + width) + 1
    left, top = math.floor(x) - box, math.floor(y) - box
    mask = Image.new("L", (8 * box, 8 * box))
    cx, cy, r = 4 * (x - left), 4 * (y - top), 4 * radius
    ImageDraw.Draw(mask).ellipse((cx - r, cy - r, cx + r, cy + r), outline=255, width=round(4 * width))
    image.paste(_RING, (left, top), mask.resize((2 * box, 2 * box), Image.Resampling.BOX))


def check_film(path: Path, width: int, height: int) -> None:
    """Raises ``ValueError``, ``UsageError`` or ``OSError`` if no film of this size can be written there, before it is begun."""
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"out must end in .gif or .mp4, got {path}")
    files.check_place(checks.place_of(path))
    if path.suffix == ".mp4" and not find_spec("imageio_ffmpeg"):
        raise ValueError(f"an .mp4 needs an extra; choose out=FILE.gif, or {checks.how_to_add('video')}")
    if path.suffix == ".mp4" and (width % 2 or height % 2):
        raise ValueError(f"an .mp4 needs even width and height, got {width} x {height}")


def write_film(path: Path, pictures: Iterable[Picture], *, frames_per_second: float) -> None:
    """Write pictures as GIF (Pillow) or MP4 (imageio), as the ending says, as they come; see ``check_film``."""
    if path.suffix == ".gif":
        from PIL import Image

        several = iter(pictures)
        first = next(several)
        # One palette for all frames: colours do not flicker and frames compress against each other.
        swatch = np.tile(np.array([_INK, _REACHED, _NOT_REACHED, _RING], np.uint8), (8, first.shape[1], 1))[:, : first.shape[1]]
        palette = Image.fromarray(np.concatenate([first, swatch])).quantize(128)
        frames = (
            Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in chain([first], several)
        )
        film = io.BytesIO()
        options = {"save_all": True, "duration": round(1000 / frames_per_second), "loop": 0, "optimize": True}
        next(frames).save(film, "GIF", append_images=frames, **options)
        files.replace(path, film.getvalue())
        return
    import imageio

    with tempfile.TemporaryDirectory() as folder:
        film_path = Path(folder) / path.name
        writer: Any = imageio.get_writer(film_path, fps=frames_per_second, codec="libx264", macro_block_size=2)
        with writer:
            for picture in pictures:
                writer.append_data(picture)
        files.replace(path, film_path.read_bytes())
