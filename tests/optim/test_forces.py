"""Goals of force: forms of the drive, their bounds, and whether a trap exists."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.io.goal_section import goal_section, load_goal
from autdtorch.methods.attainable import search_above
from autdtorch.objectives.forces import DIRECTIONS, ForceGoal
from autdtorch.objectives.hermitian import ascended, forms_bound

BEAD = at.Particle.of("EPS", 0.5e-3)
MEDIUM = at.Medium(1.204, 343.0)  # spheres have closed forms in air without absorption
POINT = (0.001, 0.002, 0.03)


@pytest.fixture(scope="module")
def propagator():
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1), source_strength=1.0)
    return at.make_propagator(at.Scene(array, MEDIUM, 40e3, [(0, 0, 0.1)]), "free_space")


def drives(count, transducers, seed=0):
    generator = torch.Generator().manual_seed(seed)
    size, turn = torch.rand(2, count, transducers, generator=generator, dtype=torch.float64)
    return torch.polar(size.sqrt(), 2 * torch.pi * turn)


def exact(propagator, particle, points, drive):
    """The force (..., P, 3) on a sphere at points, by its T-matrix."""
    settings = {"density": particle.density, "sound_speed": particle.sound_speed}
    sphere, scene = at.Sphere((0, 0, 0), particle.radius, **settings), propagator.scene
    body = at.TMatrix.of(sphere, scene.medium, scene.frequency, error=1e-8).moved(points)
    return at.radiation_force(body, drive[..., None, :], array=scene.array, medium=scene.medium)


@pytest.mark.parametrize("radius", [0.2e-3, 1e-3])
def test_scores_are_those_of_the_force_on_a_sphere_and_its_slope(propagator, radius):
    bead = at.Particle.of("EPS", radius)
    goal, lift = at.Trap([POINT], particle=bead), at.Levitate([POINT], particle=bead)
    drive, step = drives(4, 16), 1e-5
    steps = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).double()
    forces = exact(propagator, bead, torch.tensor(POINT) + step * steps, drive)
    force, stiffness = forces[:, 0], (forces[:, 4:] - forces[:, 1:4]) / (2 * step)
    n = torch.tensor(DIRECTIONS, dtype=torch.float64)
    along, across = torch.einsum("di,...ij,dj->...d", n, stiffness, n), n[:, :2]
    expected = (along - (force @ n.mT).abs() / goal.displacement).amin(dim=-1)
    objective = at.ForceObjective(propagator, goal)
    error = (objective.goal(objective(drive)) - expected).abs() / expected.abs().mean()
    assert error.max() < 1e-4  # of differences, and of the degrees left out
    sideways = (force[:, :2] @ across.mT).abs() / lift.displacement
    expected = torch.minimum(force[:, 2], lift.reach * (along - sideways).amin(dim=-1)) / bead.weight
    objective = at.ForceObjective(propagator, lift)
    error = (objective.goal(objective(drive)) - expected).abs() / expected.abs().mean()
    assert error.max() < 1e-4


def test_methods_maximise_the_goal_of_the_objective(propagator):
    bead = at.Particle.of("EPS", 0.1e-3)
    objective = at.ForceObjective(propagator, at.Trap([POINT], particle=bead))
    climbed, searched = at.gradient_ascent(objective, starts=4), at.gabs(objective)
    bound = objective.goal.bound(objective.transfer_matrix)
    assert 0.7 * bound < climbed.score.item() <= bound
    assert searched.score.item() < climbed.score.item()
    held = at.gorkov(propagator, [POINT], climbed.drive[0], bead)
    assert held.principal_stiffness.min() > 0
    assert held.displacement.norm() < 1e-3  # `displacement` is along each direction, not along all
    for method in (at.identify, at.phase_stepping, at.lssg, at.holography):
        with pytest.raises(ValueError, match="take gradient_ascent, or gabs and bayes_opt"):
            method(objective)


def test_a_push_is_the_force_on_a_body_and_has_a_bound():
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1), source_strength=1.0)
    ball = at.Sphere((0.002, 0, 0.05), 6e-3, rigid=True)
    scene = at.Scene(array, at.Medium.air(), 40e3, [(0, 0, 0.1)], [ball])
    propagator = at.make_propagator(scene, "tmatrix")
    for direction in ((1, 0, 0), (0, 0, -1)):
        objective, drive = at.ForceObjective(propagator, at.Push(0, direction)), drives(5, 16)
        force = at.radiation_force(propagator, drive) @ torch.tensor(direction, dtype=torch.float64)
        assert torch.allclose(objective.goal(objective(drive)), force, rtol=1e-9, atol=1e-18)
        bound = objective.goal.bound(objective.transfer_matrix)
        assert 0.9 * bound < at.gradient_ascent(objective, starts=4).score.item() <= bound


@pytest.fixture(scope="module")
def pushed():
    array = at.TransducerArray.grid((3, 3), 10e-3, (0, 0, 0), (0, 0, 1), source_strength=1.0)
    ball = at.Sphere((0.002, 0, 0.05), 6e-3, rigid=True)
    scene = at.Scene(array, MEDIUM, 40e3, [(0, 0, 0.04), (0.01, 0, 0.045)], [ball])
    return at.ForceObjective(at.make_propagator(scene, "tmatrix"), at.Push(0, (1, 0, 0)))


def test_methods_push_by_the_readings_of_a_balance_alone(pushed):
    bound = pushed.goal.bound(pushed.transfer_matrix)
    sensor = at.ForceSensor(pushed, load=bound)
    exact, read = at.gabs(pushed, levels=8, seed=1), at.gabs(sensor, levels=8, seed=1)
    assert torch.equal(read.drive, exact.drive)
    assert read.score.item() == pytest.approx(exact.score.item(), rel=1e-9)
    assert sensor.evaluations == read.evaluations.item()
    assert load_goal("goal", goal_section(sensor.goal)) == pushed.goal.of
    noisy = at.ForceSensor(pushed, load=bound, noise=0.02 * bound, seed=3)
    several = {
        "gabs": at.gabs(noisy, passes=2),
        "lssg": at.lssg(noisy, levels=8),
        "bo": at.bayes_opt(at.Quantised(noisy, 32), evaluations=24, initial=20),
        "random": at.random_search(noisy, evaluations=50),
    }
    for name, solution in several.items():
        force = pushed.goal(pushed(solution.drive)).item()
        # the luckiest of some 300 readings
        assert abs(force - solution.score.item()) < 6 * 0.02 * bound, name
        assert force > (0.7 if name == "gabs" else 0.0) * bound, name
    for method in (at.identify, at.phase_stepping, at.gradient_ascent):
        with pytest.raises(ValueError, match="must"):
            method(sensor)


def test_a_balance_reads_the_force_with_its_load_and_noise_and_0_when_the_body_is_off(pushed):
    drive = drives(2000, 9)
    force = pushed.goal(pushed(drive))
    sigma, load = 0.02 * force.abs().max().item(), 0.2 * force.abs().max().item()
    sensor = at.ForceSensor(pushed, load=load, noise=sigma)
    reading = sensor(drive.reshape(2, 1000, 9)).reshape(-1)
    clear = force > 6 * sigma - load
    error = (sensor.goal(reading[:, None]) - force)[clear]
    # Six deviations of the mean and of the deviation of so many readings
    assert abs(error.mean().item()) < 6 * sigma / len(error) ** 0.5
    assert error.std().item() == pytest.approx(sigma, rel=6 / (2 * len(error)) ** 0.5)
    assert (force < -load - 6 * sigma).any()
    assert (reading[force < -load - 6 * sigma] == 0).all()


@given(
    seed=st.integers(0, 10**6),
    transducers=st.integers(1, 8),
    forms=st.integers(1, 6),
    rows=st.integers(1, 12),
)
def test_no_drive_exceeds_the_bound_on_forms(seed, transducers, forms, rows):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, transducers)) + 1j * rng.normal(size=(rows, transducers))
    weights = rng.normal(size=(forms, rows)) + rng.uniform(-1, 1)
    bound = forms_bound(matrix, weights)
    several = drives(200, transducers, seed).numpy()
    best = ascended(matrix, weights, several[:1])
    loud = several[0] / np.abs(several[0]).max()
    climbed, start = ((weights @ np.abs(matrix @ drive) ** 2).min() for drive in (best[0], loud))
    assert climbed >= start - 1e-12 * np.abs(weights @ np.abs(matrix @ loud) ** 2).max()  # rounding
    scores = (weights @ np.abs(matrix @ np.vstack([several, best]).T) ** 2).min(axis=0)
    assert np.abs(best).max() <= 1 + 1e-12
    assert max(scores.max(), 0) <= bound


def test_ascents_on_several_points_do_not_depend_on_the_order_of_rows_and_forms():
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(12, 5)) + 1j * rng.normal(size=(12, 5))
    weights = np.kron(np.eye(3), rng.normal(size=(2, 4)) + 0.5)
    rows, forms, start = rng.permutation(12), rng.permutation(6), drives(1, 5).numpy()
    scores = [
        (many @ np.abs(readings @ ascended(readings, many, start)[0]) ** 2).min()
        for readings, many in ((matrix, weights), (matrix[rows], weights[forms][:, rows]))
    ]
    assert scores[0] > 0
    assert scores[1] == pytest.approx(scores[0], rel=1e-3)  # ascents end within 1e-4 of a maximum


def test_a_single_form_of_the_least_size_is_bounded_from_both_sides():
    # |q_1 + q_2|^2 - |q_1 - q_2|^2 = 4 Re q_1 q_2^*, from -4 to 4
    rows, weights = np.array([[1, 1], [1, -1]], dtype=complex), np.array([[1.0, -1.0]])
    assert forms_bound(rows, weights) == pytest.approx(4, rel=1e-6)
    assert -forms_bound(rows, -weights) == pytest.approx(-4, rel=1e-6)


def test_whether_a_trap_exists_is_decided(propagator):
    exists = at.attainable(at.ForceObjective(propagator, at.Trap([POINT])))
    assert exists.answer is True
    two = at.TransducerArray([(-0.01, 0, 0), (0.01, 0, 0)], normals=(0, 0, 1), source_strength=1.0)
    scene = at.Scene(two, at.Medium.air(), 40e3, [(0, 0, 0.1)])
    none = at.attainable(at.ForceObjective(at.make_propagator(scene, "free_space"), at.Trap([POINT])))
    assert none.answer is False  # two plane waves hold nothing along y
    assert none.bound == 0
    assert none.score == 0  # silence scores more than any drive
    assert not none.drive.any()
    drop = at.Levitate([POINT], particle=at.Particle.of("water", 0.5e-3))
    heavy = at.attainable(at.ForceObjective(propagator, drop), 1.0)
    assert heavy.answer is False


@pytest.mark.parametrize("failed", [[0], [0, 1]])
def test_a_trap_of_failed_transducers_is_not_claimed(failed):
    """A trap between two transducers that face each other: one alone only pushes, none does nothing."""
    facing = at.TransducerArray([(0, 0, 0), (0, 0, 0.04)], [(0, 0, 1), (0, 0, -1)], source_strength=1.0)
    propagator = at.make_propagator(at.Scene(facing, MEDIUM, 40e3, [(0, 0, 0.03)]), "free_space")
    objective = at.ForceObjective(propagator, at.Trap([(0, 0, 0.02)]))
    assert at.attainable(objective).answer is True
    broken = at.FailedTransducers(objective, failed)
    found = at.attainable(broken)
    assert found.answer is not True
    assert found.score == pytest.approx(objective.goal(broken(found.drive)).item(), abs=1e-20)


def octahedron(mean):
    """Rows and weights of six forms: mean |q|^2 plus and minus each Pauli matrix.

    With the Stokes vector s of a drive, |s| = |q|^2, the least of them is mean |s| - max |s_i|.
    """
    rows = np.array([[1, 1], [1, -1], [1, 1j], [1, -1j], [2**0.5, 0], [0, 2**0.5]]) / 2**0.5
    pair, sign = np.kron(np.eye(3), np.ones((2, 2))), np.kron(np.eye(3), [[1, -1], [-1, 1]])
    return rows, mean * pair + sign


class Octahedron(ForceGoal):
    name, unit = "octahedron", "N"

    def forms(self, propagator):
        rows, weights = octahedron(0.5)
        return torch.from_numpy(rows), weights

    def check(self, scene):
        pass


def test_cells_of_drives_decide_what_the_relaxation_leaves_open():
    # max |s_i| >= |s| / 3^(1/2) = 0.577 |s|, but a mixture of drives has s = 0 with |q|^2 > 0
    rows, weights = octahedron(0.5)
    assert forms_bound(rows, weights) > 0.9
    assert search_above(rows, weights, 0.0) == (None, True)
    # with amplitudes 1 and 0.518, |s| = 1.268, and the least form is 1.268 (0.6 - 0.577) = 0.02873
    rows, weights = octahedron(0.6)
    drive, excluded = search_above(rows, weights, 0.0287)
    assert not excluded
    assert np.abs(drive).max() <= 1 + 1e-12
    assert (weights @ np.abs(rows @ drive) ** 2).min() > 0.0287
    assert search_above(rows, weights, 0.035) == (None, True)
    array = at.TransducerArray([(-0.01, 0, 0), (0.01, 0, 0)], normals=(0, 0, 1), source_strength=1.0)
    two = at.make_propagator(at.Scene(array, MEDIUM, 40e3, [(0, 0, 0.1)]), "free_space")
    none = at.attainable(at.ForceObjective(two, Octahedron()))
    assert none.answer is False
    assert none.score <= 0 == none.bound  # without sound the score is 0


def test_a_lifted_bead_stays_near_its_place(propagator):
    """The drive times l^(-1/2), with a lift of l weights, does what `Levitate` says of the score."""
    louder = replace(propagator.scene, array=replace(propagator.scene.array, source_strength=20.0))
    loud, lift = at.make_propagator(louder, "free_space"), at.Levitate([POINT])
    climbed = at.gradient_ascent(at.ForceObjective(loud, lift), starts=2)
    drive, score = climbed.drive[0], climbed.score.item()
    place = torch.tensor([POINT]).double()
    force = exact(loud, BEAD, place, drive)[0]
    slope = torch.autograd.functional.jacobian(lambda point: exact(loud, BEAD, point, drive)[0], place)[:, 0]
    up = force[2].item() / BEAD.weight
    assert up > 0.999 * score > 1
    force, stiffness = force / up, -(slope + slope.T) / 2 / up
    for angle in torch.linspace(0, torch.pi, 9).double():
        across = torch.stack([angle.cos(), angle.sin(), 0 * angle])
        assert (force @ across).abs() < 1.1 * lift.displacement * (across @ stiffness @ across)
    assert BEAD.weight / stiffness[2, 2] < 1.1 * lift.reach * up / score  # between `directions`
