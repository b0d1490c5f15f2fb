"""Films of a policy: the paper's supplemental video."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uarm_rl import files
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import Policy
from uarm_rl.task.rollout import run_episode

Picture = NDArray[np.uint8]


def film(env: UArmSuctionEnv, policy: Policy, resets: Sequence[dict[str, Any]]) -> tuple[list[Picture], int]:
    """Pictures of one episode for every keyword set of ``resets``, one a control step, and the number of successes.

    ``env`` must have been made with ``render_mode="rgb_array_list"``.
    """
    pictures: list[Picture] = []
    successes = 0
    for reset in resets:
        successes += run_episode(env, policy, **reset).success
        pictures += env.render()
        pictures += [pictures[-1]] * 10  # rest on the last picture for half a second
    return pictures, successes


def write_film(path: Path, pictures: Sequence[Picture], *, frames_per_second: int) -> None:
    """Write pictures as GIF (Pillow) or MP4 (imageio). Raises :class:`ValueError` for another ending or a missing extra."""
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
    elif path.suffix == ".mp4":
        try:
            import imageio.v3 as imageio
        except ImportError:
            raise ValueError("an .mp4 needs the extra: pip install 'uarm-rl[video]'; or choose out=FILE.gif") from None
        with tempfile.TemporaryDirectory() as folder:
            film_path = Path(folder) / path.name
            imageio.imwrite(film_path, np.stack(pictures), fps=frames_per_second, codec="libx264")
            files.replace(path, film_path.read_bytes())
    else:
        raise ValueError(f"out must end in .gif or .mp4, got {path}")
