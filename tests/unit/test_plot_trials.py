"""Figures of trials, costs and poses show their data, a method in one colour in all."""

from dataclasses import replace
from itertools import pairwise

import matplotlib as mpl
import matplotlib.pyplot
import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.patches import PathPatch
from small_scenes import small_scene

import autdtorch as at
from autdtorch.plot.cost_figures import plot_pareto, plot_scaling
from autdtorch.plot.style import looks_of
from autdtorch.plot.trials import plot_convergence, plot_poses, plot_trials

RANDOM = np.random.default_rng(7)


def test_trials_draw_quartiles_of_many_dots_for_few_and_a_marker_for_one() -> None:
    values = {"gabs": RANDOM.normal(5, 1, 50), "lssg": torch.tensor([2.5])}
    figure = plot_trials({"mean pressure [Pa]": {"empty": values}})
    (ax,) = figure.axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("scene", "mean pressure [Pa]")
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["empty"]
    (box,) = (patch for patch in ax.patches if isinstance(patch, PathPatch))
    heights = box.get_path().vertices[:, 1]
    drawn = (heights.min(), heights.max())
    np.testing.assert_allclose(drawn, np.percentile(values["gabs"], [25, 75]))
    (diamond,) = (line for line in ax.get_lines() if line.get_marker() == "D")
    assert diamond.get_ydata()[0] == 2.5
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["GABS", "LSSG"]
    (ax,) = plot_trials({"f [1]": {"empty": {"gabs": [1.0, 2.0, 4.0]}}}).axes
    (dots,) = ax.get_lines()
    assert sorted(dots.get_ydata()) == [1.0, 2.0, 4.0]
    (median,) = (artist for artist in ax.collections if isinstance(artist, LineCollection))
    np.testing.assert_array_equal(median.get_segments()[0][:, 1], 2.0)
    assert not ax.patches


@pytest.mark.parametrize(
    ("scenes", "trials", "rows", "highest"),
    [(1, 1, 1, 3.0), (1, 50, 1, 3.0), (3, 1, 3, 5.0), (3, 50, 3, 7.1)],  # inches
)
def test_panels_of_few_values_are_low(scenes: int, trials: int, rows: int, highest: float) -> None:
    values = {f"scene {number}": {"gabs": RANDOM.random(trials)} for number in range(scenes)}
    figure = plot_trials(dict.fromkeys(("mean [Pa]", "area [mm²]", "std [Pa]"), values))
    assert figure.axes[0].get_subplotspec().get_gridspec().nrows == rows
    assert figure.get_figheight() <= highest


def test_a_method_has_one_colour_in_all_figures() -> None:
    trials = plot_trials({"f [1]": {"empty": {"other": np.arange(6.0), "gabs": np.arange(6.0)}}})
    convergence = plot_convergence({"empty": {"gabs": [[1.0, 2.0]], "lssg": [[1.0]], "other": [[1.0, 2.0]]}})
    boxes = {patch.get_label(): patch.get_facecolor()[:3] for patch in trials.legends[0].get_patches()}
    lines = convergence.legends[0].get_lines()
    colours = {line.get_label(): mpl.colors.to_rgb(line.get_color()) for line in lines}
    assert len(set(colours.values())) == 3
    for name in ("GABS", "other"):
        assert boxes[name] == pytest.approx(colours[name])


def test_convergence_draws_median_and_quartile_band() -> None:
    history = np.maximum.accumulate(RANDOM.normal(size=(50, 30)) + 5, axis=1)
    figure = plot_convergence({"empty": {"gabs": history}, "two_cubes": {"gabs": history[:1]}})
    first, second = figure.axes
    line = first.get_lines()[0]
    np.testing.assert_array_equal(line.get_xdata(), np.arange(1, 31))
    np.testing.assert_allclose(line.get_ydata(), np.median(history, axis=0))
    (band,) = first.collections
    vertices = band.get_paths()[0].vertices
    for column, quartiles in enumerate(np.percentile(history, [25, 75], axis=0).T):
        here = vertices[vertices[:, 0] == column + 1, 1]
        assert (here.min(), here.max()) == pytest.approx(quartiles)
    assert not second.collections, "a single trial has no band"
    assert [ax.get_title() for ax in figure.axes] == ["empty", "two cubes"]
    assert first.get_xlabel() == "evaluations"
    assert first.get_ylabel().endswith("[Pa]")


