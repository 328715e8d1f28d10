"""The scripts of the page "Ask a person" in an embedded V8, without a browser."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from py_mini_racer import MiniRacer

from prefmpc.asking.page import SOURCES as SCRIPTS

ENGINE = (
    *("linalg", "random", "plant", "belief", "questions", "interview", "blind", "masses", "remote"),
)

TAPE = """
globalThis.tape = (numbers) => {
  let k = 0;
  const next = () => {
    if (k >= numbers.length) throw new Error("the tape ends");
    return numbers[k++];
  };
  return { uniform: next, normal: next };
};
"""


class Page:
    """The page's arithmetic. A call passes its arguments and its result as JSON."""

    def __init__(self) -> None:
        self._context = MiniRacer()
        for name in ENGINE:
            self._context.eval((SCRIPTS / f"{name}.js").read_text(encoding="utf-8"))
        self._context.eval(TAPE)

    def close(self) -> None:
        self._context.close()

    def __call__(self, expression: str, **values: Any) -> Any:
        """Return the value of an expression in the names given, and `ask`."""
        names = ", ".join(["ask", *values])
        given = ", ".join(["prefmpcAsk", *(json.dumps(plain(v)) for v in values.values())])
        code = f"JSON.stringify((({names}) => {expression})({given}))"
        return json.loads(str(self._context.eval(code)))

    def wait(self, body: str) -> Any:
        """Return what the body of an asynchronous function of `ask` returns."""
        code = f"(async (ask) => {{ {body} }})(prefmpcAsk).then(JSON.stringify)"
        promise: Any = self._context.eval(code)
        return json.loads(promise.get())


def plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


class Tape:
    """A generator that keeps the standard numbers it has drawn, in their order."""

    def __init__(self, seed: int) -> None:
        self._rng, self.numbers = np.random.default_rng(seed), list[float]()

    def standard_normal(self, shape: Any) -> np.ndarray:
        return self._kept(self._rng.standard_normal(shape))

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> np.ndarray:
        size = np.broadcast(low, high).shape if size is None else size
        return low + (np.asarray(high) - low) * self._kept(self._rng.uniform(size=size))

    def choice(self, n: int, size: int, p: np.ndarray) -> np.ndarray:
        return np.searchsorted(np.cumsum(p), self.uniform(size=size), side="right")

    def _kept(self, values: np.ndarray) -> np.ndarray:
        self.numbers += np.ravel(values).tolist()
        return values
