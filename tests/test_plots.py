"""What the figures show, read back from the figures."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("agg")

import matplotlib.pyplot as plt

from prefmpc import plots


@pytest.fixture(autouse=True)
def own_style():
    with mpl.rc_context():
        yield
    plt.close("all")


def test_the_style_is_safe_for_the_colour_blind_and_in_grey():
    plots.use_style()
    cycle = list(mpl.rcParams["axes.prop_cycle"])
    assert len({entry["color"] for entry in cycle}) == len(cycle)
    looks = {(entry["color"], str(entry["linestyle"])) for entry in cycle}
    assert len(looks) == len(cycle)


def test_a_table_holds_the_texts_and_marks_what_lies_inside():
    html = plots.table(["a", "b"], [["x", plots.mark(2.04, 1.0, 2.0, 1)]], "what").data
    assert html == (
        "<table><caption>what</caption><thead><tr><th>a</th><th>b</th></tr></thead><tbody>"
        '<tr><td>x</td><td><span class="inside">2.0</span></td></tr></tbody></table>'
    )
    assert plots.mark(2.06, 1.0, 2.0, 1) == '<span class="outside">2.1</span>'
    assert plots.mark(np.inf, 5, np.inf, text=">30") == '<span class="inside">>30</span>'


@pytest.mark.parametrize("step", [False, True])
def test_responses_are_drawn_over_time(step):
    ax = plots.responses({"a": [1, 2, 3], "b": [0, 0, 1]}, 0.2, ylabel="x in m", step=step)
    drawn = {line.get_label(): line for line in ax.get_lines()}
    for name, values in {"a": [1, 2, 3], "b": [0, 0, 1]}.items():
        np.testing.assert_allclose(drawn[name].get_xdata(), [0, 0.2, 0.4])
        np.testing.assert_array_equal(drawn[name].get_ydata(), values)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time in s", "x in m")
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["a", "b"]


def test_boxes_show_the_median():
    sample = np.arange(101.0)
    ax = plots.boxes({"a": sample, "b": sample + 7}, ylabel="φ", log=True, reference=1.0)
    levels = [set(np.asarray(line.get_ydata())) for line in ax.get_lines()]
    assert {50.0} in levels
    assert {57.0} in levels
    assert {1.0} in levels
    assert ax.get_yscale() == "log"
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["a", "b"]


def test_heatmaps_share_one_scale_around_zero():
    figure = plots.heatmaps({"Q": [[1, -4], [0, 2]], "R": [[3]]}, names=["p", "v"][:0])
    images = [ax.images[0] for ax in figure.axes if ax.images]
    assert [image.get_clim() for image in images[:2]] == [(-4, 4), (-4, 4)]
    np.testing.assert_array_equal(images[0].get_array(), [[1, -4], [0, 2]])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: plots.responses({}, 0.1, ylabel="x"), "responses must hold at least one"),
        (lambda: plots.responses({"a": np.ones((2, 2))}, 0.1, ylabel="x"), r"responses\['a'\].*2"),
        (lambda: plots.boxes({}, ylabel="x"), "values must hold at least one entry"),
        (lambda: plots.heatmaps({}), "matrices must hold at least one entry"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
