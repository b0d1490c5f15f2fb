"""The environment as other libraries use it: vector environments, wrappers, copies, another trainer."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import cv2
import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import uarm_rl
from uarm_rl.task.arm import ArmError
from uarm_rl.task.policy import InverseKinematicsPolicy

ID = "uarm_rl/UArmSuction-v0"
TARGET = (0.25, 0.1, 0.03)
ADAPTIVE = ("buffer=adaptive", "time_limit_s=2")


def actions(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32)


@pytest.fixture
def env():
    with gymnasium.make(ID, overrides=ADAPTIVE) as one:
        yield one


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
def test_gymnasium_accepts_it_with_every_render_mode_it_offers():
    with gymnasium.make(ID, overrides=("buffer=uniform",), render_mode="rgb_array") as env:
        check_env(env.unwrapped)


def test_a_window_is_offered_where_there_is_a_screen_alone(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with uarm_rl.make_env() as env:
        assert env.metadata["render_modes"] == ["rgb_array", "rgb_array_list"]
    with pytest.raises(ArmError, match="needs a screen"):
        uarm_rl.make_env(render_mode="human")
    monkeypatch.setenv("DISPLAY", "elsewhere:0")
    with uarm_rl.make_env() as env:
        assert "human" in env.metadata["render_modes"]


def test_info_has_one_form():
    with uarm_rl.make_env(*ADAPTIVE) as env:
        infos = [env.reset(seed=0)[1], *(env.step(action)[4] for action in actions(8))]
    forms = [{key: (type(value), np.shape(value)) for key, value in info.items()} for info in infos]
    assert all(form == forms[0] for form in forms)
    assert {shape for _, shape in forms[0].values()} == {(), (3,)}


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize("autoreset", list(AutoresetMode))
def test_vector_environments(mode, autoreset):
    envs = gymnasium.make_vec(
        ID, num_envs=2, vectorization_mode=mode, vector_kwargs={"autoreset_mode": autoreset}, overrides=ADAPTIVE
    )
    try:
        observations, _ = envs.reset(seed=0)
        assert observations.shape == (2, 20)
        ended = np.zeros(2, bool)
        for step in range(12):  # a decision takes up to two seconds, which is the time limit
            if autoreset is AutoresetMode.DISABLED and ended.any():
                envs.reset(options={"reset_mask": ended})
            observations, rewards, terminated, truncated, infos = envs.step(actions(2, step))
            ended = terminated | truncated
            assert observations.shape == (2, 20)
            assert rewards.shape == infos["distance_m"].shape == infos["control_steps"].shape == (2,)
            assert infos["object_position"].shape == (2, 3)
    finally:
        envs.close()


def test_the_wrappers_that_people_use(tmp_path):
    env = gymnasium.make(ID, overrides=ADAPTIVE, render_mode="rgb_array")
    env = wrappers.TimeLimit(env, 3)
    env = wrappers.RecordEpisodeStatistics(env)
    env = wrappers.NormalizeObservation(env)
    env = wrappers.FrameStackObservation(env, 4)
    env = wrappers.RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda number: True, disable_logger=True)
    with env:
        observation, _ = env.reset(seed=0)
        assert observation.shape == (4, 20)
        for action in actions(3):
            *_, truncated, info = env.step(action)
        assert truncated
        assert info["episode"]["l"] == 3
    assert len(list(tmp_path.glob("films/*.mp4"))) == 1


@pytest.mark.parametrize("buffer", ["uniform", "fixed_hold", "adaptive"])
def test_a_recorded_film_plays_about_as_fast_as_the_arm(tmp_path, buffer):
    env = gymnasium.make(ID, overrides=(f"buffer={buffer}",), render_mode="rgb_array")
    env = wrappers.RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda number: True, disable_logger=True)
    policy, steps = InverseKinematicsPolicy(0.15), 0
    with env:
        observation, _ = env.reset(seed=0)
        for _ in range(20 if buffer == "uniform" else 6):
            observation, *_, info = env.step(policy.act(observation))
            steps += info["control_steps"]
    (film,) = tmp_path.glob("films/*.mp4")
    capture = cv2.VideoCapture(str(film))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) / capture.get(cv2.CAP_PROP_FPS) == pytest.approx(steps / 20, rel=0.3, abs=0.1)


def test_a_copy_is_another_world(env):
    env.reset(seed=0)
    env.step(actions(1)[0])
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            twin.unwrapped.step(actions(1)[0])
        first, _ = twin.reset(seed=3)
        moved = twin.step(np.array([1.0, 0.0, 0.0], np.float32))[0]
        twin.close()
        again, _ = env.reset(seed=3)
        np.testing.assert_array_equal(first, again)
        np.testing.assert_array_equal(env.step(np.array([1.0, 0.0, 0.0], np.float32))[0], moved)


def test_a_step_needs_a_reset():
    with uarm_rl.make_env() as env, pytest.raises(gymnasium.error.ResetNeeded, match="step needs a reset"):
        env.step(actions(1)[0])


@pytest.mark.parametrize("position", [(0.25, 0.1, 0.083), (0.25, 0.1, 0.0), (0.25, 0.1, 0.05)])
def test_an_object_in_mid_air_is_refused(env, position):
    with pytest.raises(ValueError, match=r"rests on the table, so its upper surface is at 0\.03 m"):
        env.reset(options={"object_position": position})


def test_a_dwell_of_nothing_means_that_arriving_is_enough():
    with uarm_rl.make_env("dwell_s=0", "buffer=uniform") as env:
        observation, _ = env.reset(options={"object_position": TARGET})
        policy = InverseKinematicsPolicy(0.15)
        for _ in range(200):
            observation, *_, terminated, _, info = env.step(policy.act(observation))
            assert terminated == info["is_success"] == (info["distance_m"] <= 0.005)
            if terminated:
                break
        assert terminated


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
def test_stable_baselines_takes_it():
    from stable_baselines3 import SAC
    from stable_baselines3.common import env_checker
    from stable_baselines3.common.env_util import make_vec_env

    with uarm_rl.make_env(*ADAPTIVE) as env:
        env_checker.check_env(env)
    envs = make_vec_env(ID, n_envs=2, env_kwargs={"overrides": ("buffer=uniform",)}, seed=0)
    model = SAC("MlpPolicy", envs, learning_starts=50, batch_size=16, policy_kwargs={"net_arch": [16]}, seed=0, device="cpu")
    model.learn(200)
    assert model.num_timesteps == 200
    envs.close()


FORKSERVER = """
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
if __name__ == "__main__":
    start = {"start_method": "forkserver"}
    envs = make_vec_env("uarm_rl:uarm_rl/UArmSuction-v0", n_envs=2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=start)
    print(envs.reset().shape)
    envs.close()
