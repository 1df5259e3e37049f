"""LSSG, GABS and random search against plain loops; runs that start at a drive that was good before."""

import cmath
import math

import pytest
import torch

import autdtorch as at
from autdtorch.methods.functions import gabs, lss, lssg, random_search
from autdtorch.methods.seeds import trial_seed
from autdtorch.objectives.objective import weakest_focus
from autdtorch.scene.drive import drive_from_phases, focus_phases, normalise


def focus_drives(scene):
    return drive_from_phases(focus_phases(scene.array.positions, scene.control_points, scene.wavenumber))


def test_single_focus_in_free_space_gets_all_there_is(make_objective):
    scene = make_objective(torch.ones(1, 5, dtype=torch.complex128)).scene
    phases = focus_phases(scene.array.positions, scene.control_points, scene.wavenumber)
    solution = lssg(make_objective(drive_from_phases(-phases)))
    # Five terms of magnitude 1, all in phase.
    assert solution.pressure.item() == pytest.approx(5, rel=1e-12)


def test_drive_is_a_normalised_sum_of_focus_drives_with_offsets_on_the_grid(make_objective, random_matrix):
    levels = 8
    objective = make_objective(random_matrix(3, 6, 1))
    solution = lssg(objective, levels)
    drives = focus_drives(objective.scene)
    weights = torch.linalg.lstsq(drives.T, solution.drive[0]).solution
    offsets = torch.angle(weights / weights[0]) * levels / (2 * math.pi)
    # Six equations for three weights, solved to rounding.
    torch.testing.assert_close(normalise(weights @ drives), solution.drive[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(offsets, offsets.round(), rtol=0, atol=1e-9)
    assert solution.amplitudes.max().item() == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_never_worse_than_the_plain_sum_of_focus_drives(make_objective, random_matrix, seed):
    objective = make_objective(random_matrix(4, 6, seed))
    plain = lss(objective)
    assert torch.equal(plain.drive, normalise(focus_drives(objective.scene).sum(dim=0))[None])
    # The start is among the drives tried, up to the rounding of its sum.
    assert lssg(objective).score >= plain.score * (1 - 1e-12)


def turned(weights, focus, levels):
    """The weights with each offset of one focus (levels, P)."""
    moved = weights.repeat(levels, 1)
    moved[:, focus] = weights[focus] * drive_from_phases(2 * math.pi * torch.arange(levels).double() / levels)
    return moved


def test_further_passes_end_where_no_single_offset_can_improve(make_objective, random_matrix):
    levels = 6
    objective = make_objective(random_matrix(4, 6, 3))
    solution = lssg(objective, levels, passes=40)
    count = int(solution.evaluations)
    assert count == objective.evaluations < 40 * 4 * levels
    assert solution.history.shape == (1, 40 * 4 * levels)
    assert (solution.history[0, count - 1 :] == solution.score).all()
    assert torch.equal(solution.history[:, : 4 * levels], lssg(objective, levels).history)
    drives = focus_drives(objective.scene)
    weights = torch.linalg.lstsq(drives.T, solution.drive[0]).solution
    for focus in range(4):
        scores = weakest_focus(objective(normalise(turned(weights, focus, levels) @ drives)))
        assert (scores <= solution.score * (1 + 1e-9)).all()  # six equations for four weights, to rounding


def test_order_of_the_foci_is_the_one_asked_for(make_objective, random_matrix):
    levels = 4
    objective = make_objective(random_matrix(3, 6, 1))
    solution = lssg(objective, levels, order=[2, 0, 1])
    drives = focus_drives(objective.scene)
    weights = torch.ones(3, dtype=torch.complex128)
    seen = []
    for focus in (2, 0, 1):
        tried = turned(weights, focus, levels)
        scores = weakest_focus(objective(normalise(tried @ drives)))
        weights = tried[scores.argmax()]
        seen.append(scores.max().item())
    assert solution.history[0, levels - 1 :: levels].tolist() == pytest.approx(seen, rel=1e-12)
    assert not torch.equal(solution.history, lssg(objective, levels).history)


def weakest(matrix, drive):
    rows = matrix.tolist()
    return min(abs(sum(g * q for g, q in zip(row, drive, strict=True))) for row in rows)


def greedy_search(matrix, order, levels):
    """Algorithm 2 in plain Python: the final drive, and the best weakest focus seen on the way."""
    drive = [0j] * matrix.shape[1]
    drive[order[0]] = 1 + 0j
    seen = [weakest(matrix, drive)]
    for transducer in order[1:]:
        tried = []
        for level in range(levels):
            drive[transducer] = cmath.exp(-2j * math.pi * level / levels)
            tried.append((weakest(matrix, drive), drive[transducer]))
        best = max(tried, key=lambda pair: pair[0])
        drive[transducer] = best[1]
        seen.append(best[0])
    return drive, seen


def random_order(matrix, seed):
    return torch.randperm(4, generator=torch.Generator().manual_seed(trial_seed(seed, 0))).tolist()


def strongest_first(matrix, seed):
    return matrix.abs().amin(dim=0).argsort(descending=True).tolist()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, random_order),
        ({"order": "strength"}, strongest_first),
        ({"order": "given"}, [0, 1, 2, 3]),
        ({"order": "given", "first": 2}, [2, 0, 1, 3]),
        ({"order": [3, 1, 0, 2]}, [3, 1, 0, 2]),
        ({"order": (3, 1, 0, 2), "first": 0}, [0, 3, 1, 2]),
    ],
)
def test_same_as_a_plain_loop_in_every_order(make_objective, random_matrix, options, expected, seed):
    matrix = random_matrix(2, 4, seed)
    solution = gabs(make_objective(matrix), levels=5, seed=seed, **options)
    drive, seen = greedy_search(matrix, expected(matrix, seed) if callable(expected) else expected, levels=5)
    alone = 4 if expected is strongest_first else 1  # evaluations of single transducers
    assert solution.evaluations.tolist() == [alone + 3 * 5]
    # The best so far after each transducer, which tells the orders apart.
    best = [max(seen[: count + 1]) for count in range(4)]
    assert solution.history[0, alone - 1 :: 5].tolist() == pytest.approx(best, rel=1e-12)
    if seen[-1] == max(seen):
        expected_drive = torch.tensor([drive], dtype=torch.complex128)
        torch.testing.assert_close(solution.drive, expected_drive, rtol=0, atol=1e-12)


