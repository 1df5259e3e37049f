"""Scenarios: several scenes as one objective, for every method, goal and bound."""

import dataclasses
import math
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.methods.gradient import climb, random_drives
from autdtorch.objectives.goals import WEAKEST_FOCUS, derivative
from autdtorch.objectives.perturbations import FailedTransducers
from autdtorch.study.study_method import solve

BY = ["worst", "mean", 0.3]


@pytest.fixture
def scenarios(make_objective, random_matrix):
    def make(by="worst", scenes=3, points=2, transducers=5):
        return at.Scenarios(
            [make_objective(random_matrix(points, transducers, seed)) for seed in range(scenes)], by
        )

    return make


def goals_for(points):
    return [
        at.WeakestFocus(),
        at.WeakestFocus([1.0 + point for point in range(points)]),
        at.MeanPressure(),
        at.TargetPressures([1.0 + point for point in range(points)]),
        at.QuietPoints(at.WeakestFocus(), [0], 0.3),
        at.SeenPoints(at.WeakestFocus(), [1]),
        at.Contrast([0]),
    ]


def test_scores_are_the_worst_the_mean_and_the_quantile_of_the_scenes(scenarios):
    drives = random_drives(7, 5, torch.Generator().manual_seed(0))
    for by, expected in (
        ("worst", lambda scores: scores.amin(dim=1)),
        ("mean", lambda scores: scores.mean(dim=1)),
        (0.5, lambda scores: scores.median(dim=1).values),
        (0.99, lambda scores: scores.amax(dim=1)),
    ):
        every = scenarios(by)
        pressure = every(drives)
        alone = torch.stack([each(drives) for each in every.objectives], dim=1)
        assert torch.equal(pressure.reshape(7, 3, 2), alone)
        assert every.evaluations == 7
        assert torch.equal(every.scores(drives), alone.amin(dim=2))
        assert torch.equal(every.over()(pressure), expected(alone.amin(dim=2)))
        assert torch.equal(
            every.transfer_matrix, torch.cat([each.transfer_matrix for each in every.objectives])
        )


@pytest.mark.parametrize(
    "method",
    [
        at.RandomSearch(),
        at.LSSG(levels=4),
        at.GABS(levels=4),
        at.Identify(20),
        at.GradientAscent(2, 50),
        at.Holography(),
        at.BayesOpt(6, initial=4),
        at.BayesOpt(8, initial=4, model="foci", kernel="phasor"),
    ],
    ids=lambda method: getattr(method, "model", "") + method.name,
)
def test_every_method_maximises_the_score_of_all_scenes(scenarios, method):
    every = scenarios()
    solution = at.run(method, every)
    assert solution.pressure.shape == (1, 6)
    assert every.over().by_scene(every(solution.drive)).amin(dim=1) == pytest.approx(solution.score, rel=1e-6)
    assert solution.score <= every.over().bound(every.transfer_matrix)
    # not the best of one scene alone
    if method.name == "gradient_ascent":
        alone = at.run(method, every.objectives[0])
        assert every.scores(alone.drive).amin() < solution.score


def test_lssg_takes_the_evaluations_of_one_scene(scenarios):
    assert at.LSSG(levels=4).most_evaluations(at.Problem.of(scenarios())) == 2 * 4
    with pytest.raises(ValueError, match="order"):
        at.lssg(scenarios(), order=[0, 1, 2, 3, 4, 5])


@given(
    number=st.integers(0, 6),
    by=st.sampled_from(BY),
    scenes=st.integers(1, 6),
    points=st.integers(2, 4),
    transducers=st.integers(2, 16),
    seed=st.integers(0, 1000),
)
def test_no_drive_scores_above_the_bound(random_matrix, number, by, scenes, points, transducers, seed):
    matrix, generator = random_matrix(scenes * points, transducers, seed), torch.Generator().manual_seed(seed)
    drives = random_drives(50, transducers, generator)
    over = at.OverScenes(goals_for(points)[number], scenes, by)
    best = torch.cat([drives, climb(over, matrix, drives[:4], 60)[None], torch.zeros_like(drives[:1])])
    assert over((best @ matrix.T).abs()).max() <= over.bound(matrix) * (1 + 1e-12) + 1e-12


def test_a_quantile_is_the_kth_lowest_in_spite_of_rounding():
    scores = torch.arange(1.0, 101.0, dtype=torch.float64)
    for percent in range(1, 100):
        assert at.OverScenes(at.WeakestFocus(), 100, percent / 100).joined(scores) == percent
    assert at.OverScenes(at.WeakestFocus(), 3, 1e-15).joined(scores[:3]) == 1


