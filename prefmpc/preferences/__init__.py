"""What people see and what they answer: trajectories, pools of them, preferences Π, comparisons."""

from prefmpc.preferences.answers import Answers
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.people import (
    Criterion,
    Preference,
    QuadraticPreference,
    SettlingTimePreference,
    by_criterion,
    erring,
    lexicographic,
    logistic,
    one_by_one,
)
from prefmpc.preferences.pools import lqr_pool, random_states, random_weights
from prefmpc.preferences.recordings import Recordings
from prefmpc.preferences.trajectories import (
    Moments,
    Trajectory,
    max_input,
    phi,
    rollout,
    second_moments,
    settling_text,
    settling_time,
)

__all__ = [
    "Answers",
    "Comparisons",
    "Criterion",
    "Moments",
    "Preference",
    "QuadraticPreference",
    "Recordings",
    "SettlingTimePreference",
    "Trajectory",
    "by_criterion",
    "erring",
    "lexicographic",
    "logistic",
    "lqr_pool",
    "max_input",
    "one_by_one",
    "phi",
    "random_states",
    "random_weights",
    "rollout",
    "second_moments",
    "settling_text",
    "settling_time",
]
