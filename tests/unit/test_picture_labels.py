"""No label of a figure covers another or leaves the figure, and every colour bar has a unit."""

import itertools
import re

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

import autdtorch as at
from autdtorch.plot.axes3d import axes_of, view_from

METHODS = (
    *("lssg", "bayes_opt", "bo_foci", "gabs,levels=8,passes=3", "lss", "random_search", "identify"),
    "gradient_ascent",
)
SCENES = ("lab", "two_cubes", "two_cubes,array.pitch=0.0105,medium.temperature=25", "hand_with_many_fingers")
UNIT = re.compile(r"\[(Pa|kPa|MPa|mPa|µPa|dB|rad|%|s|mm|mm²)\]")

# Shrinking would draw hundreds of figures.
few = settings(max_examples=4, deadline=None, derandomize=True, phases=[Phase.generate])


def labels(figure: Figure) -> dict[str, Bbox]:
    """The boxes of all texts that are drawn [pixels], by text and place."""
    figure.draw_without_rendering()
    hidden = set()
    for axis in (axis for ax in figure.axes for axis in (ax.xaxis, ax.yaxis)):
        low, high = sorted(axis.get_view_interval())
        beyond = [tick for tick in axis.get_major_ticks() if not low <= tick.get_loc() <= high]
        for artist in beyond if axis.axes.axison else [axis]:  # Matplotlib keeps texts that it does not draw
            hidden.update(artist.findobj(Text))
    drawn = [text for text in figure.findobj(Text) if text.get_visible() and text not in hidden]
    boxes = [(text.get_text(), text.get_window_extent()) for text in drawn if text.get_text()]
    return {f"{text!r} at {np.round(box.p0)}": box for text, box in boxes}


def require_clear(figure: Figure) -> None:
    """Check that no label covers another by over a pixel of 150 in an inch, or leaves the figure."""
    boxes = labels(figure)
    assert boxes
    frame = figure.bbox
    for name, box in boxes.items():
        inside = (box.x0 > frame.x0 - 2, box.y0 > frame.y0 - 2, box.x1 < frame.x1 + 2, box.y1 < frame.y1 + 2)
        assert all(inside), f"{name} leaves the figure: {box}"
    for (name, box), (other, covered) in itertools.combinations(boxes.items(), 2):
        width = min(box.x1, covered.x1) - max(box.x0, covered.x0)
        height = min(box.y1, covered.y1) - max(box.y0, covered.y0)
        assert min(width, height) <= 1, f"{name} and {other} overlap"


@st.composite
def planes(draw: st.DrawFn) -> at.Plane:
    sides = draw(
        st.sampled_from([(0.1, 0.1), (0.012, 0.2), (0.2, 0.012), (0.16, 0.1), (1e-3, 2e-3), (3.0, 2.0)])
    )
    normal = draw(st.sampled_from([(1, 0, 0), (0, 0, -1), (1, 1, 1)]))
    place = draw(st.sampled_from([0.0, 0.05, -1.234]))
    return at.Plane((place, 0.05, -place), normal, sides)


def field(draw: st.DrawFn) -> np.ndarray:
    peak = draw(st.sampled_from([0.0, 3e-7, 2.7e-3, 0.9, 8.56, 999.0, 4590.0, 3.3e6]))
    return peak * np.random.default_rng(0).random((6, 5))


@few
@given(data=st.data())
def test_labels_of_a_map_are_clear(data: st.DataObject) -> None:
    values, plane = field(data.draw), data.draw(planes())
    decibels = bool(values.any()) and data.draw(st.booleans())
    figure = at.plot_plane(values, plane, decibels=decibels)
    require_clear(figure)
    assert UNIT.search(figure.axes[1].get_ylabel() + figure.axes[1].get_xlabel())


@few
@given(data=st.data())
def test_labels_of_maps_are_clear(data: st.DataObject) -> None:
    scenes = data.draw(st.lists(st.sampled_from(SCENES), min_size=1, max_size=3, unique=True))
    some = st.lists(st.sampled_from(METHODS), min_size=1, max_size=4, unique=True)
    maps = {scene: {method: field(data.draw) for method in data.draw(some)} for scene in scenes}
    plane = data.draw(planes())
    figure = at.plot_planes(maps, {scene: data.draw(st.just(plane) | planes()) for scene in scenes})
    require_clear(figure)
    assert all(UNIT.search(ax.get_xlabel()) for ax in figure.axes[-len(scenes) :])


