"""Random answers of every kind, and their likelihood written out for cvxpy: no line in common."""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from prefmpc import Answers, Recordings, Trajectory


def pool_of(rng, count=8, nx=2, nu=1):
    lengths = rng.integers(2, 6, count)
    runs = [Trajectory(rng.normal(size=(n + 1, nx)), rng.normal(size=(n, nu))) for n in lengths]
    return Recordings(runs)


def some_answers(seed, per_kind=6):
    """Return a data set with answers of every kind about recordings of different lengths."""
    rng = np.random.default_rng(seed)
    pool, n = pool_of(rng), per_kind
    first, second = np.array([rng.permutation(8)[:2] for _ in range(n)]).T
    ties = rng.choice(["first", "second", "tie"], n)
    strengths = {"--": 0.0, "-": 0.25, "0": 0.5, "+": 0.75, "++": 1.0}
    orders = [rng.permutation(8)[: rng.integers(2, 7)] for _ in range(n)]
    tops = [order[: rng.integers(1, len(order) + 1)] for order in orders]
    sets = [rng.permutation(8)[: rng.integers(2, 7)] for _ in range(n)]
    four = {i: i / 3 for i in range(4)}
    return Answers.concatenate(
        [
            Answers(pool, np.stack([first, second], 1), np.full(n, 2), rng.uniform(size=n)),
            Answers.from_labels(pool, first, second, list(ties), coding="words"),
            Answers.from_labels(
                pool,
                first,
                second,
                list(rng.choice(list(strengths), n)),
                coding=strengths,
                grades=5,
            ),
            Answers.from_labels(
                pool, first, second, list(rng.integers(0, 4, n)), coding=four, grades=4
            ),
            Answers.from_rankings(pool, tops, shown=orders),
            Answers.from_choices(pool, sets, [s[rng.integers(len(s))] for s in sets]),
            Answers.from_ratings(pool, rng.integers(0, 2, 8).astype(bool), stars=2),
            Answers.from_ratings(pool, rng.integers(1, 6, 8), stars=5),
        ]
    )


def minus_log_likelihood(answers, sigma, t, log_sum_exp):
    """Return Σ −log P from σ[i] and thresholds by name, with NumPy or cvxpy expressions."""
    total = 0.0
    for row, grades, answer in zip(answers.shown, answers.grades, answers.answers, strict=True):
        s = [sigma[int(i)] for i in row if i >= 0]
        if grades == 0:
            for k in range(min(int(answer), len(s) - 1)):
                total += log_sum_exp([-one for one in s[k:]]) + s[k]
            continue
        if len(s) == 1:
            tau = {2: t["acceptable"], 5: t["5 stars"]}[int(grades)] if grades in (2, 5) else None
            u = [0.0 * s[0]]
            for j in range(grades - 1):
                u.append(u[-1] + tau[j] - s[0])
            mark = answer * (grades - 1)
        else:
            a, b = s
            u = {
                2: lambda a, b: [-b, -a],
                3: lambda a, b: [-b, t["tie"][0] - (a + b) / 2, -a],
                4: lambda a, b: [
                    1.5 * (a - b),
                    0.5 * (a - b) + t["4 grades"][0],
                    0.5 * (b - a) + t["4 grades"][0],
                    1.5 * (b - a),
                ],
                5: lambda a, b: [
                    a - b,
                    (a - b) / 2 + t["5 grades"][0],
                    t["5 grades"][1] + 0.0 * a,
                    (b - a) / 2 + t["5 grades"][0],
                    b - a,
                ],
            }[int(grades)](a, b)
            mark = answer * (grades - 1)
        low = int(np.floor(mark))
        share = mark - low
        said = (1 - share) * u[low] + (share * u[low + 1] if share else 0.0)
        total += log_sum_exp(u) - said
    return total


SIZES = {"acceptable": 1, "tie": 1, "4 grades": 1, "5 grades": 2, "5 stars": 4}


def costs(T, Q, R):
    """Return σ of every recording, step by step."""
    runs = [T[i] for i in range(len(T))]
    return [
        float(sum(x @ Q @ x for x in run.x[:-1]) + sum(u @ R @ u for u in run.u)) for run in runs
    ]


def in_cvxpy(answers, prior, spread):
    """Return the least −log posterior, Q, R and thresholds, by Clarabel's exponential cones."""
    runs = [answers.trajectories[i] for i in range(len(answers.trajectories))]
    nx, nu = len(prior.Q), len(prior.R)
    Q, R = cp.Variable((nx, nx), symmetric=True), cp.Variable((nu, nu), symmetric=True)
    t = {name: cp.Variable(size) for name, size in SIZES.items()}
    Sx = np.stack([(run.x[:-1].T @ run.x[:-1]).ravel() for run in runs])
    Su = np.stack([(run.u.T @ run.u).ravel() for run in runs])
    sigma = Sx @ cp.vec(Q, order="C") + Su @ cp.vec(R, order="C")
    cost = minus_log_likelihood(
        answers, sigma, t, lambda parts: cp.log_sum_exp(cp.hstack([cp.sum(p) for p in parts]))
    )
    for W, W0 in ((Q, prior.Q), (R, prior.R)):
        cost += prior.strength * (cp.trace(np.linalg.inv(W0) @ W) - cp.log_det(W))
    cost += sum(cp.sum_squares(value) for value in t.values()) / (2 * spread**2)
    problem = cp.Problem(cp.Minimize(cost))
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    return problem.value, Q.value, R.value, {name: value.value for name, value in t.items()}
