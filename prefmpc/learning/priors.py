"""What is believed of Q and R before anybody answered, and which of their entries are free.

The learner leans on the form of these priors: they are log-concave in (Q, R), which makes the
problem convex and its certificate one of the global minimum. Another family is another learner.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jax.typing import ArrayLike

from prefmpc._checks import instances, is_whole, positive, positive_vector, sequence
from prefmpc._matrices import psd_matrix
from prefmpc.preferences.comparisons import Comparisons

Structure = Literal["full", "diagonal"] | tuple[np.ndarray, np.ndarray]
"""Which entries of Q and R may differ from zero: by name, or as two masks (see `blocks`)."""


@dataclasses.dataclass(frozen=True, eq=False)
class WishartPrior:
    """What is believed of Q and R before anybody answered: a mode, and how strongly.

    log p(Q, R) = −strength·[tr(Q₀⁻¹Q) − log det Q + tr(R₀⁻¹R) − log det R] + const, the logarithm
    of two Wishart densities with modes Q₀ and R₀. The *scale* of the mode says how sharp the
    answers are expected to be: σ is in units of log-odds. There is no other noise parameter: a
    person who answers with P = 1 / (1 + exp(−β·z)) and weights (Q, R) answers like one with
    β = 1 and weights (βQ, βR), so β is fixed at 1.

    Parameters
    ----------
    Q : array (nx, nx)
    R : array (nu, nu)
        Q₀ and R₀, symmetric positive definite.
    strength : float
        Positive. The weights are gamma distributed for one signal, with shape strength + 1.

    Raises
    ------
    ValueError
        If a mode is not positive definite or ``strength`` is not positive.
    """

    Q: np.ndarray
    R: np.ndarray
    strength: float = 1.0

    def __post_init__(self) -> None:
        for name in ("Q", "R"):
            matrix = psd_matrix(name, getattr(self, name), definite=True, stack=False)
            object.__setattr__(self, name, matrix)
        object.__setattr__(self, "strength", positive("strength", self.strength))


def bryson(
    x_max: ArrayLike, u_max: ArrayLike, *, scale: float = 1.0, strength: float = 1.0
) -> WishartPrior:
    """Return the prior of an engineer who knows only the largest acceptable deviations.

    Bryson's rule: each weight is 1 / (largest acceptable value)², so that a signal at its limit
    costs ``scale`` in each step.

    Parameters
    ----------
    x_max : array (nx,)
    u_max : array (nu,)
        Positive, in the units of x and u. For ``fit_map(..., outputs=C)``: of y and u.
    scale, strength : float
        Positive; see `WishartPrior`.
    """
    scale = positive("scale", scale)
    limits = positive_vector("x_max", x_max), positive_vector("u_max", u_max)
    Q, R = (np.diag(scale / limit**2) for limit in limits)
    return WishartPrior(Q, R, strength)


def blocks(
    states: Sequence[Sequence[int]], inputs: Sequence[Sequence[int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the masks of block-diagonal Q and R, for ``fit_map(..., structure=...)``.

    Parameters
    ----------
    states, inputs : groups of indices
        Each index in one group; only signals of one group are weighed together.
        ``blocks([[0, 3], [1, 4], [2, 5]], [[0], [1]])`` couples the position of each of three
        masses with its speed, and nothing else.

    Returns
    -------
    bool array (nx, nx), bool array (nu, nu)
    """
    masks = []
    for name, value in {"states": states, "inputs": inputs}.items():
        groups = [sequence(f"{name}[{i}]", g) for i, g in enumerate(sequence(name, value))]
        flat = [i for group in groups for i in group]
        whole = all(map(is_whole, flat))
        if not flat or not whole or sorted(flat) != list(range(len(flat))):
            raise ValueError(
                f"{name} must name each index 0 to {max(len(flat) - 1, 0)} in one group, "
                f"got {groups}"
            )
        mask = np.zeros((len(flat), len(flat)), dtype=bool)
        for group in groups:
            mask[np.ix_(np.array(group, int), np.array(group, int))] = True
        masks.append(mask)
    return masks[0], masks[1]


def free_entries(structure: Any, prior: WishartPrior) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the free entries of blkdiag(Q, R), lower triangle, row by row.

    Raises a ValueError if ``structure`` is none, or if the prior's mode has an entry outside.
    """
    sizes = len(prior.Q), len(prior.R)
    if isinstance(structure, str) and structure in ("full", "diagonal"):
        masks = [np.ones((n, n), bool) if structure == "full" else np.eye(n) > 0 for n in sizes]
    elif isinstance(structure, tuple) and len(structure) == 2:
        try:
            masks = [np.asarray(mask) for mask in structure]
        except Exception as error:  # whatever the objects' own conversion raises
            raise ValueError(f"structure must hold two bool masks: {error}") from None
        for name, mask, n in zip("QR", masks, sizes, strict=True):
            good = mask.dtype == bool and mask.shape == (n, n) and (mask == mask.T).all()
            if not good or not mask.diagonal().all():
                raise ValueError(
                    f"structure must hold a symmetric bool mask ({n}, {n}) for {name} with a True "
                    f"diagonal, got shape {mask.shape} of {mask.dtype}"
                )
    else:
        raise ValueError(
            f'structure must be "full", "diagonal" or two masks (for Q, for R), got {structure!r}'
        )
    pairs = []
    for name, mask, matrix, at in zip("QR", masks, (prior.Q, prior.R), (0, sizes[0]), strict=True):
        if (matrix[~mask] != 0).any():
            kind = structure if isinstance(structure, str) else "the masks"
            raise ValueError(f"prior must fit structure ({kind}), its {name} has entries outside")
        rows, columns = np.nonzero(np.tril(mask))
        pairs.append((rows + at, columns + at))
    (rows_Q, columns_Q), (rows_R, columns_R) = pairs
    return np.concatenate([rows_Q, rows_R]), np.concatenate([columns_Q, columns_R])


def paired(
    comparisons: Comparisons | Sequence[Comparisons],
    priors: WishartPrior | Sequence[WishartPrior],
) -> tuple[list[Comparisons], list[WishartPrior]]:
    """Return as many data sets as priors: one of something goes with all of the other."""
    one_set, one_prior = isinstance(comparisons, Comparisons), isinstance(priors, WishartPrior)
    data_sets: list[Any] = (
        [comparisons] if one_set else instances("comparisons", comparisons, Comparisons)
    )
    beliefs: list[Any] = [priors] if one_prior else instances("priors", priors, WishartPrior)
    if one_set:
        data_sets *= len(beliefs)
    elif one_prior:
        beliefs *= len(data_sets)
    if len(data_sets) != len(beliefs):
        raise ValueError(
            "comparisons and priors must be equally many, or one of them a single one, "
            f"got {len(data_sets)} and {len(beliefs)}"
        )
    return data_sets, beliefs
