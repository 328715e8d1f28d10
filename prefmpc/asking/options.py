"""What an interview is told at its beginning: checked, and in a form that can be stored."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._checks import (
    choice,
    function,
    instance,
    instances,
    is_whole,
    nonnegative,
    positive,
    positive_int,
    require_x64,
    single,
)
from prefmpc._random import generator
from prefmpc.asking.belief import Belief, Prior
from prefmpc.asking.criteria import CRITERIA
from prefmpc.asking.features import FeatureMap, QuadraticFeatures, SeparableFeatures
from prefmpc.asking.log import to_json
from prefmpc.asking.loops import Loops, loops_about, loops_of
from prefmpc.asking.sources import States, check_pool
from prefmpc.learning.priors import WishartPrior, bryson, free_entries
from prefmpc.models.separable import SeparableCost
from prefmpc.mpc.steady import SteadyState, check_reference
from prefmpc.preferences.logs import FORMAT
from prefmpc.preferences.trajectories import Trajectory, rollout
from prefmpc.systems.linear import LinearSystem, System
from prefmpc.systems.sets import Polyhedron

FUNCTIONS = ("x0", "controller", "pool", "choose")

_OBJECTS = {"system": dict, "prior": dict, "constraints": dict | None, "pool": dict | None}
"""What stands in a log for an argument that is an object."""


@dataclasses.dataclass(eq=False)
class Options:
    """The arguments of an `Interview`, checked, and what is made of them once."""

    system: Any
    prior: Any
    x0: Any
    key: Any
    structure: Any
    spread: Any
    sharpness: Any
    coupling: Any
    steps: Any
    controller: Any
    reference: Any
    horizon: Any
    constraints: Any
    pool: Any
    choose: Any
    lapse: Any
    repeat_every: Any
    samples: Any

    def __post_init__(self) -> None:
        require_x64()
        instance("system", self.system, System)
        single("system", self.system)
        self.key = _words(self.key)
        choice("structure", self.structure, ("diagonal", "full"))
        self.spread = positive("spread", self.spread)
        self.sharpness = nonnegative("sharpness", self.sharpness)
        self.coupling = positive("coupling", self.coupling)
        for name in ("steps", "horizon", "samples"):
            setattr(self, name, positive_int(name, getattr(self, name)))
        if not (is_whole(self.repeat_every) and self.repeat_every == 0):
            self.repeat_every = positive_int("repeat_every", self.repeat_every)
        if isinstance(self.lapse, str):
            choice("lapse", self.lapse, ("estimate",))
        else:
            self.lapse = nonnegative("lapse", self.lapse)
            if self.lapse >= 1:
                raise ValueError(f'lapse must lie in [0, 1) or be "estimate", got {self.lapse}')
        self._check_sources()
        if self.prior is None:
            self.prior = self._default_prior()
        self.features = self._features()
        self._check_stabilisable()
        self.loops = self._loops()

    def _loops(self) -> Loops:
        def make(system: Any, constraints: Polyhedron | None) -> Loops:
            return loops_of(system, self.controller, self.steps, self.horizon, constraints)

        if self.reference is None:
            return make(self.system, self.constraints)
        return loops_about(self.reference, self.system, self.constraints, make)

    def starts(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return x(0) (m, nx): ``count``, or all of a shorter list; for each set point one."""
        x0 = self.states.draw(count, rng)
        if self.reference is None or len(x0) >= len(self.reference):
            return x0
        return x0[np.arange(len(self.reference)) % len(x0)]

    def _check_sources(self) -> None:
        if callable(self.choose):
            function("choose", self.choose, 1)
        else:
            choice("choose", self.choose, tuple(CRITERIA))
        if callable(self.controller):
            function("controller", self.controller, 2)
        else:
            choice("controller", self.controller, ("lqr", "mpc"))
            instance("system (with this controller)", self.system, LinearSystem)
        if callable(self.pool):
            function("pool", self.pool, 1)
        elif self.pool is not None:
            self.pool = check_pool(self.pool)
        if self.constraints is not None:
            instance("constraints", self.constraints, Polyhedron)
            if self.constraints.dim != self.system.nx + self.system.nu:
                raise ValueError(
                    f"constraints must be over (x, u), {self.system.nx + self.system.nu} entries, "
                    f"got {self.constraints.dim}"
                )
            if self.controller == "lqr":
                raise ValueError('constraints need controller="mpc", got "lqr", which keeps none')
        if self.x0 is None:
            if not isinstance(self.pool, Trajectory):
                raise ValueError("x0 must be given unless there is a pool of trajectories")
            self.x0 = np.unique(self.pool.x[:, 0], axis=0)
        self.states = States(self.x0, self.system.nx, self.constraints)
        if self.reference is not None:
            self._check_reference()

    def _check_reference(self) -> None:
        one = isinstance(self.reference, SteadyState)
        self.reference = [self.reference] if one else self.reference
        self.reference = instances("reference", self.reference, SteadyState)
        if self.pool is not None or callable(self.controller):
            raise ValueError(
                "reference must be None with a pool or a controller of your own: their "
                "trajectories hold x_r and u_r themselves"
            )
        if self.prior is None:
            raise ValueError("prior must be given (bryson makes one) with a reference")
        for at in self.reference:
            check_reference(at, self.system, self.constraints, ingredients=False)

    def _default_prior(self) -> WishartPrior:
        """Return Bryson's rule with what the responses reach: those of a pool, or of a first guess.

        The first guess is the LQR of Bryson's rule with the largest x(0) and the input limits.
        """
        force = np.minimum(-self.system.u_min, self.system.u_max)
        size = self.states.size()
        if isinstance(self.pool, Trajectory):
            reach = np.abs(self.pool.x).max((0, 1))
            force = np.where(np.isfinite(force), force, np.abs(self.pool.u).max((0, 1)))
        elif (
            isinstance(self.system, LinearSystem) and size is not None and np.isfinite(force).all()
        ):
            guess = np.divide(1.0, size**2, out=np.zeros_like(size), where=size > 0)
            with np.errstate(divide="ignore"):
                R = np.diag(1 / force**2)
            K, _ = self.system.lqr(np.diag(guess), R)
            x0 = self.states.draw(64, np.random.default_rng(0))
            runs = rollout(self.system, x0, K, self.steps, saturate=True)
            reach = np.abs(runs.x).max((0, 1))
        else:
            reach = np.zeros(self.system.nx)
        if (
            not (np.isfinite(reach) & (reach > 0)).all()
            or not (np.isfinite(force) & (force > 0)).all()
        ):
            raise ValueError(
                "prior must be given (bryson makes one) unless x0 and the input limits, or a pool, "
                "say how large each state and input may be"
            )
        return bryson(reach, force)

    def _features(self) -> FeatureMap:
        nx, nu = self.system.nx, self.system.nu
        if isinstance(self.prior, SeparableCost):
            if self.prior.batch_shape or len(self.prior.scale) != nx + nu:
                raise ValueError(f"prior must be a single σ of {nx + nu} signals")
            if not (np.asarray(self.prior.c) > 0).all():
                raise ValueError("prior must have positive weights c: their logarithms are learned")
            if not callable(self.controller):
                raise ValueError("controller must be a function if σ is a SeparableCost")
            return SeparableFeatures(self.prior)
        instance("prior", self.prior, WishartPrior)
        if self.prior.Q.shape != (nx, nx) or self.prior.R.shape != (nu, nu):
            raise ValueError(
                f"prior must weigh {nx} states and {nu} inputs, got Q {self.prior.Q.shape} and "
                f"R {self.prior.R.shape}"
            )
        free_entries(self.structure, self.prior)  # a diagonal structure needs a diagonal mode
        return QuadraticFeatures(self.prior.Q, self.prior.R, self.structure == "full")

    def _check_stabilisable(self) -> None:
        """Raise a ValueError if the centre of the prior has no stabilising gain."""
        if not callable(self.controller):
            try:
                self.system.lqr(self.prior.Q, self.prior.R)
            except ValueError as error:
                raise ValueError(f"system cannot be controlled: {error}") from None

    def belief(self) -> Belief:
        """Return the belief before any answer."""
        prior = Prior(self.spread, self.sharpness, self.coupling)
        return Belief(self.features, prior, None if self.lapse == "estimate" else self.lapse)

    def rng(self, count: int, purpose: int) -> np.random.Generator:
        """Return a generator that is a function of the key and of the number of answers."""
        return np.random.default_rng([*self.key, count, purpose])

    def stored(self) -> dict[str, Any]:
        """Return the head of a log."""
        line = {name: getattr(self, name) for name in (f.name for f in dataclasses.fields(self))}
        line |= {name: {"function": True} for name in FUNCTIONS if callable(line[name])}
        line["system"] = _parts(self.system, ("A", "B", "C", "u_min", "u_max", "dt"))
        if isinstance(self.prior, SeparableCost):
            line["prior"] = _parts(self.prior, ("c", "scale"))
        else:
            line["prior"] = _parts(self.prior, ("Q", "R", "strength"))
        if self.reference is not None:
            line["reference"] = [_parts(at, ("x", "u", "y")) for at in self.reference]
        if self.constraints is not None:
            line["constraints"] = _parts(self.constraints, ("H", "h"))
        return to_json({"prefmpc interview": FORMAT, **line})

    @classmethod
    def arguments(cls, line: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments of `Interview` from the head of a log, and what it cannot hold."""
        names = [field.name for field in dataclasses.fields(cls)]
        line = {"reference": None, **line}  # of a log from before there were set points
        if missing := [name for name in names if name not in line]:
            raise ValueError(f"{missing[0]} is missing")
        out = {name: line[name] for name in names}
        for name, wanted in _OBJECTS.items():
            if not isinstance(out[name], wanted):
                raise ValueError(f"{name} must be an object, got {out[name]!r:.50}")
        needed = {name for name in FUNCTIONS if out[name] == {"function": True}}
        if "A" not in out["system"]:
            needed.add("system")
        if needed != own.keys():
            raise ValueError(
                f"load must be given {sorted(needed) or 'nothing'}, which the log cannot hold, "
                f"got {sorted(own)}"
            )
        out |= own
        if "system" not in own:
            out["system"] = _made(LinearSystem, "system", out)
        out["prior"] = _made(SeparableCost if "c" in out["prior"] else WishartPrior, "prior", out)
        if out["reference"] is not None:
            if not isinstance(out["reference"], list):
                raise ValueError(f"reference must be a list, got {out['reference']!r:.50}")
            out["reference"] = [
                _made(SteadyState, "reference", {"reference": at}) for at in out["reference"]
            ]
        if out["constraints"] is not None:
            out["constraints"] = _made(Polyhedron, "constraints", out)
        if isinstance(out["pool"], dict):
            out["pool"] = _made(Trajectory, "pool", out)
        return out


def _parts(value: Any, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: getattr(value, name) for name in names if hasattr(value, name)}


def _made(kind: Any, name: str, line: dict[str, Any]) -> Any:
    """Return what `to_json` wrote: lists as arrays, infinite numbers in them as such."""
    try:
        return kind(
            **{
                part: np.array(value, dtype=np.float64) if isinstance(value, list) else value
                for part, value in line[name].items()
            }
        )
    except (TypeError, ValueError) as error:  # a field of another name, or of another kind
        raise ValueError(f"{name}: {error}") from error


def _words(key: Any) -> list[int]:
    """Return the whole numbers that a key is made of."""
    if isinstance(key, list) and key and all(map(is_whole, key)):
        return key  # of a log
    if is_whole(key) and key >= 0:
        return [int(key)]
    if not isinstance(key, jax.Array):
        raise ValueError(
            f"key must be a JAX random key or a whole number, got {type(key).__name__}"
        )
    generator(key)  # raises what is wrong with it
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return [int(word) for word in np.asarray(jax.random.key_data(key) if typed else key)]