def test_first_transducer_leads_every_random_order(make_objective, random_matrix):
    matrix = random_matrix(1, 6, 9)
    solution = gabs(make_objective(matrix), levels=4, first=3, trials=5)
    torch.testing.assert_close(solution.history[:, 0], matrix[0, 3].abs().expand(5), rtol=1e-14, atol=0)
    assert torch.equal(solution.drive[:, 3], torch.ones(5, dtype=torch.complex128))
    assert len({tuple(row.tolist()) for row in solution.history}) > 1
    levels = solution.phases * 4 / (2 * math.pi)
    torch.testing.assert_close(levels, levels.round(), rtol=0, atol=1e-12)
    on = solution.amplitudes  # each transducer is on or off, up to the rounding of its cosine and sine
    torch.testing.assert_close(on, on.round(), rtol=1e-15, atol=0)


def test_a_trial_ends_where_no_single_transducer_can_improve(make_objective, random_matrix):
    matrix, levels = random_matrix(3, 5, 4), 6
    objective = make_objective(matrix)
    solution = gabs(objective, levels=levels, passes=30, trials=6)
    assert (solution.evaluations < 1 + 4 * levels + 29 * 5 * levels).all()
    assert len(set(solution.evaluations.tolist())) > 1  # they end for themselves
    assert objective.evaluations == solution.evaluations.sum()
    assert solution.history.shape == (6, 1 + 4 * levels + 29 * 5 * levels)
    for trial in range(6):
        end = int(solution.evaluations[trial])
        assert (solution.history[trial, end - 1 :] == solution.score[trial]).all()
        drive = solution.drive[trial].tolist()
        for transducer in range(5):
            for level in range(levels):
                moved = drive.copy()
                moved[transducer] = cmath.exp(-2j * math.pi * level / levels)
                assert weakest(matrix, moved) <= solution.score[trial].item() * (1 + 1e-12)


