"""Interviews on disk: nothing that was answered is lost, and the same question comes next."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from test_interview import CART, PERSON, PRIOR, cart, same

from prefmpc import Interview, LinearSystem, Polyhedron, lqr_pool


def answered(interview, count=10):
    interview.answer_with(PERSON, count - 4)
    interview.undo()
    interview.answer(None)
    interview.next_batch(3)
    interview.answer("first")
    interview.answer(0.25)
    return interview


def alike(a, b):
    assert len(a) == len(b)
    np.testing.assert_array_equal(a.labels, b.labels)
    assert all(map(same, a.questions, b.questions))
    assert all(map(same, a.next_batch(3), b.next_batch(3)))


@pytest.mark.parametrize("key", [3, jax.random.key(3)])
def test_a_log_and_a_saved_file_resume_with_the_same_question(tmp_path, key):
    interview = answered(cart(key=key, log=tmp_path / "log"))
    interview.save(tmp_path / "saved")
    for path in (tmp_path / "log", tmp_path / "saved"):
        alike(Interview.load(path, append=False), interview)
    lines = (tmp_path / "log").read_text().splitlines()
    first = json.loads(lines[1])
    assert first["question"]["first"]["x"] == interview.questions[0].first.x.tolist()
    with pytest.raises(FileExistsError):
        interview.save(tmp_path / "saved")
    # In the middle of a batch: the rest of it, then as if nothing had happened.
    resumed = Interview.load(tmp_path / "log", append=False)
    for each in (interview, resumed):
        each.answer_with(PERSON, 3)
    alike(resumed, interview)


def test_undo_brings_the_same_question_back(tmp_path):
    interview = answered(cart(log=tmp_path / "log"))
    before = interview.next()
    interview.answer("first")
    after = interview.next()
    assert same(interview.undo(), before)
    interview.answer("second")
    assert not same(interview.next(), after)
    interview.undo()
    interview.answer("first")
    assert same(interview.next(), after)
    alike(Interview.load(tmp_path / "log"), interview)


def test_a_line_torn_anywhere_is_dropped(tmp_path):
    path = tmp_path / "log"
    interview = cart(log=path)
    interview.answer_with(PERSON, 3)
    whole, wanted = path.read_bytes(), interview.next()
    interview.answer("first")
    last = path.read_bytes()[len(whole) :]
    for cut in np.linspace(0, len(last) - 1, 12).astype(int):
        for rest in (b"", b"\0" * 40):
            path.write_bytes(whole + last[:cut] + rest)
            resumed = Interview.load(path)
            assert len(resumed) == 3
            assert same(resumed.next(), wanted)
    resumed.answer("first")
    assert path.read_bytes() == whole + last


KILLED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
from prefmpc import Interview, QuadraticPreference
import numpy as np
interview = Interview.load(sys.argv[1])
print(len(interview), flush=True)
while True:
    interview.answer_with(QuadraticPreference(np.diag([4.0, 0.2]), [[0.5]]), 1)
    print(len(interview), flush=True)
"""


def test_nothing_acknowledged_is_lost_when_the_process_is_killed(tmp_path):
    path = tmp_path / "log"
    cart(log=path)
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    lines = [child.stdout.readline() for _ in range(4)]
    time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    lines += child.communicate()[0].split()
    resumed, undisturbed = Interview.load(path), cart()
    assert len(resumed) >= int(lines[-1])
    undisturbed.answer_with(PERSON, len(resumed))
    alike(resumed, undisturbed)


def test_a_write_that_fails_leaves_the_log_whole(tmp_path, monkeypatch):
    interview = cart(log=tmp_path / "log")
    interview.answer("first")
    question = interview.next()

    def full(descriptor):
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="no space"):
            interview.answer("second")
    assert len(interview) == 1
    assert same(interview.next(), question)
    interview.answer("first")
    alike(Interview.load(tmp_path / "log"), interview)


def test_open_limits_constraints_and_pools_are_stored(tmp_path):
    pool = lqr_pool(CART, 6, 5, key=jax.random.key(0), radius=[1.0, 0.5])
    free = LinearSystem(CART.A, CART.B, dt=0.1, u_max=[2.0])
    limits = Polyhedron.box([-3, -3, -1], [3, 3, np.inf])
    options = {"pool": pool, "constraints": limits, "controller": "mpc", "lapse": "estimate"}
    interview = Interview(free, PRIOR, key=0, log=tmp_path / "log", **options)
    interview.answer_with(PERSON, 2)
    resumed = Interview.load(tmp_path / "log")
    alike(resumed, interview)
    assert resumed._options.system.u_min[0] == -np.inf
    np.testing.assert_array_equal(resumed._options.constraints.h, limits.h)


def test_functions_are_given_again(tmp_path):
    path = tmp_path / "log"

    def states(rng, count):
        return rng.uniform(-1, 1, (count, 2))

    interview = Interview(CART, PRIOR, x0=states, key=0, log=path)
    interview.answer_with(PERSON, 2)
    alike(Interview.load(path, x0=states), interview)
    with pytest.raises(ValueError, match=r"load must be given \['x0'\]"):
        Interview.load(path)


def test_bad_input_to_load_is_named(tmp_path):
    path = tmp_path / "log"
    with pytest.raises(FileNotFoundError):
        Interview.load(path)
    path.write_text("hello\n")
    with pytest.raises(ValueError, match="path must be a log"):
        Interview.load(path)
    path.unlink()
    cart(log=path).answer_with(PERSON, 3)
    lines = path.read_bytes().splitlines(keepends=True)
    for wrong in (b"{}\n", lines[2][:50] + b"\n", b'{"undo": 7}\n'):
        path.write_bytes(lines[0] + lines[1] + wrong + lines[3])
        with pytest.raises(ValueError, match="line 3"):
            Interview.load(path)
