"""Problems that cvxpy takes apart once, and that are then solved as cone programs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp

from prefmpc.mpc._cone import TIGHT, ConeProgram, ConeSolution


class ParametricProgram:
    """A cvxpy problem whose single parameter only shifts right-hand sides, solved directly.

    cvxpy takes the problem apart once; a solve then costs what Clarabel needs.
    """

    def __init__(self, problem: Any, parameter: Any, variables: Sequence[Any]) -> None:
        import cvxpy

        cp: Any = cvxpy

        def taken_apart(value: np.ndarray) -> tuple[dict[str, Any], float]:
            parameter.value = value
            data, _, inverse = problem.get_problem_data(
                cp.CLARABEL, canon_backend=cp.SCIPY_CANON_BACKEND
            )
            return data, float(inverse[-1]["offset"])

        data, self._offset = taken_apart(np.zeros(parameter.shape))
        self._base = data["b"]
        self._slope = np.stack(
            [taken_apart(unit)[0]["b"] - self._base for unit in np.eye(parameter.size)], axis=1
        )
        size = len(data["c"])
        P = data.get("P", sp.csc_matrix((size, size)))
        dims = data["dims"]
        # The cones of cvxpy's standard form, in its order.
        cones = [
            *(("zero", dims.zero), ("nonnegative", dims.nonneg)),
            *(("second_order", size) for size in dims.soc),
            *(("exponential", 3) for _ in range(dims.exp)),
        ]
        options = {} if dims.exp else TIGHT
        self._program = ConeProgram(P, data["c"], data["A"], self._base, cones, options)
        first = data["param_prob"].var_id_to_col
        self._places = [(first[v.id], v.shape) for v in variables]

    def solve(self, value: np.ndarray) -> tuple[ConeSolution, list[np.ndarray]]:
        """Return the solution for a value of the parameter, and the variables in it."""
        found = self._program.solve(self._base + self._slope @ value)
        parts = [
            found.z[start : start + int(np.prod(shape))].reshape(shape, order="F")
            for start, shape in self._places
        ]
        return dataclasses.replace(found, objective=found.objective + self._offset), parts

    def multipliers(self, found: ConeSolution) -> np.ndarray:
        """Return by how much the optimum falls for each unit by which the parameter grows."""
        return self._slope.T @ found.y