def test_further_passes_start_where_one_pass_ends(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 6, 2))
    one, three = (gabs(objective, levels=8, passes=passes, trials=10) for passes in (1, 3))
    assert torch.equal(three.history[:, : one.history.shape[1]], one.history)
    assert (three.score >= one.score).all()
    assert (three.score > one.score).any()


@pytest.mark.parametrize("levels", [3, 16])
def test_single_point_gets_all_but_what_the_levels_cost(make_objective, random_matrix, levels):
    matrix = random_matrix(1, 8, 3)
    score = gabs(make_objective(matrix), levels=levels, trials=5).score
    # The best level turns each transducer to within pi / levels of the sum so far: it adds at least its
    # projection.
    assert (score >= math.cos(math.pi / levels) * matrix.abs().sum()).all()
    assert (score <= matrix.abs().sum() * (1 + 1e-12)).all()


@pytest.mark.parametrize(("passes", "evaluations"), [(1, 1), (4, 1 + 16)])
def test_one_transducer_alone_needs_one_evaluation(make_objective, random_matrix, passes, evaluations):
    solution = gabs(make_objective(random_matrix(2, 1, 0)), passes=passes)
    assert solution.evaluations.tolist() == [evaluations]  # the second pass changes nothing
    assert solution.drive.tolist() == [[1 + 0j]]


def test_paper_ranking_in_empty_air(paper_objective):
    # Fig. 3(a): the mean of GABS over 50 trials is above LSSG.
    solution = gabs(paper_objective, levels=16, trials=50)
    baseline = lssg(paper_objective, levels=16)
    assert solution.score.mean() > baseline.score
    assert baseline.evaluations.tolist() == [64]  # the paper's
    assert len(set(solution.score.tolist())) > 10  # the orders differ, and so do the results


@pytest.mark.parametrize("options", [{}, {"order": "strength"}, {"passes": 3}])
def test_near_ties_do_not_hang_on_the_last_digit(make_objective, paper_objective, options):
    """Empty air and array are symmetric: without a rule most of these drives differ."""
    matrix = paper_objective.transfer_matrix
    expected = gabs(paper_objective, trials=10, **options)
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(matrix.shape, dtype=torch.complex128, generator=generator)
        # the size of what another instruction set makes of a simulation in float32
        solution = gabs(make_objective(matrix * (1 + 1e-7 * noise)), trials=10, **options)
        torch.testing.assert_close(solution.drive, expected.drive, rtol=0, atol=1e-12)
        assert torch.equal(solution.score, solution.history[:, -1])


def test_random_searches_have_uniform_phases_and_begin_with_shorter_ones(make_objective, random_matrix):
    objective = make_objective(random_matrix(3, 5, 0))
    long, short = (random_search(objective, evaluations=count, trials=3) for count in (200, 64))
    assert torch.equal(long.history[:, :64], short.history)
    objective = make_objective(random_matrix(2, 4, 0))
    best = random_search(objective, evaluations=8, trials=400).score
    phases = 2 * math.pi * torch.rand(400, 8, 4, generator=torch.Generator().manual_seed(5)).double()
    scores = weakest_focus(objective(drive_from_phases(phases).flatten(0, 1))).reshape(400, 8)
    expected = scores.amax(dim=1)
    error = math.sqrt((best.var() + expected.var()).item() / 400)
    assert abs(best.mean() - expected.mean()).item() < 4 * error


