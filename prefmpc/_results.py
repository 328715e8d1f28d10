"""What the results of fits and solves share: nobody uses a failed one unawares."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar

import jax
import numpy as np


class FitError(RuntimeError):
    """No model was learned that may be used."""


class Result:
    """The outcome of something that may fail. A subclass has ``status`` and ``message``."""

    GOOD: ClassVar[str] = "converged"
    """The status of what may be used."""

    NAME: ClassVar[str]
    """Of the function whose result it is, for errors and warnings."""

    status: Any
    message: Any

    @property
    def success(self) -> bool:
        """Whether the status says that this may be used; of an array, everywhere."""
        return bool(np.all(np.asarray(self.status) == self.GOOD))

    def check(self) -> None:
        """Raise the error that names what went wrong, unless this is a success."""
        if not self.success:
            raise self._error()

    def _error(self) -> Exception:
        """Return the error of `check`."""
        return FitError(f"{self.NAME}: {self.message}")


class Restarts(Result):
    """A stack of ``models``, one from each start, of which ``chosen`` may be used, if any."""

    models: Any
    chosen: int | None

    @property
    def success(self) -> bool:
        """Whether at least one restart gave a model that may be used."""
        return self.chosen is not None

    @property
    def model(self) -> Any:
        """The chosen model. Raises a `FitError` if there is none."""
        self.check()
        return jax.tree.map(lambda leaf: leaf[self.chosen], self.models)


def warn_of_failure(result: Result, note: str = "") -> None:
    """Warn the user, who called the function that calls this, unless the result is a success."""
    if not result.success:
        warnings.warn(f"{result.NAME}: {result.message}{note}", RuntimeWarning, stacklevel=3)
