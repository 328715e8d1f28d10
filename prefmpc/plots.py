"""The book's figures in one style: arrays in, a matplotlib figure out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from prefmpc._checks import instance, real_array, sample_time

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, safe for the colour-blind, strongest contrasts first."""

LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), "-")
"""Line styles that go with `COLOURS`, so that a figure survives being printed in grey."""

STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.facecolor": "white",
    "figure.facecolor": "white",
    "figure.constrained_layout.use": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "font.size": 10,
    "axes.prop_cycle": cycler(color=list(COLOURS)) + cycler(linestyle=list(LINES)),
}


def use_style() -> None:
    """Apply the book's style to all figures that follow."""
    mpl.rcParams.update(STYLE)


def responses(
    responses: Mapping[str, ArrayLike],
    dt: float,
    *,
    ylabel: str,
    title: str = "",
    ax: Axes | None = None,
    step: bool = False,
) -> Axes:
    """Draw one signal over time, a line for each named response.

    Parameters
    ----------
    responses : mapping of label to array (steps,)
    dt : float
        Sample time in seconds.
    step : bool
        Hold each value until the next sample, as inputs do.
    """
    signals = _named("responses", responses, "steps")
    dt = sample_time(dt)
    ax = ax if ax is not None else plt.subplots(figsize=(6.4, 3.0))[1]
    for label, values in signals.items():
        time = dt * np.arange(values.size)
        if step:
            ax.step(time, values, where="post", label=label)
        else:
            ax.plot(time, values, label=label)
    ax.axhline(0, color="#888888", linewidth=0.8, linestyle="-", zorder=0)
    ax.set(xlabel="time in s", ylabel=ylabel, title=title)
    if len(signals) > 1:
        # Above the axes, where it hides no line; the title stands on the left.
        columns = 1 if sum(map(len, signals)) > 32 else len(signals)
        ax.legend(loc="lower right", bbox_to_anchor=(1, 1), fontsize="small", ncols=columns)
    return ax


def boxes(
    values: Mapping[str, ArrayLike],
    *,
    ylabel: str,
    title: str = "",
    ax: Axes | None = None,
    log: bool = False,
    reference: float | None = None,
) -> Axes:
    """Draw one box for each named sample: quartiles, 5–95 % whiskers, outliers as dots.

    Parameters
    ----------
    values : mapping of label to array (n,)
    log : bool
        Logarithmic vertical axis.
    reference : float, optional
        A horizontal line to compare with.
    """
    samples = _named("values", values, "n")
    ax = ax if ax is not None else plt.subplots(figsize=(6.4, 3.2))[1]
    drawn = ax.boxplot(
        list(samples.values()),
        tick_labels=list(samples),
        whis=(5, 95),
        widths=0.55,
        patch_artist=True,
        flierprops={"marker": ".", "markersize": 3, "markerfacecolor": "#666666"},
        medianprops={"color": "#D55E00", "linewidth": 1.8},
    )
    for box in drawn["boxes"]:
        box.set(facecolor="#cfe4f3", edgecolor="#0072B2")
    if reference is not None:
        ax.axhline(reference, color="#888888", linewidth=0.9, linestyle="--", zorder=0)
    if log:
        ax.set_yscale("log")
    ax.set(ylabel=ylabel, title=title)
    return ax


def heatmaps(matrices: Mapping[str, ArrayLike], names: Sequence[str] = ()) -> Figure:
    """Draw square matrices side by side on one colour scale, symmetric around zero.

    Parameters
    ----------
    matrices : mapping of title to array (n, n)
    names : labels of rows and columns.
    """
    arrays = _named("matrices", matrices)
    for title, array in arrays.items():
        if array.ndim != 2 or array.shape[0] != array.shape[1] or not array.size:
            raise ValueError(f"matrices[{title!r}] must have shape (n, n), got {array.shape}")
    limit = max(float(np.abs(array).max()) for array in arrays.values())
    figure, axes = plt.subplots(1, len(arrays), figsize=(3.1 * len(arrays) + 0.6, 3.0))
    for ax, (title, array) in zip(np.atleast_1d(axes), arrays.items(), strict=True):
        image = ax.imshow(array, cmap="RdBu_r", vmin=-limit, vmax=limit)
        ax.set_title(title)
        ax.grid(False)
        ticks = range(len(array)) if names else []
        ax.set_xticks(ticks, list(names))
        ax.set_yticks(ticks, list(names))
    figure.colorbar(image, ax=np.atleast_1d(axes).tolist(), shrink=0.85)
    return figure


def _named(name: str, values: Any, size: str | None = None) -> dict[str, np.ndarray]:
    """Return a mapping of labels to arrays; with ``size``, the name of it, to vectors."""
    instance(name, values, Mapping)
    if not values:
        raise ValueError(f"{name} must hold at least one entry, got none")
    arrays = {}
    for label, value in values.items():
        arrays[label] = array = np.asarray(real_array(f"{name}[{label!r}]", value))
        if size is not None and array.ndim != 1:
            raise ValueError(f"{name}[{label!r}] must have shape ({size},), got {array.shape}")
    return arrays


def table(head: Sequence[str], rows: Iterable[Sequence[Any]], caption: str) -> Any:
    """Return an HTML table for a notebook (needs IPython) of texts, which may hold HTML."""
    from IPython.display import HTML

    def line(tag: str, row: Sequence[Any]) -> str:
        return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in row) + "</tr>"

    body = "".join(line("td", row) for row in rows)
    return HTML(
        f"<table><caption>{caption}</caption><thead>{line('th', head)}</thead>"
        f"<tbody>{body}</tbody></table>"
    )


def mark(value: float, low: float, high: float, digits: int = 0, text: str | None = None) -> str:
    """Return a number for `table`, marked as inside or outside of a range.

    The range is widened by half a unit of the last digit, to which ``value`` was rounded.
    """
    edge = 0.5 * 10.0**-digits
    word = "inside" if low - edge <= value <= high + edge else "outside"
    return f'<span class="{word}">{f"{value:.{digits}f}" if text is None else text}</span>'
