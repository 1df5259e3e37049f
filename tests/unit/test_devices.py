"""Tensors on a GPU, or in the guise of a GPU's, are accepted everywhere; results are on it, and equal."""

import inspect
import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from emulated_gpu import HAS_GPU, gpu, needs_gpu
from public_calls import Call, public_calls
from public_values import AIR_ALONE, BALL, DRIVE, MATRIX, SCENE, limited_link, propagator

import autdtorch as at
from autdtorch.fdtd.kernels import waves
from autdtorch.methods.bayes.gaussian_process import Hyperparameters, Processes
from autdtorch.propagators import free_space
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.utils.apertures import Discs, centers_of
from autdtorch.utils.validation import real_tensor

TENSORS = {"drive", "drives", "G", "points", "positions", "pressure", "X"}
"""Parameters that are tensors, wherever a tensor is accepted."""

RESULTS_ON_CPU = {
    "PoseBall.certificate",
    "SimulatedPropagator.compared",
    "equilibrium",
    "haptic_metrics",
    "modulated",
}
"""Calls whose results are kept, as scenes are, on the CPU."""

ROOMS = tuple(f"autdtorch.{room}." for room in ("analytic", "methods", "objectives", "propagators", "scene"))

CALLS = {
    name: call
    for name, call in public_calls().items()
    if TENSORS & call.parameters.keys()
    and call.function.__module__.startswith(ROOMS)
    and not inspect.isclass(call.function)
    and not name.endswith((".tell", "of_rows", ".air"))
}

pytestmark = pytest.mark.filterwarnings("ignore::autdtorch.SteadyStateWarning")  # of coarse, short runs

POINTS = torch.tensor([[22e-3, 7e-3, 14e-3], [20e-3, 16e-3, 12e-3]], dtype=torch.float64)


def tensors_of(result):
    """The tensors that a result is or has."""
    if isinstance(result, torch.Tensor):
        return [result]
    parts = vars(result).values() if hasattr(result, "__dict__") else result
    return [part for part in parts if isinstance(part, torch.Tensor)] if np.iterable(parts) else []


def is_array(value):
    return isinstance(value, torch.Tensor) or (
        isinstance(value, list) and np.asarray(value).dtype.kind == "f"
    )


def require_equal(results, expected):
    assert len(results) == len(expected)
    for result, value in zip(results, expected, strict=True):
        assert result.dtype == value.dtype
        # rounding in double precision, and of fields that a GPU steps in single precision
        size = 0.0 if value.dtype == torch.bool else float(value.nan_to_num().abs().sum())
        torch.testing.assert_close(result.cpu(), value, rtol=1e-4, atol=1e-6 * size, equal_nan=True)


@pytest.mark.parametrize("name", sorted(CALLS))
def test_a_result_is_on_the_device_of_the_tensors(name, tmp_path):
    call: Call = CALLS[name]
    others = {"array": None, "medium": None} if name.startswith("radiation_") else {}  # of a propagator
    if name == "drive_sequence":
        others["G"] = MATRIX.expand(2, -1, -1)
    arguments = call.arguments(tmp_path, **others)
    expected = tensors_of(call.bound(tmp_path)(**arguments))
    with gpu() as to_gpu:
        moved = {
            key: to_gpu(real_tensor(key, value) if isinstance(value, list) else value)
            if key in TENSORS and is_array(value)
            else value
            for key, value in arguments.items()
        }
        results = tensors_of(call.bound(tmp_path)(**moved))
        if name not in RESULTS_ON_CPU:
            assert all(result.is_cuda for result in results)
        require_equal(results, expected)


@pytest.mark.parametrize("method", ["free_space", "tmatrix", "box"])
def test_a_field_is_on_the_device_of_the_drive(method):
    scene = {"free_space": AIR_ALONE, "tmatrix": BALL, "box": SCENE}[method]
    settings = {"spacing": 2e-3, "tolerance": 0.5, "max_periods": 6} if method == "box" else {}
    made = propagator(scene, method, **settings)
    expected = made.field(DRIVE, POINTS)
    with gpu() as to_gpu:
        for drive, points in itertools.product((DRIVE, to_gpu(DRIVE)), (POINTS, to_gpu(POINTS))):
            field = made.field(drive, points)
            assert field.device == drive.device
            require_equal([field], [expected])
            assert made.transfer_matrix(points).device == points.device


