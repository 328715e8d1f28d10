"""The studies of the book: repeatable, consistent with themselves, and what the book says."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from prefmpc import (
    QuadraticPreference,
    Trajectory,
    accuracy,
    lqr_pool,
    max_input,
    oscillating_masses,
    phi,
    settling_time,
)
from prefmpc.learning.training import best_restart
from studies import (
    COLUMNS,
    PAPER_TABLE_I,
    PAPER_TABLE_II,
    QUADRATIC_Q,
    QUADRATIC_R,
    RADIUS,
    ROWS,
    SETTLING_COLUMNS,
    SETTLING_ROWS,
    SETTLING_SIZES,
    SETTLING_VARIANTS,
    SIZES,
    VARIANTS,
    __main__,
    diagonal_weights,
    distinct_case,
    error_rates,
    measures_case,
    quadratic_case,
    quadratic_data,
    quantiles,
    read_spread,
    settling_case,
    settling_data,
    ties_case,
    write_spread,
)
from studies import measures as measuring
from studies.quadratic import DISTINCT_COLUMNS, DISTINCT_ROWS
from studies.settling import TIES_COLUMNS, TIES_ROWS, coarse_preference

BOOK = Path(__file__).parents[1] / "book"
SPREAD = BOOK / "case_studies" / "quadratic_spread.json"
DISTINCT_SPREAD = BOOK / "case_studies" / "distinct_spread.json"
SETTLING_SPREAD = BOOK / "case_studies" / "settling_spread.json"
TIES_SPREAD = BOOK / "case_studies" / "ties_spread.json"
MEASURES_SPREAD = BOOK / "insight" / "measures_spread.json"
TIME = COLUMNS.index("time s")
KEY = jax.random.key(2000)


def head_of(path, least=50):
    head = json.loads(path.read_text(encoding="utf-8"))
    seeds = head["seeds"]
    assert seeds == list(range(len(head.pop("draws"))))
    assert len(seeds) >= least
    return {name: tuple(value) for name, value in head.items()}, len(seeds)


@pytest.fixture(scope="module")
def draw():
    return quadratic_case(key=jax.random.key(0))


def test_the_book_s_table_is_what_the_code_gives(draw):
    stored = read_spread(SPREAD)["paper"][0]
    kept = [i for i in range(len(COLUMNS)) if i != TIME]
    shares, costs = kept[:2], kept[2:]
    np.testing.assert_array_equal(np.isnan(draw.table[:, kept]), np.isnan(stored[:, kept]))
    np.testing.assert_allclose(draw.table[:, shares], stored[:, shares], atol=0.5)
    np.testing.assert_allclose(draw.table[:, costs], stored[:, costs], atol=0.02)
    assert np.isnan(stored[:, TIME]).all()  # times belong to a machine


def test_the_stored_tables_are_complete():
    head, count = head_of(SPREAD)
    assert head["rows"] == ROWS == tuple(PAPER_TABLE_I)
    assert head["columns"] == COLUMNS
    stored = read_spread(SPREAD)
    assert tuple(stored) == VARIANTS
    for tables in stored.values():
        assert tables.shape == (count, len(ROWS), len(COLUMNS))
        assert np.isfinite(tables[:, :, 3:]).all()


def test_a_draw_is_deterministic(draw):
    again = quadratic_case(key=jax.random.key(0))
    kept = np.arange(len(COLUMNS)) != TIME
    np.testing.assert_array_equal(again.table[:, kept], draw.table[:, kept])
    np.testing.assert_array_equal(again.pool.x, draw.pool.x)


def test_the_table_is_made_of_the_loops(draw):
    assert list(draw.phi) != []
    reference = np.asarray(phi(draw.loops["From Π"], QUADRATIC_Q, QUADRATIC_R)).mean()
    for row, name in enumerate(ROWS):
        values = np.asarray(phi(draw.loops[name], QUADRATIC_Q, QUADRATIC_R)) / reference
        assert values.shape == (200,)
        np.testing.assert_allclose(
            draw.table[row, 3:], [values.mean(), values.max(), values.min()], rtol=1e-12
        )
        # All controllers start from the same states, and none leaves the input bounds.
        np.testing.assert_array_equal(draw.loops[name].x[:, 0], draw.loops["From Π"].x[:, 0])
        assert (np.abs(draw.loops[name].u) <= 1).all()
    assert draw.table[0, 3] == pytest.approx(1)
    for row, n in enumerate(SIZES, start=2):
        model = draw.fits[n].model
        assert draw.table[row, 1] == pytest.approx(100 * accuracy(model, draw.test))
    # What the study is about: more answers help, and even 20 beat guessing.
    assert draw.table[6, 3] < draw.table[2, 3] < draw.table[1, 3]


def test_data_are_drawn_apart():
    _, pool, train, test = quadratic_data(key=jax.random.key(2000))
    assert [len(train[n]) for n in SIZES] == list(SIZES)
    assert len(test) == 500
    assert not np.isin(test.trajectories.x, pool.x).any()
    _, pool, _, test = quadratic_data(key=jax.random.key(2000), shared_pool=True)
    np.testing.assert_array_equal(test.trajectories.x, pool.x)


def test_error_rates_are_one_minus_accuracy(draw):
    models = draw.fits[20].models
    expected = [1 - accuracy(models[i], draw.test) for i in (0, 5)]
    np.testing.assert_allclose(error_rates(models, draw.test)[[0, 5]], expected, atol=1e-12)


def test_the_best_restart_is_one_that_may_be_used():
    good, bad = "converged", "out_of_bounds"
    assert best_restart([0.0, 2, 1], np.array([bad, good, good]), np.zeros(3)) == 2
    assert best_restart([1.0, 1, 1], np.array([good] * 3), np.array([3.0, 1, 2])) == 1
    assert best_restart([np.nan, 1], np.array([bad, good]), np.array([np.nan, 1])) == 1
    assert best_restart([0.0, 1], np.array([bad, bad]), np.zeros(2)) is None


def test_the_book_s_distinct_pairs_are_what_the_code_gives():
    stored = read_spread(DISTINCT_SPREAD)["table"]
    head, count = head_of(DISTINCT_SPREAD)
    assert (head["rows"], head["columns"]) == (DISTINCT_ROWS, DISTINCT_COLUMNS)
    assert stored.shape == (count, len(DISTINCT_ROWS), len(DISTINCT_COLUMNS))
    table = distinct_case(key=jax.random.key(0))
    np.testing.assert_allclose(table[:, :2], stored[0, :, :2], atol=0.5)
    np.testing.assert_allclose(table[:, 2], stored[0, :, 2], atol=0.02)


@pytest.fixture(scope="module")
def settled():
    return settling_case(key=jax.random.key(0))


def test_the_book_s_settling_table_is_what_the_code_gives(settled):
    stored = read_spread(SETTLING_SPREAD)
    table = stored["table"][0]
    assert np.isnan(table[..., TIME]).all()
    kept = [0, 1, 3, 5]
    np.testing.assert_array_equal(np.isnan(settled.table[..., kept]), np.isnan(table[..., kept]))
    np.testing.assert_allclose(settled.table[..., :2], table[..., :2], atol=1)
    np.testing.assert_allclose(settled.table[..., 3], table[..., 3], atol=1)
    np.testing.assert_allclose(settled.table[..., 5], table[..., 5], rtol=0.05)
    assert settled.data_kappa == stored["data κ"][0]


def test_the_stored_settling_tables_are_complete():
    head, count = head_of(SETTLING_SPREAD)
    assert head["variants"] == SETTLING_VARIANTS == tuple(PAPER_TABLE_II)
    assert head["rows"] == SETTLING_ROWS
    assert head["columns"] == SETTLING_COLUMNS
    stored = read_spread(SETTLING_SPREAD)
    assert stored["table"].shape == (count, 2, len(SETTLING_ROWS), len(SETTLING_COLUMNS))
    assert not np.isnan(stored["table"][..., 3:]).any()  # but inf: some never settle
    assert np.isfinite(stored["table"][..., 5]).all()
    assert stored["data κ"].shape == (count,)


def test_the_settling_table_is_made_of_the_loops(settled):
    reference = settled.loops["with Πᵤ"]["Random"].x[:, 0]
    for v, variant in enumerate(SETTLING_VARIANTS):
        for r, name in enumerate(SETTLING_ROWS):
            loops = settled.loops[variant][name]
            assert loops.batch_shape == (200,)
            np.testing.assert_array_equal(loops.x[:, 0], reference)
            kappa = settling_time(loops, 0.1)
            expected = [np.median(kappa), kappa.max(), max_input(loops).mean()]
            np.testing.assert_allclose(settled.table[v, r, 3:], expected, rtol=1e-12)
        for r, n in enumerate(SETTLING_SIZES, start=2):
            model = settled.fits[variant][n].model
            shares = [settled.train[variant][n], settled.test[variant]]
            expected = [100 * accuracy(model, data) for data in shares]
            np.testing.assert_allclose(settled.table[v, r, :2], expected)
    assert settled.data_kappa == np.median(settling_time(settled.pool, 0.1))


def test_both_variants_ask_about_the_same_pairs():
    system, pool, train, test = settling_data(key=KEY, sizes=(20, 300))
    assert np.isinf(system.u_max).all()
    sets = {n: [train[v][n] for v in SETTLING_VARIANTS] for n in (20, 300)}
    sets[500] = [test[v] for v in SETTLING_VARIANTS]
    for n, (broken, left_out) in sets.items():
        assert len(broken) == n
        assert set(broken.labels) == {0, 1}
        kappa = settling_time(broken.trajectories)
        first, second = kappa[broken.first], kappa[broken.second]
        decided = broken.subset(first != second)
        assert 0 < len(decided) < n or n == 20
        for name in ("first", "second", "labels"):
            np.testing.assert_array_equal(getattr(left_out, name), getattr(decided, name))
        np.testing.assert_array_equal(decided.labels, (first < second)[first != second])
    assert not np.isin(test["with Πᵤ"].trajectories.x, pool.x).any()


def test_the_weights_of_the_settling_data_are_diagonal():
    Q, R = diagonal_weights(KEY, 400)
    for weights, low, high in ((Q[:, :3, :3], 5, 20), (Q[:, 3:, 3:], 0.1, 1), (R, 0.1, 1)):
        diagonal = np.diagonal(weights, axis1=1, axis2=2)
        assert ((diagonal >= low) & (diagonal <= high)).all()
        np.testing.assert_allclose(diagonal.mean(0), (low + high) / 2, rtol=0.1)
    np.testing.assert_array_equal(Q, Q * np.eye(6))
    np.testing.assert_array_equal(R, R * np.eye(2))


def test_the_book_s_ties_are_what_the_code_gives():
    stored = read_spread(TIES_SPREAD)["table"]
    head, count = head_of(TIES_SPREAD)
    assert (head["rows"], head["columns"]) == (TIES_ROWS, TIES_COLUMNS)
    assert stored.shape == (count, len(TIES_ROWS), len(TIES_COLUMNS))
    table = ties_case(key=jax.random.key(0))
    np.testing.assert_allclose(table[:, 0], stored[0, :, 0], rtol=1e-12)
    np.testing.assert_allclose(table[:, [1, 3]], stored[0][:, [1, 3]], atol=1)
    np.testing.assert_allclose(table[:, [2, 4]], stored[0][:, [2, 4]], rtol=0.1)
    # A coarser clock has more ties. Without Πᵤ it does not matter how its arguments stand.
    assert table[0, 0] < table[1, 0] < table[2, 0]
    np.testing.assert_array_equal(table[3, [0, 3, 4]], table[0, [0, 3, 4]])


def test_a_coarse_clock_by_hand():
    # κ = 1, 2, 3 and never, with inputs 4, 3, 2 and 1.
    y = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1.0]])[..., None]
    T = Trajectory(
        np.zeros((4, 5, 1)), np.ones((4, 4, 1)) * np.arange(4.0, 0, -1)[:, None, None], y
    )
    first, second = T[[0, 1, 1, 2, 2]], T[[1, 0, 2, 1, 3]]
    for resolution, swapped, answers in (
        (1, False, [1, 0, 1, 0, 1]),
        (2, False, [1, 0, 0, 1, 1]),  # readings 0, 1, 1 and never
        (4, False, [0, 1, 0, 1, 1]),
        (4, True, [1, 0, 1, 0, 1]),
    ):
        ask = coarse_preference(resolution, tie_break=True, swapped=swapped)
        np.testing.assert_array_equal(ask(first, second), answers)
    drop = coarse_preference(2, tie_break=False)
    np.testing.assert_array_equal(drop(first, second), [1, 0, np.nan, np.nan, 1])


@pytest.fixture(scope="module")
def measured():
    # The two smaller sizes: n = 400 takes as long as both, and they do not depend on it.
    return measures_case(key=jax.random.key(0), sizes=measuring.SIZES[:2])


def test_the_book_s_measures_are_what_the_code_gives(measured):
    stored = {name: values[0] for name, values in read_spread(MEASURES_SPREAD).items()}
    assert measured.keys() == stored.keys()
    np.testing.assert_allclose(measured["baselines"], stored["baselines"], atol=0.5)
    np.testing.assert_allclose(measured["leak"], stored["leak"][:2], atol=1)
    kept = [i for i, name in enumerate(measuring.MODELS) if "400" not in name]
    table, expected = measured["models"], stored["models"][kept]
    np.testing.assert_allclose(table[:, :2], expected[:, :2], atol=1.5)
    np.testing.assert_allclose(table[:, 2], expected[:, 2], rtol=0.1, atol=2)


def test_the_stored_measures_are_complete():
    head, count = head_of(MEASURES_SPREAD, least=30)
    assert head["models"] == measuring.MODELS
    assert head["columns"] == measuring.MODEL_COLUMNS
    stored = read_spread(MEASURES_SPREAD)
    shapes = {
        "baselines": (len(measuring.BASELINES), len(measuring.BASELINE_COLUMNS)),
        "leak": (len(measuring.SIZES), len(measuring.LEAK_COLUMNS)),
        "models": (len(measuring.MODELS), len(measuring.MODEL_COLUMNS)),
    }
    assert {name: values.shape for name, values in stored.items()} == {
        name: (count, *shape) for name, shape in shapes.items()
    }
    assert all(np.isfinite(values).all() for values in stored.values())


def test_nobody_is_better_at_being_the_person_than_the_person(measured):
    table = measured["models"]
    # Π agrees with itself, loses nothing but what 10 steps of 30 cost, and beats at random.
    np.testing.assert_array_equal(table[0, :2], 100)
    assert (table[:, 2] >= 0).all()
    assert table[0, 2] == table[:, 2].min() < 1
    assert table[0, 3] > 90
    # The rule that looks at x(0) alone knows nothing where all start alike.
    np.testing.assert_allclose(measured["baselines"][1, [1, 3]], 50, atol=10)


def test_states_are_repeated_in_a_row():
    x = measuring.starts_repeated(KEY, 3, 2)
    assert x.shape == (6, 6)
    np.testing.assert_array_equal(x[::2], x[1::2])
    assert len(np.unique(x, axis=0)) == 3
    y = np.arange(18.0).reshape(3, 6)
    T = Trajectory(np.stack([y, y], axis=1), np.zeros((3, 1, 2)))
    np.testing.assert_array_equal(measuring.first_position(T), [5, 149, 509])  # 0 + 1 + 4, …


def test_an_unsure_person_errs_as_often_as_asked():
    pool = lqr_pool(oscillating_masses(), 20, 10, key=KEY, radius=RADIUS, saturate=False)
    cost = phi(pool, QUADRATIC_Q, QUADRATIC_R)
    i, j = np.triu_indices(20, 1)
    for error in (0.02, 0.1):
        scale = measuring.unsure_scale(pool, error)
        wrong = 1 / (1 + np.exp(np.abs(cost[i] - cost[j]) / scale))
        assert wrong.mean() == pytest.approx(error, rel=1e-6)


def test_pairs_of_the_same_start():
    person = QuadraticPreference(QUADRATIC_Q, QUADRATIC_R)
    rng = np.random.default_rng(0)
    data = measuring.same_start_data(oscillating_masses(), 5, person, 30, rng, starts=4, copies=3)
    assert (len(data), len(data.trajectories)) == (30, 12)
    np.testing.assert_array_equal(data.first // 3, data.second // 3)
    assert (data.first != data.second).all()


DRAWS = [
    {"table": np.array([[1.0, np.nan], [np.inf, 2.00004]]), "number": np.array(3.0)},
    {"table": np.array([[-np.inf, 0], [-1e-9, 1e6]]), "number": np.nan},
]
HEAD = {"rows": ["σ₂₀", "Π"], "columns": ["a", "b"], "seeds": [0, 1]}


def test_files_give_back_what_was_drawn(tmp_path):
    path = tmp_path / "spread.json"
    write_spread(path, HEAD, DRAWS)
    stored = read_spread(str(path))
    assert list(stored) == ["table", "number"]
    np.testing.assert_array_equal(
        stored["table"], [[[1, np.nan], [np.inf, 2]], [[-np.inf, 0], [-1e-9, 1e6]]]
    )  # four decimals, and small numbers stay
    np.testing.assert_array_equal(stored["number"], [3, np.nan])
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) == len(DRAWS) + 2  # a line for each draw, to see what changed
    assert {**json.loads(text), "draws": None} == {**HEAD, "draws": None}
    assert "σ₂₀" in text
    assert [p.name for p in tmp_path.iterdir()] == ["spread.json"]


@pytest.mark.parametrize("broken", ["os.replace", "os.fsync"])
def test_an_interrupted_write_leaves_the_old_file_whole(tmp_path, monkeypatch, broken):
    path = tmp_path / "spread.json"
    write_spread(path, HEAD, DRAWS)
    before = path.read_bytes()

    def refuse(*args):
        raise OSError("full")

    monkeypatch.setattr(broken, refuse)
    with pytest.raises(OSError, match="full"):
        write_spread(path, HEAD, DRAWS[:1])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_draw_that_cannot_be_written_leaves_the_old_file_whole(tmp_path):
    path = tmp_path / "spread.json"
    write_spread(path, HEAD, DRAWS)
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_spread(path, HEAD, [*DRAWS, {"table": "soon"}])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_quantiles_are_values_and_may_be_infinite():
    draws = np.array([[3, 1], [1, np.inf], [2, np.inf], [np.inf, np.inf]])
    np.testing.assert_array_equal(quantiles(draws, 0.5), [2, np.inf])
    np.testing.assert_array_equal(quantiles(draws, [0, 0.75, 1])[:, 0], [1, 3, np.inf])


def test_the_command_line_writes_the_draws_of_the_first_seeds(tmp_path, monkeypatch):
    def study(*, key):
        return {"table": jax.random.key_data(key).astype(float)}

    monkeypatch.setitem(__main__.STUDIES, "quadratic", (study, "new/spread.json", {"rows": ["a"]}))
    monkeypatch.setattr(__main__, "BOOK", tmp_path)
    monkeypatch.setattr(sys, "argv", ["studies", "quadratic", "--draws", "3"])
    __main__.main()
    path = tmp_path / "new" / "spread.json"
    np.testing.assert_array_equal(read_spread(path)["table"], [[0, 0], [0, 1], [0, 2]])
    assert json.loads(path.read_text(encoding="utf-8"))["seeds"] == [0, 1, 2]
    other = tmp_path / "other.json"
    monkeypatch.setattr(sys, "argv", [*sys.argv[:2], "--draws", "1", "--out", str(other)])
    __main__.main()
    assert read_spread(other)["table"].shape == (1, 2)


def test_every_study_has_a_file_in_the_book():
    files = {name for _, name, _ in __main__.STUDIES.values()}
    assert {str(path.relative_to(BOOK)) for path in BOOK.rglob("*_spread.json")} == files