def test_a_scene_that_is_there_twice_changes_no_bound(make_objective, random_matrix):
    scene = make_objective(random_matrix(4, 6, 0))
    twice = at.Scenarios([scene, scene])
    alone = at.focus_bound(scene.transfer_matrix)
    assert twice.over().bound(twice.transfer_matrix) <= alone * (1 + 1e-9)


def test_a_goal_over_all_scenes_stays(scenarios):
    every = scenarios()
    assert at.Problem.of(every, every.over()).goal == every.over()
    highest = at.run(at.GradientAscent(2, 50), every, goal=at.OverScenes(at.WeakestFocus(), 3, "mean"))
    assert highest.score == pytest.approx(every.scores(highest.drive).mean(dim=1))
    assert at.attainable(every, 0.0).answer is True
    assert at.attainable(every, 100.0).answer is False
    with pytest.raises(ValueError, match=r"goal.scenes: 2; must be 3"):
        at.gabs(every, goal=at.OverScenes(at.WeakestFocus(), 2))


def test_forces_in_scenes_have_one_goal():
    array = at.TransducerArray.grid((3, 3), 10e-3, (0, 0, 0), (0, 0, 1))
    propagator = at.make_propagator(at.Scene(array, at.Medium.air(), 40e3, [(0, 0, 0.1)]), "free_space")
    bead = at.Particle.of("EPS", 0.5e-3)
    low, same, other = (
        at.ForceObjective(propagator, at.Trap([(0, 0, 0.03)], directions, bead))
        for directions in ([(1, 0, 0)], [(1, 0, 0)], [(0, 1, 0)])
    )
    every = at.Scenarios([low, same])
    drive = torch.ones(1, 9) + 0j
    # sums of one drive and of a batch round apart with other numbers of threads
    assert every.scores(drive).tolist() == [pytest.approx([low.goal(low(drive)).item()] * 2, rel=1e-9)]
    with pytest.raises(ValueError, match=r"objectives\[1\]: goal .*must be that of the first"):
        at.Scenarios([low, other])


def test_a_run_goes_on_from_the_file_with_a_function_as_goal(scenarios, tmp_path):
    def functions():  # of equal code at other addresses, as in another process
        return lambda pressure: pressure.amin(dim=-1)

    goals, file = [functions(), functions()], tmp_path / "state.npz"
    first, again = (at.run(at.GABS(levels=3), scenarios(), goal=goal, state_file=file) for goal in goals)
    assert torch.equal(first.drive, again.drive)


@pytest.mark.parametrize("by", BY)
@pytest.mark.parametrize("goal", goals_for(2)[:3] + goals_for(2)[5:6], ids=lambda goal: goal.name)
def test_slopes_are_derivatives(by, goal):
    over = at.OverScenes(goal, 4, by)
    pressure = torch.tensor([1.3, 1.9, 2.4, 3.1, 0.8, 5.0, 2.0, 1.1], dtype=torch.float64)
    cosine = torch.nn.functional.cosine_similarity(
        over.slope(pressure, 1e-4), derivative(over, pressure), dim=0
    )
    assert cosine == pytest.approx(1, abs=1e-6)


def test_failed_transducers_are_supposed_within_and_unknown_around(make_objective, random_matrix):
    whole = make_objective(random_matrix(2, 5, 0))
    every = at.Scenarios([whole, at.FailedTransducers(whole, [1])])
    assert torch.equal(every.transfer_matrix[:2], whole.transfer_matrix)
    assert every.transfer_matrix[2:, 1].abs().max() == 0
    around = at.FailedTransducers(every, [1])
    assert torch.equal(at.Problem.of(around).transfer_matrix, every.transfer_matrix)
    assert at.Problem.of(around).goal == every.over()
    assert at.Problem.of(at.Quantised(every, 4)).foci == 4
    drive = at.gabs(at.Noise(at.Quantised(every, 4), snr=40)).drive
    assert torch.equal(at.Quantised(every, 4).quantised(drive), drive)


@pytest.fixture(scope="module")
def behind_a_ball():
    array = at.TransducerArray.grid((3, 3), pitch=10e-3, center=(0, 0, 0), normal=(0, 0, 1))
    foci = at.circle_points(center=(0, 0, 80e-3), radius=15e-3, count=2, normal=(0, 0, 1))
    ball = at.Sphere(center=(0, 0, 40e-3), radius=8e-3, density=100.0, sound_speed=340.0)
    scene = at.Scene(array, at.Medium.air(), frequency=40e3, control_points=foci, obstacles=(ball,))
    return at.make_propagator(scene, "tmatrix")