@pytest.mark.parametrize(("factor", "shared"), [(2.0, True), (500.0, False)])
def test_scenes_of_other_scales_have_their_own_axis(factor: float, shared: bool) -> None:
    first, second = plot_convergence({"a": {"gabs": [[1.0, 2.0]]}, "b": {"gabs": [[factor, factor]]}}).axes
    assert (first.get_ylim() == second.get_ylim()) == shared
    assert first.get_ylim()[0] == second.get_ylim()[0] == 0
    assert first.get_ylim()[1] >= 2.0


def test_curves_that_never_rise_have_room_above_them() -> None:
    """As of a method that begins at its best drive."""
    for heights in ([8.17, 8.18], [8.0, 8.0]):
        (ax,) = plot_convergence({"a": {"identify": [heights]}}).axes
        assert ax.get_ylim()[0] == 0
        assert ax.get_ylim()[1] > 1.02 * heights[-1]
    (ax,) = plot_convergence({"a": {"identify": [[-2.0, -1.0]]}}).axes
    assert ax.get_ylim()[0] < -2.0


def test_gains_within_their_uncertainty_are_pale() -> None:
    propagator = at.make_propagator(small_scene())
    drives = at.drive_from_phases(6 * RANDOM.random((6, 4)))
    readings = at.Readings(drives, (drives @ propagator.transfer_matrix().T).abs())
    calibration = at.calibrate(propagator, readings, at.Prior(gain=0.2, phase=0.5), folds=0)
    _, gains, _ = at.plot_calibration(calibration).axes[:3]
    (dots,) = gains.collections
    off = (dots.get_array() - 1).max()
    assert off < 0.5 * float((calibration.gain * calibration.gain_deviation).min())
    assert dots.norm(1 + off) - 0.5 < 0.125  # of 0.5, the end of the colours


def test_a_calibration_is_drawn_on_the_array_or_by_index() -> None:
    propagator = at.make_propagator(small_scene())
    matrix = propagator.transfer_matrix()
    drives = at.drive_from_phases(6 * RANDOM.random((20, 4)))
    pressure = (drives @ (torch.tensor([1.2, 0.9, 1.0, 1.0j]) * matrix).T).abs()
    pressure[7, 1] *= 100
    calibration = at.calibrate(propagator, at.Readings(drives, pressure), at.Prior(rest=0.01))
    left, gains, phases = at.plot_calibration(calibration).axes[:3]
    before, after, outlier = (each.get_offsets() for each in left.collections)
    assert len(before) == len(after) == 59
    np.testing.assert_allclose(after[:, 1], after[:, 0], atol=0.05 * pressure[:7].max())
    assert outlier.max() <= left.get_xlim()[1]  # at the edge, so that others can be told apart
    assert f"{100 * calibration.held_back.before:.1f} %" in left.figure.legends[0].get_texts()[0].get_text()
    held = calibration.held_back
    useless = replace(calibration, held_back=held._replace(error=held.before))
    figures = map(at.plot_calibration, (calibration, useless))
    labels = [figure.legends[0].get_texts()[1].get_text() for figure in figures]
    assert ["no better than the simulation" in label for label in labels] == [False, True]
    for ax, values in ((gains, calibration.gain), (phases, calibration.phase)):
        (dots,) = ax.collections
        np.testing.assert_array_equal(dots.get_array(), values)
        # the array is in the plane of y and z
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("y [mm]", "z [mm]")
    of_matrix = at.calibrate(matrix, at.Readings(drives, pressure), folds=0)
    figure = at.plot_calibration(of_matrix)
    assert [ax.get_xlabel() for ax in figure.axes] == ["reading [Pa]", "transducer", "transducer"]
    opposite = at.TransducerArray.grid((2, 2), 8e-3, (23e-3, 12e-3, 12e-3), normal=(-1, 0, 0))
    two = at.make_propagator(replace(small_scene(), array=small_scene().array + opposite))
    drives = at.drive_from_phases(6 * RANDOM.random((20, 8)))
    readings = at.Readings(drives, (drives @ two.transfer_matrix().T).abs())
    figure = at.plot_calibration(at.calibrate(two, readings, folds=0))
    assert figure.axes[1].get_xlabel() == "transducer"  # one array would cover the other


