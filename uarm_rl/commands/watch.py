"""Show an arm live in a browser: a policy, a training in progress, or the real arm.

Examples:
  uarm-rl watch run=results/adaptive-plain/seed0      its policy tries position after position
  uarm-rl watch run=results/mine/seed0                a training: its newest policy, and its curves
  uarm-rl watch policy=ik                             the inverse-kinematics controller
  uarm-rl watch arm=results/default/real              the arm, while run-real watch=true works in another terminal
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import count
from pathlib import Path
from typing import Any, Final

import numpy as np

from uarm_rl import checks, columns, csvfile, signals, workers
from uarm_rl.checks import UsageError
from uarm_rl.configuration import Settings, build_env, compose
from uarm_rl.files import POLICY, PROGRESS
from uarm_rl.learn import checkpoint
from uarm_rl.real import live
from uarm_rl.task import kinematics
from uarm_rl.task.env import UArmSuctionEnv
from uarm_rl.task.policy import InverseKinematicsPolicy, Policy
from uarm_rl.trained import in_engine, load_policy, policy_card, read_run
from uarm_rl.view.watch import Page, page

_LOOK_S: Final = 2.0  # how often a training is looked at
_REST_S: Final = 1.0  # at the end of a position
_IDLE_S: Final = 0.2
_ARM_S: Final = 0.05  # how often the arm's file is looked at
_GLIDE: Final = 0.3  # of the way to where the arm was read, in that time: it is read at standstill
_SILENT_S: Final = 5.0
_CURVES: Final = {"validation_success_rate": ("Validation success", "success"), "episode_return": ("Return", "return")}


def run(settings: Settings) -> None:
    """Show it until Ctrl-C."""
    workers.one_thread()
    port = checks.integer("port", settings["port"], low=0, high=65535)
    seed = checks.integer("seed", settings["seed"], low=0)
    given = [name for name in ("run", "arm") if settings[name] is not None]
    if len(given) > 1 or not (given or settings["policy"]):
        raise UsageError("watch shows one thing: give run=FOLDER, policy=ik or arm=FOLDER")
    stop = threading.Event()
    if given == ["arm"]:
        folder = checks.path("arm", settings["arm"])
        if not folder.parent.is_dir():
            raise UsageError(f"there is no folder {folder.parent}; arm takes the folder that run-real watch=true writes to")
        title, size_m = f"uarm-rl: {folder}", 0.03
    else:
        shown = _Newest(settings)
        title, size_m = f"uarm-rl: {shown.name}", float(shown.settings["sim"]["object_size_m"])
    with (
        signals.heard(lambda number: stop.set()),
        page(port, stop, title=title, object_size_m=size_m, plays=given != ["arm"]) as (one, address),
    ):
        print(f"{address}\nopen this address in a browser of this machine; Ctrl-C ends it", flush=True)
        if given == ["arm"]:
            if not (folder / live.LIVE).exists():
                meant = checks.did_you_mean(
                    str(folder), [str(path.parent) for path in folder.parent.parent.glob(f"*/*/{live.LIVE}")]
                )
                waiting = "waiting for run-real watch=true, which writes it"
                print(f"{folder} has no {live.LIVE} yet{meant}\n{waiting}", flush=True)
            _show_arm(one, folder)
        else:
            _try_positions(one, shown, seed)


class _Newest:
    """The newest policy that there is, and the curves: of a run that is trained, or of one that is training."""

    def __init__(self, settings: Settings) -> None:
        self._run_dir = None if settings["run"] is None else checks.path("run", settings["run"])
        self._wanted = settings["policy"]
        if self._run_dir is None:
            checks.one_of("policy", self._wanted, ("ik",))
            self.settings = compose("train", (f"sim={settings['sim']['name']}",) if settings.get("sim") else ())
        else:
            self.settings = in_engine(read_run(self._run_dir), settings.get("sim"))
        self.name = str(self._run_dir or "a default task")
        self.words = ""  # which policy it is
        self._policy: Policy | None = None
        self._of: object = None
        self._progress_s = 0.0
        self.policy()  # what is wrong with it shows before the page is there

    def policy(self) -> Policy | None:
        """The policy to try next; ``None`` as long as there is none."""
        if self._run_dir is None or self._wanted is not None:
            if self._policy is None:
                run_dir = self._run_dir
                self._policy = (
                    InverseKinematicsPolicy(self.settings["max_delta_rad"])
                    if run_dir is None
                    else load_policy(run_dir, self._wanted, self.settings)
                )
                self.words = "inverse kinematics"
        elif (self._run_dir / POLICY).exists():
            if self._of != POLICY:
                self._policy, self._of = load_policy(self._run_dir, None, self.settings), POLICY
                self.words = "the trained policy"
        else:
            self._from_checkpoint(self._run_dir)
        return self._policy

    def _from_checkpoint(self, run_dir: Path) -> None:
        episode = checkpoint.newest(run_dir)
        if self.settings["agent"]["name"] != "ddpg":
            self.words = "this learner's policy can be seen once it is trained"
        elif episode is None:
            self.words = "waiting for the first checkpoint"
        elif episode != self._of:
            # It may be replaced while it is read; then the next look finds the newer one.
            with suppress(checkpoint.CheckpointError, OSError):
                saved = checkpoint.read_latest(run_dir)
                if saved is not None:
                    self._policy = checkpoint.actor(saved, policy_card(self.settings), self.settings["agent"]["hidden"])
                    self._of, self.words = saved.episode, f"the policy after episode {saved.episode}"

    def draw_curves(self, one: Page) -> None:
        """Draw the training's curves, if there are any and they are new."""
        path = None if self._run_dir is None else self._run_dir / PROGRESS
        with suppress(csvfile.CsvError, OSError):  # a row may be half written
            if path is None or (changed_s := path.stat().st_mtime) == self._progress_s:
                return
            table = csvfile.read(path, columns.pick(columns.PROGRESS, "episode", *_CURVES))
            self._progress_s = changed_s
            for name, (title, unit) in _CURVES.items():
                episodes, values = np.array(table.values["episode"], float), np.array(table.values[name], float)
                known = np.isfinite(values)
                if known.any():
                    one.draw_curve(title, episodes[known], values[known], unit)


