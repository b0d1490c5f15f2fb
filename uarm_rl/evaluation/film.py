"""Films of a policy: the paper's supplemental video."""

from __future__ import annotations

import io
import math
import tempfile
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uarm_rl import checks, files
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import Policy
from uarm_rl.task.rollout import run_episode

Picture = NDArray[np.uint8]
Pixel = Callable[[Sequence[float]], tuple[float, float]]


def film(
    env: UArmSuctionEnv, policy: Policy, resets: Sequence[dict[str, Any]], *, control_hz: int, pixel: Pixel
) -> tuple[list[Picture], int]:
    """Pictures of one episode for every keyword set of ``resets``, one a control step, and the number of successes.

    ``env`` must have been made with ``render_mode="rgb_array_list"``; ``pixel`` tells where in them a point (m) is seen. The
    target is marked; time, distance from cup to target and success are written in.
    """
    pictures: list[Picture] = []
    successes = 0
    for reset in resets:
        episode = run_episode(env, policy, **reset)
        successes += episode.success
        last = len(episode.trace) - 1
        for number, (picture, state) in enumerate(zip(env.render(), episode.trace, strict=True)):
            text = f"{number / control_hz:5.2f} s   {1000.0 * math.dist(state[3:6], state[6:9]):5.1f} mm"
            end = "" if number < last else "   reached" if episode.success else "   not reached"
            pictures.append(_captioned(picture, text + end, pixel(state[6:9])))
        pictures += [pictures[-1]] * (control_hz // 2)  # rest on the last picture for half a second
    return pictures, successes


def _captioned(picture: Picture, text: str, target: tuple[float, float]) -> Picture:
    """The picture with a caption, and a ring where the target is."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    size = max(10, image.height // 20)
    x, y = target
    radius = image.height / 45
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=(20, 20, 20), width=max(1, image.height // 240))
    draw.text((size / 2, size / 2), text, fill=(20, 20, 20), font=ImageFont.load_default(size))
    return np.asarray(image)


def check_film(path: Path, width: int, height: int) -> None:
    """Raises :class:`ValueError` or :class:`OSError` if no film of this size can be written there, before it is begun."""
    if path.suffix not in (".gif", ".mp4"):
        raise ValueError(f"out must end in .gif or .mp4, got {path}")
    if not path.parent.is_dir():
        raise ValueError(f"there is no folder {path.parent} for {path.name}; make it first, or give another out=FILE")
    files.check_place(path)
    if path.suffix == ".mp4" and not find_spec("imageio_ffmpeg"):
        raise ValueError(f"an .mp4 needs an extra; choose out=FILE.gif, or {checks.how_to_add('video')}")
    if path.suffix == ".mp4" and (width % 2 or height % 2):
        raise ValueError(f"an .mp4 needs even width and height, got {width} x {height}")


def write_film(path: Path, pictures: Sequence[Picture], *, frames_per_second: int) -> None:
    """Write pictures as GIF (Pillow) or MP4 (imageio), as the ending says; see ``check_film``."""
    if path.suffix == ".gif":
        from PIL import Image

        # One palette for all frames: colours do not flicker and frames compress against each other.
        palette = Image.fromarray(np.concatenate(pictures[:: max(1, len(pictures) // 8)])).quantize(128)
        frames = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        duration_ms = round(1000 / frames_per_second)
        film = io.BytesIO()
        options = {"save_all": True, "append_images": frames[1:], "duration": duration_ms, "loop": 0, "optimize": True}
        frames[0].save(film, "GIF", **options)
        files.replace(path, film.getvalue())
        return
    import imageio.v3 as imageio

    with tempfile.TemporaryDirectory() as folder:
        film_path = Path(folder) / path.name
        imageio.imwrite(film_path, np.stack(pictures), fps=frames_per_second, codec="libx264", macro_block_size=2)
        files.replace(path, film_path.read_bytes())
