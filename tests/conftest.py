"""What the unit tests share: quiet hypothesis, the book's plant, one draw of its data."""

from __future__ import annotations

import jax
import pytest
from hypothesis import settings

from prefmpc import LinearSystem, oscillating_masses
from studies import quadratic_data

# The same examples on every run; no deadline, since a first call may compile.
settings.register_profile("prefmpc", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("prefmpc")


@pytest.fixture(scope="session")
def masses() -> LinearSystem:
    return oscillating_masses()


@pytest.fixture(scope="session")
def data():
    """System, pool, training sets by size, test set; a key that no study reports on."""
    return quadratic_data(key=jax.random.key(2000))
