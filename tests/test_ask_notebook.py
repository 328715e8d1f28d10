"""An interview in a notebook: messages of a browser in, a log out, and nothing lost in between."""

from __future__ import annotations

import builtins
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_interview import CART, PERSON, PRIOR, cart, same

from prefmpc import Interview, NonlinearSystem, SeparableCost, Trajectory, ask, oscillating_masses
from prefmpc.asking.desk import Desk
from prefmpc.asking.files import resume

NAMES = [{"name": name, "unit": ""} for name in ("x1", "x2", "u1")]


def desk_of(interview: Interview) -> Desk:
    return Desk(interview, NAMES, 0.02, 0.9, 30)


def call(desk: Desk, name: str, **given: Any) -> Any:
    """Call as a front end does: everything passes through JSON."""
    message = json.loads(json.dumps({"id": "1", "call": name, **given}))
    reply = json.loads(json.dumps(desk.reply(message), allow_nan=False))
    assert reply.keys() in ({"reply", "result"}, {"reply", "error"})
    assert reply["reply"] == "1"
    return reply["result"] if "result" in reply else ValueError(reply["error"])


def wish(question: Any) -> float:
    sides = (Trajectory(*(question[side][name] for name in "xuy")) for side in ("first", "second"))
    return float(PERSON(*(jax.tree.map(lambda leaf: leaf[None], side) for side in sides))[0])


def test_a_front_end_gets_the_same_interview_as_python(tmp_path: Path) -> None:
    interview, undisturbed = cart(log=tmp_path / "log"), cart()
    desk = desk_of(interview)
    for number in range(10):
        question = call(desk, "next")
        assert question["number"] == number
        state = call(desk, "answer", value=wish(question), number=number)
        assert state["count"] == number + 1
    undisturbed.answer_with(PERSON, 10)
    assert same(interview.next(), undisturbed.next())
    assert state["bound"] == undisturbed.regret.bound(0.9)
    assert state["enough"] == (state["bound"] <= 0.02)
    assert state["consistency"] == {"repeats": 1, "equal": 1}
    model: Any = interview.model
    assert [w["weight"] for w in state["weights"]] == [*np.diag(model.Q), *np.diag(model.R)]
    ratios = np.array([w["ratio"] for w in state["weights"]])
    np.testing.assert_allclose(np.log(ratios).sum(), 0, atol=1e-9)
    assert all(w["low"] < w["high"] for w in state["weights"])
    text = call(desk, "log")
    (tmp_path / "copy.jsonl").write_text(text, encoding="utf-8")
    copy = Interview.load(tmp_path / "copy.jsonl")
    np.testing.assert_array_equal(copy.labels, interview.labels)


def test_an_answer_that_comes_twice_or_late_changes_nothing() -> None:
    desk = desk_of(cart())
    call(desk, "next")
    for value in ("first", "first", "second"):
        assert call(desk, "answer", value=value, number=0)["count"] == 1
    assert desk.interview.labels.tolist() == [1.0]
    assert call(desk, "undo", number=3)["count"] == 1
    assert call(desk, "undo", number=1)["count"] == 0
    assert call(desk, "undo", number=1)["count"] == 0
    assert "there is none" in str(call(desk, "undo", number=0))
    assert call(desk, "answer", value="skip", number=0)["count"] == 1


HOSTILE: list[Any] = [
    *(None, True, -1, 2, 1.5, float("nan"), float("inf"), 10**400, "", "First", "x" * 10**6),
    *([], [0.5], [[1]], {}, {"value": 1}, "__class__", "first\n", "\ud800", b"first"),
]


def test_what_a_browser_sends_is_checked_like_what_a_user_passes() -> None:
    desk = desk_of(cart())
    call(desk, "next")
    for bad in HOSTILE:
        assert desk.reply(bad) is None
        assert desk.reply({"id": bad, "call": ""}) is None or isinstance(bad, str)
        messages = [
            *({"call": bad}, {"call": "answer", "value": bad, "number": 0}),
            *({"call": "answer", "value": "first", "number": bad},),
            *({"call": "undo", "number": bad}, {"call": "trial", "count": bad}),
        ]
        for message in messages:
            reply = desk.reply({"id": "1", **message})
            assert reply is not None
            if message.get("count") != 2 and message.get("number") not in (-1, 2, 10**400):
                assert isinstance(reply.get("error"), str), message
                assert len(reply["error"]) < 500
            json.dumps(reply, allow_nan=False)
    assert len(desk.interview) == 0


def test_a_write_that_fails_is_told_and_the_question_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = desk_of(cart(log=tmp_path / "log"))
    question = call(desk, "next")

    def full(descriptor: int) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert "no space left" in str(call(desk, "answer", value="first", number=0))
    assert call(desk, "progress")["count"] == 0
    assert call(desk, "next") == question
    assert call(desk, "answer", value="second", number=0)["count"] == 1
    assert Interview.load(tmp_path / "log", append=False).labels.tolist() == [0.0]