def _try_positions(one: Page, shown: _Newest, seed: int) -> None:
    """Position after position, as long as somebody looks."""
    settings = shown.settings
    env = build_env(settings, time_limit_s=settings["time_limit_s"], render_mode="rgb_array_list", picture_size=None)
    results, of = list[bool](), ""
    with closing(env):
        for number in count():
            while not one.stopped:
                shown.draw_curves(one)
                policy = shown.policy()
                if policy is not None and one.watched:
                    break
                one.say(f"**{shown.name}**\n\n{shown.words}")
                one.wait(_IDLE_S if one.watched else _LOOK_S / 2.0)
            if one.stopped:
                return
            assert policy is not None
            if shown.words != of:  # of another policy
                results, of = [], shown.words
            head = f"**{shown.name}**\n\n{shown.words}"
            tried = f"{sum(results)} of {len(results)} reached" if results else ""
            if _try_position(one, env, policy, {"seed": seed + number}, settings["control_hz"], (head, tried), results):
                one.wait(_REST_S)
                one.skips()


def _try_position(
    one: Page, env: UArmSuctionEnv, policy: Policy, reset: dict[str, Any], control_hz: int, words: tuple[str, str], results: Any
) -> bool:
    """One position, drawn as it goes; its result is added. False if it was left before the end."""
    passed = 0
    for states, scenes, success in _episode(env, policy, reset):
        for state, scene in zip(states, scenes, strict=True):
            one.show(scene, state[6:9])
            distance_mm = 1000.0 * math.dist(state[3:6], state[6:9])
            at_end = "" if success is None or state is not states[-1] else "**reached**" if success else "**not reached**"
            one.say(
                "\n\n".join([words[0], f"{passed / control_hz:.2f} s, {distance_mm:.1f} mm from the target {at_end}", words[1]])
            )
            passed += 1
            if not one.wait(1.0 / control_hz) or one.skips():
                return False
        if success is not None:
            results.append(success)
    return True


def _episode(env: UArmSuctionEnv, policy: Policy, reset: dict[str, Any]) -> Iterator[tuple[Any, list[Any], bool | None]]:
    """Decision after decision: states and scenes, one a control step, and how it ended, once it has."""
    observation, _ = env.reset(**reset)
    yield [env.state()], env.render(), None
    ended = False
    while not ended:
        observation, _, success, truncated, _ = env.step(policy.act(observation))
        ended = success or truncated
        yield list(env.trace), env.render(), bool(success) if ended else None


def _show_arm(one: Page, folder: Path) -> None:
    """What ``run-real watch=true`` writes, moment after moment."""
    joints, pictures = np.array(kinematics.HOME_JOINTS_RAD), 0
    while one.wait(_ARM_S):
        now = live.read(folder)
        if now is None:
            one.say(f"**{folder}**\n\nwaiting for {live.LIVE}, which `run-real watch=true` writes there")
            continue
        joints += _GLIDE * (np.array(now.reference_rad if now.moving else now.joints_rad) - joints)
        one.show_arm(
            joints,
            now.target_m,
            kinematics.cup_position(now.reference_rad),
            object_size_m=now.object_size_m,
            holds=now.pump == "holding",
        )
        if now.pictures != pictures and (picture := live.read_picture(folder)):
            one.show_picture(picture)
            pictures = now.pictures
        silent_s = time.time() - now.written_s
        state = "moving" if now.moving else "standing"
        if now.ended:
            state = "run-real has ended"
        elif silent_s > _SILENT_S:
            state = f"nothing heard for {silent_s:.0f} s"
        words = [f"**{folder}**" + " (emulated)" * now.emulated, f"{state}, pump {now.pump}", f"trials over: {now.trials}"]
        one.say("\n\n".join([*words, f"`{now.said.strip()}`" if now.said else ""]))
