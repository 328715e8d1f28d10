"""The page "Ask a person": its arithmetic is the library's."""

from __future__ import annotations

import base64
import hashlib
import inspect
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bs4 import BeautifulSoup

pytest.importorskip("py_mini_racer")

from ask_page import SCRIPTS, Page, Tape
from test_interview import same

from prefmpc import (
    Comparisons,
    Interview,
    LinearSystem,
    QuadraticPreference,
    WishartPrior,
    oscillating_masses,
)
from prefmpc.asking import belief, loops, questions, regret, sources
from prefmpc.asking.belief import Belief, Prior
from prefmpc.asking.desk import Desk
from prefmpc.asking.making import RECENT
from prefmpc.asking.options import Options
from prefmpc.asking.page import SCRIPTS as SHARED
from prefmpc.preferences.trajectories import Trajectory

SYSTEM = oscillating_masses()
STEPS = 20
X0 = np.array([0.3, 0.3, 0.3, 0.05, 0.05, 0.05])
CENTRE = np.array([1 / 0.3**2] * 6 + [1.0, 1.0])
PRIOR = WishartPrior(np.diag(CENTRE[:6]), np.diag(CENTRE[6:]))
PERSON = np.array([40.0] * 3 + [5.0] * 3 + [0.2] * 2)
SESSIONS = 50
CLOSE = {"rtol": 1e-8, "atol": 1e-8}


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    page = Page()
    yield page
    page.close()


def options(**given: Any) -> Options:
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(Interview).parameters.items()
        if name not in ("log", "self")
    }
    return Options(**{**defaults, "system": SYSTEM, "prior": PRIOR, "x0": X0, "key": 0, **given})