@settings(few, max_examples=2)
@given(data=st.data())
def test_labels_over_trials_are_clear(data: st.DataObject) -> None:
    scenes = data.draw(st.lists(st.sampled_from(SCENES), min_size=1, max_size=4, unique=True))
    methods = data.draw(st.lists(st.sampled_from(METHODS), min_size=1, max_size=8, unique=True))
    random = np.random.default_rng(data.draw(st.integers(0, 9)))
    scale = data.draw(st.sampled_from([1e-3, 1.0, 5e3]))
    values = {scene: {method: scale * random.random(7) for method in methods} for scene in scenes}
    require_clear(at.plot_trials({"mean pressure of the foci [Pa]": values, "area per focus [mm²]": values}))
    history = {scene: {name: np.sort(values[scene][name])[None] for name in methods} for scene in scenes}
    levels = {scene: {"bound": 1.1 * scale, "90 % of the bound": scale} for scene in scenes}
    require_clear(at.plot_convergence(history, levels))
    points = {scene: {name: random.lognormal(0, 3, (3, 2)) for name in methods} for scene in scenes}
    names = dict.fromkeys(scenes, dict.fromkeys(methods, ("0.5 mm", "1 mm", "2 mm")))
    require_clear(at.plot_pareto(points, "time of the search [s per trial]", "error [%]", names=names))
    path = {name: random.random((7, 2)) for name in methods}
    require_clear(
        at.plot_poses(path, np.arange(7.0), "shift along the path [mm]", "weakest of eight foci [Pa]")
    )


