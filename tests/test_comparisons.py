"""Data sets of comparisons, how they are drawn, and files that survive what happens to files."""

from __future__ import annotations

import json
import os

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefmpc import Comparisons, QuadraticPreference, Trajectory
from prefmpc._pytree import bypass_init

KEY = jax.random.key(2000)
RNG = np.random.default_rng(0)
POOL = Trajectory(*(RNG.normal(size=(6, *s)) for s in [(4, 2), (3, 1), (3, 5)]))
PREFERENCE = QuadraticPreference(np.diag([2.0, 1.0]), np.eye(1))


def test_random_pairs_are_of_two_trajectories_and_answered_by_the_preference():
    drawn = Comparisons.random(POOL, PREFERENCE, 300, key=KEY)
    assert len(drawn) == 300
    assert (drawn.first != drawn.second).all()
    seen = np.zeros((6, 6), bool)
    seen[drawn.first, drawn.second] = True
    assert (seen | np.eye(6, dtype=bool)).all()  # every ordered pair comes up
    np.testing.assert_array_equal(drawn.labels, PREFERENCE(*drawn.pairs))
    again = Comparisons.random(POOL, PREFERENCE, 300, key=KEY)
    np.testing.assert_array_equal(again.first, drawn.first)
    np.testing.assert_array_equal(again.second, drawn.second)


def starting_in(starts):
    """One trajectory of two steps for each start, all different after it."""
    count = len(starts)
    later = np.arange(2.0 * count).reshape(count, 2, 1)
    return Trajectory(np.concatenate([np.reshape(starts, (count, 1, 1)), later], 1), later)


# Starts in no order: 5 three times, −1 twice, and two trajectories without a twin.
TWINS = starting_in([5.0, -1, 7, 5, 2, -1, 5])
ALLOWED = {(0, 3), (0, 6), (3, 0), (3, 6), (6, 0), (6, 3), (1, 5), (5, 1)}


def first_wins(first, second):
    return np.ones(len(first))


def test_pairs_with_the_same_start_are_all_there_is_to_draw():
    drawn = Comparisons.random(TWINS, first_wins, 800, key=KEY, same_start=True)
    assert len(drawn) == 800
    one, other = drawn.pairs
    np.testing.assert_array_equal(one.x[:, 0], other.x[:, 0])
    pairs = list(zip(drawn.first.tolist(), drawn.second.tolist(), strict=True))
    assert set(pairs) == ALLOWED
    # The first is any of the five that have a twin, the second any of its twins: 1/10 or 1/5.
    for pair in ALLOWED:
        share = 1 / 5 if pair in {(1, 5), (5, 1)} else 1 / 10
        assert pairs.count(pair) / 800 == pytest.approx(share, abs=0.05)
    again = Comparisons.random(TWINS, first_wins, 800, key=KEY, same_start=True)
    np.testing.assert_array_equal(again.first, drawn.first)
    np.testing.assert_array_equal(again.second, drawn.second)


@given(st.lists(st.integers(0, 3), min_size=5, max_size=12), st.integers(0, 100))
def test_whatever_the_starts_a_pair_has_one(starts, seed):
    # Five trajectories from four states: two of them start alike.
    pool = starting_in(np.array(starts, float))
    rng = np.random.default_rng(seed)
    drawn = Comparisons.random(pool, first_wins, 20, key=rng, same_start=True)
    assert (drawn.first != drawn.second).all()
    np.testing.assert_array_equal(pool.x[drawn.first, 0], pool.x[drawn.second, 0])


def test_states_are_the_same_only_if_all_their_entries_are():
    x = np.zeros((3, 2, 2))
    x[:, 0] = [[1, 2], [1, 3], [1, 2]]
    pool = Trajectory(x, np.zeros((3, 1, 1)))
    drawn = Comparisons.random(pool, first_wins, 50, key=KEY, same_start=True)
    assert {0, 2} == {*drawn.first, *drawn.second}