def test_the_blind_test_is_of_the_present_weights_against_the_priors(tmp_path: Path) -> None:
    for structure in ("diagonal", "full"):
        interview = cart(structure=structure)
        interview.answer_with(PERSON, 12)
        pairs = call(desk_of(interview), "trial", count=10)
        assert pairs == call(desk_of(interview), "trial", count=10)
        assert len(pairs) == 10
        assert {pair["learned"] for pair in pairs} == {"first", "second"}
        won = [(wish(pair) > 0.5) == (pair["learned"] == "first") for pair in pairs]
        assert np.mean(won) >= 0.8
        centre = CART.lqr(PRIOR.Q, PRIOR.R)[0]
        for pair in pairs:
            other = pair["second" if pair["learned"] == "first" else "first"]
            u = np.clip(-centre @ other["x"][0], CART.u_min, CART.u_max)
            np.testing.assert_allclose(other["u"][0], u, atol=1e-9)


# ---- the log ----


def test_it_goes_on_where_the_log_ends(tmp_path: Path) -> None:
    path, undisturbed = tmp_path / "log.jsonl", cart()
    undisturbed.answer_with(PERSON, 9)
    for count in (3, 4, 2):
        interview = cart()
        assert resume(interview, path, False) == 0
        interview.answer_with(PERSON, count)
    assert len(interview) == 9
    assert same(interview.next(), undisturbed.next())
    assert len(path.read_text("utf-8").splitlines()) == 10


def test_a_log_of_another_interview_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    other = cart(log=path)
    other.answer_with(PERSON, 2)
    for given, name in (({"key": 1}, "key"), ({"x0": [2, 1]}, "x0"), ({"lapse": 0.1}, "lapse")):
        with pytest.raises(ValueError, match=f"has another {name}"):
            resume(cart(**given), path, False)
    ahead = cart()
    ahead.answer_with(PERSON, 3)
    with pytest.raises(ValueError, match="must begin with the answers"):
        resume(ahead, path, False)
    with pytest.raises(ValueError, match="the interview's own"):
        resume(other, tmp_path / "another.jsonl", False)
    with pytest.raises(ValueError, match="log must be a path"):
        resume(cart(), 3, False)
    with pytest.raises(ValueError, match="log must be given"):
        resume(cart(), None, True)
    path.write_text("{}\n")
    with pytest.raises(ValueError, match="line 1"):
        resume(cart(), path, False)


def test_a_second_writer_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    mine, late = cart(), None
    resume(mine, path, False)
    mine.answer_with(PERSON, 2)
    late = Interview.load(path)
    child = f"""
        import sys, jax
        jax.config.update("jax_enable_x64", True)
        sys.path[:0] = {[str(Path(__file__).parent)]!r}
        from test_interview import cart
        from prefmpc import Interview
        from prefmpc.asking.files import resume
        loaded = Interview.load({str(path)!r})
        for attempt in (lambda: resume(cart(), {str(path)!r}, False), lambda: loaded.answer(1)):
            try:
                attempt()
            except BlockingIOError as error:
                print(error)
    """
    code = "\n".join(line[8:] for line in child.splitlines())
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.count("is in use: another session writes") == 2, done.stderr
    with pytest.raises(BlockingIOError):
        late.answer("first")
    # In the same process the cell that runs last has it.
    again = cart()
    resume(again, path, False)
    again.answer_with(PERSON, 1)
    with pytest.raises(BlockingIOError):
        mine.answer("first")
    assert len(mine) == 2
    again._log.release()  # type: ignore[union-attr]
    # Who has read an older state must read again, or he would overwrite what came since.
    for stale in (mine, late):
        with pytest.raises(ValueError, match="changed by somebody else"):
            stale.answer("first")
    assert Interview.load(path).labels.tolist() == again.labels.tolist()


