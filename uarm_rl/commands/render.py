"""Film a policy as GIF or MP4, or two of them side by side.

Examples:
  uarm-rl render run=results/adaptive-penalty/seed0   episode.gif in the run's folder
  uarm-rl render run=results/adaptive-plain/seed0 compare=results/uniform-plain/seed0 out=beside.gif
  uarm-rl render run=results/uniform-plain/seed0 position=[0.25,0.1,0.03] out=shaking.gif
  uarm-rl render run=results/adaptive-penalty/seed0 compare=ik out=ik.gif  beside the controller
  uarm-rl render run=results/adaptive-penalty/seed0 sim=mujoco out=mujoco.gif  in the other engine
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from uarm_rl import checks, progress, workers
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build_env
from uarm_rl.evaluation.film import Screen, Take, check_film, film, head_height, play, takes_of, write_film
from uarm_rl.sim.simulated_arm import CAMERA, Camera, SimulatedArm
from uarm_rl.task import kinematics, positions
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.layouts import Layout
from uarm_rl.task.obstacles import boxes
from uarm_rl.trained import in_engine, load_policy, read_run


def run(settings: Settings) -> None:
    """Film one policy, or two."""
    workers.one_thread()
    width, height = (checks.integer(name, settings[name], low=64, high=4096) for name in ("width", "height"))
    episodes = checks.integer("episodes", settings["episodes"], low=1)
    first_seed = checks.integer("seed", settings["seed"], low=0)
    resets: list[dict[str, Any]] = [{"seed": first_seed + number} for number in range(episodes)]
    if settings["position"] is not None:
        position = positions.within_reach("position", checks.position("position", settings["position"]))
        resets = [{"options": Layout(position, boxes("obstacles", settings["obstacles"])).options()}]
    elif settings["obstacles"] is not None:
        raise UsageError("obstacles stand around an object that is told: give position=[x,y,z] too")
    shows = _shows(settings)
    out = output(settings)
    check_film(out, width, height)
    control_hz, time_limit_s = shows[0][1]["control_hz"], settings["time_limit_s"]
    pace = checks.integer("pictures_per_second", settings["pictures_per_second"], low=1, high=control_hz)
    if control_hz % pace:
        raise ValueError(f"pictures_per_second must divide control_hz, which is {control_hz} in this run; got {pace}")
    with ExitStack() as stack:
        screens: list[Screen] = []
        arms, takes = [], []
        for policy, run_settings, _ in shows:
            env = stack.enter_context(closing(_stage(run_settings, time_limit_s)))
            assert isinstance(env.arm, SimulatedArm)
            arms.append(env.arm)
            takes.append([play(env, policy, reset) for reset in resets])
            # The other one gets the same.
            resets = [{"options": Layout(take.episode.trace[0, 6:9], take.scenes[0].obstacles).options()} for take in takes[0]]
        full = width // len(shows), height
        size = full[0], height - head_height(*full)
        camera = _camera([take for several in takes for take in several], *size)
        for arm, several, (_, _, title) in zip(arms, takes, shows, strict=True):
            draw = partial(_draw, arm, camera, size)
            screens.append(Screen(title, full, several, draw, partial(camera.pixel, *size)))
        every = control_hz // pace
        total = sum(len(steps) for _, steps in takes_of(screens, control_hz=control_hz, every=every))
        pictures = progress.shown(film(screens, control_hz=control_hz, every=every), total, "picture", out.name)
        write_film(out, pictures, frames_per_second=pace)
    for screen in screens:
        successes = sum(take.episode.success for take in screen.takes)
        print(f"{out}: {screen.title}: {successes} of {len(screen.takes)} episodes successful, {total} pictures")


def _shows(settings: Settings) -> list[tuple[Any, Settings, str]]:
    """The policies that are shown, with the settings that each runs in and what it is called."""
    folder, other = checks.path("run", settings["run"]), settings["compare"]
    wanted: list[tuple[Path, str | None]] = [(folder, settings["policy"])]
    if other is not None:
        wanted.append((folder, "ik") if other == "ik" else (checks.path("compare", other), None))
        if wanted[0] == wanted[1]:
            raise UsageError(f"compare={other} is the run itself; name another one, or compare=ik for the controller")
    shows = []
    for run_dir, name in wanted:
        run_settings = in_engine(read_run(run_dir), settings.get("sim"))
        shows.append((load_policy(run_dir, name, run_settings), run_settings, _title(run_settings, name)))
    one, last = shows[0][1], shows[-1][1]
    for of, key in (("control_hz", None), ("sim", "object_size_m")):
        values = [each[of] if key is None else each[of][key] for each in (one, last)]
        if values[0] != values[1]:
            raise ValueError(f"compare takes a run with the same {key or of}; run has {values[0]:g} and compare {values[1]:g}")
    return shows


def _title(settings: Settings, policy: str | None) -> str:
    """What a policy is called in the report."""
    from uarm_rl.report.records import METHODS

    if policy == "ik":
        return "inverse kinematics"
    name, buffer, reward = settings["name"], settings["buffer"]["name"], settings["reward"]["name"]
    return next((one.words for one in METHODS if one.folder == name), f"{name}: {buffer}, {reward}")


def _stage(settings: Settings, time_limit_s: float | None) -> UArmSuctionEnv:
    longest_s = settings["time_limit_s"] if time_limit_s is None else time_limit_s
    return build_env(settings, time_limit_s=longest_s, render_mode="rgb_array_list", picture_size=None)


def _draw(arm: SimulatedArm, camera: Camera, size: tuple[int, int], scene: Any) -> Any:
    return arm.draw(scene, *size, camera)


def _camera(takes: Sequence[Take], width: int, height: int) -> Camera:
    """As near as shows the arm and the object wherever they go."""
    around = np.array([[0.0, 0.0, 0.05], [0.0, 0.0, -0.03], [0.03, 0.03, 0.0], [-0.03, -0.03, 0.0]])
    base = [(x, y, z) for x in (-0.07, 0.07) for y in (-0.07, 0.07) for z in (0.0, 0.15)]
    ends = [kinematics.forward(scene.joints_rad) for take in takes for scene in take.scenes]
    objects = [take.episode.trace[:, 6:9] for take in takes]
    spots = np.concatenate([*ends, *objects])
    standing = {box for take in takes for box in take.scenes[0].obstacles}
    edges = [np.add(box.centre_m, side * np.array(box.size_m)) for box in standing for side in (-0.5, 0.5)]
    return CAMERA.fitted(
        np.concatenate([base, *(spots + by for by in around), *np.array(edges).reshape(-1, 1, 3)]), width, height
    )


def output(settings: Settings) -> Path:
    """The film."""
    return checks.path("out", settings["out"]) if settings["out"] else checks.path("run", settings["run"]) / "episode.gif"
