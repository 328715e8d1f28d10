"""Control from measured outputs without an offset: a Kalman filter that finds disturbances."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import finite_array, instance, positive_vector, shaped, single
from prefmpc.mpc.qp import LinearMPC
from prefmpc.mpc.solution import Controller, MPCSolution, Outcome, mpc_solution
from prefmpc.mpc.steady import SteadyState, steady_state
from prefmpc.systems.linear import LinearSystem


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A state x (nx,) and disturbances d (nd,) of the model of an estimator."""

    x: np.ndarray
    d: np.ndarray


class KalmanEstimator:
    """The stationary Kalman filter of x⁺ = A x + B u + B_d d, y = C x + C_d d with a constant d.

    All noise is white, as standard deviations for each step, each in the unit of its signal. How
    far they are apart says how fast the filter is: a larger ``disturbance_noise`` finds d sooner,
    and takes more of the measurements' noise for it.

    Parameters
    ----------
    system : LinearSystem
    B_d : array (nx, nd), optional
        Default: B, disturbances that enter like the inputs.
    C_d : array (ny, nd), optional
        Default: zeros. For a model that is wrong in ways unknown take as many disturbances as
        outputs, where errors come in: forces, rather than offsets of the outputs (C_d), which a
        plant with little damping hardly tells from its own swinging.
    state_noise : array (nx,)
    output_noise : array (ny,)
    disturbance_noise : array (nd,)

    Raises
    ------
    ValueError
        If a size does not fit, a deviation is not positive, or the outputs do not tell the
        disturbances from the state.
    """

    def __init__(
        self,
        system: LinearSystem,
        *,
        state_noise: ArrayLike,
        output_noise: ArrayLike,
        disturbance_noise: ArrayLike,
        B_d: ArrayLike | None = None,
        C_d: ArrayLike | None = None,
    ) -> None:
        instance("system", system, LinearSystem)
        single("system", system)
        self.system, nx, ny = system, system.nx, system.ny
        B_d = system.B if B_d is None else B_d
        self.B_d = np.asarray(shaped("B_d", finite_array("B_d", B_d, ndim=2), (nx, None)))
        nd = self.B_d.shape[1]
        C_d = np.zeros((ny, nd)) if C_d is None else C_d
        self.C_d = np.asarray(shaped("C_d", finite_array("C_d", C_d, ndim=2), (ny, nd)))
        deviations = {
            "state_noise": (state_noise, nx),
            "output_noise": (output_noise, ny),
            "disturbance_noise": (disturbance_noise, nd),
        }
        sizes = [
            shaped(name, positive_vector(name, value), (size,))
            for name, (value, size) in deviations.items()
        ]
        A = np.block([[system.A, self.B_d], [np.zeros((nd, nx)), np.eye(nd)]])
        C = np.concatenate([system.C, self.C_d], axis=1)
        W, V = np.diag(np.concatenate([sizes[0], sizes[2]]) ** 2), np.diag(sizes[1] ** 2)
        try:
            # The filter's gain is the LQR's of the dual plant.
            _, P = LinearSystem(A.T, C.T, dt=system.dt).lqr(W, V)
        except ValueError as error:
            raise ValueError(
                f"B_d and C_d must be such that outputs tell disturbances from the state: {error}"
            ) from None
        self._C = C
        self._gain = np.linalg.solve(C @ P @ C.T + V, C @ P).T
        self.reset()

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the measurements: the state is x0 (nx,), default the origin, undisturbed."""
        nx = self.system.nx
        x0 = np.zeros(nx) if x0 is None else finite_array("x0", x0, ndim=1)
        self._expected = np.concatenate([shaped("x0", x0, (nx,)), np.zeros(self.B_d.shape[1])])

    def corrected(self, y: ArrayLike) -> Estimate:
        """Return the estimate after a measurement y (ny,); asking twice changes nothing."""
        y = shaped("y", finite_array("y", y, ndim=1), (self.system.ny,))
        z = self._expected + self._gain @ (y - self._C @ self._expected)
        return Estimate(z[: self.system.nx], z[self.system.nx :])

    def predict(self, now: Estimate, u: ArrayLike) -> None:
        """Go on by a step in which the plant received u (nu,)."""
        u = np.asarray(shaped("u", finite_array("u", u, ndim=1), (self.system.nu,)))
        x = self.system.A @ now.x + self.system.B @ u + self.B_d @ now.d
        self._expected = np.concatenate([x, now.d])


class OutputFeedback(Controller):
    """A controller of measured outputs that reaches its set point in spite of disturbances.

    In each step the estimator finds state and disturbance; `steady_state` finds where the
    disturbed model rests with its output at y_r, or as near as it can; and the controller,
    which knows the disturbance, steers there. If the loop comes to rest, the filter's constant
    disturbance explains the measurement, and the output is where the target wants it: without an
    offset, also with a wrong model, as long as there are as many disturbances as outputs.

    Parameters
    ----------
    controller : LinearMPC
        Without terminal ingredients: these are made for the origin.
    estimator : KalmanEstimator
    y_r : array (ny,), optional
        The first set point; default 0.

    Raises
    ------
    ValueError
        If controller and estimator are not for the same sizes.
    """

    def __init__(
        self,
        controller: LinearMPC,
        estimator: KalmanEstimator,
        y_r: ArrayLike | None = None,
    ) -> None:
        instance("controller", controller, LinearMPC)
        instance("estimator", estimator, KalmanEstimator)
        ours, theirs = controller.system, estimator.system
        if (ours.nx, ours.nu, ours.ny) != (theirs.nx, theirs.nu, theirs.ny):
            raise ValueError(
                f"estimator must have {ours.nx} states, {ours.nu} inputs and {ours.ny} outputs "
                f"like the controller, got {theirs.nx}, {theirs.nu} and {theirs.ny}"
            )
        if controller._ingredients:
            raise ValueError("controller must have no TerminalIngredients, made for the origin")
        self.controller, self.estimator = controller, estimator
        self.estimate = Estimate(np.zeros(ours.nx), np.zeros(estimator.B_d.shape[1]))
        self.track(np.zeros(ours.ny) if y_r is None else y_r)

    def track(self, y_r: ArrayLike) -> None:
        """Follow another set point y_r (ny,) from now on."""
        y = finite_array("y_r", y_r, ndim=1)
        self.y_r = np.asarray(shaped("y_r", y, (self.controller.system.ny,)))

    def target(self) -> SteadyState:
        """Return where the model can rest with the disturbance that is estimated now.

        Its output, without that disturbance's own part, is as near to y_r as limits allow. Raises
        a ValueError if it can rest nowhere.
        """
        d = self.estimate.d
        return steady_state(
            self.controller.system,
            self.y_r - self.estimator.C_d @ d,
            constraints=self.controller._hard,
            disturbance=self.estimator.B_d @ d,
            nearest=True,
        )

    def solve(self, x0: ArrayLike) -> MPCSolution:
        """Solve for a measured output (ny,), which is what ``x0`` is here."""
        began = time.perf_counter()
        self.estimate = now = self.estimator.corrected(x0)
        try:
            target = self.target()
        except ValueError as error:
            system, N = self.controller.system, self.controller.horizon
            return mpc_solution(system, N, Outcome("infeasible", str(error)), began)
        push = self.estimator.B_d @ now.d
        return self.controller.solve(now.x, reference=target, disturbance=push)

    def applied(self, u: np.ndarray) -> None:
        """Take note of the input that the plant received: say so after a failed solve, too."""
        self.estimator.predict(self.estimate, u)
        self.controller.applied(u)

    def reset(self) -> None:
        """Forget all measurements; the set point stays."""
        self.estimator.reset()
        self.controller.reset()
