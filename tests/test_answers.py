"""Answers of every kind and recordings of every length: what comes in, and what is refused."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest
from few_comparisons import COST, FEW, POOL

from prefmpc import Answers, Comparisons, Recordings, Trajectory
from prefmpc.preferences.recordings import applied

RNG = np.random.default_rng(1)
LONG = Trajectory(RNG.normal(size=(6, 2)), RNG.normal(size=(5, 1)))
UNEVEN = Recordings([LONG, POOL])
PER_STEP = Recordings([LONG, POOL], per_step=True)


def same(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_recordings_keep_their_order_and_sum_over_their_own_steps():
    assert UNEVEN.horizons.tolist() == [5, 3, 3, 3, 3, 3]
    same(UNEVEN[0], LONG)
    same(UNEVEN[-1], POOL[4])
    same(UNEVEN[[3, 0]][1], LONG)
    sigma = [float(COST(LONG)), *COST(POOL)]
    np.testing.assert_allclose(UNEVEN.apply(COST), sigma, rtol=1e-14)
    np.testing.assert_allclose(PER_STEP.apply(COST), sigma / UNEVEN.horizons, rtol=1e-14)
    np.testing.assert_allclose(applied(COST, Recordings([POOL])), COST(POOL), rtol=1e-15)


def test_every_coding_is_named_and_means_the_same():
    sides = POOL, [0, 1, 2], [1, 2, 3]
    words = Answers.from_labels(*sides, ["first", "tie", "second"], coding="words")
    for labels, coding in (
        ([1, 0, -1], "signs"),
        (np.array([1.0, 0.0, -1.0]), "signs"),
        (np.array(["a", "=", "b"]), {"a": 1, "=": 0.5, "b": 0}),
        ([-1, 0, 1], {-1: 1, 0: 0.5, 1: 0}),
    ):
        grades = 3 if isinstance(coding, dict) else None
        same(words, Answers.from_labels(*sides, labels, coding=coding, grades=grades))
    assert words.grades.tolist() == [3, 3, 3]
    assert words.answers.tolist() == [1, 0.5, 0]
    much = Answers.from_labels(*sides, [2, -1, 0], coding="signs", grades=5)
    assert much.answers.tolist() == [1, 0.25, 0.5]
    plain = Answers.from_labels(*sides, np.array([True, False, True]), coding="booleans")
    same(plain, Answers.from_comparisons(Comparisons(*sides, [1, 0, 1])))


def test_rankings_choices_and_stars_as_they_are_kept():
    told = Answers.from_rankings(POOL, [[3, 1], [0]], shown=[[0, 1, 3], [4, 0]])
    assert told.shown.tolist() == [[3, 1, 0], [0, 4, -1]]
    assert (told.grades.tolist(), told.answers.tolist()) == ([0, 0], [2, 1])
    best = Answers.from_choices(POOL, [[0, 1, 3], [4, 0]], [3, 0])
    assert best.shown.tolist() == [[3, 0, 1], [0, 4, -1]]
    stars = Answers.from_ratings(POOL, [1, 5, 3], stars=5, index=[4, 0, 0])
    assert (stars.shown[:, 0].tolist(), stars.answers.tolist()) == ([4, 0, 0], [0, 1, 0.5])
    fine = Answers.from_ratings(POOL, [True, False], stars=2)
    assert fine.answers.tolist() == [1, 0]


def test_put_together_and_taken_apart():
    both = Comparisons.concatenate([FEW, FEW])
    assert both.trajectories is POOL  # one pool stays one
    other = Comparisons(POOL[1:], [0], [3], [0.2])
    three = Comparisons.concatenate([FEW, other, FEW])
    assert len(three.trajectories) == 9
    assert (three.first[4], three.second[4]) == (5, 8)
    same(three.pairs[0][4], POOL[1])
    mixed = Answers.concatenate([FEW, Answers.from_ratings(UNEVEN, [1, 2], stars=2)])
    assert mixed.trajectories.horizons.tolist() == [3] * 5 + [5] + [3] * 5
    same(mixed.subset([0, 3]), mixed.subset(np.array([True, False, False, True, False, False])))
    assert mixed.subset([-1]).shown.tolist() == [[6, -1]]
    assert jax.tree.map(lambda leaf: leaf, mixed).shown is mixed.shown


@pytest.mark.parametrize("trajectories", [POOL, UNEVEN, PER_STEP], ids=["even", "uneven", "mean"])
def test_a_file_gives_back_what_was_saved(tmp_path, trajectories):
    data = Answers.concatenate(
        [
            Answers.from_rankings(trajectories, [[3, 1], [0, 2]], shown=[[0, 1, 3], [0, 2]]),
            Answers.from_labels(trajectories, [0], [1], [-1], coding="signs", grades=5),
            Answers.from_ratings(trajectories, [1, 3], stars=3),
        ]
    )
    path = data.save(tmp_path / "answers.jsonl")
    same(data, Answers.load(path))
    lines = path.read_text("utf-8").splitlines()
    assert json.loads(lines[-1]) == {"shown": [1], "grades": 3, "answer": 1.0}
    with pytest.raises(FileExistsError):
        data.save(path)
    assert len(Answers.load(data.subset([0]).save(path, overwrite=True))) == 1


def test_older_files_still_load(tmp_path):
    same(Answers.load(FEW.save(tmp_path / "few.npz")), Answers.from_comparisons(FEW))


@pytest.mark.parametrize(
    ("place", "line", "words"),
    [
        (0, '{"prefmpc answers": 2}', "line 1: prefmpc answers must be format 1, got 2"),
        (1, '{"x": [[1], [2]]}', "line 2: u is missing"),
        (7, '{"shown": [0, 1], "ranked": 3}', "answers must lie in"),
        (6, '{"shown": 3, "grades": 2, "answer": 1}', "line 7: shown must be a list"),
        (6, '{"shown": [0, 1], "grades": 2}', "line 7: answer must be a number"),
        (6, "[", "line 7: a line must be an object"),
    ],
)
def test_a_damaged_file_is_refused_by_line_and_field(tmp_path, place, line, words):
    path = Answers.from_comparisons(FEW).save(tmp_path / "a.jsonl")
    lines = path.read_text("utf-8").splitlines()
    path.write_text("\n".join([*lines[:place], line, *lines[place + 1 :], ""]), "utf-8")
    with pytest.raises(ValueError, match=words):
        Answers.load(path)


def test_the_same_start_is_asked_for_by_name():
    even = Trajectory(np.zeros((3, 4, 2)), RNG.normal(size=(3, 3, 1)))
    data = Answers.from_rankings(even, [[0, 1, 2], [1, 0]])
    assert data.check_same_start() is data
    with pytest.raises(ValueError, match="answers must be about trajectories that start alike"):
        Answers.from_comparisons(FEW).check_same_start()
    uneven = Answers.from_labels(UNEVEN, [1, 0], [1, 2], [1, 1], coding="signs")
    words = r"last equally long, answer 1 is about \[\[5\], \[3\]\]"
    with pytest.raises(ValueError, match=words):
        uneven.check_same_start()


def labelled(labels, coding, **options):
    return Answers.from_labels(
        POOL, [0] * len(labels), [1] * len(labels), labels, coding=coding, **options
    )


NO_OUTPUT = Trajectory(np.ones((3, 2)), np.ones((2, 1)))
WITH_OUTPUT = Trajectory(np.ones((4, 2)), np.ones((3, 1)), np.ones((3, 1)))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: Answers.from_rankings(POOL, [[0, 1], [2, 3, 2]]),
            r"rankings\[1\] must hold no traj.* \[2\]",
        ),
        (
            lambda: Answers.from_rankings(POOL, [[0, 7]]),
            r"shown must point into the 5 .* got \[0, 7\]",
        ),
        (lambda: Answers.from_rankings(POOL, [[0, -2]]), "shown must point into the 5"),
        (lambda: Answers.from_rankings(POOL, [[0]]), "at least two for a ranking"),
        (
            lambda: Answers.from_rankings(POOL, [[0, 4]], shown=[[0, 1]]),
            r"rankings\[0\] must rank what is shown, got \[4\]",
        ),
        (lambda: Answers.from_rankings(POOL, [[]]), r"rankings\[0\] must hold whole numbers"),
        (
            lambda: Answers.from_choices(POOL, [[0, 1]], [2]),
            r"chosen\[0\] must be among those shown, got 2",
        ),
        (
            lambda: Answers.from_choices(POOL, [[0, 1]], [0, 1]),
            "shown and chosen must be equally many, got 1 and 2",
        ),
        (
            lambda: Answers.from_ratings(POOL, [1, 6], stars=5),
            "ratings must lie in 1 to 5 stars, got 6 at index 1",
        ),
        (lambda: Answers.from_ratings(POOL, [1], stars=1), "stars must be at least 2"),
        (lambda: Answers.from_ratings(POOL, [1.5], stars=5), "ratings must hold whole numbers"),
        (
            lambda: labelled(["best"], "words"),
            r"labels\[0\] must be one of \['first', 'tie', 'second'\]",
        ),
        (lambda: labelled([2], "signs"), r"labels\[0\] must be a whole number in −1 to 1, got 2"),
        (lambda: labelled([True], "signs"), r"labels\[0\] must be a whole number"),
        (lambda: labelled([1], "booleans"), r"labels\[0\] must be True or False, got 1"),
        (lambda: labelled([1], "guess"), "coding must be"),
        (lambda: labelled(["a"], {"a": 1}), "grades must be given"),
        (lambda: labelled(["a"], {"a": 2}, grades=2), r"coding must give grades in \[0, 1\]"),
        (lambda: Answers(POOL, [[0, 1]], [3], [1.1]), r"answers must lie in \[0, 1\]"),
        (lambda: Answers(POOL, [[0, 1]], [1], [1]), "grades must be at least 2"),
        (lambda: Answers(POOL, [[-1, 1]], [2], [1]), "shown must be filled up"),
        (lambda: Answers(POOL, [[0, 1, 2]], [2], [1]), "shown must hold one or two"),
        (
            lambda: Answers(POOL, np.zeros((0, 2), int), np.zeros(0, int), []),
            "answers must hold at least one",
        ),
        (lambda: Answers.concatenate([FEW, POOL]), r"sets\[1\] must be a Comparisons"),
        (lambda: Answers.concatenate([]), "sets must hold at least one"),
        (
            lambda: Answers.concatenate([FEW, Answers.from_ratings(PER_STEP, [1], stars=2)]),
            "sets must all sum",
        ),
        (
            lambda: Comparisons.concatenate([FEW, Comparisons(UNEVEN.parts[1], [0], [0], [1])]),
            r"equally long trajectories, got \[3, 5\]",
        ),
        (
            lambda: Comparisons.concatenate(
                [
                    FEW,
                    Comparisons(Trajectory(np.ones((1, 4, 3)), np.ones((1, 3, 1))), [0], [0], [1]),
                ]
            ),
            r"sets\[1\] must have 2 states as the first one, got 3",
        ),
        (
            lambda: Recordings([WITH_OUTPUT, NO_OUTPUT]),
            r"trajectories\[1\] must have 1 outputs as the first one, got 2 \(outputs that are",
        ),
        (lambda: Recordings([]), "trajectories must be a sequence of at least one"),
        (lambda: Recordings([POOL], per_step=1), "per_step must be True or False"),
        (
            lambda: Comparisons.from_arrays(
                [[[1.0], [1]], [[1.0], [1], [1]]],
                [[[1.0]], [[1.0], [1]]],
                [[[1.0], [1]]] * 2,
                [[[1.0]]] * 2,
                [1, 0],
            ),
            "Recordings and Answers take different lengths",
        ),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