class Session:
    """Random answers to random pairs of closed loops, of somebody with random weights."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.rng, self.options = rng, options()
        self.lapse = (0.0, 0.05, None)[seed % 3]
        self.prior = Prior(rng.uniform(0.5, 2.5), rng.uniform(0, 2.5), 0.5)
        self.belief = Belief(self.options.features, self.prior, self.lapse)
        n, x0 = int(rng.integers(0, 30)), rng.uniform(-X0, X0, (8, 6))
        runs = self.options.loops(self.options.features.model(np.exp(rng.normal(0, 2, (8, 8)))), x0)
        phi = self.options.features(runs)  # (8 controllers, 8 states, p)
        state, pair = rng.integers(0, 8, n), rng.integers(0, 8, (2, n))
        self.gap = (phi[pair[1], state] - phi[pair[0], state]).reshape(n, 8)
        w = np.exp(rng.normal(0, 1.5, 8))
        z = self.gap @ w
        self.labels = (z > rng.logistic(size=n)).astype(float)
        self.labels[np.abs(z) < 0.2] = 0.5  # no difference is seen

    def given(self) -> dict[str, Any]:
        """Return what the page needs of it."""
        return {
            "prior": vars(self.prior),
            "lapse": "estimate" if self.lapse is None else self.lapse,
            "answers": {"gap": self.gap, "labels": self.labels},
        }


FIT = "{ const b = ask.belief.belief(8, prior, lapse); return ask.belief.fit(b, answers); }"


@pytest.fixture(scope="module")
def sessions(page: Page) -> list[tuple[Session, Any, Any]]:
    out = []
    for seed in range(SESSIONS):
        session = Session(seed)
        laplace = session.belief.fit(session.gap, session.labels)
        out.append((session, laplace, page(FIT, **session.given())))
    return out


def test_weights_and_their_deviations(sessions: list[tuple[Session, Any, Any]]) -> None:
    for _, laplace, found in sessions:
        assert found["success"]
        assert laplace.success
        np.testing.assert_allclose(found["eta"], laplace.eta, **CLOSE)
        np.testing.assert_allclose(found["lapse"], laplace.lapse, **CLOSE)
        np.testing.assert_allclose(found["curvature"], laplace.curvature, **CLOSE)
        # At sharpnesses that the answers all but exclude, rounding decides where a search ends.
        counts = laplace.weights > 1e-4
        odds = [np.array(weights)[counts] for weights in (found["weights"], laplace.weights)]
        np.testing.assert_allclose(*(weights / weights.max() for weights in odds), **CLOSE)
        np.testing.assert_allclose(np.array(found["at"])[counts], laplace.at[counts], **CLOSE)
        np.testing.assert_allclose(np.array(found["roots"])[counts], laplace.roots[counts], **CLOSE)


def test_gains_and_closed_loops(page: Page, sessions: list[tuple[Session, Any, Any]]) -> None:
    code = """{
      const plant = ask.masses(), K = ask.plant.gainOf(plant, centre, w);
      return [K, x0.map((start) => ask.plant.loop(plant, K, start, 20)),
              ask.plant.loopFeatures(plant, K, centre, x0, 20)];
    }"""
    for session, laplace, _ in sessions:
        w = np.exp(laplace.eta)
        model = session.options.features.model(w[None])
        x0 = session.rng.uniform(-2 * X0, 2 * X0, (3, 6))
        K, found, phi = page(code, centre=CENTRE, w=w, x0=x0)
        np.testing.assert_allclose(K, loops.gains(SYSTEM, model.Q, model.R)[0], **CLOSE)
        wanted = loops.lqr_loops(SYSTEM, model, x0, STEPS)
        for i, loop in enumerate(found):
            for name in ("x", "u", "y"):
                np.testing.assert_allclose(loop[name], getattr(wanted, name)[0, i], **CLOSE)
        np.testing.assert_allclose(phi, session.options.features(wanted)[0], **CLOSE)


def test_samples_from_the_same_random_numbers(
    page: Page, sessions: list[tuple[Session, Any, Any]]
) -> None:
    code = """{
      const b = ask.belief.belief(8, prior, lapse);
      const found = ask.belief.draws(b, {at, roots, weights}, answers, 6, slices, tape(numbers));
      return {...found, mean: ask.belief.meanWeights(found.eta)};
    }"""
    for seed, (session, laplace, _) in enumerate(sessions):
        numbers: Any = Tape(seed)
        eta, lapse = session.belief.draws(laplace, session.gap, session.labels, 6, numbers)
        given = {name: getattr(laplace, name) for name in ("at", "roots", "weights")}
        found = page(
            code, slices=belief.SLICES, numbers=numbers.numbers, **given, **session.given()
        )
        np.testing.assert_allclose(found["eta"], eta, **CLOSE)
        np.testing.assert_allclose(found["lapse"], lapse, **CLOSE)
        np.testing.assert_allclose(found["mean"], session.belief.chart.mean_weights(eta), **CLOSE)


def test_information_and_regret(page: Page, sessions: list[tuple[Session, Any, Any]]) -> None:
    code = """{
      const plant = ask.masses(), q = ask.questions;
      const found = q.candidates(plant, centre, w.slice(0, 4), x0, 20), all = q.pairs(found);
      return [all, q.gains(found, all, {w, lapse}),
              q.regret(plant, {centre, steps: 20}, mean, w, x0)].map((found, i, all) =>
        i < 2 ? found : [found, q.bound(found, 0.9)]);
    }"""
    for session, laplace, _ in sessions[::5]:
        rng, setup = session.rng, session.options
        eta, lapse = session.belief.draws(laplace, session.gap, session.labels, 10, rng)
        w, mean = np.exp(eta), session.belief.chart.mean_weights(eta)
        x0 = setup.states.draw(loops.STATES, setup.rng(0, 2))
        shown = sources.loops_shown(setup.loops, setup.features.model(w[:4]), x0, rng)
        cost = w @ setup.features(shown.trajectories).T
        P = questions.probability(cost[:, shown.pairs[1]] - cost[:, shown.pairs[0]], lapse)
        given = {"centre": CENTRE, "w": w, "lapse": lapse, "x0": x0, "mean": mean}
        all_pairs, gain, (values, bound) = page(code, **given)
        assert np.array_equal(np.transpose(all_pairs), shown.pairs)
        np.testing.assert_allclose(gain, questions.information(P), **CLOSE)
        ours = regret.regret_of(mean, w, setup)
        np.testing.assert_allclose(values, ours.values, **CLOSE)
        np.testing.assert_allclose(bound, ours.bound(), **CLOSE)


def test_it_is_the_same_plant_with_the_same_numbers(page: Page) -> None:
    plant = page("ask.masses()")
    for name, value in {"A": SYSTEM.A, "B": SYSTEM.B, "C": SYSTEM.C, "x0": X0}.items():
        assert np.array_equal(plant[name], value)
    assert (plant["uMin"], plant["uMax"]) == (SYSTEM.u_min.tolist(), SYSTEM.u_max.tolist())
    np.testing.assert_allclose(plant["centre"]["Q"] + plant["centre"]["R"], CENTRE, rtol=1e-15)

    ours = page("ask.interview.DEFAULTS")
    library = inspect.signature(Interview).parameters
    for name, theirs in {"repeatEvery": "repeat_every", **{k: k for k in ours}}.items():
        if theirs in library:
            assert ours[name] == library[theirs].default, name
    level = inspect.signature(Interview.finished).parameters
    assert (ours["level"], ours["certain"]) == (level["level"].default, level["q"].default)
    assert ours["slices"] == belief.SLICES
    assert (ours["controllers"], ours["states"]) == (loops.CONTROLLERS, loops.STATES)
    assert f"RECENT = {RECENT};" in (SCRIPTS / "questions.js").read_text(encoding="utf-8")


SESSION = """
  const plant = ask.masses(), person = ask.blind.visitor({person});
  const page = ask.interview.interviewer(plant, {{seed: {seed}}});
  for (let n = 0; n < {count}; n++) {{
    const question = await page.next();
    const wish = await person(question);
    await page.answer(n === 3 ? 0.5 : n === 5 ? "skip" : wish);
    if (n === 8) await page.undo();
  }}
  const log = await page.log(), again = ask.interview.interviewer(plant, {{log}});
  const [one, other] = [await page.next(), await again.next()];
  return {{ log, same: JSON.stringify(one) === JSON.stringify(other),
           progress: await page.progress(), trial: await page.trial(10) }};
