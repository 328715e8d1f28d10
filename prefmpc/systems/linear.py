"""Plants: what all have in common, linear ones, and the book's benchmark plant."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg
from jax.typing import ArrayLike

from prefmpc._checks import (
    bounds_pair,
    finite_array,
    instances,
    nonnegative,
    real_array,
    sample_time,
    single,
)
from prefmpc._matrices import psd_matrix
from prefmpc._pytree import Stack, register_pytree, set_fields, stacked
from prefmpc._units import cost_units

if TYPE_CHECKING:
    import control

RICCATI = 1e-8
"""How far a solution of Riccati's equation may be off, relative to its largest entry."""


class System:
    """A discrete-time plant x⁺ = f(x, u), y = g(x) with input bounds; see its two kinds.

    It has nx states, nu inputs and ny outputs, a sample time ``dt`` in seconds, and limits
    u_min, u_max (nu,) in the unit of the input, ±inf where there are none.
    """

    nx: int
    nu: int
    ny: int
    dt: float
    u_min: np.ndarray
    u_max: np.ndarray

    def step(self, x: Any, u: Any) -> Any:
        """Return the next state (..., nx) for x (..., nx) and u (..., nu)."""
        raise NotImplementedError

    def output(self, x: Any) -> Any:
        """Return the output (..., ny) for x (..., nx)."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True, eq=False, init=False)
class LinearSystem(System, Stack):
    """The discrete-time plant x⁺ = A x + B u, y = C x with u_min ≤ u ≤ u_max.

    Implements eq. (8) of arXiv 2511.22502.

    Parameters
    ----------
    A : array (nx, nx)
    B : array (nx, nu)
    C : array (ny, nx), optional
        Default: the identity, so that the output is the state.
    dt : float
        Sample time in seconds.
    u_min, u_max : array (nu,) or float, optional
        Input bounds in the unit of the input; None leaves that side open, equal ones lock an
        actuator.

    Raises
    ------
    ValueError
        If a matrix holds NaN or its shape does not fit, if dt ≤ 0, or if the bounds cross.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    u_min: np.ndarray
    u_max: np.ndarray
    dt: float
    nx: int
    nu: int
    ny: int

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike | None = None,
        *,
        dt: float,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
    ) -> None:
        a, b, c = _state_space(A, B, C)
        low, high = bounds_pair(("u_min", "u_max"), u_min, u_max, b.shape[1])
        sizes = {"nx": len(a), "nu": b.shape[1], "ny": len(c)}
        set_fields(self, A=a, B=b, C=c, u_min=low, u_max=high, dt=sample_time(dt), **sizes)

    def step(self, x: Any, u: Any) -> Any:
        """Return x⁺ = A x + B u, shape (..., nx)."""
        x, u = real_array("x", x), real_array("u", u)
        return x @ self.A.swapaxes(-1, -2) + u @ self.B.swapaxes(-1, -2)

    def output(self, x: Any) -> Any:
        """Return y = C x, shape (..., ny)."""
        return real_array("x", x) @ self.C.swapaxes(-1, -2)

    @classmethod
    def stack(cls, systems: Sequence[LinearSystem]) -> LinearSystem:
        """Return c plants of the same size and sample time as one, with a leading axis.

        For studies of many plants at once: `closed_loops` and `BatchedMPC` take such a stack, and
        ``step`` and ``output`` then take x (c, m, nx) and u (c, m, nu).
        """
        systems = instances("systems", systems, LinearSystem)
        for i, system in enumerate(systems):
            single(f"systems[{i}]", system)
        kinds = {(s.A.shape, s.B.shape, s.C.shape, s.dt) for s in systems}
        if len(kinds) > 1:
            raise ValueError(f"systems must agree in all shapes and in dt, got {sorted(kinds)}")
        return stacked(systems)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """(c,) for a stack of c plants, () for a single one."""
        return tuple(self.A.shape[:-2])

    def __len__(self) -> int:
        """Return the number of plants in a stack."""
        if not self.batch_shape:
            raise TypeError("a single plant has no length")
        return self.batch_shape[0]

    @classmethod
    def from_continuous(
        cls,
        A: ArrayLike,
        B: ArrayLike,
        C: ArrayLike | None = None,
        *,
        dt: float,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
    ) -> LinearSystem:
        """Discretise ẋ = A x + B u, y = C x exactly for inputs held constant over ``dt`` seconds.

        The zero-order hold is one matrix exponential: exp([[A, B], [0, 0]]·dt) holds both
        discrete matrices in its upper rows. Shapes, bounds and errors as in the constructor.
        """
        a, b, c = _state_space(A, B, C)
        dt = sample_time(dt)
        nx, nu = b.shape
        block = np.zeros((nx + nu, nx + nu))
        block[:nx, :nx], block[:nx, nx:] = a, b
        held = scipy.linalg.expm(block * dt)
        if not np.isfinite(held).all():
            raise ValueError(f"dt must be short enough for A and B: the plant overflows in {dt} s")
        return cls(held[:nx, :nx], held[:nx, nx:], c, dt=dt, u_min=u_min, u_max=u_max)

    @classmethod
    def from_control(
        cls,
        system: control.StateSpace,
        *,
        dt: float | None = None,
        u_min: ArrayLike | None = None,
        u_max: ArrayLike | None = None,
    ) -> LinearSystem:
        """Take over a python-control state space.

        A discrete one keeps its own sample time; a continuous one is discretised by zero-order
        hold with ``dt`` in seconds. A feed-through D ≠ 0 is refused: outputs are y = C x here.
        """
        if not all(hasattr(system, name) for name in ("A", "B", "C", "D", "dt")):
            raise ValueError(
                f"system must be a python-control StateSpace, got {type(system).__name__}; "
                "control.ss(...) makes one of a transfer function"
            )
        if np.any(np.asarray(system.D)):
            raise ValueError(f"system must have D = 0 (the output is y = C x), got D = {system.D}")
        continuous = system.isctime(strict=True) or system.dt == 0
        if not (continuous or system.dt is None or system.dt is True):
            own = float(system.dt)
            if dt is not None and not np.isclose(own, sample_time(dt), atol=0):
                raise ValueError(f"dt must equal the system's own sample time {own}, got {dt}")
            dt = own
        if dt is None:
            kind = "continuous-time" if continuous else "discrete-time"
            raise ValueError(f"dt must be given for a {kind} system without its own, got None")
        make = cls.from_continuous if continuous else cls
        return make(system.A, system.B, system.C, dt=dt, u_min=u_min, u_max=u_max)

    def to_control(self) -> control.StateSpace:
        """Return the same plant as a python-control ``StateSpace`` (without the input bounds)."""
        import control

        return control.ss(self.A, self.B, self.C, np.zeros((self.ny, self.nu)), self.dt)

    def lqr(self, Q: ArrayLike, R: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the LQR gain K (nu, nx) of u = −K x and the cost-to-go matrix P (nx, nx).

        Q (nx, nx) must be positive semidefinite, R (nu, nu) positive definite. Raises a
        ValueError if the pair (A, B) cannot be stabilised, or if Q leaves an undamped mode
        unseen, so that no stabilising solution exists.
        """
        Q = psd_matrix("Q", Q)
        R = psd_matrix("R", R, definite=True)
        if Q.shape != self.A.shape or R.shape != (self.nu, self.nu):
            raise ValueError(
                f"Q and R must have shapes {self.A.shape} and {(self.nu, self.nu)}, "
                f"got {Q.shape} and {R.shape}"
            )
        # In units in which Q, R and P are of order one: the solver loses digits in others.
        dx, du = cost_units(self.A, self.B, Q, R)
        A, B = self.A * dx / dx[:, None], self.B * du / dx[:, None]
        Q, R = Q * dx * dx[:, None], R * du * du[:, None]
        try:
            P = scipy.linalg.solve_discrete_are(A, B, Q, R)
            K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
            radius = float(np.abs(np.linalg.eigvals(A - B @ K)).max())
            if not radius < 1:
                raise np.linalg.LinAlgError(f"the closed loop has radius {radius:.6g}")
            miss = np.abs(Q + A.T @ P @ (A - B @ K) - P).max() / np.abs(P).max(initial=1e-300)
            if not miss < RICCATI:
                raise np.linalg.LinAlgError(f"Riccati's equation is missed by {miss:.1e}")
        except np.linalg.LinAlgError as error:
            # Only now: a mode that no input reaches stays in the closed loop, so this is caught.
            mode = _unstabilisable_mode(A, B)
            if mode is not None:
                raise ValueError(
                    f"the pair (A, B) must be stabilisable, got a mode {mode:.4g} with "
                    f"|mode| = {abs(mode):.4g} that no input reaches"
                ) from None
            raise ValueError(f"Q must see every undamped mode of A: {error}") from None
        return K * du[:, None] / dx, P / dx / dx[:, None]


register_pytree(LinearSystem, static=("dt", "nx", "nu", "ny"))


def _state_space(A: ArrayLike, B: ArrayLike, C: ArrayLike | None) -> tuple[Any, Any, Any]:
    A = np.asarray(finite_array("A", A, ndim=2))
    B = np.asarray(finite_array("B", B, ndim=2))
    if A.shape[0] != A.shape[1] or A.shape[0] == 0:
        raise ValueError(f"A must be square (nx, nx), got shape {A.shape}")
    nx = A.shape[0]
    if B.shape[0] != nx or B.shape[1] == 0:
        raise ValueError(f"B must have shape ({nx}, nu), got {B.shape}")
    C = np.eye(nx) if C is None else np.asarray(finite_array("C", C, ndim=2))
    if C.shape[1] != nx or C.shape[0] == 0:
        raise ValueError(f"C must have shape (ny, {nx}), got {C.shape}")
    return A, B, C


def _unstabilisable_mode(A: np.ndarray, B: np.ndarray) -> complex | None:
    """Return an eigenvalue on or outside the unit circle that fails the Hautus test, if any."""
    nx = A.shape[0]
    scale = max(float(np.linalg.norm(A, 2)), float(np.linalg.norm(B, 2)), 1.0)
    for mode in np.linalg.eigvals(A):
        if abs(mode) < 1 - 1e-12:
            continue
        pencil = np.concatenate([A - mode * np.eye(nx), B], axis=1)
        if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-10 * scale:
            return complex(mode)
    return None


def oscillating_masses(
    masses: ArrayLike | Sequence[float] = (1.0, 0.5, 1.0),
    stiffness: ArrayLike | Sequence[float] = 2.0,
    *,
    dt: float = 0.2,
    u_max: float = 1.0,
) -> LinearSystem:
    """Return the book's plant: masses on a line between two walls, joined by springs.

    Forces act on the first and the last mass; there is no damping. The state is
    (positions, velocities), the output the positions. With the defaults this is the plant of both
    case studies of arXiv 2511.22502, section III.

    Parameters
    ----------
    masses : array (n,)
        In kg, n ≥ 2.
    stiffness : float or array (n + 1,)
        Spring constants in N/m, wall to wall.
    dt : float
        Sample time in s.
    u_max : float
        Largest force in N, in both directions. ``np.inf`` leaves the force unbounded.

    Raises
    ------
    ValueError
        If fewer than two masses are given, a mass is not positive or a spring is negative.
    """
    m = np.asarray(finite_array("masses", masses, ndim=1))
    n = m.size
    if n < 2 or (m <= 0).any():
        raise ValueError(f"masses must be at least two positive numbers in kg, got {m}")
    k = np.asarray(finite_array("stiffness", stiffness))
    if k.shape not in ((), (n + 1,)) or (k < 0).any():
        raise ValueError(f"stiffness must be one or {n + 1} nonnegative numbers in N/m, got {k}")
    k = np.broadcast_to(k, (n + 1,))
    u_max = nonnegative("u_max", u_max, allow_inf=True)
    springs = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-springs / m[:, None], np.zeros((n, n))]])
    B = np.zeros((2 * n, 2))
    B[n, 0], B[-1, 1] = 1 / m[0], 1 / m[-1]
    C = np.eye(n, 2 * n)
    return LinearSystem.from_continuous(A, B, C, dt=dt, u_min=-u_max, u_max=u_max)
