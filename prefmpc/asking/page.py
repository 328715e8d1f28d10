"""The page that asks a person: how it shows a plant, and as a file that needs nothing else."""

from __future__ import annotations

import base64
import hashlib
import html
import itertools
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from prefmpc._checks import sequence
from prefmpc._files import atomic_write
from prefmpc.asking.options import Options
from prefmpc.systems.linear import LinearSystem, oscillating_masses

SOURCES = Path(__file__).parent / "static" / "ask"
SCRIPTS = (
    *("linalg", "random", "plant", "belief", "questions", "interview", "blind", "words", "draw"),
    *("card", "player", "store", "view", "page"),
)
"""What every front end is made of, in this order."""

LINES = 3
"""So many curves can be told apart in one plot."""

LONG = 30
"""A longer name is not written along an axis."""

MASSES = (
    *(f"position of mass {i}" for i in (1, 2, 3)),
    *(f"speed of mass {i}" for i in (1, 2, 3)),
    *("force on mass 1", "force on mass 3"),
)
MASSES_UNITS = ("m",) * 3 + ("m/s",) * 3 + ("N",) * 2

CODE = """import jax
from prefmpc import Interview, LinearMPC, simulate

jax.config.update("jax_enable_x64", True)
interview = Interview.load("answers.jsonl", append=False)
controller = LinearMPC(interview.system, interview.model, horizon=10)
x0 = {x0}
print(simulate(interview.system, controller, x0, steps={steps}).x[-1].round(3))
"""

FILE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
<h1>{title}</h1>
<p>Two controllers start alike. <b>Choose the response that you would rather have</b>; there is no
right answer. Nothing leaves this page: at the end, download the answers and send the file back.</p>
<div class="ask" id="ask">
<noscript><p>This page needs JavaScript, which is switched off here.</p></noscript>
</div>
</main>
<script type="application/json" id="ask-config">{config}</script>
<script>{script}</script>
</body>
</html>
"""


def source(*names: str) -> str:
    """Return the text of scripts or style sheets, one after the other."""
    return "\n".join((SOURCES / name).read_text(encoding="utf-8") for name in names)


def scripts(*more: str) -> str:
    """Return the front end as one script, and what comes after it."""
    return source(*(f"{name}.js" for name in SCRIPTS), *more)


def appearance(options: Options, names: Any, units: Any, draw: str | None = None) -> dict[str, Any]:
    """Return how the front end shows a plant: its signals, their plots, and its drawing.

    Parameters
    ----------
    options : Options
    names, units : sequence of str, optional
        Of the states, then the inputs, then (optional) the outputs.
    draw : str, optional
        The name of a drawing.
    """
    system = options.system
    nx, nu = system.nx, system.nu
    masses = _are_the_masses(system)
    if masses and names is None and units is None:
        names, units = MASSES, MASSES_UNITS
    default = [f"x{i + 1}" for i in range(nx)] + [f"u{i + 1}" for i in range(nu)]
    names = default if names is None else _texts("names", names, system)
    units = [""] * len(names) if units is None else _texts("units", units, system)
    if len(units) != len(names):
        raise ValueError(f"units must be one for each of {len(names)} names, got {len(units)}")
    shown, kind = _shown(system, len(names))
    signals = list(zip(names, units, strict=True))
    plots = _plots(kind, [signals[i] for i in shown]) + _plots("u", signals[nx : nx + nu])
    if masses:
        plots[-1]["colours"] = [0, 2]  # those of the masses on which they act
    weighed = [{"name": name, "unit": _inverse_square(unit)} for name, unit in signals]
    bounds = {"uMin": system.u_min, "uMax": system.u_max}
    limits = {k: [float(b) if np.isfinite(b) else None for b in v] for k, v in bounds.items()}
    return {
        **limits,
        "dt": float(system.dt),
        "states": weighed[:nx],
        "inputs": weighed[nx : nx + nu],
        "plots": plots,
        "draw": draw or ("masses" if masses else None),
        "standard": "the weights from before the first answer",
    }


def _texts(name: str, value: Any, system: Any) -> list[str]:
    texts = sequence(name, value, "a sequence of texts")
    sizes = system.nx + system.nu, system.nx + system.nu + system.ny
    if len(texts) not in sizes or not all(isinstance(text, str) for text in texts):
        raise ValueError(
            f"{name} must hold a text for each of {system.nx} states and {system.nu} inputs "
            f"(and of {system.ny} outputs), got {texts}"
        )
    return [str(text) for text in texts]


def _are_the_masses(system: Any) -> bool:
    """Whether a plant is the book's, which has a drawing."""
    masses = oscillating_masses()
    return isinstance(system, LinearSystem) and all(
        np.array_equal(getattr(system, name), getattr(masses, name)) for name in ("A", "B", "dt")
    )