"""


def session(page: Page, seed: int, count: int = 20) -> Any:
    return page.wait(SESSION.format(person=PERSON.tolist(), seed=seed, count=count))


def test_the_library_resumes_what_the_page_has_written(
    page: Page,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    done = session(page, 1)
    assert done["same"], "a reload asks another question"
    path = tmp_path / "answers.jsonl"
    path.write_text(done["log"], encoding="utf-8")
    interview = Interview.load(path)
    assert len(interview) == 19
    labels = interview.labels
    assert labels[3] == 0.5
    assert np.isnan(labels[5])
    repeats = [q.repeats for q in interview.questions]
    assert [n for n, of in enumerate(repeats) if of is not None] == [7, 15]
    for n in (7, 15):
        again, before = interview.questions[n], interview.questions[repeats[n]]
        assert np.array_equal(again.first.x, before.second.x)
    assert alike(done["progress"], interview)
    # The same visitor by the library, from the same trajectories.
    said = QuadraticPreference(np.diag(PERSON[:6]), np.diag(PERSON[6:]))
    data = interview.comparisons
    clear = data.labels != 0.5
    assert np.array_equal(said(*data.pairs)[clear], data.labels[clear])
    monkeypatch.chdir(tmp_path)
    exec(page("ask.masses().code"), {})  # what the page offers to be copied
    assert "0" in capsys.readouterr().out
    interview.answer("first")  # appended to the same file
    assert len(path.read_text(encoding="utf-8").splitlines()) == 21


def test_the_page_reads_what_the_library_has_written(page: Page, tmp_path: Path) -> None:
    path = tmp_path / "answers.jsonl"
    interview = Interview(SYSTEM, PRIOR, x0=X0, key=3, log=path)
    interview.answer_with(QuadraticPreference(np.diag(PERSON[:6]), np.diag(PERSON[6:])), 9)
    code = """const page = ask.interview.interviewer(ask.masses(), {{log: {log!r}}});
      return await page.progress();"""
    found = page.wait(code.format(log=path.read_text(encoding="utf-8")))
    assert found["count"] == 9
    assert alike(found, interview)


def alike(progress: Any, interview: Interview) -> bool:
    """Whether both would use the same weights, but for the random numbers of the samples.

    Two means over samples differ by the samples' own spread over the root of their number.
    """
    weights = np.log([weight["weight"] for weight in progress["weights"]])
    model: Any = interview.model
    own = np.log([*np.diag(model.Q), *np.diag(model.R)])
    everyone: Any = interview.posterior
    diagonals = [np.diagonal(M, axis1=-2, axis2=-1) for M in (everyone.Q, everyone.R)]
    spread = np.log(np.concatenate(diagonals, axis=-1))
    spread = (spread - spread.mean(axis=1, keepdims=True)).std(axis=0)
    gap = (weights - weights.mean()) - (own - own.mean())
    return bool((np.abs(gap) < 6 * spread / np.sqrt(150)).all())


def test_the_blind_test(page: Page) -> None:
    pairs = session(page, 2, 12)["trial"]
    assert len(pairs) == 10
    assert {pair["learned"] for pair in pairs} == {"first", "second"}
    for pair in pairs:
        assert pair["first"]["x"][0] == pair["second"]["x"][0]
    ways = page("[ask.blind.wilson(9, 10), ask.blind.wilson(0, 10), ask.blind.wilson(10, 10)]")
    # Wilson (1927), as statsmodels' proportion_confint(..., method="wilson") gives it.
    wanted = [[0.5958499732, 0.9821237869], [0.0, 0.2775327999], [0.7224672001, 1.0]]
    np.testing.assert_allclose(ways, wanted, atol=1e-9)
    code = "ask.blind.verdict(pairs, answers)"
    given = {"pairs": [{"learned": "first"}] * 4, "answers": ["first", "second", 0.5, "first"]}
    found = page(code, **given)
    assert (found["wins"], found["count"], found["ties"]) == (2, 3, 1)


def test_random_numbers(page: Page) -> None:
    code = """{
      const one = ask.random.random(7, 1), other = ask.random.random(7, 1);
      const next = ask.random.random(7, 2);
      return [ask.random.uniforms(one, 20000), ask.random.uniforms(other, 3),
              ask.random.uniforms(next, 3), ask.random.normals(next, 1, 20000)[0]];
    }"""
    uniform, same, another, normal = map(np.array, page(code))
    assert np.array_equal(uniform[:3], same)
    assert not np.isclose(same, another).any()
    assert 0 <= uniform.min() < uniform.max() < 1
    counts = np.histogram(uniform, 20, (0, 1))[0]
    assert ((counts - 1000) ** 2 / 1000).sum() < 45  # χ² with 19 degrees: 1 in 1000
    assert abs(np.corrcoef(uniform[:-1], uniform[1:])[0, 1]) < 0.025
    assert abs(normal.mean()) < 0.025
    assert abs(normal.var() - 1) < 0.04
    assert abs((np.abs(normal) < 1).mean() - 0.6827) < 0.012


# ---- files of their own ----

HOSTILE = (
    "</script><script>document.title = 1</script>",
    "<!-- & \"speed\" '😀' ]]>",
    "\u2028\ud800",
)


def held(path: Path) -> dict[str, Any]:
    """Return the configuration that a file holds, as a browser reads it."""
    soup = BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")
    scripts = soup.find_all("script")
    assert len(scripts) == 2
    assert len(soup.find_all("style")) == 1
    policy = str(soup.find("meta", attrs={"http-equiv": "Content-Security-Policy"})["content"])
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    for tag in (scripts[1], soup.find("style")):
        digest = hashlib.sha256(tag.string.encode()).digest()
        assert f"'sha256-{base64.b64encode(digest).decode()}'" in policy
    return json.loads(scripts[0].string)


def own_plant(**given: Any) -> Interview:
    cart = LinearSystem.from_continuous([[0, 1], [0, -0.1]], [[0], [1]], dt=0.1, u_max=1.0)
    prior = WishartPrior(np.diag([1.0, 4.0]), np.eye(1))
    return Interview(cart, prior, **{"x0": [1.0, 0.5], "key": 5, "steps": 12, **given})


def test_a_file_goes_on_with_the_interview_and_its_answers_come_back(
    page: Page, tmp_path: Path
) -> None:
    person = QuadraticPreference(np.diag([9.0, 1.0]), [[0.3]])
    for x0 in ([1.0, 0.5], [[1.0, 0.0], [0.0, 0.5], [0.7, 0.2]]):
        interview = own_plant(x0=x0, lapse=0.05)
        interview.answer_with(person, 3)
        path = tmp_path / "ask.html"
        interview.to_html(path, title=HOSTILE[0], names=HOSTILE, units=HOSTILE, overwrite=True)
        config = held(path)
        assert tuple(state["name"] for state in config["states"]) == HOSTILE[:2]
        assert config["uMin"] == [None]
        code = f"""
          const config = ask.plant.limited({json.dumps(config)});
          const page = ask.interview.interviewer(config, {{ log: config.log }});
          const person = ask.blind.visitor([9, 1, 0.3]);
          for (let n = 0; n < 9; n++) await page.answer(await person(await page.next()));
          return {{ log: await page.log(), progress: await page.progress(),
                    trial: await page.trial(10) }};
        """
        done = page.wait(code)
        (tmp_path / "answers.jsonl").write_text(done["log"], encoding="utf-8")
        resumed = Interview.load(tmp_path / "answers.jsonl", append=False)
        assert len(resumed) == 12
        assert all(map(same, resumed.questions[:3], interview.questions))
        assert vars(resumed._options).keys() == vars(interview._options).keys()
        assert resumed._options.stored() == interview._options.stored()
        assert alike(done["progress"], resumed)
        data = Comparisons.load(tmp_path / "answers.jsonl")
        assert np.array_equal(person(*data.pairs), data.labels)
        assert {pair["first"]["x"][0][0] for pair in done["trial"]} <= (
            {1.0, 0.0, 0.7} if np.ndim(x0) == 2 else {p["second"]["x"][0][0] for p in done["trial"]}
        )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"structure": "full"}, "whose structure is"),
        ({"controller": "mpc"}, "whose controller is"),
        ({"choose": "eubo"}, "whose choose is"),
        ({"x0": lambda rng, n: rng.uniform(size=(n, 2))}, "whose x0 is"),
        ({"pool": lambda rng: None}, "whose pool is"),
    ],
)
def test_what_a_file_cannot_do_is_named(tmp_path: Path, given: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        own_plant(**given).to_html(tmp_path / "ask.html")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_replaced_on_demand_only(tmp_path: Path) -> None:
    path = tmp_path / "ask.html"
    own_plant().to_html(path)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        own_plant().to_html(path)
    for wrong, words in (
        ({"title": " "}, "title must be a text"),
        ({"names": ["a", "b"]}, "names must hold a text for each of 2 states and 1 inputs"),
        ({"names": "abc"}, "names must be a sequence of texts"),
        ({"units": [1, 2, 3]}, "units must hold a text"),
        ({"names": list("abcde")}, "units must be one for each of 5 names"),
        ({"most": 0}, "most must be a whole number"),
    ):
        with pytest.raises(ValueError, match=words):
            own_plant().to_html(path, overwrite=True, **{"units": ["m", "m/s", "N"], **wrong})


# ---- an interviewer that lives in Python ----

MODEL = """
  globalThis.outbox = [];
  globalThis.listeners = [];
  globalThis.done = null;
  globalThis.model = {
    send: (message) => outbox.push(message),
    on: (name, listener) => listeners.push(listener),
    off: (name, listener) => listeners.splice(listeners.indexOf(listener), 1),
  };
