"""Asking people: which question comes next, what the answers say so far, and when to stop.

An `Interview` shows closed loops in pairs that are made to tell what is not yet known; `ask` holds
it in a notebook.
"""

from prefmpc.asking.interview import Interview
from prefmpc.asking.notebook import ask
from prefmpc.asking.questions import Question

__all__ = ["Interview", "Question", "ask"]
