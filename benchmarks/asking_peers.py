"""The race of the chapter on chosen questions, run by others: GLISp, BoTorch and APReL.

Not a part of ``make bench``: the competitors need an environment of their own, which
``asking_peers.txt`` describes. There ``python benchmarks/asking_peers.py --people 24`` writes
``book/extensions/asking_peers.json`` and prints its table; ``--people 0 --resume`` only prints.
People, plant and measure are those of `studies.asking`, and person k here is person k there.

GLISp and BoTorch tune the weights of a controller. Seven log weights, relative to Bryson's rule,
are searched; that of the first force stays, since a common factor changes no controller. The
person compares two closed loops from the same x(0), as long as an interview's. APReL learns a
cost from pairs of the paper's pool; it has no release on PyPI, so its method is written out.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import sys
import types
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "book"))
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import numpy as np
from scipy.special import log_expit, ndtri

from prefmpc._pytree import stacked
from prefmpc.asking.loops import lqr_loops
from prefmpc.asking.questions import information
from prefmpc.models.quadratic import QuadraticCost
from prefmpc.preferences.pools import random_states
from prefmpc.preferences.trajectories import Trajectory
from prefmpc.systems.linear import oscillating_masses
from studies import asking
from studies.quadratic import RADIUS
from studies.spread import read_spread, write_spread

OUT = Path(__file__).resolve().parents[1] / "book" / "extensions" / "asking_peers.json"
jax.config.update("jax_enable_x64", True)

PEOPLE = ("paper, sure", "paper, unsure", "random, sure", "random, unsure")
CENTRE = np.log(np.concatenate([np.diag(M) for M in (asking.rule().Q, asking.rule().R)]))
FREE = np.delete(np.arange(len(CENTRE)), 6)  # all but that of the first force
LOOP_STEPS, HALF_WIDTH, SPREAD = 20, 4.0, 2.0
REFITS = (1, 2, 3, 4, 5, 7, 10, 15, 20, 30, 40)
"""After these numbers of answers BoTorch fits its length scales anew."""

Space = Callable[[np.ndarray], np.ndarray]
"""Points (n, 7) of the unit cube ↦ seven log weights of each, relative to Bryson's rule."""


def box(points: np.ndarray) -> np.ndarray:
    """Return log weights in ±4: what an author of GLISp would search."""
    return HALF_WIDTH * (2 * points - 1)


def prior(points: np.ndarray) -> np.ndarray:
    """Return the quantiles of our prior: a uniform point is a draw from it."""
    return SPREAD * ndtri(np.clip(points, 1e-4, 1 - 1e-4))


def cost_of(log_weights: np.ndarray) -> QuadraticCost:
    """Return the diagonal σ of eight log weights."""
    w = np.exp(log_weights)
    return QuadraticCost(np.diag(w[:6]), np.diag(w[6:]))


@dataclasses.dataclass(eq=False)
class Tuning:
    """A person who compares the closed loops of controllers, points of the unit cube.

    ``x0`` says whether all loops begin in "one" state, so that the answers are about one thing,
    or each question has a "new" one, as in an interview.
    """

    person: asking.Person
    space: Space
    x0: str
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self._first = random_states(RADIUS, key=self.rng, shape=(1,))

    def cost(self, point: np.ndarray) -> QuadraticCost:
        """Return the σ of one point (7,)."""
        log_weights = CENTRE.copy()
        log_weights[FREE] += self.space(np.asarray(point, dtype=np.float64)[None])[0]
        return cost_of(log_weights)

    def prefers(self, first: np.ndarray, second: np.ndarray) -> bool:
        """Ask whether the closed loop of the first is better."""
        x0 = random_states(RADIUS, key=self.rng, shape=(1,)) if self.x0 == "new" else self._first
        pair = stacked([self.cost(first), self.cost(second)])
        loops = lqr_loops(oscillating_masses(), pair, x0, LOOP_STEPS)
        return bool(self.rng.uniform() < self.person.answers(loops[0], loops[1])[0])


def glisp(
    person: asking.Person,
    counts: tuple[int, ...],
    rng: np.random.Generator,
    *,
    space: Space = box,
    x0: str = "one",
) -> list[QuadraticCost]:
    """Let GLISp propose controllers, each to be compared with the best so far."""
    import pydoe

    # glis imports a name that pyDOE no longer has; its sampler is seeded like all else.
    sampler = partial(pydoe.lhs, seed=rng)
    sys.modules["pyDOE"] = types.SimpleNamespace(lhs=sampler)  # type: ignore[assignment]
    from glis import solvers

    solvers.lhs = sampler
    np.random.seed(rng.integers(2**32))  # noqa: NPY002, the swarm's
    tuning = Tuning(person, space, x0, rng)
    bounds = np.zeros(len(FREE)), np.ones(len(FREE))
    solver = solvers.GLISp(
        bounds, n_initial_random=10, expected_max_evals=max(counts) + 1, display=0
    )
    best, proposed = solver.initialize()
    found = []
    for count in range(1, max(counts) + 1):
        proposed = solver.update(-1 if tuning.prefers(proposed, best) else 1)
        best = solver.xbest
        if count in counts:
            found.append(tuning.cost(best))
    return found