@pytest.mark.parametrize(("points", "count", "scale"), [(1, 16, 1e-4), (4, 60, 30.0)])
def test_labels_of_a_calibration_are_clear(points: int, count: int, scale: float) -> None:
    array = at.TransducerArray.grid((2, count // 2), 10e-3, (0.0, 0.0, 0.0), source_strength=scale)
    places = [[0.1, 0.01 * number, 0.0] for number in range(points)]
    propagator = at.make_propagator(at.Scene(array, at.Medium(1.2, 340.0), 40e3, places))
    random = np.random.default_rng(0)
    drives = at.drive_from_phases(6 * random.random((6, count)))
    pressure = (drives @ propagator.transfer_matrix().T).abs().numpy() * random.uniform(0.5, 2, (6, points))
    pressure[2, 0] *= 1000
    for model in (propagator, propagator.transfer_matrix()):
        require_clear(at.plot_calibration(at.calibrate(model, at.Readings(drives, pressure), folds=0)))


def test_rounding_errors_of_equal_transducers_are_no_colours() -> None:
    array = at.TransducerArray.grid((4, 4), 10e-3, (0.0, 0.0, 0.0))
    propagator = at.make_propagator(at.Scene(array, at.Medium(1.2, 340.0), 40e3, [[0.0, 0.0, 0.1]]))
    drives = at.drive_from_phases(6 * np.random.default_rng(0).random((40, 16)))
    exact = at.Readings(drives, (drives @ propagator.transfer_matrix().T).abs())
    figure = at.plot_calibration(at.calibrate(propagator, exact, folds=0))
    for ax, middle in zip(figure.axes[1:3], (1.0, 0.0), strict=True):
        (dots,) = ax.collections
        assert dots.norm.vmax - middle >= 0.01  # 1 % and 0.01 rad, less than a bench resolves
    require_clear(figure)


POINT_NAMES = ("", "gabs,levels=8,passes=3", "W" * 22, "a name of sixty letters " * 3)


@pytest.mark.parametrize(
    ("name", "higher_is_better", "count"),
    [*((name, False, 4) for name in POINT_NAMES), (POINT_NAMES[-1], True, 1)],
)
def test_names_of_points_on_a_front_are_clear(name: str, higher_is_better: bool, count: int) -> None:
    random = np.random.default_rng(3)
    points = {scene: {"gabs": random.lognormal(0, 1, (count, 2))} for scene in ("lab", "two_cubes")}
    names = {scene: {"gabs": [name] * count} for scene in points}
    figure = at.plot_pareto(points, "time [s]", "result [%]", higher_is_better, names)
    require_clear(figure)
    for ax in figure.axes:
        texts = [text for text in ax.texts if text.get_text()]
        assert bool(texts) == bool(name)
        for box in (text.get_window_extent() for text in texts):  # does not lie on the axis and its numbers
            assert ax.bbox.x0 <= box.x0 <= box.x1 <= ax.bbox.x1
            assert ax.bbox.y0 <= box.y0 <= box.y1 <= ax.bbox.y1


ROWS = (["a", "b", "a very long method name indeed"], ["gabs,levels=8,passes=3", "lss"], ["x" * 60])
SIDES = [(0.1, 0.1), (0.012, 0.2), (0.2, 0.012)]


@pytest.mark.parametrize(("rows", "size"), list(zip(ROWS, SIDES, strict=True)))
def test_names_of_rows_are_clear(rows: list[str], size: tuple[float, float]) -> None:
    plane = at.Plane((0.08, 0.05, 0.05), (1, 0, 0), size)
    maps = {row: np.full((20, 20), 120.0) for row in rows}
    box = at.Box((0.08, 0.05, 0.05), (0.01,) * 3, rigid=True)
    require_clear(at.plot_planes({"two_cubes": maps}, {"two_cubes": plane}))
    require_clear(at.plot_planes(maps, plane, [(0.08, 0.03, 0.045)], [box]))  # of one scene


SIDE = st.floats(1.0, 3e3)  # mm


@given(
    sides=st.tuples(SIDE, SIDE, SIDE),
    start=st.floats(-2e3, 2e3),
    towards=st.tuples(st.floats(-1.0, -0.3), st.floats(-1.0, -0.3), st.floats(0.2, 1.0)),
)
def test_labels_of_a_box_are_clear_and_at_their_ticks(
    sides: tuple[float, ...], start: float, towards: tuple[float, ...]
) -> None:
    lower, room = np.full(3, start), np.array([800.0, 600.0])
    upper = lower + sides
    view = view_from(np.array(towards))
    np.testing.assert_allclose(view @ view.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(view @ towards, 0, atol=1e-12)

    def size(text: str) -> tuple[float, float]:
        return 12.0 * len(text), 18.0

    axes = axes_of(lower, upper, view, (800.0, 600.0), size, ("x [mm]", "y [mm]", "z [mm]"))
    assert (axes.high - axes.low <= room).all()
    boxes = []
    for text, point, corner in axes.labels:
        place = axes.scale * view @ (point - (lower + upper) / 2) + corner
        boxes.append((place, place + size(text)))
        assert (boxes[-1][0] >= axes.low - 1e-9).all()
        assert (boxes[-1][1] <= axes.high + 1e-9).all()
        if "mm" not in text:  # a number, of one of the coordinates
            assert np.isclose(point, float(text.replace("\N{MINUS SIGN}", "-")), rtol=0, atol=1e-6).any()
    for (low, high), (other, end) in itertools.combinations(boxes, 2):
        assert not ((low < end) & (high > other)).all()
    assert {"x [mm]", "y [mm]", "z [mm]"} <= {label.text for label in axes.labels}
    for axis, ticks in enumerate(axes.ticks):
        assert all(lower[axis] - 1e-6 <= tick <= upper[axis] + 1e-6 for tick in ticks)
    step = max((ticks[1] - ticks[0] for ticks in axes.ticks if len(ticks) > 1), default=np.inf)
    for axis, ticks in enumerate(axes.ticks):
        if np.floor(upper[axis] / step) > np.ceil(lower[axis] / step):  # two ticks of that step fit
            np.testing.assert_allclose(np.diff(ticks), step)


@few
@given(data=st.data())
def test_labels_of_a_scene_are_clear(data: st.DataObject) -> None:
    counts = data.draw(st.sampled_from([(1, 1), (4, 3), (16, 16), (24, 2)]))
    array = at.TransducerArray.grid(counts, pitch=10e-3, center=(0.0, 0.0, 0.0), normal=(0, 0, 1))
    height = data.draw(st.sampled_from([0.02, 0.15, 0.9]))
    scene = at.Scene(array, at.Medium.air(), 40e3, [[0.0, 0.0, height]])
    drive = data.draw(st.sampled_from([None, at.drive_from_phases(np.zeros(len(array)))]))
    figure = at.plot_scene(scene, drive)
    require_clear(figure)
    assert {"x [mm]", "y [mm]", "z [mm]"} <= {text.get_text() for text in figure.texts}
