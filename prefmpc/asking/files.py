"""An interview in files: the log that is resumed, and a page that asks without Python."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any, Self

from prefmpc._checks import flag, positive_int
from prefmpc._files import atomic_write
from prefmpc.asking import page
from prefmpc.asking.answers import Answer, line_of, replayed
from prefmpc.asking.log import Log, encoded
from prefmpc.asking.options import Options
from prefmpc.preferences.logs import at_line, read


class Files:
    """What an `Interview` writes, and how one is read."""

    _options: Options
    _answers: list[Answer]
    _batch: tuple[int, int]
    _log: Log | None

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the whole interview as a log, which `load` resumes."""
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"path must be a path, got {type(path).__name__}")
        with atomic_write(path, overwrite=overwrite) as file:
            file.write(self._text())

    def to_html(
        self,
        path: str | os.PathLike[str],
        *,
        title: str = "Ask a person",
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
        draw: str | None = None,
        most: int = 30,
        overwrite: bool = False,
    ) -> None:
        """Write a page that goes on with this interview in a browser, and needs nothing else.

        The answers come back as a file that `load` and `Comparisons.load` read.

        Parameters
        ----------
        title : str
        names, units : sequence of str, optional
            Of the states, then the inputs, then (optional) the outputs, which are then shown.
        draw : "masses", "pendulum" or "lane", optional
            What moves: a drawing for the states of `oscillating_masses` (the default for that
            plant), `cart_pendulum` or `kinematic_bicycle`. Other plants are shown by curves.
        most : int
            The page stops after so many answers, or when it knows enough.

        Raises
        ------
        ValueError
            If a text is none, or the interview has what the page cannot do: a plant that is not
            linear, couplings, a pool, or another controller, criterion or x0 than its own.
        FileExistsError
            If ``path`` exists and ``overwrite`` is False.
        """
        shown: dict[str, Any] = {"title": title, "names": names, "units": units, "draw": draw}
        shown |= {"most": positive_int("most", most), "overwrite": flag("overwrite", overwrite)}
        page.write(path, self._options, self._text(), **shown)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, append: bool = True, **functions: Any) -> Self:
        """Resume an interview from its log: the same answers, and the same next question.

        Parameters
        ----------
        path : path-like
        append : bool
            Go on writing to the same file.
        **functions
            Those of ``x0``, ``controller``, ``pool`` and ``choose`` that were functions, and a
            ``system`` that is no `LinearSystem`: they cannot be stored.

        Raises
        ------
        ValueError
            If the file is no log, or needs a function that is not given. What is wrong in it is
            named with its line and field.
        """
        lines, size = read(path)
        with at_line(path, 1):
            interview = cls(**Options.arguments(lines[0], functions))
        interview._answers, interview._batch = replayed(lines, path)
        if append:
            interview._log = Log(path, size)
        return interview

    def _text(self) -> bytes:
        """Return the whole log, without what was taken back."""
        lines = [line_of(number, answer) for number, answer in enumerate(self._answers)]
        return b"".join(map(encoded, [self._options.stored(), *lines]))


def resume(interview: Files, path: Any, needed: bool) -> int:
    """Let an interview go on from its log, which it alone may write to from now on.

    Parameters
    ----------
    path : path or None
        A new file, that of an earlier session with the same interview, or None for the log that
        the interview has.
    needed : bool
        Whether there must be a log.

    Returns
    -------
    torn : int
        Bytes of a torn last line, which was removed.
    """
    if path is None:
        if needed and interview._log is None:
            raise ValueError("log must be given if it is to say who answers, got None")
        return 0 if interview._log is None else interview._log.hold()
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"log must be a path, got {type(path).__name__}")
    if interview._log is not None:
        own = interview._log.path
        if os.path.realpath(own) != os.path.realpath(path):
            raise ValueError(f"log must be {own}, the interview's own, got {path}")
        return interview._log.hold()
    if not os.path.lexists(path):
        interview.save(path)
    lines, size = read(path)
    log = Log(path, size)
    for name, value in json.loads(encoded(interview._options.stored())).items():
        if lines[0].get(name) != value:
            raise ValueError(f"log must be of this interview, but {path} has another {name}")
    answers, batch = replayed(lines, path)
    texts = [
        [encoded(line_of(*a)) for a in enumerate(some)] for some in (answers, interview._answers)
    ]
    if texts[0][: len(texts[1])] != texts[1]:
        raise ValueError(f"log must begin with the answers that the interview has, {path} does not")
    torn = log.hold()
    interview._log = log
    interview._answers, interview._batch = answers, batch
    return torn