def botorch(
    person: asking.Person,
    counts: tuple[int, ...],
    rng: np.random.Generator,
    *,
    space: Space = box,
    x0: str = "one",
) -> list[QuadraticCost]:
    """Fit BoTorch's PairwiseGP, compare two controllers with the largest EUBO, and so on.

    The first two pairs are random; the controller learned has the largest posterior mean.
    """
    import torch
    from botorch.acquisition import PosteriorMean
    from botorch.acquisition.preference import AnalyticExpectedUtilityOfBestOption
    from botorch.fit import fit_gpytorch_mll
    from botorch.models.pairwise_gp import PairwiseGP, PairwiseLaplaceMarginalLogLikelihood
    from botorch.optim import optimize_acqf

    torch.set_num_threads(1)
    torch.manual_seed(int(rng.integers(2**63)))
    tuning = Tuning(person, space, x0, rng)
    points = np.empty((0, len(FREE)))
    better: list[list[int]] = []
    model: Any = None
    state: Any = None
    found = []
    bounds = torch.stack([torch.zeros(len(FREE)), torch.ones(len(FREE))]).double()

    def largest(value: Any, q: int) -> np.ndarray:
        settings = {"num_restarts": 2, "raw_samples": 128, "options": {"maxiter": 25}}
        return optimize_acqf(value, bounds=bounds, q=q, **settings)[0].numpy()

    for count in range(1, max(counts) + 1):
        pair = rng.uniform(size=(2, len(FREE)))
        if count > 2:
            pair = largest(AnalyticExpectedUtilityOfBestOption(model), 2)
        n = len(points)
        points = np.concatenate([points, pair])
        better.append([n, n + 1] if tuning.prefers(*pair) else [n + 1, n])
        model = PairwiseGP(torch.tensor(points), torch.tensor(better))
        if count in REFITS:
            fit_gpytorch_mll(PairwiseLaplaceMarginalLogLikelihood(model.likelihood, model))
            state = {k: v for k, v in model.state_dict().items() if "covar_module" in k}
        else:
            model.load_state_dict(state, strict=False)
        if count in counts:
            found.append(tuning.cost(largest(PosteriorMean(model), 1)[0]))
    return found


def squares(pool: Trajectory) -> np.ndarray:
    """Return what the eight diagonal weights multiply, (n, 8)."""
    return np.concatenate([(pool.x[..., :-1, :] ** 2).sum(-2), (pool.u**2).sum(-2)], axis=-1)


def on_sphere(w: np.ndarray) -> float:
    """Return the log prior of APReL, of weights that are none of them negative."""
    return 0.0 if (w > 0).all() else -np.inf


def log_normal(w: np.ndarray) -> float:
    """Return the log prior of an interview of log weights about Bryson's rule."""
    return float(-0.5 * ((w**2).sum() - w.sum() ** 2 / (1 + len(w))) / SPREAD**2)


