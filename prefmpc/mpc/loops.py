"""Closed loops of MPC controllers by the thousand, as one compiled program."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.typing import ArrayLike

from prefmpc._checks import instance, nonnegative, positive_int
from prefmpc._pytree import bypass_init
from prefmpc._sharding import WHOLE, check_mesh, on_mesh, padded, shares
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc._batched_qp import SOLVED, STATUSES, solve, with_derivative
from prefmpc.mpc.batched import (
    Controllers,
    Terminal,
    controllers,
    leading_axis,
    starts,
)
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron


@dataclasses.dataclass(frozen=True)
class ClosedLoops:
    """Simulated closed loops of c controllers from m initial states each.

    Attributes
    ----------
    trajectories : Trajectory
        Leading shape (c, m), without c for a single controller. NaN from a failed solve onwards.
    solved : bool array, same leading shape
        Whether every solve along the way succeeded.
    iterations : int array, same leading shape
        Solver iterations, summed over the steps.
    codes : int array, same leading shape and (…, steps)
        What `status` spells out.
    seconds : float
    """

    trajectories: Trajectory
    solved: np.ndarray
    iterations: np.ndarray
    codes: np.ndarray
    seconds: float

    @property
    def status(self) -> np.ndarray:
        """Status (…, steps) of every solve: "solved", "infeasible", "max_iterations" or "failed".

        After a failed solve there is no state to solve for; its status stays.
        """
        return STATUSES[self.codes]


class _Loop(NamedTuple):
    x: Any
    u: Any
    y: Any
    codes: Any
    iterations: Any


def closed_loops(
    system: LinearSystem,
    costs: QuadraticCost,
    x0: ArrayLike,
    *,
    horizon: int,
    steps: int,
    constraints: Polyhedron | None = None,
    terminal: Terminal | None = None,
    plants: LinearSystem | None = None,
    tol: float = 1e-8,
    mesh: Mesh | None = None,
) -> ClosedLoops:
    """Simulate MPC closed loops for many controllers and initial states in one compiled call.

    Parameters
    ----------
    system : LinearSystem
        The model that the controllers predict with; one, or a stack of c (`LinearSystem.stack`).
    costs : QuadraticCost
        One σ, or a stack of c of them.
    x0 : array (m, nx) or (c, m, nx)
        The same m initial states for every controller, or m of its own for each.
    horizon, steps : int
        N of the controllers, and the length of the simulations.
    constraints : Polyhedron, optional
    terminal : Polyhedron or TerminalIngredients, optional
        See `BatchedMPC`.
    plants : LinearSystem, optional
        What is controlled, if it is not what the controllers believe: one, or a stack of c. Its
        input bounds play no role: the controllers keep to those of ``system``.
    tol : float
        See `BatchedMPC`.
    mesh : jax.sharding.Mesh, optional
        Devices to share the initial states among, each of which runs its loops on its own.

    Returns
    -------
    ClosedLoops

    Raises
    ------
    ValueError
        If something is out of range or does not fit. A solve that fails on the way raises
        nothing: see ``solved`` and ``status``.
    """
    began = time.perf_counter()
    many = controllers(system, costs, constraints, terminal)
    horizon, steps = positive_int("horizon", horizon), positive_int("steps", steps)
    tol = nonnegative("tol", tol)
    many, truth = _with_plants(many, plants)
    begin, lead = starts(x0, system.nx, many)
    mesh = None if mesh is None else check_mesh(mesh)

    program = _program(horizon, steps)
    if mesh is None:
        out = program(*many, truth, begin, tol)
    else:
        out = _shared(program, mesh, many, truth, begin, tol)
    out = jax.tree.map(lambda a: np.asarray(a).reshape((*lead, *a.shape[2:])), out)
    return ClosedLoops(
        trajectories=bypass_init(Trajectory, x=out.x, u=out.u, y=out.y),
        solved=(out.codes == SOLVED).all(axis=-1),
        iterations=out.iterations,
        codes=out.codes,
        seconds=time.perf_counter() - began,
    )


def mpc_rollout(
    system: LinearSystem,
    cost: QuadraticCost,
    x0: Any,
    *,
    horizon: int,
    steps: int,
    constraints: Polyhedron | None = None,
    terminal: Terminal | None = None,
    tol: float = 1e-8,
) -> Trajectory:
    """Return closed loops as a function that JAX can differentiate, in x0 and in the weights of σ.

    Between two changes of the active constraints an MPC law is smooth in both. The derivative is
    that of the optimality conditions with the active constraints kept: exact, and no iteration
    of a solver is differentiated. Where a constraint is about to become active there are two
    derivatives, and this is one of them.

    Parameters
    ----------
    system, cost, horizon, steps, constraints, terminal, tol
        As for `closed_loops`; ``cost`` and x0 may be traced.
    x0 : array (nx,) or (m, nx)

    Returns
    -------
    Trajectory
        Leading shape as `closed_loops` gives it; NaN from a failed solve onwards.
    """
    many = controllers(system, cost, constraints, terminal)
    horizon, steps = positive_int("horizon", horizon), positive_int("steps", steps)
    tol = nonnegative("tol", tol)
    begin, lead = starts(x0, system.nx, many)
    out = _program(horizon, steps, derivative=True)(*many, many.systems, begin, tol)
    x, u, y = (a.reshape(*lead, *a.shape[2:]) for a in (out.x, out.u, out.y))
    return bypass_init(Trajectory, x=x, u=u, y=y)


def _with_plants(
    many: Controllers, plants: LinearSystem | None
) -> tuple[Controllers, LinearSystem]:
    """Return as many controllers as there are plants, and the plants with a leading axis."""
    if plants is None:
        return many, many.systems
    instance("plants", plants, LinearSystem)
    sizes = (plants.nx, plants.nu)
    if sizes != (many.systems.nx, many.systems.nu):
        raise ValueError(
            f"plants must have {many.systems.nx} states and {many.systems.nu} inputs like the "
            f"system, got {sizes[0]} and {sizes[1]}"
        )
    if not plants.batch_shape:
        return many, leading_axis(plants)
    if len(plants.batch_shape) > 1 or (many.stacked and len(plants) != many.count):
        raise ValueError(
            f"plants must be a single one or a stack of {many.count}, one for each controller, "
            f"got {plants.batch_shape}"
        )
    if many.stacked:
        return many, plants
    repeated = jax.tree.map(lambda a: np.repeat(a, len(plants), axis=0), many.costs)
    return Controllers(many.systems, repeated, many.sets, stacked=True), plants


@lru_cache(maxsize=256)
def _program(horizon: int, steps: int, *, derivative: bool = False) -> Callable[..., _Loop]:
    """Return the compiled simulation; one object for each size, so that it compiles once."""

    @jax.jit
    def run(systems: Any, costs: Any, sets: Any, plants: Any, x0: Any, tol: Any) -> _Loop:
        many = Controllers(systems, costs, sets, stacked=True)
        problem = many.condensed(horizon)
        rows = problem.Y.shape[1]
        start = x0, jnp.full(x0.shape[:2], SOLVED), jnp.zeros((*x0.shape[:2], rows))

        def step(now: Any, _: None) -> Any:
            x, before, start = now
            answer = solve(problem, x, tol, start=start)
            U = with_derivative(problem, x, answer) if derivative else answer.U
            u = jnp.where((answer.status == SOLVED)[..., None], U[..., : plants.nu], jnp.nan)
            code = jnp.where(before == SOLVED, answer.status, before)
            x_next = plants.step(x, u)
            start = many.moved_on(answer.multipliers, horizon)
            return (x_next, code, start), (x_next, u, plants.output(x), code, answer.iterations)

        _, (x, u, y, codes, iterations) = jax.lax.scan(step, start, None, length=steps)
        x = jnp.concatenate([x0[None], x])
        x, u, y, codes = (jnp.moveaxis(a, 0, 2) for a in (x, u, y, codes))
        return _Loop(x, u, y, codes, iterations.sum(0))

    return run


def _shared(
    run: Callable[..., _Loop],
    mesh: Mesh,
    many: Controllers,
    plants: LinearSystem,
    x0: np.ndarray,
    tol: float,
) -> _Loop:
    """Run on a mesh: the initial states are shared or, if they are too few, the controllers."""
    c, m = x0.shape[:2]
    axis = 1 if m >= mesh.size else 0
    each = shares(mesh, axis)

    def controller_axis(part: Any, count: int) -> tuple[Any, Any]:
        if axis == 1 or count == 1:
            return WHOLE, part
        return each, jax.tree.map(lambda leaf: padded(leaf, 0, mesh.size), part)

    parts = [
        controller_axis(many.systems, len(many.systems)),
        controller_axis(many.costs, len(many.costs.theta_Q)),
        (WHOLE, many.sets),
        controller_axis(plants, len(plants)),
        (each, padded(x0, axis, mesh.size)),
        (WHOLE, tol),
    ]
    specs, arguments = zip(*parts, strict=True)
    out = on_mesh(run, mesh, specs, each, arguments)
    return jax.tree.map(lambda a: a[:c, :m], out)
