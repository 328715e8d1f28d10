"""The widget in a real JupyterLab: whatever is restarted or closed, no answer is lost or doubled.

It takes a minute, and so runs with PREFMPC_LAB=1 alone: `make test-lab`.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import BROWSER, Browser

if not os.environ.get("PREFMPC_LAB"):
    pytest.skip("PREFMPC_LAB is not set", allow_module_level=True)
if not BROWSER:
    pytest.skip("no Chromium was found on the PATH", allow_module_level=True)
pytest.importorskip("jupyterlab")

ROOT = Path(__file__).resolve().parent.parent.parent
TOKEN = "of-this-test-alone"
CELL = """\
import jax
from prefmpc import Interview, LinearSystem, ask

jax.config.update("jax_enable_x64", True)
cart = LinearSystem.from_continuous([[0, 1], [0, -0.1]], [[0], [1]], dt=0.1, u_min=-1, u_max=1)
interview = Interview(cart, x0=[1.0, 0.5], key=0, samples=40)
ask(interview, log="answers.jsonl", who="A7", level=0, most=100)
"""
LONG = 300
ACCEPT = "document.querySelector('.jp-Dialog-button.jp-mod-accept')"
IDLE = "document.querySelector('.jp-Notebook-ExecutionIndicator')?.dataset.status === 'idle'"
WAYS = (("first", 1.0), ("ArrowRight", 0.0), ("ArrowDown", 0.5))


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[str]:
    """Return the address of a server whose folder holds a notebook of one cell."""
    cell = {"cell_type": "code", "id": "a", "metadata": {}, "outputs": [], "source": CELL}
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook = {
        **{"nbformat": 4, "nbformat_minor": 5, "metadata": {"kernelspec": kernel}},
        "cells": [{**cell, "execution_count": None}],
    }
    (tmp_path / "ask.ipynb").write_text(json.dumps(notebook), encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    places = {
        name: str(tmp_path / name)
        for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR")
    }
    given = [f"--ServerApp.{k}={v}" for k, v in {"port": port, "root_dir": tmp_path}.items()]
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", *given]
    server = subprocess.Popen(
        [*command, f"--IdentityProvider.token={TOKEN}", "--ServerApp.port_retries=0"],
        env={**os.environ, **places, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.terminate()
        server.wait(30)


def asked(address: str, way: str) -> Any:
    """Return what the server replies, None before it is there."""
    headers = {"Authorization": f"token {TOKEN}"}
    request = urllib.request.Request(f"{address}/api/{way}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=LONG) as reply:
            return json.load(reply)
    except OSError:
        return None


def opened(browser: Browser, address: str) -> None:
    browser.call(
        "Network.emulateNetworkConditions",
        **{"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1},
    )
    browser.until(lambda: asked(address, "status") is not None, "the server", LONG)
    browser.call("Page.navigate", url=f"{address}/lab/tree/ask.ipynb?reset&token={TOKEN}")
    browser.wait("document.querySelector('.jp-CodeCell .cm-content') !== null", LONG)
    browser.wait(IDLE, LONG)


def restart(browser: Browser) -> None:
    """Restart the kernel by the button of the notebook, and take away the old widget."""
    browser.click('[data-command="notebook:restart-kernel"]')
    browser.wait(f"{ACCEPT} !== null")
    browser(f"{ACCEPT}.click()")
    browser.wait(f"{ACCEPT} === null")
    time.sleep(5)  # the window learns that the kernel stops, and then that it is there
    browser.wait(IDLE, LONG)
    browser("document.querySelector('.ask').remove()")


def run_cell(browser: Browser, count: int) -> None:
    """Run the cell, and wait until it asks the question after so many answers.

    A slow server asks which kernel is meant when one is there already. Then there is another, and
    what the first one began is lost: the cell is run again, as a person would.
    """
    enter = {"key": "Enter", "windowsVirtualKeyCode": 13, "modifiers": 8, "text": "\r"}
    for _ in range(LONG // 30):
        browser(f"{ACCEPT}?.click()")
        browser.wait(IDLE, LONG)
        browser("document.querySelector('.jp-CodeCell .cm-content').focus()")
        for kind in ("keyDown", "keyUp"):
            browser.call("Input.dispatchKeyEvent", type=kind, **enter)
        with contextlib.suppress(TimeoutError):
            return wait_for(browser, count, 30)
    return wait_for(browser, count)


def wait_for(browser: Browser, count: int, seconds: float = LONG) -> None:
    """Wait for the question that comes after so many answers."""
    shown = "document.querySelector('.ask-count')?.textContent"
    browser.wait(f"{shown} === 'Question {count + 1}'", seconds)


def choose(browser: Browser, number: int) -> float:
    """Answer question ``number`` by a click or a key; return P(first preferred)."""
    way, label = WAYS[number % 3]
    if way == "first":
        browser.click('[data-answer="first"]')
    else:
        browser("document.querySelector('.ask-stage').focus()")
        browser.press(way)
    return label


def test_no_answer_is_lost_or_doubled(lab: str, tmp_path: Path) -> None:
    given: list[float] = []

    def answer(browser: Browser, until: int) -> None:
        while len(given) < until:
            given.append(choose(browser, len(given)))
            wait_for(browser, len(given))

    with Browser(1280, 1400) as browser:
        opened(browser, lab)
        run_cell(browser, 0)
        answer(browser, 10)
        browser.press("Backspace")
        given.pop()
        wait_for(browser, 9)
        answer(browser, 15)
        restart(browser)
        run_cell(browser, 15)
        answer(browser, 22)
        last = choose(browser, 22)  # and the window is closed before there is a reply
    log = tmp_path / "answers.jsonl"
    with Browser(1280, 1400) as browser:
        opened(browser, lab)
        # Whether that answer still got through is open; if so, it is in the log.
        before = len(labels(log))
        given += [last] * (before - 22)
        run_cell(browser, before)
        answer(browser, 30)
    np.testing.assert_array_equal(labels(log), given)
    lines = log.read_text(encoding="utf-8").splitlines()
    assert sum("undo" in json.loads(line) for line in lines) == 1
    assert all(json.loads(line)["who"] == "A7" for line in lines[1:])


def labels(log: Path) -> list[float]:
    """Return the answers that a log leaves, read without the library."""
    found: list[float] = []
    for line in map(json.loads, log.read_text(encoding="utf-8").splitlines()[1:]):
        if "undo" in line:
            assert line["undo"] == len(found) - 1
            found.pop()
        else:
            assert line["number"] == len(found)
            found.append(line["answer"])
    return found
