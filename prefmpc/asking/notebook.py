"""`ask`: an interview in a notebook, with the front end of the page and Python as the learner."""

from __future__ import annotations

import base64
import datetime
import io
import os
import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from prefmpc._checks import instance, nonnegative, positive_int, share
from prefmpc.asking.desk import Desk
from prefmpc.asking.files import resume
from prefmpc.asking.interview import Interview
from prefmpc.asking.options import FUNCTIONS
from prefmpc.asking.page import DRAWINGS, appearance, scripts, source
from prefmpc.systems.linear import LinearSystem

CODE = """import jax
from prefmpc import Interview

jax.config.update("jax_enable_x64", True)
interview = Interview.load({log!r}, append=False{functions})
print(interview.model, interview.regret)
"""


def ask(
    interview: Interview,
    *,
    log: str | os.PathLike[str] | None = None,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    draw: str | None = None,
    who: str | None = None,
    level: float = 0.02,
    certain: float = 0.9,
    most: int = 30,
) -> Any:
    """Show an interview in a notebook, to be answered by clicks or keys.

    The last expression of a cell: it shows two responses, and writes each answer to the log
    before the next question appears. Run again, after whatever happened, it goes on where the
    log ends; the interview has all answers, whenever it is looked at.

    Parameters
    ----------
    interview : Interview
        With any plant.
    log : path, optional
        A new file, or that of this interview from an earlier session. Without it answers are
        kept where the interview keeps them: in its own log, or in memory alone.
    names, units : sequence of str, optional
        Of the states, then the inputs, then (optional) the outputs, which are then shown.
    draw : str, optional
        A drawing for the states of a plant of the library, "masses", "pendulum" or "lane"; or one
        of your own, in JavaScript: a function without arguments that returns {element, move(x, u,
        share)}, an SVG element, and what moves it to a state, an input, and a share of the time.
        It runs in the notebook.
    who : str, optional
        Who answers, for the log.
    level, certain : float
        Enough is known when the regret is at most ``level`` with probability ``certain``.
    most : int
        So many answers are enough in any case.

    Returns
    -------
    widget : anywidget.AnyWidget
        Where there is no browser it is a picture of the open question.

    Raises
    ------
    ValueError
        If an argument is out of range, or the log is damaged or of another interview.
    BlockingIOError
        If somebody else writes to the log.
    ImportError
        If the package anywidget is not installed.

    Warns
    -----
    UserWarning
        If the last line of the log was torn: it was never acknowledged, and is removed.
    """
    instance("interview", interview, Interview)
    limits = nonnegative("level", level), share("certain", certain), positive_int("most", most)
    for name, value in (("draw", draw), ("who", who)):
        if value is not None and not (isinstance(value, str) and value.strip()):
            raise ValueError(f"{name} must be a text, got {value!r}")
    own = draw is not None and draw not in DRAWINGS
    shown = appearance(interview._options, names, units, "own" if own else draw)
    torn = resume(interview, log, who is not None)
    notice = ""
    if interview._log is None:
        notice = "These answers are kept in memory alone: ask(…, log=…) writes them down."
    else:
        interview._log.notes = lambda: _notes(who)
    if torn:
        notice = (
            "The last line of the log was torn when its writer was stopped, and "
            "has been removed. Its answer was never acknowledged: please answer again."
        )
        warnings.warn(notice, stacklevel=2)
    desk = Desk(interview, shown["states"] + shown["inputs"], *limits)
    return _widget(desk, _config(interview, shown, limits[2]), notice, draw if own else None)


def _notes(who: str | None) -> dict[str, Any]:
    """Return what a line of the log has beside the answer."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"time": now} if who is None else {"time": now, "who": who}


def _config(interview: Interview, shown: dict[str, Any], most: int) -> dict[str, Any]:
    system, log = interview.system, interview._log
    kept = "answers.jsonl" if log is None else str(log.path)
    linear = isinstance(system, LinearSystem)
    needed = [name for name in FUNCTIONS if callable(getattr(interview._options, name))]
    functions = "".join(f", {name}={name}" for name in needed + ["system"] * (not linear))
    out = {
        "name": "",
        **shown,
        "method": {"steps": int(interview.next().first.u.shape[0]), "most": most},
        "code": CODE.format(log=kept, functions=functions),
    }
    return {**out, "C": np.asarray(system.C).tolist()} if isinstance(system, LinearSystem) else out


def _widget(desk: Desk, config: dict[str, Any], notice: str, draw: str | None) -> Any:
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise ImportError(
            "ask needs the package anywidget: pip install anywidget (or prefmpc[notebook])"
        ) from error
    own = "" if draw is None else f"prefmpcAsk.draw.scenes.own = () => (\n{draw}\n)();\n"

    class Ask(anywidget.AnyWidget):
        """The front end of a desk."""

        _esm = scripts("remote.js") + own + source("widget.js")
        _css = source("ask.css")
        config = traitlets.Dict().tag(sync=True)
        notice = traitlets.Unicode().tag(sync=True)

        def __repr__(self) -> str:
            return f"ask: {len(desk.interview)} answers"

        def _repr_mimebundle_(self, **kwargs: Any) -> Any:
            bundle: Any = super()._repr_mimebundle_(**kwargs)
            data, *rest = bundle or ({},)
            return {**data, "image/png": picture(desk.interview, self.config)}, *rest

    widget = Ask(config=config, notice=notice)

    def receive(_: Any, message: Any, __: Any) -> None:
        reply = desk.reply(message)
        if reply is not None:
            widget.send(reply)

    widget.on_msg(receive)
    return widget


def picture(interview: Interview, config: dict[str, Any]) -> str:
    """Return the open question as a PNG in base64."""
    from matplotlib.figure import Figure

    question, plots = interview.next(), config["plots"]
    figure = Figure(figsize=(9, 1.3 + 1.3 * len(plots)), layout="constrained")
    figure.suptitle(f"Question {question.number + 1}: which one do you prefer?")
    axes = figure.subplots(len(plots), 2, sharex=True, sharey="row", squeeze=False)
    for column, side in enumerate((question.first, question.second)):
        for row, plot in enumerate(plots):
            values = np.asarray(getattr(side, plot["signal"]))[:, plot["index"]]
            time = config["dt"] * np.arange(len(values) + 1)
            style = dict(zip(("C0", "C1", "C2"), ("-", "--", ":"), strict=True))
            for value, name, colour in zip(values.T, plot["names"], style, strict=False):
                held = plot["signal"] == "u"
                value, t = (np.append(value, value[-1]), time) if held else (value, time[:-1])
                steps = "steps-post" if held else "default"
                axes[row, column].plot(
                    t, value, colour, ls=style[colour], label=_plain(name), drawstyle=steps
                )
            axes[row, 0].set_ylabel(_plain(plot["label"]))
            if plot["legend"]:
                axes[row, 0].legend(fontsize="small")
        axes[-1, column].set_xlabel("time in s")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return base64.b64encode(buffer.getvalue()).decode()


def _plain(text: str) -> str:
    """Return a text in which matplotlib sees no formula."""
    return re.sub(r"(?<!\\)\$", r"\\$", text)