def test_scenes_around_one_are_those_that_the_propagator_gives(behind_a_ball):
    settings = {"offset": 2e-3, "warming": 3.0, "gain": 0.1, "failed": 1, "seed": 3}
    every = at.Scenarios.around(behind_a_ball, 4, **settings)
    assert torch.allclose(every.objectives[0].transfer_matrix, behind_a_ball.transfer_matrix(), rtol=1e-9)
    for each in every.objectives[1:]:
        moved = each.scene.obstacles[0].center
        assert 0 < math.dist(moved, (0, 0, 40e-3)) <= 2e-3
        assert abs(each.scene.medium.temperature - 20) <= 3
    columns = every.transfer_matrix.reshape(4, 2, 9).abs().amax(dim=1)
    assert (columns == 0).sum(dim=1).tolist() == [0, 1, 1, 1]
    more = at.Scenarios.around(behind_a_ball, 6, **settings)
    assert torch.equal(more.transfer_matrix[:8], every.transfer_matrix)
    # a shift of the ball alone is the scene that make_propagator simulates
    shifted = at.Scenarios.around(behind_a_ball, 2, offset=2e-3).objectives[1]
    exact = at.make_propagator(shifted.scene, "tmatrix").transfer_matrix()
    assert torch.allclose(shifted.transfer_matrix, exact, rtol=1e-6)


def test_a_box_of_offsets_has_its_edges(behind_a_ball):
    every = at.Scenarios.around(behind_a_ball, 20, offset=(1e-3, 0, 4e-3))
    places = torch.tensor([each.scene.obstacles[0].center for each in every.objectives])
    away = (places - places[0]).abs().amax(dim=0)
    assert away[0] <= 1e-3
    assert away[1] < 1e-12
    assert 2e-3 < away[2] <= 4e-3


def test_targets_of_holography_are_those_of_each_scene(scenarios):
    every = scenarios()
    drive = at.holography(every, [1.0, 2.0])
    assert torch.equal(drive, at.holography(every, [1.0, 2.0] * 3))
    assert torch.equal(drive, at.holography(at.Quantised(every, 256), [1.0, 2.0]))
    assert not torch.equal(drive, at.holography(every))
    with pytest.raises(ValueError, match=r"targets: shape \(3,\); must be \(6,\)"):
        at.holography(every, [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count: 0"),
        ({"by": 1.0}, "by: 1.0; must be .*quantile"),
        ({"by": "best"}, "by: 'best'"),
        ({"offset": -1.0}, "offset: -1.0"),
        ({"offset": (1e-3, 1e-3)}, "offset: .*, or 3 of them"),
        ({"failed": 9}, "failed: 9; must be below"),
        ({"rotation": 0.1}, "turn_x.*sphere"),
        ({"offset": 1.0}, "scene 1 of the scenarios"),
    ],
)
def test_wrong_variants_are_named(behind_a_ball, arguments, message):
    with pytest.raises(ValueError, match=message):
        at.Scenarios.around(behind_a_ball, **{"count": 3, **arguments})


def test_scenes_that_do_not_fit_are_named(make_objective, random_matrix, scenarios):
    one, other = make_objective(random_matrix(2, 5, 0)), make_objective(random_matrix(3, 5, 0))
    with pytest.raises(ValueError, match=r"objectives\[1\]: numbers of .*must be \(5, 2\)"):
        at.Scenarios([one, other])
    with pytest.raises(ValueError, match=r"objectives: .*at least one"):
        at.Scenarios([])
    with pytest.raises(ValueError, match="must be of one scene"):
        at.Scenarios([scenarios()])
    readings = at.Readings(torch.ones(1, 5) + 0j, torch.ones(1, 2), points=one.scene.control_points)
    with pytest.raises(ValueError, match=r"points: .*a place is in all scenes"):
        at.run(at.Identify(20), scenarios(), readings=readings)
    assert dataclasses.replace(at.Problem.of(scenarios()), readings=None).foci == 6


def test_a_function_may_run_on_perturbed_scenarios(scenarios):
    perturbed = FailedTransducers(scenarios(), [1])
    solution = solve(partial(at.gabs, levels=4), perturbed, [0], 0, WEAKEST_FOCUS)
    assert solution.pressure.shape == (1, perturbed(solution.drive).shape[-1])
