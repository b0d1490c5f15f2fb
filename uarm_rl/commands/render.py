"""Film a policy as GIF or MP4.

Examples:
  uarm-rl render run=results/adaptive-penalty/seed0   episode.gif in the run's folder
  uarm-rl render run=results/uniform-plain/seed0 position=[0.25,0.1,0.03] out=shaking.gif
  uarm-rl render run=results/adaptive-penalty/seed0 policy=ik out=ik.gif
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from uarm_rl import checks
from uarm_rl.configuration import Settings, build_env, load_policy, read_run
from uarm_rl.evaluation.film import film, write_film


def run(settings: Settings) -> None:
    """Film a policy."""

    run_dir = checks.path("run", settings["run"])
    run_settings = read_run(run_dir)
    policy = load_policy(run_dir, settings["policy"], run_settings)
    out = checks.path("out", settings["out"]) if settings["out"] else run_dir / "episode.gif"
    size = (checks.integer("width", settings["width"], low=64), checks.integer("height", settings["height"], low=64))
    episodes = checks.integer("episodes", settings["episodes"], low=1)
    first_seed = checks.integer("seed", settings["seed"], low=0)
    resets: list[dict[str, Any]] = [{"seed": first_seed + number} for number in range(episodes)]
    if settings["position"] is not None:
        resets = [{"options": {"object_position": np.array(settings["position"], np.float64)}}]
    time_limit_s = run_settings["time_limit_s"]
    with_pictures = partial(build_env, run_settings, time_limit_s=time_limit_s, render_mode="rgb_array_list", picture_size=size)
    env = with_pictures()
    try:
        pictures, successes = film(env, policy, resets)
    finally:
        env.close()
    write_film(out, pictures, frames_per_second=run_settings["control_hz"])
    print(f"{out}: {len(pictures)} pictures, {successes} of {len(resets)} episodes successful")
