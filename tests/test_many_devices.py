"""What many devices say, in one process or in two, is what one says."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

DEVICES = """
import sys
import numpy as np, jax
if len(sys.argv) > 1:
    jax.distributed.initialize(f"127.0.0.1:{sys.argv[1]}", 2, int(sys.argv[2]))
jax.config.update("jax_enable_x64", True)
import prefmpc as p
from studies import QUADRATIC_Q, QUADRATIC_R, RADIUS
system, cost = p.oscillating_masses(), p.QuadraticCost(QUADRATIC_Q, QUADRATIC_R)
mesh = jax.make_mesh((jax.device_count(),), ("devices",))
assert mesh.size == COUNT, mesh
worst = []

def compare(ours, theirs):
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert a.shape == b.shape
        np.testing.assert_array_equal(np.isnan(a), np.isnan(b))
        worst.append(np.nanmax(np.abs(a - b)))

def loops(costs, x0, **options):
    return p.closed_loops(system, costs, x0, horizon=5, steps=4, **options)

x0 = np.asarray(p.random_states(RADIUS, key=jax.random.key(5), shape=(21,)))
stack = p.QuadraticCost.random(6, 2, key=jax.random.key(1), shape=(11,))
cases = [(cost, x0, {}), (stack, x0[:1], {})]
if COUNT == 8:
    cases.append((cost, x0, {"constraints": p.Polyhedron(np.eye(8)[[3, 4]], [0.3, 0.3])}))
for costs, states, options in cases:
    alone, shared = loops(costs, states, **options), loops(costs, states, mesh=mesh, **options)
    compare(alone.trajectories, shared.trajectories)
    np.testing.assert_array_equal(alone.codes, shared.codes)
assert COUNT == 2 or not alone.solved.all()

pool = p.lqr_pool(system, 40, 10, key=jax.random.key(0), radius=RADIUS, saturate=False)
person = p.QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)
data = p.Comparisons.random(pool, person, 6000, key=jax.random.key(1))
prior = p.bryson(RADIUS, [1, 1])
alone, shared = p.fit_map(data, prior), p.fit_map(data, prior, mesh=mesh)
assert shared.success
compare((alone.Q, alone.R), (shared.Q, shared.R))
print("worst", max(worst))
"""


def devices(count, *arguments):
    environment = dict(os.environ)
    if not arguments:
        environment["XLA_FLAGS"] += f" --xla_force_host_platform_device_count={count}"
    return subprocess.Popen(
        [sys.executable, "-c", DEVICES.replace("COUNT", str(count)), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def worst_of(process):
    out, err = process.communicate(timeout=240)
    assert process.returncode == 0, err[-3000:]
    return float(out.split("worst")[1])


def test_eight_devices_say_what_one_says():
    assert worst_of(devices(8)) <= 1e-10


def test_two_processes_say_what_one_says():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    both = [devices(2, port, str(i)) for i in range(2)]
    assert max(map(worst_of, both)) <= 1e-10