"""


def test_a_process_that_imports_nothing_finds_it_by_its_module(tmp_path):
    (tmp_path / "main.py").write_text(FORKSERVER)
    done = subprocess.run([sys.executable, "main.py"], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout == "(2, 20)\n", done.stderr


@pytest.mark.parametrize("order", ["uarm_rl, gymnasium", "gymnasium, uarm_rl"])
def test_importing_the_package_is_light_and_registers_the_environment(order):
    code = (
        "import sys, uarm_rl; print({'torch', 'pybullet', 'hydra', 'numpy', 'gymnasium'} & set(sys.modules))"
        if order.startswith("uarm")
        else "print(set())"
    )
    code = f"import sys\n{code}\nimport {order}\nprint(gymnasium.spec('{ID}').id)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["set()", ID]


@pytest.mark.parametrize(("missing", "remedy"), [("pybullet", "elsewhere sim=mujoco trains"), ("mujoco", "pip install")])
def test_where_the_engine_is_missing_a_sentence_says_what_to_do(missing, remedy):
    code = (
        f"import sys; sys.modules['{missing}'] = None\nimport gymnasium, uarm_rl\n"
        f"gymnasium.make('{ID}', overrides=('sim={missing}',))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ModuleNotFoundError: {missing} is not installed")
    assert remedy in last
