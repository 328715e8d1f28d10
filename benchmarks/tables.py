"""Part "tables": both tables of the paper, one draw each, from a cold process and warm.

Cold: both in one new process, imports and all compilations included, JAX's cache of compiled
programs off. Warm: the same process, other keys. ``compiling_seconds`` is the time inside XLA, as
JAX counts it. Beside that: what ``import prefmpc`` adds to importing jax, optax and jaxopt, and
how many compilations serve the five sizes of Table I. ``mean_phi`` and ``median_kappa`` are what
the tables say of the model from 1000 comparisons, as a check that they are the right ones.
"""

from __future__ import annotations

from typing import Any

from measure import child, show

BOTH = """
import json, time
began = time.perf_counter()
import jax
jax.config.update("jax_enable_x64", True)
import studies
imported = time.perf_counter() - began
compiling = []
def listen(event, seconds, **_):
    if event.endswith("backend_compile_duration"):
        compiling.append(seconds)
jax.monitoring.register_event_duration_secs_listener(listen)
rows = []
for when, seed in (("cold", 0), ("warm", 1)):
    for name in ("quadratic", "settling"):
        compiling.clear()
        start = time.perf_counter()
        draw = getattr(studies, name + "_case")(key=jax.random.key(seed))
        rows.append({
            "when": when,
            "table": name,
            "seconds": time.perf_counter() - start,
            "compilations": len(compiling),
            "compiling_seconds": sum(compiling),
        })
        if name == "quadratic":
            rows[-1]["mean_phi"] = float(draw.table[-1, 3])
        else:
            rows[-1]["median_kappa"] = float(draw.table[0, -1, 3])
total = {when: sum(r["seconds"] for r in rows if r["when"] == when) for when in ("cold", "warm")}
print(json.dumps({
    "rows": rows,
    "import_seconds": imported,
    "cold_seconds": imported + total["cold"],
    "warm_seconds": total["warm"],
}))
"""

IMPORT = """
import json, time, warnings
warnings.simplefilter("ignore")
import jax, optax, jaxopt
began = time.perf_counter()
import prefmpc
print(json.dumps(time.perf_counter() - began))
"""

SIZES = """
import json, jax
jax.config.update("jax_enable_x64", True)
import prefmpc
from prefmpc.learning import training
import studies
_, _, train, _ = studies.quadratic_data(key=jax.random.key(0))
for n in studies.SIZES:
    prefmpc.fit(train[n], key=jax.random.key(0), selection="training_loss", restarts=2)
print(json.dumps(training._train._cache_size()))
"""


def run(mini: bool = False) -> dict[str, Any]:
    """Run the part; it is made of processes of its own, so that the miniature has none of it."""
    if mini:
        return {}
    results: dict[str, Any] = child(BOTH)
    columns = {"when": "", "table": "", "seconds": "ms", "compiling_seconds": "ms of it in XLA"}
    columns |= {"compilations": "compilations", "mean_phi": "mean φ", "median_kappa": "median κ"}
    show("1. Both tables of the paper, one draw", results["rows"], columns)
    print(f"  cold, with imports: {results['cold_seconds']:.1f} s (wanted: under 25)")
    print(f"  warm: {results['warm_seconds']:.2f} s (wanted: under 5)")
    results["import_prefmpc_seconds"] = sorted(child(IMPORT) for _ in range(3))[1]
    results["compilations_for_five_sizes"] = child(SIZES)
    print(f"  import prefmpc after jax, optax, jaxopt: {results['import_prefmpc_seconds']:.3f} s")
    print(f"  compilations of fit for five sizes: {results['compilations_for_five_sizes']}")
    return results