"""


def talk(page: Page, body: str, reply: Callable[[Any], Any]) -> Any:
    """Run an asynchronous function of the interviewer `there` while Python replies to it."""
    page("(() => {" + MODEL + " return 0; })()")
    page(
        "((async () => { const there = ask.remote.interviewer(model); " + body + "})()"
        ".then((value) => { done = [value]; }, (error) => { done = error.message; }), 0)"
    )
    while page("done") is None:
        for message in page("outbox.splice(0)"):
            page("listeners.map((hear) => hear(reply))", reply=reply(message))
    return page("done")


def test_a_front_end_asks_python(page: Page) -> None:
    interview, by_hand = own_plant(), own_plant()
    desk = Desk(
        interview, [{"name": name, "unit": ""} for name in ("x1", "x2", "u1")], 0.02, 0.9, 9
    )
    body = """
      const person = ask.blind.visitor([9, 1, 0.3]), counts = [(await there.progress()).count];
      for (let n = 0; n < 6; n++) {
        const wish = await person(await there.next());
        counts.push((await there.answer(wish)).count);
      }
      counts.push((await there.undo()).count);
      // Another view of the same session answers: this one's answer is late.
      const other = ask.remote.interviewer(model);
      await other.next();
      await other.answer("first");
      counts.push((await there.answer("second")).count, (await there.answer(0.5)).count);
      there.close();
      return { counts, log: await other.log(), pairs: (await other.trial(10)).length,
               left: listeners.length };
    """
    (done,) = talk(page, body, desk.reply)
    assert done["counts"] == [0, 1, 2, 3, 4, 5, 6, 5, 6, 7]
    assert (done["pairs"], done["left"]) == (10, 1)
    by_hand.answer_with(QuadraticPreference(np.diag([9.0, 1.0]), [[0.3]]), 5)
    labels = [*by_hand.labels, 1.0, 0.5]
    assert interview.labels.tolist() == labels
    assert len(done["log"].splitlines()) == 8


def test_an_error_of_python_is_an_error_of_the_front_end(page: Page) -> None:
    def broken(message: Any) -> Any:
        return {"reply": message["id"], "error": "no space left"}

    assert talk(page, "return there.answer('first');", broken) == "no space left"


def test_the_book_loads_the_same_scripts_in_the_same_order() -> None:
    text = (Path(__file__).parents[1] / "book" / "ask.md").read_text(encoding="utf-8")
    named = re.findall(r"_static/ask/(\w+)\.js", text)
    assert [name for name in named if name not in ("masses", "start")] == list(SHARED)
    everything = "".join(path.read_text(encoding="utf-8") for path in SCRIPTS.iterdir())
    assert "</" not in everything
    assert "<!--" not in everything


def test_trajectories_on_the_page_are_trajectories(page: Page) -> None:
    code = "return (await ask.interview.interviewer(ask.masses(), {seed: 5}).next());"
    question = page.wait(code)
    first, second = (Trajectory(**question[side]) for side in ("first", "second"))
    assert first.x.shape == (STEPS + 1, 6)
    assert np.array_equal(first.x[0], second.x[0])
    assert np.abs(first.u).max() <= 1
