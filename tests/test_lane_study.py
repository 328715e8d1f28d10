"""The study of the lane change: what the passenger minds, the drivers, and the file of results."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from prefmpc import MPCError, Trajectory, accuracy
from prefmpc._random import generator
from studies import lane, read_spread

FILE = Path(__file__).parents[1] / "book" / "extensions" / "lane_spread.json"


def test_peaks_of_a_drive_made_by_hand():
    y = np.zeros((lane.STEPS, 4))
    y[:4, 0] = [2.0, 1.0, 0.5, 0.31]  # outside of the lane for four steps
    y[2, 2] = 1.0
    x = np.zeros((lane.STEPS + 1, 4))
    drive = Trajectory(x, np.zeros((lane.STEPS, 2)), y)
    a, jerk, time = lane.peaks(drive)
    assert (a, jerk, time) == (1.0, 4.0, 1.0)
    assert np.isclose(lane.discomfort(drive), (1 / 1.5) ** 2 + (4 / 2.5) ** 2 + 0.5)
    y[-1, 0] = 1.0  # gone again at the end
    assert lane.peaks(drive)[2] == 1.5 * lane.STEPS * lane.SAMPLE


def test_drives_follow_the_plant_and_hold_the_limits():
    x0 = lane.scenarios(40, key=jax.random.key(600))
    runs = lane.drives(x0, key=jax.random.key(601))
    car = lane.lane_car()
    assert np.allclose(car.step(runs.x[:, :-1], runs.u), runs.x[:, 1:], atol=1e-9)
    assert (lane.excess(runs) <= 0).all()
    assert np.allclose(runs.x[:, 0], x0)
    broken = Trajectory(runs.x + np.array([9.0, 0, 0, 0]), runs.u, runs.y)
    assert (lane.excess(broken) > 0).all()


def test_learned_curves_drive_within_the_limits_and_beat_the_hand_tuned_quadratic():
    data = lane.lane_pairs(100, key=jax.random.key(602))
    sigma = lane.fit_separable(data)
    assert accuracy(sigma, data) > accuracy(lane.fit_quadratic(data), data)
    x0 = lane.scenarios(3, key=jax.random.key(603))
    setting = read_spread(FILE)["setting"][0]
    learned, seconds = lane.controlled_drives(sigma, x0)
    by_hand, _ = lane.controlled_drives(lane.by_hand(*setting), x0)
    assert lane.excess(learned).max() <= 1e-6
    assert lane.discomfort(learned).mean() < lane.discomfort(by_hand).mean()
    assert (seconds > 0).all()


def test_a_drive_without_a_plan_is_an_error():
    with pytest.raises(MPCError, match="no input sequence"):
        lane.controlled_drives(lane.by_hand(1, 1, 1), np.array([[7.0, 0, 0, 20.0]]))


def test_the_file_holds_what_a_draw_gives():
    spread = read_spread(FILE)
    assert spread["won"].shape == (10, 2, 3)
    parts = generator(jax.random.key(0)).spawn(3)
    data = lane.lane_pairs(max(lane.ANSWERS), key=parts[0])
    test = lane.lane_pairs(500, key=parts[1])
    sigma = lane.fit_separable(data)
    assert np.isclose(accuracy(sigma, test), spread["accuracy"][0, -1, 0], atol=2e-3)
    assert np.allclose(sigma.model.c, spread["curves"][0], atol=2e-3)
