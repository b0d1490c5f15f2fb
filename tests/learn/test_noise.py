"""Exploration noise: its spread, its memory, its decay."""

from __future__ import annotations

import numpy as np
import pytest

from uarm_rl.learn.noise import OrnsteinUhlenbeck

AMPLITUDES = {"initial_amplitude": 0.5, "final_amplitude": 0.1, "decay_fraction": 0.5}


def noise(theta: float = 0.15, seed: int = 0) -> OrnsteinUhlenbeck:
    return OrnsteinUhlenbeck(theta=theta, **AMPLITUDES, action_size=3, generator=np.random.default_rng(seed))


def series(one: OrnsteinUhlenbeck, progress: float, length: int = 20000) -> np.ndarray:
    one.reset()
    return np.array([one(progress) for _ in range(length)])


@pytest.mark.parametrize(("progress", "amplitude"), [(0.0, 0.5), (0.25, 0.3), (0.5, 0.1), (1.0, 0.1)])
def test_the_amplitude_is_the_standard_deviation_and_falls(progress, amplitude):
    assert noise().amplitude(progress) == pytest.approx(amplitude)
    assert series(noise(), progress).std() == pytest.approx(amplitude, rel=0.06)


def test_memory_fades_as_theta_says():
    x = series(noise(theta=0.15), 0.0)[:, 0]
    assert np.corrcoef(x[1:], x[:-1])[0, 1] == pytest.approx(0.85, abs=0.02)
    y = series(noise(theta=1.0), 0.0)[:, 0]
    assert abs(np.corrcoef(y[1:], y[:-1])[0, 1]) < 0.03


def test_the_generator_alone_decides():
    np.testing.assert_array_equal(series(noise(seed=3), 0.0, 50), series(noise(seed=3), 0.0, 50))
    assert not np.array_equal(series(noise(seed=3), 0.0, 50), series(noise(seed=4), 0.0, 50))


def test_bad_values_are_refused_in_a_sentence():
    with pytest.raises(ValueError, match=r"noise\.theta must be a number above 0 and at most 1, got 0"):
        noise(theta=0)
