"""``uarm-rl watch``: a policy, a training and an arm on a page, in a browser too; errors in a sentence."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tests.browser import CHROMIUM, browser
from tests.conftest import uarm_rl
from uarm_rl import cli
from uarm_rl.sim.simulated_arm import Scene
from uarm_rl.task.kinematics import HOME_JOINTS_RAD, cup_position

pytest.importorskip("viser")

from uarm_rl.view.watch import page

ROOT = Path(__file__).parents[2]
RUN = ROOT / "results" / "adaptive-plain" / "seed0"
MOMENT = {"joints_rad": [0.4, 0.3, 0.4], "reference_rad": [0.4, 0.3, 0.5], "target_m": [0.2, 0.1, 0.03], "trials": 2}


@pytest.fixture
def shown():
    stop = threading.Event()
    with page(0, stop, title="test", object_size_m=0.03, plays=True) as (one, _):
        yield one, stop


def test_a_scene_is_shown_and_words_are_said(shown):
    one, _ = shown
    assert not one.watched
    one.show(Scene((0.4, 0.3, 0.4), (0.25, 0.1, 0.015, 1.0, 0.0, 0.0, 0.0)), np.array([0.25, 0.1, 0.03]))
    np.testing.assert_allclose(one.arm.cup_m(), cup_position([0.4, 0.3, 0.4]), atol=1e-6)
    one.show_arm(HOME_JOINTS_RAD, None, np.array([0.2, 0.0, 0.1]), object_size_m=(0.06, 0.03, 0.02), holds=True)
    np.testing.assert_allclose(one.arm.cup_m(), cup_position(HOME_JOINTS_RAD), atol=1e-6)
    one.draw_curve("Return", np.array([1.0, 2.0]), np.array([-3.0, -1.0]), "return")
    one.draw_curve("Return", np.array([1.0, 2.0, 3.0]), np.array([-3.0, -1.0, 0.0]), "return")
    one.show_picture(b"no picture")
    one.say("moving")


def test_waits_end_when_all_is_to_end_or_the_next_is_asked_for(shown):
    one, stop = shown
    assert one.wait(0.0)
    one._toggle()  # paused: nothing but these ends it
    threading.Timer(0.05, one._skips.set).start()
    assert one.wait(0.0)
    assert one.skips()
    assert not one.skips()
    threading.Timer(0.05, stop.set).start()
    assert not one.wait(0.0)
    assert one.stopped


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "give run=FOLDER, policy=ik or arm=FOLDER"),
        ([f"run={RUN}", "arm=real"], "watch shows one thing"),
        (["run=nowhere/seed0"], "there is no run folder nowhere/seed0"),
        (["arm=nowhere/real"], "there is no folder nowhere"),
        (["policy=best"], "policy must be ik"),
        ([f"run={RUN}", "policy=best"], "policy=best is unknown"),
        (["policy=ik", "port=TAKEN"], "is taken; give another port=NUMBER"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_a_sentence(capsys, words, sentence):
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(SystemExit) as stop:
        cli.main(["watch", *(word.replace("TAKEN", str(taken.getsockname()[1])) for word in words)])
    output, error = capsys.readouterr()
    assert (stop.value.code, output) == (2, "")
    assert error.startswith("error: ")
    assert sentence in error


def test_without_viser_a_sentence_says_how_to_add_it(tmp_path, without):
    done = uarm_rl("watch", "policy=ik", cwd=tmp_path, environment=without("viser"))
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"error: viser is not installed, .*pip install .*'\.\[view\]'\n", done.stderr)


def test_a_training_is_shown_by_its_newest_checkpoint(tmp_path):
    """The run's own actor, as a checkpoint would hold it, acts like its policy; without one, nothing acts yet."""
    from uarm_rl.commands.watch import _Newest
    from uarm_rl.configuration import compose
    from uarm_rl.learn import checkpoint
    from uarm_rl.trained import load_policy, read_run

    run = tmp_path / "mine" / "seed0"
    run.mkdir(parents=True)
    shutil.copy(RUN / "config.yaml", run)
    newest = _Newest(compose("watch", (f"run={run}",)))
    assert newest.policy() is None
    assert newest.words == "waiting for the first checkpoint"
    settings = read_run(RUN)
    trained = load_policy(RUN, None, settings)
    flat = np.concatenate([part.ravel() for layer in trained.layers for part in layer]).astype(np.float32)
    for episode, sign in ((5, -1.0), (10, 1.0)):
        parameters = np.append(sign * flat, np.zeros(7, np.float32))  # the critic's are behind it
        checkpoint.write(run, checkpoint.Checkpoint(episode, {"agent/parameters": parameters}, {}))
        policy = newest.policy()
        assert newest.words == f"the policy after episode {episode}"
    seen = np.random.default_rng(0).normal(0.0, 0.3, 20).astype(np.float32)
    np.testing.assert_array_equal(policy.act(seen), trained.act(seen))
    shutil.copy(RUN / "policy.safetensors", run)
    np.testing.assert_array_equal(newest.policy().act(seen), trained.act(seen))
    assert newest.words == "the trained policy"


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium, in which the page would be opened")
def test_in_a_browser_the_arm_is_seen_and_ctrl_c_ends_it(tmp_path):
    (tmp_path / "real").mkdir()
    moment = MOMENT | {"said": "held", "pump": "holding", "written_s": time.time()}
    (tmp_path / "real" / "live.json").write_text(json.dumps(moment))
    command = [sys.executable, "-m", "uarm_rl", "watch", "arm=real", "port=0"]
    with (
        subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
        browser() as one,
    ):
        address = process.stdout.readline().strip()
        one.open(address, width=640, height=480, dark=True)
        for _ in range(100):
            said, scheme = one.value("[document.body.innerText, document.documentElement.dataset.mantineColorScheme]")
            if "trials over: 2" in said and scheme == "dark":
                break
            one.wait(0.1)
        title = one.value("document.title")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
    assert "pump holding" in said
    assert "trials over: 2" in said
    assert (title, scheme) == ("uarm-rl: real", "dark")
    assert not one.problems
    assert all(request.startswith((address, "data:", "blob:")) for request in one.requests)
    assert (process.returncode, error) == (0, "")
