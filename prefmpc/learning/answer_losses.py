"""The loss of answers of every kind, for σ models of every kind: what `fit` makes of `Answers`."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from prefmpc._pytree import register_pytree
from prefmpc.learning.choices import Choices, Thresholds, choices_of, merged
from prefmpc.learning.losses import SMALLEST_SHAPE, features_of, padded_size, pair_data
from prefmpc.preferences.answers import Answers, as_answers
from prefmpc.preferences.comparisons import Comparisons
from prefmpc.preferences.recordings import Recordings, batches


@dataclasses.dataclass(frozen=True)
class WithThresholds:
    """A σ model, and the thresholds (..., q) that are learned with it."""

    model: Any
    thresholds: Any

    def bounds(self) -> tuple[Any, Any]:
        """Return the bounds of the model; thresholds have none."""
        low, high = self.model.bounds()
        far = jnp.full(self.thresholds.shape, jnp.inf)
        return WithThresholds(low, -far), WithThresholds(high, far)


register_pytree(WithThresholds)


class ChoiceData(NamedTuple):
    """Choices ready for the loss, and what σ needs of every trajectory, as `PairData` for pairs."""

    parts: tuple[Any, ...]
    """Features of recordings that last equally long; of all, if σ is linear in them."""
    order: Any
    """(n_t,): places of the trajectories in the parts, one after the other."""
    factor: Any
    """(n_t,): what the score of each is multiplied by, for means per step."""
    choices: Choices
    offsets: Any
    weights: Any

    def costs(self, model: Any) -> Any:
        """Return σ (n_t,) of every trajectory."""
        each = [model.score(features) for features in self.parts]
        return jnp.concatenate(each)[self.order] * self.factor

    def utilities(self, model: WithThresholds) -> Any:
        """Return u (n, K), −∞ where there is no alternative."""
        c = self.choices
        cost = jnp.sum(c.coefficients * self.costs(model.model)[c.items], axis=-1)
        u = (self.offsets @ model.thresholds)[c.which] - cost
        return jnp.where(c.possible, u, -jnp.inf)

    def losses(self, model: WithThresholds) -> Any:
        """Return −log P (n,) of what was chosen; nothing overflows."""
        u, c = self.utilities(model), self.choices
        best = jnp.max(u, axis=-1, keepdims=True)
        gaps = jnp.where(c.possible, u - best, 0.0)
        total = jnp.sum(jnp.where(c.possible, jnp.exp(gaps), 0.0), axis=-1)
        return jnp.log(total) - jnp.sum(c.chosen * gaps, axis=-1)

    def hits(self, model: WithThresholds) -> Any:
        """Return how much of each choice is what the model says."""
        best = jnp.argmax(self.utilities(model), axis=-1)
        return jnp.take_along_axis(self.choices.chosen, best[:, None], axis=-1)[:, 0]

    def hold_out(self, index: np.ndarray) -> None:
        """Give answers weight 0, with all choices of which they consist."""
        self.weights[np.isin(self.choices.answer, index)] = 0.0

    def part(self, chosen: Any) -> ChoiceData:
        """Return a mini-batch; see `PairData.part`.

        Only its own trajectories are scored, unless they last differently long or are few.
        """
        choices = jax.tree.map(lambda leaf: leaf[chosen], self.choices)
        weights = self.weights.at[chosen].get(mode="fill", fill_value=0.0)
        out = self._replace(choices=choices, weights=weights)
        if len(self.parts) > 1 or len(self.order) <= choices.items.size:
            return out
        used = choices.items.reshape(-1)
        parts = jax.tree.map(lambda leaf: leaf[self.order[used]], self.parts)
        places = np.arange(used.size)
        own = choices._replace(items=places.reshape(choices.items.shape))
        return out._replace(parts=parts, order=places, factor=self.factor[used], choices=own)


def choice_data(
    model: Any, answers: Answers, thresholds: Thresholds, smallest: int = SMALLEST_SHAPE
) -> ChoiceData:
    """Compute the features of all trajectories once, and pad the choices with some of weight 0."""
    T = answers.trajectories
    parts: tuple[Any, ...] = tuple(features_of(model, part) for part in batches(T))
    order, factor = np.arange(len(T)), np.ones(len(T))
    if isinstance(T, Recordings):
        order = T.order
        factor = 1 / T.horizons if T.per_step else factor
    if model.linear_in_features and len(parts) > 1:
        parts = (jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts),)
    found, offsets = choices_of(answers, thresholds)
    count = sum(len(part.answer) for part in found)
    width = max(part.chosen.shape[1] for part in found)
    choices, weights = merged(found, width, padded_size(count, smallest))
    return ChoiceData(parts, order, factor, choices, offsets, weights)


class Task(NamedTuple):
    """What is trained: the starts, with thresholds where some answers need them."""

    starts: Any
    thresholds: Thresholds | None
    """None: all data are plain pairs, and the starts are the models themselves."""

    @classmethod
    def of(cls, starts: Any, *sets: Any) -> Task:
        """Return the task of learning from the first of several data sets, or None in its place.

        The thresholds of single trajectories start at their mean σ, the others at 0.
        """
        given = [one for one in sets if one is not None]
        if all(isinstance(one, Comparisons) for one in given):
            return cls(starts, None)
        answers = [as_answers("comparisons", one) for one in given]
        thresholds = Thresholds.of(*answers)
        first = Thresholds.of(answers[0])
        data = choice_data(starts, answers[0], thresholds)
        sigma = np.asarray(jax.vmap(data.costs)(starts))
        values = np.zeros((len(sigma), thresholds.total))
        for (size, grades), place in thresholds.places.items():
            if size == 1 and (size, grades) in first.places:
                about = (answers[0].sizes == 1) & (answers[0].grades == grades)
                values[:, place] = sigma[:, answers[0].shown[about, 0]].mean(axis=1)[:, None]
        return cls(WithThresholds(starts, values), thresholds)

    def data(self, data_set: Any, smallest: int = SMALLEST_SHAPE) -> Any:
        """Return a data set ready for the loss."""
        if self.thresholds is None:
            return pair_data(self.starts, data_set, padded_size(len(data_set), smallest))
        answers = as_answers("comparisons", data_set)
        return choice_data(self.starts.model, answers, self.thresholds, smallest)

    def split(self, trained: Any) -> tuple[Any, dict[str, np.ndarray]]:
        """Return the models, and the thresholds by name."""
        if self.thresholds is None:
            return trained, {}
        return trained.model, self.thresholds.named(trained.thresholds)