def sphere_step(w: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Propose the next weights as APReL does."""
    w = w + 0.05 * rng.standard_normal(w.shape)
    return w / np.linalg.norm(w)


def log_step(w: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Propose the next log weights."""
    return w + 0.4 * rng.standard_normal(w.shape)


def aprel(
    person: asking.Person,
    counts: tuple[int, ...],
    rng: np.random.Generator,
    ours: bool = False,
    rationality: float = 1.0,
) -> list[QuadraticCost]:
    """Ask the most informative pair of a pool, under a belief sampled by Metropolis-Hastings.

    As APReL does it: 100 samples, one in 20 after 200, and the mean is learned. Its weights have
    norm 1 and multiply standardised features, times the ``rationality`` of the person; with
    ``ours`` log weights are sampled from the posterior of an interview.
    """
    pool = asking.paper_pool(rng)
    size, features = len(CENTRE), squares(pool)
    scale = np.exp(-CENTRE) if ours else features.std(0)
    features = rationality * features / scale
    step, log_prior = (log_step, log_normal) if ours else (sphere_step, on_sphere)
    weights: Callable[[np.ndarray], np.ndarray] = np.exp if ours else np.asarray
    i, j = np.triu_indices(len(pool), 1)
    gap = features[j] - features[i]
    state = np.zeros(size) if ours else np.full(size, size**-0.5)
    won, asked, found = np.empty((0, size)), np.zeros(len(gap), dtype=bool), []

    def belief(w: np.ndarray) -> float:
        value = log_prior(w)
        return value + float(log_expit(won @ weights(w)).sum()) if value > -np.inf else value

    for count in range(max(counts) + 1):
        samples = metropolis(state, belief, step, rng)
        state = samples.mean(0) if ours else samples.mean(0) / np.linalg.norm(samples.mean(0))
        if count in counts:
            found.append(cost_of(np.log(weights(state) / scale)))
        P = np.exp(log_expit(weights(samples) @ gap.T))
        best = int(np.argmax(np.where(asked, -np.inf, information(P))))
        asked[best] = True
        first, second = (pool[np.array([k[best]])] for k in (i, j))
        sign = 1.0 if rng.uniform() < person.answers(first, second)[0] else -1.0
        won = np.concatenate([won, sign * gap[best : best + 1]])
    return found


def metropolis(
    state: np.ndarray,
    log_density: Callable[[np.ndarray], float],
    step: Callable[[np.ndarray, np.random.Generator], np.ndarray],
    rng: np.random.Generator,
    samples: int = 100,
) -> np.ndarray:
    """Return states (samples, n) of a chain: one in 20, after the first 200."""
    kept, density = [], log_density(state)
    for k in range(200 + 20 * samples):
        proposed = step(state, rng)
        there = log_density(proposed)
        if np.log(rng.uniform()) < there - density:
            state, density = proposed, there
        if k >= 200 and k % 20 == 0:
            kept.append(state)
    return np.array(kept)


PEERS: dict[str, asking.Strategy] = {
    "GLISp, box, one x(0)": glisp,
    "GLISp, box, new x(0)": partial(glisp, x0="new"),
    "GLISp, our prior, new x(0)": partial(glisp, space=prior, x0="new"),
    "BoTorch EUBO, box, one x(0)": botorch,
    "BoTorch EUBO, our prior, new x(0)": partial(botorch, space=prior, x0="new"),
    "APReL, its belief": aprel,
    "APReL, its belief, rationality 10": partial(aprel, rationality=10.0),
    "APReL, our prior": partial(aprel, ours=True),
}


def draw(seed: int, peers: tuple[str, ...] = tuple(PEERS)) -> dict[str, np.ndarray]:
    """Race the competitors for one draw of each of `PEOPLE`."""
    warnings.simplefilter("ignore")  # of BoTorch, where a fit is hard
    asking.STRATEGIES.update(PEERS)
    return asking.asking_case(key=jax.random.key(seed), people=PEOPLE, strategies=peers)


def table(regret: np.ndarray) -> list[dict[str, Any]]:
    """Return a row for each kind of person, competitor and count, of regrets (draws, …)."""
    rng = np.random.default_rng(0)
    resampled = regret[rng.integers(0, len(regret), (2000, len(regret)))]
    low, high = np.quantile(np.median(resampled, axis=1), [0.025, 0.975], axis=0)
    middle, most = np.quantile(regret, [0.5, 0.9], axis=0)
    numbers = {"median": middle, "quantile 90 %": most, "median from": low, "median to": high}
    rows = []
    for i, k, n in np.ndindex(regret.shape[1:]):
        row = {"people": PEOPLE[i], "competitor": tuple(PEERS)[k], "answers": asking.COUNTS[n]}
        found = {name: round(float(v[i, k, n]), 4) for name, v in numbers.items()}
        rows.append(row | {"draws": len(regret)} | found)
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """Print the rows as a table in Markdown: median (its interval) / 90 % quantile, in percent."""
    print("| people | competitor |" + "".join(f" {n} answers |" for n in asking.COUNTS))
    print("|---|---|" + "---|" * len(asking.COUNTS))
    for k in range(0, len(rows), len(asking.COUNTS)):
        line = f"| {rows[k]['people']} | {rows[k]['competitor']} |"
        for row in rows[k : k + len(asking.COUNTS)]:
            middle, most, low, high = (100 * v for v in list(row.values())[-4:])
            line += f" {middle:.1f} ({low:.1f} to {high:.1f}) / {most:.0f} |"
        print(line)


def main() -> None:
    """Run from the command line; the file is written anew after each draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=24, help="seeds 0 … PEOPLE − 1")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--resume", action="store_true", help="keep the draws that OUT holds")
    options = parser.parse_args()
    head: dict[str, Any] = {"people": PEOPLE, "strategies": tuple(PEERS), "counts": asking.COUNTS}
    draws = []
    if options.resume and options.out.exists():
        draws = [{"regret": regret} for regret in read_spread(options.out)["regret"]]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for found in pool.imap(draw, range(len(draws), options.people)):
            draws.append(found)
            rows = table(np.array([d["regret"] for d in draws]))
            head |= {"table": rows, "seeds": list(range(len(draws)))}
            write_spread(options.out, head, draws)
            print(f"{len(draws)} of {options.people}", flush=True)
    show(table(np.array([d["regret"] for d in draws])))


if __name__ == "__main__":
    main()
