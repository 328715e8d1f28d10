"""What every test run needs: the processor, float64, and kernels that find the library."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent

# Set before JAX is imported, here and in the notebooks' kernels, which inherit it.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: threads only wait
os.environ["SOURCE_DATE_EPOCH"] = "0"
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(ROOT), str(ROOT / "book"), *filter(None, [os.environ.get("PYTHONPATH")])]
)
# Most of the time here would go into compiling programs that run once: XLA may do it quickly.
# `XLA_FLAGS= make test` runs everything as the library's users do.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)
# The same programs are compiled in many tests and notebooks: keep them between processes, in a
# folder for each set of XLA's options. Only a cache of limited size is locked while it is read or
# written (with the package filelock), so that two processes can share it.
_setting = re.sub(r"\W+", "-", "xla " + os.environ["XLA_FLAGS"])
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax" / _setting))
os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(500_000_000))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")


import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)  # in this process; a notebook does it for itself


# Files that take long, the longest first: workers that begin with them end together.
LONGEST = """
speed settling neural icnn stability lane training accuracy test_benchmarks test_loop_derivatives
test_unstable_plants test_many_devices test_nonlinear_mpc test_priors_study test_references_study
test_extension_studies test_signals_study test_measures_study test_training test_settling_study
""".split()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Share folders and lists of files among the processors; one file is not worth it."""
    many = len(config.args) > 2 or any(Path(name).is_dir() for name in config.args)
    return min(4, os.cpu_count() or 1) if many else 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first; the order within a file and of the others stays."""
    place = {stem: k for k, stem in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_configure(config: pytest.Config) -> None:
    # The path in pyproject.toml is relative; make it independent of the current folder.
    rules = getattr(config.option, "nbval_sanitize_with", None)
    if rules:
        config.option.nbval_sanitize_with = str(ROOT / rules)
    if getattr(config.option, "nbval", False) or getattr(config.option, "nbval_lax", False):
        run_cells_as_jupyter_does()


def run_cells_as_jupyter_does() -> None:
    """Make nbval store the history, in memory.

    Without a history a trailing semicolon does not hide the value of a cell, so nbval
    would see an output that neither JupyterLab nor the stored notebook has.
    """
    from nbval import kernel

    start = kernel.start_new_kernel

    def start_new_kernel(*args: Any, **kwargs: Any) -> Any:
        kwargs["extra_arguments"] = ["--HistoryManager.hist_file=:memory:"]
        return start(*args, **kwargs)

    def execute_cell_input(self: Any, cell_input: str, allow_stdin: bool | None = None) -> Any:
        return self.kc.execute(
            cell_input, store_history=True, allow_stdin=allow_stdin, stop_on_error=False
        )

    kernel.start_new_kernel = start_new_kernel
    kernel.RunningKernel.execute_cell_input = execute_cell_input