def test_pairs_without_an_answer_are_left_out():
    asked = []

    def answers_some(first, second):
        asked.append((first, second))
        return np.where(first.u[:, 0, 0] > second.u[:, 0, 0], np.nan, 0.25)

    drawn = Comparisons.random(POOL, answers_some, 100, key=KEY)
    ((first, second),) = asked  # all pairs in one call
    kept = first.u[:, 0, 0] <= second.u[:, 0, 0]
    assert 0 < kept.sum() == len(drawn) < len(kept) == 100
    np.testing.assert_array_equal(drawn.pairs[0].u, first.u[kept])
    np.testing.assert_array_equal(drawn.pairs[1].u, second.u[kept])
    np.testing.assert_array_equal(drawn.labels, 0.25)


def test_sampled_answers_come_with_the_probability_of_the_label():
    labels = np.repeat([0.0, 1.0, 0.3, 0.8], 2000)
    n = len(labels)
    asked = Comparisons(POOL, np.zeros(n, int), np.ones(n, int), labels)
    drawn = asked.sampled(key=KEY)
    assert drawn.trajectories is POOL
    np.testing.assert_array_equal(drawn.first, asked.first)
    np.testing.assert_array_equal(drawn.second, asked.second)
    assert drawn.labels.dtype == np.float64
    assert set(drawn.labels) == {0, 1}
    sure = (labels == 0) | (labels == 1)
    np.testing.assert_array_equal(drawn.labels[sure], labels[sure])
    # The standard deviation of a share of 2000 is 0.01.
    assert drawn.labels[labels == 0.3].mean() == pytest.approx(0.3, abs=0.04)
    assert drawn.labels[labels == 0.8].mean() == pytest.approx(0.8, abs=0.04)
    np.testing.assert_array_equal(asked.labels, labels)
    np.testing.assert_array_equal(asked.sampled(key=KEY).labels, drawn.labels)
    assert (asked.sampled(key=jax.random.key(1)).labels != drawn.labels).any()


def test_own_recordings_as_lists():
    # One step, one state, one input, two comparisons; nothing here knows of JAX.
    mine = Comparisons.from_arrays(
        [[[1], [2]], [[3], [4]]], [[[0.1]], [[0.2]]], [[[5], [6]], [[7], [8]]], [[[0]], [[0]]],
        [1, 0.5],
    )  # fmt: skip
    first, second = mine.pairs
    np.testing.assert_array_equal(first.x[..., 0], [[1, 2], [3, 4]])
    np.testing.assert_array_equal(second.x[..., 0], [[5, 6], [7, 8]])
    np.testing.assert_array_equal(first.u.ravel(), [0.1, 0.2])
    np.testing.assert_array_equal(mine.labels, [1, 0.5])


def test_own_outputs_are_kept():
    y = np.arange(2.0).reshape(1, 1, 2)
    mine = Comparisons.from_arrays(
        np.ones((1, 2, 1)), np.ones((1, 1, 1)), np.ones((1, 2, 1)), np.ones((1, 1, 1)), [0],
        y_first=y, y_second=-y,
    )  # fmt: skip
    np.testing.assert_array_equal(mine.pairs[0].y, y)
    np.testing.assert_array_equal(mine.pairs[1].y, -y)


def test_subset_by_numbers_and_by_mask():
    all_of_them = Comparisons(POOL, [0, 1, 2], [3, 4, 5], [1, 0, 0.5])
    chosen = all_of_them.subset([2, 0])
    np.testing.assert_array_equal(chosen.first, [2, 0])
    np.testing.assert_array_equal(chosen.second, [5, 3])
    np.testing.assert_array_equal(chosen.labels, [0.5, 1])
    masked = all_of_them.subset([True, False, True])
    np.testing.assert_array_equal(masked.first, [0, 2])


def contents(comparisons):
    T = comparisons.trajectories
    return [np.asarray(a) for a in (T.x, T.u, T.y)] + [
        comparisons.first,
        comparisons.second,
        comparisons.labels,
    ]


def assert_same(one, other):
    for a, b in zip(contents(one), contents(other), strict=True):
        assert a.dtype == b.dtype
        assert a.tobytes() == b.tobytes()


