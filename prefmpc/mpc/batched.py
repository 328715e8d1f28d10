"""MPC for many states, many costs and many models at once, as one compiled program."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import array_module, nonnegative, positive_int
from prefmpc._pytree import bypass_init
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.mpc._batched_qp import SOLVED, STATUSES, Answer, solve
from prefmpc.mpc._condensed import CondensedProblem, Sets, condense
from prefmpc.mpc.solution import (
    Controller,
    MPCSolution,
    check_problem,
    check_state,
)
from prefmpc.mpc.terminal import TerminalIngredients, check_polyhedron, terminal_set
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron

Terminal = Polyhedron | TerminalIngredients


@dataclasses.dataclass(frozen=True)
class Controllers:
    """c controllers: what can be stacked has a leading axis of length c or 1, ``sets`` has none."""

    systems: LinearSystem
    costs: QuadraticCost
    sets: Sets | None
    stacked: bool

    def __iter__(self) -> Iterator[Any]:
        """Give what a compiled program takes."""
        return iter((self.systems, self.costs, self.sets))

    @property
    def count(self) -> int:
        """Number c of controllers."""
        return max(len(self.systems), self.costs.batch_shape[0])

    def condensed(self, horizon: int) -> CondensedProblem:
        """Return the problems, each array with a leading axis of length c."""
        parts, axes = zip(*map(self.own, (self.systems, self.costs)), strict=True)
        one = partial(condense, horizon=horizon, sets=self.sets)
        return jax.vmap(one, in_axes=axes)(*parts)

    def moved_on(self, multipliers: Any, horizon: int) -> Any:
        """Return multipliers (c, m, rows) of a plan for the plan that begins one step later."""
        sizes = [self.systems.nu, 0]
        if self.sets is not None and self.sets.stage is not None:
            sizes[1] = len(self.sets.stage)
        parts, at = [], 0
        for size in sizes:
            now = multipliers[..., at : at + horizon * size]
            parts.append(jnp.zeros_like(now).at[..., : now.shape[-1] - size].set(now[..., size:]))
            at += horizon * size
        return jnp.concatenate([*parts, multipliers[..., at:]], axis=-1)

    def own(self, part: Any) -> tuple[Any, int | None]:
        """Return systems or costs and the axis to map over: None for one that all share."""
        return (part, 0) if part.batch_shape[0] == self.count else (part[0], None)


def leading_axis(part: Any) -> Any:
    """Return a system or a cost as a stack of one, if it is none yet."""
    return part if part.batch_shape else jax.tree.map(lambda leaf: leaf[None], part)


def controllers(
    system: LinearSystem,
    cost: QuadraticCost,
    constraints: Polyhedron | None,
    terminal: Terminal | None,
) -> Controllers:
    """Check what makes c controllers, and give all of it a leading axis. Raises a ValueError."""
    check_problem(system, cost)
    for name, shape in (("system", system.batch_shape), ("cost", cost.batch_shape)):
        if len(shape) > 1:
            raise ValueError(
                f"{name} must be a single one or a stack along one axis, got shape {shape}"
            )
    if system.batch_shape and cost.batch_shape and system.batch_shape != cost.batch_shape:
        raise ValueError(
            f"cost must be as many as the systems, {system.batch_shape[0]}, or a single one, "
            f"got {cost.batch_shape[0]}"
        )
    stacked = bool(system.batch_shape or cost.batch_shape)
    check_polyhedron("constraints", constraints, system.nx + system.nu)
    P, end = terminal_set(terminal, system.nx)
    stage, last = (
        (part.H, part.h) if isinstance(part, Polyhedron) else (None, None)
        for part in (constraints, end)
    )
    given = (
        None
        if constraints is None and terminal is None
        else Sets(stage[0], stage[1], last[0], last[1], P)
    )
    return Controllers(leading_axis(system), leading_axis(cost), given, stacked)


def starts(x0: ArrayLike, nx: int, many: Controllers) -> tuple[Any, tuple[int, ...]]:
    """Return the states as (c, m, nx), and the leading axes that the answer has."""
    x = check_state(x0, nx)
    count = many.count
    if many.stacked and x.ndim == 3:
        if len(x) != count:
            raise ValueError(
                f"x0 must have {count} rows of states, one a controller, got {x.shape}"
            )
        return x, x.shape[:2]
    if x.ndim > 2:
        raise ValueError(f"x0 must have shape ({nx},) or (m, {nx}), got {x.shape}")
    lead = (count, *x.shape[:-1]) if many.stacked else x.shape[:-1]
    flat = x.reshape(-1, nx)
    return array_module(x).broadcast_to(flat, (count, *flat.shape)), lead


@jax.jit(static_argnums=1)
def _solve_many(
    parts: tuple[Any, Any, Any], horizon: int, x0: Any, tol: Any
) -> tuple[Answer, Trajectory, Any]:
    """Return the answers, the plans (c, m) and their costs, NaN where not solved."""
    many = Controllers(*parts, True)
    plant, given = many.systems, many.sets
    problem = many.condensed(horizon)
    answer = solve(problem, x0, tol)
    solved = (answer.status == SOLVED)[..., None]
    shape = (*x0.shape[:2], horizon, plant.nu)
    low, high = plant.u_min[:, None], plant.u_max[:, None]
    U = jnp.where(solved, answer.U, jnp.nan).reshape(shape)
    assert problem.law is not None

    def step(x: Any, now: tuple[Any, Any, Any]) -> tuple[Any, tuple[Any, Any]]:
        # With feedback: on an unstable plant the inputs alone would not lead where they should.
        K, L, w = now
        u = jnp.clip(w @ L - x @ K.swapaxes(1, 2), low, high)
        return plant.step(x, u), (x, plant.output(x))

    start = jnp.where(solved, x0, jnp.nan)
    K, L = (jnp.moveaxis(a, 1, 0) for a in problem.law)
    w = jnp.moveaxis(answer.w.reshape(shape), 2, 0)
    last, (x, y) = jax.lax.scan(step, start, (K, L, w))
    X, Y = jnp.moveaxis(jnp.concatenate([x, last[None]]), 0, 2), jnp.moveaxis(y, 0, 2)
    plans = bypass_init(Trajectory, x=X, u=U, y=Y)
    cost, axis = many.own(many.costs)
    total = jax.vmap(lambda cost, T: cost(T), in_axes=(axis, 0))(cost, plans)
    if given is not None and given.P is not None:
        total = total + jnp.einsum("cmi,ij,cmj->cm", last, given.P, last)
    return answer, plans, total


class BatchedMPC(Controller):
    """The MPC of eq. (7) of arXiv 2511.22502 for whole batches of states, costs and models.

    Solves the same problem as `LinearMPC`, in coordinates that keep their digits on unstable
    plants and long horizons. Every answer carries an estimate of its own error.

    Parameters
    ----------
    system : LinearSystem
        One model, or a stack of c (`LinearSystem.stack`).
    cost : QuadraticCost
        One σ, or a stack of c of them.
    horizon : int
        N ≥ 1.
    constraints : Polyhedron, optional
        Over the stacked (x_k, u_k), dimension nx + nu, for k = 0 … N−1; the same for all.
    terminal : Polyhedron or TerminalIngredients, optional
        X_N; or the ingredients of `terminal_ingredients`, whose x_NᵀPx_N is added to the cost;
        the same for all.
    tol : float
        What counts as solved: the largest error of an input, relative to the largest input of the
        plan, each in the unit in which σ sees it. Below 1e-12 it counts as 1e-12.

    Raises
    ------
    ValueError
        If the horizon is below 1, or a dimension does not fit.
    """

    def __init__(
        self,
        system: LinearSystem,
        cost: QuadraticCost,
        horizon: int,
        *,
        constraints: Polyhedron | None = None,
        terminal: Terminal | None = None,
        tol: float = 1e-8,
    ) -> None:
        self._many = controllers(system, cost, constraints, terminal)
        self.system, self.cost = system, cost
        self.horizon = positive_int("horizon", horizon)
        self.tol = nonnegative("tol", tol)

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for x0 (nx,) or (m, nx); with c controllers also (c, m, nx).

        The leading shape of everything in the answer is (c, m), without c for a single cost and
        model, and without m for a single state. Raises a ValueError on a bad x0.
        """
        began = time.perf_counter()
        begin, lead = starts(x0, self.system.nx, self._many)
        parts = tuple(self._many)
        answer, plans, cost = jax.tree.map(
            np.asarray, _solve_many(parts, self.horizon, begin, self.tol)
        )
        trajectory = jax.tree.map(lambda a: a.reshape(*lead, *a.shape[2:]), plans)
        status = STATUSES[answer.status].reshape(lead)
        return MPCSolution(
            u=trajectory.u[..., 0, :],
            trajectory=trajectory,
            cost=cost.reshape(lead),
            status=status if lead else str(status),
            message=self._message(answer),
            iterations=answer.iterations.reshape(lead),
            residual=answer.residual.reshape(lead),
            seconds=time.perf_counter() - began,
        )

    def _message(self, answer: Answer) -> str:
        counts = {str(name): int((answer.status == i).sum()) for i, name in enumerate(STATUSES)}
        solved = counts.pop("solved")
        if solved == answer.status.size:
            return "optimal"
        parts = [f"{count} {name}" for name, count in counts.items() if count]
        why = ""
        if counts["failed"]:
            why = "; failed: no plan was found whose error float64 can tell to be within tolerance"
        return (
            f"of {answer.status.size} problems {' and '.join(parts)}; "
            f"tolerance {self.tol:g}, worst residual {np.max(answer.residual):.2g}{why}"
        )