def test_gradients_pass_to_tensors_on_the_device():
    made = propagator(BALL, "tmatrix")

    def slopes(drive, points):
        drive, points = drive.clone().requires_grad_(), points.clone().requires_grad_()
        total = made.field(0.9 * drive, points).abs().sum() + made.transfer_matrix(points).abs().sum()
        return torch.autograd.grad(total, (drive, points))

    expected = slopes(DRIVE, POINTS)
    with gpu() as to_gpu:
        results = slopes(to_gpu(DRIVE), to_gpu(POINTS))
        assert all(result.is_cuda for result in results)
        require_equal(results, expected)


@pytest.mark.parametrize(
    "method", [at.GABS(), at.LSSG(), at.GradientAscent(), at.Holography(), at.PhaseStepping()]
)
def test_methods_take_a_matrix_a_start_and_readings_on_the_device(method):
    def solution(matrix, start):
        objective = at.SimulatedObjective.of_matrix(AIR_ALONE, matrix)
        state = method.start(at.Problem.of(objective, start=start))
        return at.run(method, objective, start=start), method.tell(state, objective(method.ask(state)))

    expected, _ = solution(MATRIX, DRIVE)
    with gpu() as to_gpu:
        result, state = solution(to_gpu(MATRIX), to_gpu(DRIVE))
        readings = at.Readings(to_gpu(DRIVE)[None], to_gpu(MATRIX.abs()[None, :, 0]))
        method.tell(state, to_gpu(readings.pressure), drives=to_gpu(readings.drives))
    require_equal([result.drive, result.pressure], [expected.drive, expected.pressure])


def test_poses_and_the_bench_take_tensors_of_the_device():
    bodies = propagator(BALL, "tmatrix").bodies
    offsets = torch.tensor([[1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0]], dtype=torch.float64)
    expected = bodies.moved(offsets).transfer_matrix(BALL.array, POINTS)
    with gpu() as to_gpu:
        matrices = bodies.moved(to_gpu(offsets)).transfer_matrix(BALL.array, to_gpu(POINTS))
        assert matrices.is_cuda
        require_equal([matrices], [expected])
        limited_link().play(to_gpu(DRIVE))
        assert torch.equal(limited_link().quantised(to_gpu(DRIVE)), limited_link().quantised(DRIVE))


