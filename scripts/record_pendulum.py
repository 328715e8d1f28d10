"""Make the recordings of "Your plant, your people": ``python scripts/record_pendulum.py``.

They stand for a bench that is not quite the model: heavier masses, a longer rod, noisy sensors,
hand-tuned state feedback. Somebody has watched all pairs that started alike.
"""

from __future__ import annotations

import csv
from pathlib import Path

import jax
import numpy as np

from prefmpc import cart_pendulum, rollout

FOLDER = Path(__file__).parents[1] / "book" / "practice" / "pendulum"
STEPS, STARTS, GAINS = 40, 8, 4
NOISE = np.array([0.001, 0.002, 0.01, 0.01])
"""Standard deviations in m, rad, m/s, rad/s."""

COLUMNS = ("run", "t_s", "position_m", "angle_rad", "speed_m_s", "rate_rad_s", "force_N")
WANTED = np.array([4.0, 60.0, 25.0, 6.0]), np.array([0.02])
"""Weights of somebody who has put a glass of water on the cart: speed is what they mind."""

NOTHING = 0.4
"""Smaller log-odds than that are no difference to them."""


def main() -> None:
    """Write recordings.csv and answers.csv."""
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(2026)
    bench = cart_pendulum(cart=1.1, bob=0.22, length=0.52)
    model = cart_pendulum().linearise(np.zeros(4), np.zeros(1))
    x0 = rng.uniform(-1, 1, (STARTS, 4)) * [0.3, 0.15, 0.1, 0.1]
    weights = np.exp(rng.normal(0, 1.5, (STARTS, GAINS, 5))) * [10, 30, 1, 1, 0.1]
    K = np.array([[model.lqr(np.diag(w[:4]), [[w[4]]])[0] for w in row] for row in weights])
    starts = np.repeat(x0, GAINS, axis=0)
    runs = rollout(bench, starts, K.reshape(-1, 1, 4), STEPS, saturate=True)
    x, u = np.asarray(runs.x), np.asarray(runs.u)
    seen = x + NOISE * rng.standard_normal(x.shape)
    cost = (x[:, :-1] ** 2 @ WANTED[0]).sum(1) + (u**2 @ WANTED[1]).sum(1)

    FOLDER.mkdir(exist_ok=True)
    with open(FOLDER / "recordings.csv", "w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for run in range(len(x)):
            for k in range(STEPS + 1):
                force = "" if k == STEPS else f"{u[run, k, 0]:.4f}"
                state = [f"{value:.5f}" for value in seen[run, k]]
                rows.writerow([run, f"{k * bench.dt:.2f}", *state, force])
    with open(FOLDER / "answers.csv", "w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["first", "second", "answer"])
        for start in range(STARTS):
            for i, j in zip(*np.triu_indices(GAINS, 1), strict=True):
                pair = rng.permutation([start * GAINS + i, start * GAINS + j])
                z = np.log(cost[pair[1]] / cost[pair[0]]) * 4 + rng.logistic()
                said = "tie" if abs(z) < NOTHING else ("first" if z > 0 else "second")
                rows.writerow([*pair, said])


if __name__ == "__main__":
    main()