def _shown(system: Any, named: int) -> tuple[list[int], str]:
    """Return which of the named signals are plotted beside the inputs, and what they are.

    The outputs y, if they have names of their own or are states; else the states x.
    """
    nx, nu = system.nx, system.nu
    if named > nx + nu:
        return list(range(nx + nu, named)), "y"
    C = getattr(system, "C", np.zeros((1, nx)))
    if ((C == 0).sum(axis=1) == nx - 1).all() and (C.sum(axis=1) == 1).all():
        return [int(i) for i in C.argmax(axis=1)], "y"
    return list(range(nx)), "x"


def _inverse_square(unit: str) -> str:
    return f"1/{unit}²" if unit.isalpha() else f"1/({unit})²" if unit else ""


def _plots(kind: str, signals: list[tuple[str, str]]) -> list[dict[str, Any]]:
    """Return plots of signals (name, unit): neighbours with the same unit share one."""
    numbered = enumerate(signals)
    runs = itertools.groupby(numbered, key=lambda pair: pair[1][1] or pair[0])
    parts: list[Any] = []
    for _, run in runs:
        members = list(run)
        parts += [members[i : i + LINES] for i in range(0, len(members), LINES)]
    plots = []
    for part in parts:
        name, unit = part[0][1]
        alone = f"{name} in {unit}" if unit else name
        plots.append(
            {
                "signal": kind,
                "index": [i for i, _ in part],
                "label": alone if len(part) == 1 and len(alone) <= LONG else unit or kind,
                "names": [signal[0] for _, signal in part],
                "colours": list(range(len(part))),
                "legend": len(part) > 1 or len(alone) > LONG,
            }
        )
    return plots


def write(
    path: str | os.PathLike[str],
    options: Options,
    log: bytes,
    *,
    title: Any,
    names: Any,
    units: Any,
    most: int,
    overwrite: bool,
) -> None:
    """Write the page for a linear plant; see `Interview.to_html`."""
    _check_supported(options)
    if not isinstance(title, str) or not title.strip():
        raise ValueError(f"title must be a text, got {title!r}")
    system, prior = options.system, options.prior
    x0 = np.asarray(options.states.given)
    config = {
        "name": title,
        **{name: getattr(system, name).tolist() for name in ("A", "B", "C")},
        **appearance(options, names, units),
        "x0": x0.tolist(),
        "centre": {name: np.diag(getattr(prior, name)).tolist() for name in ("Q", "R")},
        "method": {"steps": options.steps, "most": most},
        "log": log.decode(),
        "code": CODE.format(x0=np.atleast_2d(x0)[0].tolist(), steps=options.steps),
    }
    digest = hashlib.sha256(json.dumps(config).encode()).hexdigest()
    config["storage"] = f"prefmpc: {digest[:16]}"
    script, style = scripts("start.js"), source("file.css", "ask.css")
    policy = (
        f"default-src 'none'; script-src '{_hashed(script)}'; style-src '{_hashed(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    held = json.dumps(config, allow_nan=False).replace("<", "\\u003c")
    page = FILE.format(
        policy=policy, title=html.escape(title), style=style, config=held, script=script
    )
    with atomic_write(path, overwrite=overwrite) as file:
        file.write(page.encode("utf-8", "xmlcharrefreplace"))


def _hashed(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _check_supported(options: Options) -> None:
    """Raise a ValueError unless the page's own learner can hold the interview."""
    for name, value, wish in (
        ("system", isinstance(options.system, LinearSystem), "a LinearSystem"),
        ("structure", options.structure == "diagonal", '"diagonal"'),
        ("controller", options.controller == "lqr", '"lqr"'),
        ("pool", options.pool is None, "None"),
        ("reference", options.reference is None, "None"),
        ("choose", options.choose == "information", '"information"'),
        ("x0", not callable(options.x0), "a radius or a list of states"),
    ):
        if not value:
            raise ValueError(f"to_html needs an interview whose {name} is {wish}; `ask` takes any")