def test_a_log_that_is_replaced_gets_no_answers(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    interview = cart()
    resume(interview, path, False)
    interview.answer("first")
    interview.save(path, overwrite=True)
    with pytest.raises(ValueError, match="changed by somebody else"):
        interview.answer("first")
    assert len(interview) == 1


KILLED = """
import json, os, signal, sys, time
import jax
jax.config.update("jax_enable_x64", True)
sys.path[:0] = [sys.argv[1]]
from test_interview import cart
from prefmpc.asking.desk import Desk
from prefmpc.asking.files import resume
path, kills = sys.argv[2], int(sys.argv[3])
cart().answer("first")  # what is needed is imported

def session(out):
    interview = cart(samples=20)
    resume(interview, path, False)
    desk = Desk(interview, [{}] * 3, 0.02, 0.9, 30)
    os.write(out, b"+")
    for _ in range(1000):
        number = len(interview)
        desk.reply({"id": "1", "call": "next"})
        value = (number * 7 % 11) / 11  # which answer it was can be told
        reply = desk.reply({"id": "1", "call": "answer", "value": value, "number": number})
        assert reply["result"]["count"] == number + 1, reply
        os.write(out, b"+")

told = []
for kill in range(kills):
    back, out = os.pipe()
    pid = os.fork()
    if not pid:
        session(out)
        os._exit(0)
    os.close(out)
    said = os.read(back, 1)
    time.sleep(0.001 * (1 + 7 * kill % 60))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    while more := os.read(back, 1000):
        said += more
    told.append(len(said) - 1)
print(json.dumps(told))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills by fork")
def test_every_answer_is_there_once_and_in_order_after_50_kills(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-c",
        KILLED,
        str(Path(__file__).parent),
        str(path),
        "50",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    acknowledged = json.loads(done.stdout)
    assert len(acknowledged) == 50
    labels = Interview.load(path, append=False).labels
    # One may have been written and not acknowledged at each kill.
    assert sum(acknowledged) <= len(labels) <= sum(acknowledged) + 50
    np.testing.assert_array_equal(labels, np.arange(len(labels)) * 7 % 11 / 11)


# ---- the widget ----


@pytest.mark.parametrize(
    ("function", "given", "words"),
    [
        (ask, {"interview": CART}, "interview must be a Interview"),
        (ask, {"log": 3}, "log must be a path"),
        (ask, {"names": ["a"]}, "names must hold a text for each of 2 states and 1 inputs"),
        (ask, {"units": [0, 1, 2]}, "units must hold a text"),
        (ask, {"draw": 3}, "draw must be a text"),
        (ask, {"who": ""}, "who must be a text"),
        (ask, {"who": "Anna"}, "log must be given"),
        (ask, {"level": -1}, "level must be"),
        (ask, {"certain": 1}, "certain must lie in"),
        (ask, {"most": 0}, "most must be a whole number"),
    ],
)
def test_bad_input_to_ask_is_named(function: Any, given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        function(**{"interview": cart(), **given})


def test_without_anywidget_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def missing(name: str, *rest: Any, **more: Any) -> Any:
        if name == "anywidget":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match=r"pip install .*prefmpc\[notebook\]"):
        ask(cart())


def widget_of(interview: Interview, **given: Any) -> tuple[Any, list[Any]]:
    pytest.importorskip("anywidget")
    widget, sent = ask(interview, **given), list[Any]()
    widget.send = sent.append
    return widget, sent


def test_a_widget_passes_messages_on(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    interview = cart()
    widget, sent = widget_of(interview, log=path, who="Anna </script>")
    widget._handle_custom_msg({"id": "a", "call": "next"}, [])
    widget._handle_custom_msg({"id": "b", "call": "answer", "value": "first", "number": 0}, [])
    widget._handle_custom_msg("nonsense", [])
    assert [message["reply"] for message in sent] == ["a", "b"]
    assert interview.labels.tolist() == [1.0]
    line = json.loads(path.read_text("utf-8").splitlines()[1])
    assert line["who"] == "Anna </script>"
    assert line["time"].endswith("+00:00")
    assert len(Interview.load(path, append=False)) == 1
    assert repr(widget) == "ask: 1 answers"
    assert widget.notice == ""
    assert "memory alone" in widget_of(cart())[0].notice


def test_a_torn_line_is_repaired_with_a_notice(tmp_path: Path) -> None:
    pytest.importorskip("anywidget")
    path = tmp_path / "log.jsonl"
    cart(log=path).answer_with(PERSON, 2)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"answer": 1, "numb')
    interview = cart()
    with pytest.warns(UserWarning, match="torn") as warned:
        widget = ask(interview, log=path)
    assert warned[0].filename == __file__
    assert "has been removed" in widget.notice
    assert path.read_bytes() == whole
    assert len(interview) == 2


def test_where_there_is_no_browser_it_is_a_picture() -> None:
    widget, _ = widget_of(cart(), names=["$x_1$", "v", "<b>"], units=["m", "m", "N"])
    data = widget._repr_mimebundle_()[0]
    assert data["text/plain"] == "ask: 0 answers"
    assert data["image/png"].startswith("iVBORw0KGgo")
    assert data == widget._repr_mimebundle_()[0]


def test_any_plant_can_be_shown() -> None:
    def f(x: Any, u: Any) -> Any:
        return x + 0.1 * u

    def loops(models: Any, x0: Any) -> Trajectory:
        gain = 1 / (1 + np.asarray(models.c)[:, 0].sum(1))[:, None, None, None]
        x = x0[None, :, None, :] * (1 - 0.1 * gain) ** np.arange(5)[:, None]
        return Trajectory(x, np.diff(x, axis=2) / 0.1)

    plant = NonlinearSystem(f, nx=1, nu=1, dt=0.1)
    centre = SeparableCost(np.ones((3, 2)), scale=[1.0, 1.0])
    interview = Interview(plant, centre, x0=[1.0], key=0, controller=loops, samples=20)
    widget, sent = widget_of(interview, draw="() => null")
    assert [plot["signal"] for plot in widget.config["plots"]] == ["x", "u"]
    assert widget.config["draw"] == "own"
    assert "scenes.own = () => (\n() => null\n)();" in widget._esm
    widget._handle_custom_msg({"id": "a", "call": "progress"}, [])
    widget._handle_custom_msg({"id": "b", "call": "trial", "count": 2}, [])
    assert sent[0]["result"]["weights"] == []
    assert len(sent[1]["result"]) == 2
    assert ask(Interview(oscillating_masses(), x0=[0.3] * 6, key=0)).config["draw"] == "masses"
