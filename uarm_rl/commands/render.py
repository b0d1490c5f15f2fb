"""Film a policy as GIF or MP4.

Examples:
  uarm-rl render run=results/adaptive-penalty/seed0   episode.gif in the run's folder
  uarm-rl render run=results/uniform-plain/seed0 position=[0.25,0.1,0.03] out=shaking.gif
  uarm-rl render run=results/adaptive-penalty/seed0 policy=ik out=ik.gif
  uarm-rl render run=results/adaptive-penalty/seed0 sim=mujoco out=mujoco.gif  in the other engine
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from uarm_rl import checks, workers
from uarm_rl.configuration import Settings, build_env
from uarm_rl.evaluation.film import check_film, film, write_film
from uarm_rl.sim.simulated_arm import SimulatedArm
from uarm_rl.trained import in_engine, load_policy, read_run


def run(settings: Settings) -> None:
    """Film a policy."""
    workers.one_thread()
    width, height = (checks.integer(name, settings[name], low=64, high=4096) for name in ("width", "height"))
    episodes = checks.integer("episodes", settings["episodes"], low=1)
    first_seed = checks.integer("seed", settings["seed"], low=0)
    resets: list[dict[str, Any]] = [{"seed": first_seed + number} for number in range(episodes)]
    if settings["position"] is not None:
        resets = [{"options": {"object_position": checks.position("position", settings["position"])}}]
    run_dir = checks.path("run", settings["run"])
    out = output(settings)
    check_film(out, width, height)
    run_settings = in_engine(read_run(run_dir), settings.get("sim"))
    policy = load_policy(run_dir, settings["policy"], run_settings)
    control_hz = run_settings["control_hz"]
    env = build_env(
        run_settings,
        time_limit_s=run_settings["time_limit_s"],
        render_mode="rgb_array_list",
        picture_size=(width, height),
    )
    try:
        assert isinstance(env.arm, SimulatedArm)
        pixel = partial(env.arm.pixel, width, height)
        pictures, successes = film(env, policy, resets, control_hz=control_hz, pixel=pixel)
    finally:
        env.close()
    write_film(out, pictures, frames_per_second=control_hz)
    print(f"{out}: {len(pictures)} pictures, {successes} of {len(resets)} episodes successful")


def output(settings: Settings) -> Path:
    """The film."""
    return checks.path("out", settings["out"]) if settings["out"] else checks.path("run", settings["run"]) / "episode.gif"