@pytest.mark.parametrize("wavenumber", [733.0, complex(733.0, 5.0)])
@pytest.mark.parametrize("kinds", ["points", "discs as sources", "discs as points"])
def test_sums_of_waves_are_those_of_the_cpu(kinds, wavenumber, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    targets = 0.1 * torch.rand((90, 3), generator=generator, dtype=torch.float64)
    centers, normals = targets[30:70].roll(1, dims=1), torch.nn.functional.normalize(targets[:40] - 0.03)
    discs = Discs(centers, normals, torch.tensor([4.5e-3, 2e-3], dtype=torch.float64).repeat(20))
    pair = {
        "points": (targets, centers),
        "discs as sources": (targets, discs),
        "discs as points": (discs, targets),
    }[kinds]
    amplitude = torch.randn((len(centers_of(pair[1])), 3), generator=generator, dtype=torch.complex128)
    expected = waves.superposition(*pair, amplitude, wavenumber)
    single = waves.superposition(*pair, amplitude, wavenumber, torch.float32)
    monkeypatch.setattr(waves, "WORTH_A_GPU", 1)
    monkeypatch.setattr(waves, "AT_ONCE", 1000)
    with gpu():
        field = waves.superposition(*pair, amplitude, wavenumber, device="cuda")
    # series end at most 1e-8 apart, see test_kernels.py; in single precision, waves are within 3e-7
    assert (field - expected).norm() < 1e-7 * expected.norm()
    assert (field - single).norm() < 1e-5 * expected.norm()


@pytest.mark.parametrize(("method", "radius"), [("free_space", 4e-3), ("box", 0.0)])
def test_pictures_summed_on_the_gpu_are_those_of_the_cpu(method, radius, monkeypatch, accepted):
    scene = replace(
        SCENE, array=replace(SCENE.array, radius=radius), reflectors=[at.Reflector((40e-3, 0, 0), (-1, 0, 0))]
    )
    made = at.make_propagator(scene, method, 2e-3, 0.5, max_periods=6, device="cpu")
    plane = torch.cartesian_prod(*(torch.linspace(-20e-3, 50e-3, n, dtype=torch.float64) for n in (7, 3, 5)))[
        None
    ]
    expected = made.field(torch.stack([DRIVE, 0.5j * DRIVE]), plane)
    for module in (waves, free_space):
        monkeypatch.setattr(module, "WORTH_A_GPU", 1)
    if method == "free_space":
        summed = free_space.FreeSpacePropagator(scene, "cuda")
    else:
        summed = SimulatedPropagator(replace(made.plan, kernel="reference"))
        for box in summed.simulation.boxes:
            object.__setattr__(box, "device", "cuda")
    with gpu():
        field = summed.field(torch.stack([DRIVE, 0.5j * DRIVE]), plane)
    assert (field - expected).norm() < 1e-5 * expected.norm()


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("algorithm", ["naive", "gs", "wgs", "gs_pat", "diff_pat"])
def test_holograms_are_those_of_the_kernel_for_cpus(algorithm, free):
    matrix = torch.randn(3, 4, 16, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    settings = {"algorithm": algorithm, "iterations": 30, "free_amplitudes": free, "starts": 2}
    expected = at.holography(matrix, **settings)
    with gpu() as to_gpu:
        result = at.holography(to_gpu(matrix), **settings)
        assert result.is_cuda
        # rounding of double precision, through 30 iterations
        torch.testing.assert_close(result.cpu(), expected, rtol=0, atol=1e-7)


@pytest.fixture
def accepted(monkeypatch):
    """The setting ``device="cuda"``, accepted without a GPU."""
    if not HAS_GPU:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)


@pytest.mark.usefixtures("accepted")
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"evaluations": 7, "initial": 5}, marks=needs_gpu),
        pytest.param(
            {"evaluations": 7, "initial": 5, "kernel": "circle", "acquisition": "log_ei"}, marks=needs_gpu
        ),
        {"evaluations": 13, "initial": 11, "model": "foci", "kernel": "phasor", "noise": "inferred"},
        {"evaluations": 2, "model": "foci", "kernel": "phasor", "prior": at.Prior(gain=0.1, phase=0.5)},
    ],
)
def test_bayesian_optimisation_on_the_device_begins_as_on_the_cpu(settings):
    objective = at.SimulatedObjective.of_matrix(AIR_ALONE, MATRIX)
    expected = at.bayes_opt(objective, trials=2, **settings)
    with gpu():
        result = at.bayes_opt(objective, trials=2, device="cuda", **settings)
    # two points by the acquisition, whose climbs amplify rounding
    torch.testing.assert_close(result.history, expected.history, rtol=1e-4, atol=0)
    assert result.drive.device == torch.device("cpu")


@pytest.mark.usefixtures("accepted")
@pytest.mark.parametrize(
    "kernel", [pytest.param("phases", marks=needs_gpu), pytest.param("circle", marks=needs_gpu), "phasor"]
)
def test_the_processes_on_the_device_are_those_of_the_cpu(kernel):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand((2, 9, 3), generator=generator, dtype=torch.float64)
    values = 1 + torch.rand((2, 9, 2), generator=generator, dtype=torch.float64)
    if kernel != "phasor":
        values = values[..., :1]
    shape = values.shape[::2]
    fit = Hyperparameters(0.3 * torch.ones(shape).double(), 1e-3 * torch.ones(shape).double())
    before = Processes(kernel, points, values, fit).at(points.flip(1) + 0.01)
    with gpu() as to_gpu:
        on_gpu = Processes(kernel, to_gpu(points), to_gpu(values), fit.to("cuda"))
        after = on_gpu.at(to_gpu(points.flip(1) + 0.01))
        assert on_gpu.model.train_targets.is_cuda
        for one, other in zip(after, before, strict=True):
            assert one.is_cuda
            torch.testing.assert_close(one.cpu(), other, rtol=1e-7, atol=1e-9)