def test_poses_and_levels_are_drawn_along_the_path_and_across_their_scene() -> None:
    scores = {"gabs": 1 + RANDOM.random((7, 5)), "lssg": 1 + RANDOM.random((7, 1))}
    figure = plot_poses(scores, np.arange(7.0), "path [mm]", "weakest focus [Pa]", np.full(7, 2.0))
    (ax,) = figure.axes
    lines = {line.get_label(): line.get_xydata() for line in ax.get_lines()}
    assert set(lines) == {"GABS", "LSSG", "bound"}
    np.testing.assert_allclose(lines["GABS"][:, 1], np.median(scores["gabs"], axis=1))
    assert ax.get_ylim()[0] == 0
    without = plot_poses(scores, np.arange(7.0), "", "", np.full(7, np.inf))
    assert len(without.axes[0].get_lines()) == 2
    with pytest.raises(ValueError, match=r"scores\['gabs'\]: 7 poses; must be 6"):
        plot_poses(scores, np.arange(6.0), "", "")
    history = {"empty": {"gabs": [[1.0, 2.0]]}, "two_cubes": {"gabs": [[1.0, 2.0]]}}
    figure = plot_convergence(history, {"empty": {"bound": 4.0, "90 %": 3.6}, "two_cubes": {"bound": 5.0}})
    for ax, expected in zip(figure.axes, ([4.0, 3.6], [5.0]), strict=True):
        across = [line for line in ax.get_lines() if list(line.get_xdata()) == [0, 1]]  # of the width
        assert [line.get_ydata()[0] for line in across] == expected
        assert ax.get_ylim()[1] >= max(expected)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["GABS", "bound", "90 %"]


METHODS = (
    *("lssg", "bayes_opt", "bo_foci", "gabs", "lss", "random_search", "identify", "phase_stepping"),
    "gradient_ascent",
)


def test_methods_differ_in_colour_in_marker_and_in_dashes() -> None:
    looks = looks_of([*METHODS, "a", "b", "c", "d"])
    for part in zip(*looks.values(), strict=True):
        assert len(set(part)) == len(looks)
    assert len(set(looks_of(["a", "b", "c"]).values()) & set(looks_of(METHODS).values())) == 3


def test_ticks_of_nearly_equal_costs_are_short_and_apart() -> None:
    points = {"a": {"x": [(4.02e-3, 80.0)], "y": [(4.11e-3, 30.0)]}}
    figure = plot_pareto(points, "time [s]", "score [%]", higher_is_better=True)
    figure.draw_without_rendering()
    (ax,) = figure.axes
    low, high = ax.get_xlim()
    assert high / low >= 10
    labels = [label for label in ax.get_xticklabels(which="both") if label.get_text()]
    boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
    assert len(boxes) >= 2
    assert all(before.x1 < after.x0 for before, after in pairwise(boxes))


def test_pareto_draws_the_front_of_all_as_steps_and_names_its_points() -> None:
    points = {"a_b": {"gabs": [(1.0, 0.3), (2.0, 0.4)], "other": [(4.0, 0.1), (0.5, 0.9), (3.0, 0.5)]}}
    names = {"a_b": {"gabs": ["g1", "g2"], "other": ["o1", "o2", "o3"]}}
    figure = plot_pareto(points, "time [s]", "error [1]", names=names)
    (ax,) = figure.axes
    assert (ax.get_title(), ax.get_xlabel(), ax.get_ylabel()) == ("a b", "time [s]", "error [1]")
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert [text.get_text() for text in ax.texts] == ["o2", "g1", "o1"]
    (front,) = (line for line in ax.get_lines() if line.get_drawstyle() == "steps-post")
    np.testing.assert_allclose(front.get_xydata(), [(0.5, 0.9), (1, 0.3), (4, 0.1), (ax.get_xlim()[1], 0.1)])
    (ax,) = plot_pareto(points, "time [s]", "score [Pa]", higher_is_better=True).axes
    assert (ax.get_xscale(), ax.get_yscale(), ax.get_ylim()[0] <= 0) == ("log", "linear", True)
    (front,) = (line for line in ax.get_lines() if line.get_drawstyle() == "steps-post")
    np.testing.assert_allclose(front.get_xydata(), [(0.5, 0.9), (ax.get_xlim()[1], 0.9)])


def test_scaling_shows_slopes_and_sizes() -> None:
    sizes = np.array([1.0, 2.0, 4.0, 8.0])
    square, flat = (np.column_stack([sizes, 3 * sizes**power]) for power in (2, 0))
    figure = plot_scaling({"time [s]": {"edge [mm]": {"box": square}, "foci": {"box": flat}}})
    first, second = figure.axes
    assert (first.get_xlabel(), second.get_xlabel(), first.get_ylabel()) == ("edge [mm]", "foci", "time [s]")
    legends = [ax.get_legend().get_texts()[0].get_text() for ax in (first, second)]
    assert legends == ["box, slope 2.0", "box, within a factor 1"]
    assert list(first.get_xticks()) == pytest.approx(list(sizes))