@pytest.fixture
def some():
    return Comparisons(POOL, [0, 1, 2], [3, 4, 5], [1, 0, 0.3])


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.floats(0, 1)), min_size=1))
def test_files_give_back_every_bit(tmp_path_factory, rows):
    first, second, labels = zip(*rows, strict=True)
    saved = Comparisons(POOL, first, second, labels)
    path = tmp_path_factory.mktemp("saved") / "data.npz"
    assert saved.save(path) == path
    assert_same(Comparisons.load(path), saved)


def test_an_old_file_is_replaced_only_on_demand(tmp_path, some):
    path = some.save(tmp_path / "data.npz")
    other = some.subset([1])
    with pytest.raises(FileExistsError, match="overwrite=True"):
        other.save(path)
    assert_same(Comparisons.load(path), some)
    other.save(str(path), overwrite=True)
    assert_same(Comparisons.load(str(path)), other)
    assert [p.name for p in tmp_path.iterdir()] == ["data.npz"]


@pytest.mark.parametrize("broken", ["os.replace", "numpy.savez_compressed", "os.fsync"])
@pytest.mark.parametrize("stop", [OSError("full"), KeyboardInterrupt()], ids=["disk", "ctrl-c"])
def test_an_interrupted_write_leaves_the_old_file_whole(tmp_path, monkeypatch, some, broken, stop):
    path = some.save(tmp_path / "data.npz")
    before = path.read_bytes()

    def fail(*args, **kwargs):
        raise stop

    monkeypatch.setattr(broken, fail)
    with pytest.raises(type(stop)):
        some.subset([1]).save(path, overwrite=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_private_file_behind_a_link_stays_both(tmp_path, some):
    path = some.save(tmp_path / "data.npz")
    path.chmod(0o600)
    link = tmp_path / "link.npz"
    link.symlink_to(path)
    assert some.subset([1]).save(link, overwrite=True) == link
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o600
    assert_same(Comparisons.load(path), some.subset([1]))


def test_a_saved_file_has_ordinary_permissions(tmp_path, some):
    path = some.save(tmp_path / "data.npz")
    plain = tmp_path / "plain"
    plain.touch()
    assert path.stat().st_mode == plain.stat().st_mode


@pytest.mark.parametrize("who", [["Ada", "Grace", "Ada"], [7, 3, 7], np.array(["a", "b", "c"])])
def test_who_answered_stays_with_the_answers(tmp_path, who):
    named = Comparisons(POOL, [0, 1, 2], [3, 4, 5], [1, 0, 0.3], who)
    assert named.subset([2, 1]).who.tolist() == [who[2], who[1]]
    assert named.sampled(key=KEY).who.tolist() == list(who)
    path = named.save(tmp_path / "data.npz")
    loaded = Comparisons.load(path)
    assert_same(loaded, named)
    assert loaded.who.dtype == named.who.dtype
    assert loaded.who.tolist() == list(who)
    with np.load(path) as file:
        assert file["format_version"] == 3


def test_a_file_without_names_is_of_the_version_that_older_readers_know(tmp_path, some):
    assert some.who is None
    assert some.subset([0]).who is None
    with np.load(some.save(tmp_path / "data.npz")) as file:
        assert file["format_version"] == 1
        assert "who" not in file


def test_own_recordings_may_say_who_answered():
    assert Comparisons.from_arrays(X, U, X, U, [1, 0], who=["Ada", "Bob"]).who.tolist() == [
        "Ada",
        "Bob",
    ]


@pytest.mark.parametrize("twins", [["Ada", "ada"], ["Ada L.", "Ada  L."], [" Bob", "Bob"]])
def test_one_person_under_two_names_is_asked_about(twins):
    with pytest.warns(UserWarning, match=r"blanks or in case") as warned:
        Comparisons(POOL, [0, 1, 2], [3, 4, 5], [1, 0, 1], [*twins, "Eve"])
    (said,) = {str(w.message) for w in warned}
    assert all(repr(name) in said for name in twins)
    assert "Eve" not in said
    assert warned[0].filename == __file__


def stored(some, **changes):
    names = ["x", "u", "y", "first", "second", "labels"]
    arrays = dict(zip(names, contents(some), strict=True), format_version=np.asarray(1))
    return {name: value for name, value in {**arrays, **changes}.items() if value is not None}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format_version": np.asarray(4)}, r"format version \(1, 2, 3\), got 4"),
        ({"format_version": np.asarray([1, 1])}, r"format version \(1, 2, 3\)"),
        ({"format_version": np.asarray("one")}, r"format version \(1, 2, 3\)"),
        ({"labels": None, "x": None}, r"lacks \['labels', 'x'\]"),
        ({"format_version": None}, "lacks"),
        ({"labels": np.array([1, 0, 2.0])}, r"labels must lie in \[0, 1\]"),
        ({"x": np.full((6, 4, 2), np.nan)}, "x must be finite"),
        ({"first": np.array([0, 1, 99])}, "first must point into the 6 trajectories"),
        ({"labels": np.array([{}, 0, 1], object)}, "path must be a readable .npz file"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path, some, changes, words):
    path = tmp_path / "data.npz"
    np.savez(path, allow_pickle=True, **stored(some, **changes))
    with pytest.raises(ValueError, match=words):
        Comparisons.load(path)


def test_garbage_is_refused(tmp_path):
    path = tmp_path / "data.npz"
    for garbage in (b"", b"garbage", json.dumps({"x": 1}).encode()):
        path.write_bytes(garbage)
        with pytest.raises(ValueError, match="path must be a readable"):
            Comparisons.load(path)
    np.save(tmp_path / "one.npy", np.ones(3))
    with pytest.raises(ValueError, match="path must be a readable"):
        Comparisons.load(tmp_path / "one.npy")
    with pytest.raises(FileNotFoundError):
        Comparisons.load(tmp_path / "nothing.npz")


class Explosive:
    def __reduce__(self):
        return os.abort, ()


def test_a_pickle_in_a_file_is_never_run(tmp_path, some):
    path = tmp_path / "data.npz"
    np.savez(path, allow_pickle=True, **stored(some, labels=np.array([Explosive()], object)))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        Comparisons.load(path)


def test_a_pool_with_a_failed_loop_is_refused():
    failed = bypass_init(Trajectory, x=POOL.x, u=POOL.u.copy(), y=POOL.y)
    failed.u[3, 1] = np.nan
    words = "trajectories must be finite, got 1 of 6 with NaN .* the first at index 3"
    with pytest.raises(ValueError, match=words):
        Comparisons(failed, [0], [1], [1])
    with pytest.raises(ValueError, match=words):
        Comparisons.random(failed, PREFERENCE, 2, key=KEY)
    x, u = np.ones((2, 4, 2)), np.ones((2, 3, 1))
    with pytest.raises(ValueError, match=r"x_second.*x must be finite"):
        Comparisons.from_arrays(x, u, np.where(np.arange(4)[:, None] > 2, np.nan, x), u, [1, 1])
    kept = np.delete(np.arange(6), 3)
    assert len(Comparisons.random(failed[kept], PREFERENCE, 5, key=KEY)) == 5


X, U = np.ones((2, 4, 2)), np.ones((2, 3, 1))


def no_answer(first, second):
    return np.full(len(first), np.nan)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Comparisons(POOL, [], [], []), "at least one comparison, got an empty data set"),
        (lambda: Comparisons(POOL, [0], [1], [1.1]), r"labels must lie in \[0, 1\].*1.1 at index"),
        (lambda: Comparisons(POOL, [0], [1], [-1]), r"labels must lie in \[0, 1\]"),
        (lambda: Comparisons(POOL, [0], [1], [np.nan]), "labels must be finite"),
        (lambda: Comparisons(POOL, [0], [1], [[1]]), "labels must have 1 dimension"),
        (lambda: Comparisons(POOL, [0], [1], [1], []), "who must name 1 people, .* got 0"),
        (lambda: Comparisons(POOL, [0], [1], [1], "Ada"), "who must be a sequence, got str"),
        (lambda: Comparisons(POOL, [0], [1], [1], [None]), "who must hold whole .* got None"),
        (lambda: Comparisons(POOL, [0], [1], [1], [" "]), "who must hold .* not blank, got ' '"),
        (lambda: Comparisons(POOL, [0], [1], [1], [0.5]), "who must hold whole .* got 0.5"),
        (lambda: Comparisons(POOL, [0, 1], [1, 2], [1, 1], [1, "Ada"]), "who must hold .* both"),
        (lambda: Comparisons(POOL, [0], [1], [1], [2**70]), "who must hold whole .* 64 bits"),
        (lambda: Comparisons(POOL, [0, 1], [1], [1]), "first must hold 1 whole numbers"),
        (lambda: Comparisons(POOL, [0], [1.5], [1]), "second must hold whole numbers, got float"),
        (lambda: Comparisons(POOL, [0], [6], [1]), r"second must point.*0 to 5\), got 6 to 6"),
        (lambda: Comparisons(POOL, [-1], [1], [1]), "first must point into the 6"),
        (lambda: Comparisons(POOL.x, [0], [1], [1]), "trajectories must be a Trajectory"),
        (lambda: Comparisons(POOL[0], [0], [1], [1]), "trajectories must have one leading dim"),
        (lambda: Comparisons.random(POOL, PREFERENCE, 0, key=KEY), "size must be a whole number"),
        (lambda: Comparisons.random(POOL[:1], PREFERENCE, 2, key=KEY), "at least two to compare"),
        (lambda: Comparisons.random(POOL.x, PREFERENCE, 2, key=KEY), "trajectories must be a Traj"),
        (lambda: Comparisons.random(POOL[0], PREFERENCE, 2, key=KEY), "trajectories must have one"),
        (
            lambda: Comparisons.random(POOL, lambda a, b: 1, 2, key=KEY),
            "one answer in .* each pair",
        ),
        (lambda: Comparisons.random(POOL, no_answer, 2, key=KEY), "it answered none of 2"),
        (
            lambda: Comparisons.random(POOL, lambda a, b: np.full(2, np.inf), 2, key=KEY),
            "preference must return one answer in .* with inf",
        ),
        (
            lambda: Comparisons.random(POOL, PREFERENCE, 2, key=KEY, same_start=True),
            r"two with the same x\(0\) for same_start=True, all 6 start in different",
        ),
        (lambda: Comparisons.random(POOL, PREFERENCE, 2, key=-1), "key must be a single JAX"),
        (lambda: Comparisons(POOL, [0], [1], [1]).sampled(key=True), "key must be a single JAX"),
        (lambda: Comparisons.from_arrays(X, U, X[:1], U[:1], [1, 1]), "must have equal shapes"),
        (lambda: Comparisons.from_arrays(X[0], U[0], X[0], U[0], [1]), "one leading dimension"),
        (lambda: Comparisons.from_arrays(X, U, X, U, [1]), r"labels must have shape \(2,\)"),
        (lambda: Comparisons.from_arrays(X * np.nan, U, X, U, [1, 1]), "x must be finite"),
        (lambda: Comparisons(POOL, [0], [1], [1]).subset([]), "index must choose"),
        (lambda: Comparisons(POOL, [0], [1], [1]).subset([5]), "index must"),
        (lambda: Comparisons(POOL, [0], [1], [1]).save("data.csv"), "path must end in .npz"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_data_sets_that_are_put_together_say_who_answered_or_do_not():
    ann, bob, nobody = (
        Comparisons(POOL, [0, 1], [1, 2], [1, 0], who)
        for who in (["Ann", "Ann"], ["Bob", "Ann"], None)
    )
    both = Comparisons.concatenate([ann, bob])
    assert both.who is not None
    assert both.who.tolist() == ["Ann", "Ann", "Bob", "Ann"]
    assert Comparisons.concatenate([nobody, nobody]).who is None
    for other in (nobody, Comparisons(POOL, [0], [1], [1], [7])):
        with pytest.raises(ValueError, match="sets must all say who answered in one way"):
            Comparisons.concatenate([ann, other])
