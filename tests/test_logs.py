"""Logs that come back from elsewhere: what is wrong in one is named with its line and field."""

from __future__ import annotations

import contextlib
import copy
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_interview import PERSON, cart

from prefmpc import Comparisons, Interview


@pytest.fixture
def path(tmp_path: Path) -> Path:
    interview = cart(log=tmp_path / "answers.jsonl", repeat_every=3)
    interview.answer_with(PERSON, 4)
    interview.undo()
    interview.answer(None)
    interview.answer(0.25)
    return tmp_path / "answers.jsonl"


def test_comparisons_are_read_from_a_log(path: Path) -> None:
    interview = Interview.load(path, append=False)
    wanted, found = interview.comparisons, Comparisons.load(path)
    assert len(found) == 4
    assert found.labels[-1] == 0.25
    np.testing.assert_array_equal(found.labels, wanted.labels)
    for one, other in zip(found.pairs, wanted.pairs, strict=True):
        for name in ("x", "u", "y"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


Change = Callable[[dict[str, Any]], Any]


def at(*way: Any, value: Any) -> Change:
    """Put a value where the names lead."""

    def change(line: dict[str, Any]) -> None:
        for name in way[:-1]:
            line = line[name]
        line[way[-1]] = value

    return change


def without(*way: Any) -> Change:
    def change(line: dict[str, Any]) -> None:
        for name in way[:-1]:
            line = line[name]
        del line[way[-1]]

    return change


NAN = float("nan")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (at("answer", value=NAN), r"answer must lie in \[0, 1\], got nan"),
        (at("answer", value=1.5), r"answer must lie in \[0, 1\], got 1.5"),
        (at("answer", value="first"), "answer must be a number, got 'first'"),
        (at("answer", value=True), "answer must be a number, got True"),
        (without("answer"), "answer is missing"),
        (at("number", value=7), "number must be 1, got 7"),
        (at("batch", value=[1]), "batch must hold two whole numbers"),
        (at("batch", value=[3, 1]), "batch must hold number 1"),
        (at("question", value=[]), "question must be an object"),
        (without("question", "second"), "question.second is missing"),
        (at("question", "first", value="x"), "question.first must be an object"),
        (without("question", "first", "u"), "question.first.u is missing"),
        (
            at("question", "first", "x", 3, 1, value=NAN),
            r"question.first.x must be finite.*\(3, 1\)",
        ),
        (
            at("question", "first", "x", 3, 1, value="nan"),
            "question.first.x must be an array of real",
        ),
        (at("question", "second", "u", 0, value=[]), "question.second.u must be an array of real"),
        (
            at("question", "second", "u", 0, 0, value=float("inf")),
            "question.second.u must be finite",
        ),
        (without("question", "second", "x", 0), "question.second: x must hold one step more"),
        (at("question", "gain", value=NAN), "question.gain must be finite"),
        (at("question", "sure", value=2), r"question.sure must lie in \[0, 1\]"),
        (at("question", "number", value=0), "question.number must be 1, got 0"),
        (at("question", "repeats", value=1), "question.repeats must be an earlier number"),
        (at("undo", value=3), "undo must be 0, got 3"),
    ],
)
def test_a_line_edited_by_hand_is_named_with_its_field(
    path: Path, change: Change, words: str
) -> None:
    lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    change(lines[2])
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    for load in (Comparisons.load, Interview.load):
        with pytest.raises(ValueError, match=f"line 3: {words}"):
            load(path)


def test_an_answer_to_a_blind_test_is_checked_and_passed_over(path: Path) -> None:
    lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    said = {"blind": 0, "number": 3, "answer": 0.5, "learned": "first"}
    said |= {side: copy.deepcopy(lines[1]["question"][side]) for side in ("first", "second")}
    lines[3:3] = [said, {**copy.deepcopy(said), "answer": None}]

    def write(changed: Any) -> None:
        path.write_text("".join(json.dumps(line) + "\n" for line in changed), encoding="utf-8")

    write(lines)
    assert len(Comparisons.load(path)) == 4
    assert len(Interview.load(path, append=False)) == 5
    wrong: list[tuple[Change, str]] = [
        (at("blind", value=-1), "blind must be a whole number, got -1"),
        (without("number"), "number is missing"),
        (at("answer", value=2), r"answer must lie in \[0, 1\], got 2"),
        (without("answer"), "answer is missing"),
        (at("learned", value="third"), "learned must be"),
        (without("second"), "second is missing"),
        (at("first", "x", 0, 0, value=NAN), "first.x must be finite"),
    ]
    for change, words in wrong:
        changed = copy.deepcopy(lines)
        change(changed[3])
        write(changed)
        for load in (Comparisons.load, Interview.load):
            with pytest.raises(ValueError, match=f"line 4: {words}"):
                load(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (at("prefmpc interview", value=2), "prefmpc interview must be format 1, got 2"),
        (without("prefmpc interview"), "prefmpc interview must be format 1, got None"),
        (without("spread"), "spread is missing"),
        (at("spread", value=-1), "spread must be positive"),
        (at("system", value=3), "system must be an object"),
        (at("system", "A", value=[[1, 2], [3]]), "system: "),
        (at("system", "dt", value=NAN), "system: dt must be"),
        (without("system", "B"), "system: .*B"),
        (at("prior", "S", value=1), "prior: .*S"),
        (at("x0", value=[1]), "x0 must be"),
        (at("key", value="?"), "key must be"),
    ],
)
def test_a_head_edited_by_hand_is_named_with_its_field(
    path: Path, change: Change, words: str
) -> None:
    first, rest = path.read_text("utf-8").split("\n", 1)
    line = json.loads(first)
    change(line)
    path.write_text(json.dumps(line) + "\n" + rest, encoding="utf-8")
    with pytest.raises(ValueError, match=f"line 1: {words}"):
        Interview.load(path)


def test_trajectories_of_one_log_have_the_same_shapes(path: Path) -> None:
    lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    for name in "xuy":
        lines[2]["question"]["second"][name].pop()
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    with pytest.raises(ValueError, match=r"line 3: question.second.x must have shape \(21, 2\)"):
        Comparisons.load(path)


def test_garbage_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    head = whole.split(b"\n")[0] + b"\n"
    for garbage in (
        b"",
        b"garbage\n",
        b"\xff\xfe\n{}\n",
        b"{}\n",
        b"[" * 100_000 + b"\n{}\n",
        b"[]\n",
    ):
        path.write_bytes(garbage)
        with pytest.raises(ValueError, match="path must be a log"):
            Comparisons.load(path)
    path.write_bytes(head)
    with pytest.raises(ValueError, match="at least one answer"):
        Comparisons.load(path)


def test_any_damage_is_a_value_error_or_harmless(path: Path) -> None:
    """Bytes that fell out or were changed: a ValueError, or a data set that is finite."""
    whole, rng = path.read_bytes(), random.Random(0)
    for _ in range(300):
        begin = rng.randrange(len(whole))
        put = bytes(rng.choices(b'0123456789.,:[]{}"en\n', k=rng.randrange(4)))
        path.write_bytes(whole[:begin] + put + whole[begin + rng.randrange(4) :])
        with contextlib.suppress(ValueError):
            found = Comparisons.load(path)
            assert np.isfinite(found.trajectories.x).all()
            assert ((found.labels >= 0) & (found.labels <= 1)).all()