@pytest.mark.parametrize("levels", [2, 5])
def test_phases_are_on_the_levels_and_all_of_them_occur(make_objective, random_matrix, levels):
    objective = make_objective(random_matrix(2, 4, 0))
    solution = random_search(objective, evaluations=3, levels=levels, trials=50)
    steps = solution.phases * levels / (2 * math.pi)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-12)
    assert set(steps.round().flatten().tolist()) == set(range(levels))
    torch.testing.assert_close(solution.amplitudes, torch.ones(50, 4).double(), rtol=1e-15, atol=0)


PHASES = torch.arange(5).double()
DRIVE = torch.polar(torch.ones(5).double(), PHASES)
WARM = [
    at.GABS(levels=8),
    at.GABS(levels=8, order="strength", passes=2),
    at.BayesOpt(evaluations=9, initial=5, fixed_transducer=1),
    at.GradientAscent(starts=1, steps=40),
]


@pytest.fixture
def objectives(make_objective, random_matrix):
    """A matrix that changes a little from one pose to the next."""
    first, other = random_matrix(3, 5, 0), random_matrix(3, 5, 1)
    return [make_objective(first + 0.03 * step * other) for step in range(3)]


@pytest.mark.parametrize("method", WARM, ids=repr)
def test_the_drive_to_start_from_is_not_lost(objectives, method):
    """The solution is at least as good, up to the grid of 8 phases: |1 - e^(i pi / 8)| = 0.39 at most."""
    objective = objectives[0]
    good = at.gradient_ascent(objective, seed=3)
    cold = float(good.score[0])
    solution = at.run(method, objective, start=good.drive[0])
    assert float(solution.score[0]) >= (0.6 if isinstance(method, at.GABS) else 0.999) * cold


def test_gabs_goes_through_all_transducers_from_the_drive(objectives):
    drive = torch.polar(torch.ones(5).double(), -2 * torch.pi * torch.tensor([0, 3, 1, 2, 0]).double() / 4)
    method = at.GABS(levels=4, order="given")
    state = method.start(at.Problem.of(objectives[0], start=drive))
    torch.testing.assert_close(method.ask(state), drive[None])
    solution = at.run(method, objectives[0], start=drive)
    assert int(solution.evaluations[0]) == 1 + 5 * 4
    assert float(solution.history[0, 0]) == pytest.approx(float(objectives[0](drive).amin()))


def test_a_sequence_starts_each_pose_at_the_drives_of_the_one_before(objectives):
    method = at.GABS(levels=8)
    poses = at.run(method, objectives, trials=3, seed=1)
    assert [len(solution.score) for solution in poses] == [3, 3, 3]
    first = at.run(method, objectives[0], trials=3, seed=1)
    second = at.run(method, objectives[1], trials=3, seed=1, start=first.drive)
    for solution, alone in zip(poses, (first, second), strict=False):
        assert torch.equal(solution.drive, alone.drive)
        assert torch.equal(solution.history, alone.history)


def test_starts_that_do_not_fit_are_named(objectives):
    with pytest.raises(ValueError, match=r"start: 2 drives; must be one for each of 3 trials"):
        at.run(WARM[0], objectives[0], trials=3, start=DRIVE.expand(2, 5))
    with pytest.raises(ValueError, match=r"start: shape \(1, 2, 5\); must be \(5,\) or \(T, 5\)"):
        at.run(WARM[0], objectives[0], start=DRIVE.expand(1, 2, 5))
    with pytest.raises(ValueError, match=r"start: shape \(4,\)"):
        at.run(WARM[0], objectives[0], start=DRIVE[:4])
    with pytest.raises(ValueError, match=r"objective\[1\]: objective: 'x'; must be"):
        at.run(WARM[0], [objectives[0], "x"])
    with pytest.raises(ValueError, match=r"state_file: .* must be None for a sequence"):
        at.run(WARM[0], objectives, state_file="state.npz")
