"""When is MPC with a general convex σ stable? A sufficient condition that is checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, instance, nonnegative, shaped, single
from prefmpc._units import cost_units
from prefmpc.models.networks import ICNNCost
from prefmpc.models.quadratic import QuadraticCost, SumCost
from prefmpc.mpc._cone import ConeSolution
from prefmpc.mpc._expressions import (
    check_cones,
    check_convex,
    expression,
    stage_limits,
    weights,
)
from prefmpc.mpc._parametric import ParametricProgram
from prefmpc.mpc.solution import MPCSolution
from prefmpc.mpc.terminal import stage_constraints
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import LinearSystem
from prefmpc.systems.sets import Polyhedron, SecondOrderCone


@dataclasses.dataclass(frozen=True, eq=False)
class StabilityCheck:
    """Whether MPC with σ and x_N = x_s is certain to be stable, and the proof.

    Attributes
    ----------
    stable : bool
        Yes or no. No means: this check cannot promise it.
    reason : str
        Why, in a sentence.
    x, u : arrays (nx,), (nu,)
        The steady state that σ likes best, to which the closed loop then goes; NaN if there is
        none.
    multiplier : array (nx,)
        λ of the constraint x_s = A x_s + B u_s.
    stage_cost : float
        ℓ(x_s, u_s).
    modulus : array (nx + nu, nx + nu)
        M with ℓ̃(z) ≥ (z − z_s)ᵀM(z − z_s) on Z.
    gap : float
        How far below 0 the rotated stage cost falls anywhere in Z, by a program of its own; a
        proof needs 0, solvers give 1e-8.
    """

    stable: bool
    reason: str
    cost: Any
    system: LinearSystem
    x: np.ndarray
    u: np.ndarray
    multiplier: np.ndarray
    stage_cost: float
    modulus: np.ndarray
    gap: float

    def value(self, solution: MPCSolution) -> float:
        """Return the Lyapunov function V(x) = σ(T*) − N ℓ(z_s) + λᵀ(x − x_s) of a solved problem.

        It is the sum of the rotated stage costs along the plan: 0 at x_s, positive elsewhere, and
        from one step to the next it falls by at least the rotated cost of the first stage.
        """
        T = solution.trajectory
        travelled = self.multiplier @ (np.asarray(T.x)[0] - self.x)
        return float(solution.cost - len(np.asarray(T.u)) * self.stage_cost + travelled)

    def rotated(self, x: ArrayLike, u: ArrayLike) -> np.ndarray:
        """Return ℓ̃(x, u) = ℓ(x, u) − ℓ(z_s) + λᵀ(x − A x − B u) for x (m, nx) and u (m, nu)."""
        states = shaped("x", np.asarray(finite_array("x", x, ndim=2)), (self.system.nx,), "states")
        inputs = shaped("u", np.asarray(finite_array("u", u, ndim=2)), (self.system.nu,), "inputs")
        if len(states) != len(inputs):
            raise ValueError(f"x and u must be equally many, got {len(states)} and {len(inputs)}")
        after = states @ self.system.A.T + inputs @ self.system.B.T
        stages = Trajectory(np.stack([states, after], axis=1), inputs[:, None])
        return np.asarray(self.cost(stages) - self.stage_cost + (states - after) @ self.multiplier)


def check_stability(
    system: LinearSystem,
    cost: QuadraticCost | ICNNCost | SumCost,
    *,
    constraints: Polyhedron | None = None,
    output_cones: Sequence[SecondOrderCone] = (),
    tol: float = 1e-6,
) -> StabilityCheck:
    """Say whether MPC with a convex σ and a terminal equality is certain to be stable.

    The construction: let z_s = (x_s, u_s) be the steady state with the smallest stage cost ℓ, and
    λ the multiplier of x_s = A x_s + B u_s. For a linear plant and a convex ℓ the rotated cost
    ℓ̃(x, u) = ℓ(x, u) − ℓ(z_s) + λᵀ(x − A x − B u) is nowhere negative on Z (duality), and with
    x_N = x_s the plans that minimise σ also minimise Σ ℓ̃. So Σ ℓ̃ is a Lyapunov function as soon
    as ℓ̃ grows away from x_s, which strict convexity in x ensures (Diehl, Amrit and Rawlings,
    2011). Every state from which x_s can be reached within the horizon is then driven to x_s.

    Answers "no" for networks over whole trajectories, which are no sum of stage costs; for σ that
    is not strictly convex in x (an `ICNNCost` without a floor, a singular Q); and if no steady
    state satisfies the constraints.

    Parameters
    ----------
    cost : QuadraticCost, ICNNCost or SumCost of these
    constraints, output_cones : as for `ConvexMPC`
    tol : float
        Largest `gap`, relative to ℓ(z_s) and to what one unit of z costs, that counts as none.

    Returns
    -------
    StabilityCheck
        Hand it to ``ConvexMPC(..., terminal=check)``.

    Raises
    ------
    ValueError
        If σ is not one of the convex models or something does not fit.
    """
    instance("system", system, LinearSystem)
    single("system", system)
    tol = nonnegative("tol", tol)
    nx, nu = system.nx, system.nu
    over_trajectory = _over_trajectory(cost)
    if not over_trajectory:
        check_convex(cost, nx, nu, 1)
    stage_constraints(system, constraints)
    check_cones(system, output_cones)

    def answer(stable: bool, reason: str, **found: Any) -> StabilityCheck:
        nothing: dict[str, Any] = {
            "x": np.full(nx, np.nan),
            "u": np.full(nu, np.nan),
            "multiplier": np.full(nx, np.nan),
            "stage_cost": np.nan,
            "modulus": np.full((nx + nu, nx + nu), np.nan),
            "gap": np.nan,
        }
        return StabilityCheck(stable, reason, cost, system, **{**nothing, **found})

    if over_trajectory:
        return answer(False, "σ looks at whole trajectories, so it is no sum of stage costs")
    dx, du = cost_units(system.A, system.B, *weights(cost, nx, nu))
    programs = _Programs(system, cost, constraints, output_cones, (dx, du))
    steady, x, u, multiplier = programs.steady()
    if steady.status == "infeasible":
        return answer(False, "no steady state satisfies the constraints")
    if steady.status != "solved":
        return answer(False, f"the best steady state was not found: {steady.message}")
    best: dict[str, Any] = {
        "x": x,
        "u": u,
        "multiplier": multiplier / dx,
        "stage_cost": steady.objective,
        "modulus": _modulus(cost, nx, nu),
    }
    rotated = programs.rotated(multiplier)
    lowest = rotated.objective if rotated.status == "solved" else -np.inf
    gap = best["gap"] = max(0.0, best["stage_cost"] - lowest)
    curvature = np.linalg.eigvalsh(best["modulus"][:nx, :nx] * dx * dx[:, None])
    if not curvature[0] > 1e-12 * max(curvature[-1], 1e-300):
        return answer(
            False, "σ is not strictly convex in the states; a floor would make it", **best
        )
    if not gap <= tol * (steady.unit**2 + abs(best["stage_cost"])):
        why = "" if rotated.status == "solved" else f" ({rotated.message})"
        return answer(False, f"the rotated stage cost falls to {-gap:.1e}{why}", **best)
    return answer(True, "the rotated stage cost is positive away from the steady state", **best)


class _Programs:
    """The best steady state, and the stage with the lowest rotated cost, in ``units``."""

    def __init__(
        self,
        system: LinearSystem,
        cost: Any,
        constraints: Polyhedron | None,
        output_cones: Sequence[SecondOrderCone],
        units: tuple[np.ndarray, np.ndarray],
    ) -> None:
        import cvxpy

        cp: Any = cvxpy
        self._cp = cp
        dx, du = self._units = units
        x, u = self._signals = cp.Variable((1, system.nx)), cp.Variable((1, system.nu))
        self._moved = cp.Parameter(system.nx)
        A, B = system.A * dx / dx[:, None], system.B * du / dx[:, None]
        self._still = x - x @ A.T - u @ B.T
        scaled = cp.multiply(x, dx[None]), cp.multiply(u, du[None])
        self._stage = expression(cp, cost, *scaled)
        self._limits = stage_limits(cp, system, constraints, output_cones, self._signals, units)

    def steady(self) -> tuple[ConeSolution, np.ndarray, np.ndarray, np.ndarray]:
        """Return the solution, x, u, and the multiplier of x = A x + B u in own units."""
        program = self._program(self._stage, [self._still[0] == self._moved, *self._limits])
        found, (x, u) = program.solve(np.zeros(self._moved.size))
        dx, du = self._units
        return found, x[0] * dx, u[0] * du, program.multipliers(found)

    def rotated(self, multiplier: np.ndarray) -> ConeSolution:
        """Look for a stage whose rotated cost is negative."""
        total = self._stage + self._cp.sum(self._still[0] @ multiplier)
        return self._program(total, self._limits).solve(np.zeros(self._moved.size))[0]

    def _program(self, total: Any, limits: list[Any]) -> ParametricProgram:
        problem = self._cp.Problem(self._cp.Minimize(total), limits)
        return ParametricProgram(problem, self._moved, self._signals)


def _over_trajectory(cost: Any) -> bool:
    if isinstance(cost, SumCost):
        return any(map(_over_trajectory, cost.models))
    return isinstance(cost, ICNNCost) and cost.over == "trajectory"


def _modulus(cost: Any, nx: int, nu: int) -> np.ndarray:
    """Return M such that ℓ(z) − zᵀMz is convex."""
    if isinstance(cost, SumCost):
        parts = zip(cost.weights, cost.models, strict=True)
        return np.sum([weight * _modulus(model, nx, nu) for weight, model in parts], axis=0)
    if isinstance(cost, QuadraticCost):
        return scipy.linalg.block_diag(cost.Q, cost.R)
    return cost.floor * np.diag(1 / np.asarray(cost.scale) ** 2)
