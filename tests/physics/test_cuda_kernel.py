"""The CUDA kernel against the reference kernel: on a GPU, or interpreted by Triton on the CPU."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_scenes import CUBE, all_tensors, relative_error, small_scene

pytest.importorskip("triton", reason="the CUDA kernel needs Triton: install autdtorch[cuda]")

from triton.runtime import interpreter

from autdtorch.fdtd.kernels.contract import Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.kernels.cuda import BlockSizes, CudaKernel
from autdtorch.fdtd.kernels.reference import ReferenceKernel
from autdtorch.fdtd.stepping import assemble
from autdtorch.propagators import differentiable_field, make_propagator
from autdtorch.propagators.plan import plan, region_of
from autdtorch.scene.drive import drive_from_phases
from autdtorch.scene.obstacles import Box, Sphere
from autdtorch.scene.reflectors import Reflector

needs_gpu = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="needs an NVIDIA GPU: torch.cuda.is_available() is false"
)

RUNS = 2
SIZE = 9e-3
"""Edge of the domain [m], 9 cells; the layers make it 23 to 28."""

HEAVY = Box((3.4e-3, 4.5e-3, 4.5e-3), (1.8e-3, 4e-3, 3e-3), density=100.0, sound_speed=340.0)
RIGID = Box((3.4e-3, 4.5e-3, 4.5e-3), (2.2e-3, 5e-3, 4e-3), rigid=True)
WALL = Box((4.5e-3, 4.5e-3, 7.3e-3), (30e-3, 30e-3, 1.2e-3), density=5.0, sound_speed=300.0)
"""Continues through the absorbing layers of x and y."""

WHOLE = BlockSizes(x=32, y=32, z=32, lanes=1024)
"""One program a task: interpreted, a program takes the same time however large it is."""

BLOCKS = None if torch.cuda.is_available() else WHOLE


def parts(obstacles, dtype, absorption=0.0, lossy=False):
    """Coefficients of a scene; sources of two runs and receivers all over the grid, in special cells too."""
    assembly = assemble(region_of(small_scene(obstacles, SIZE, absorption)), 1e-3, dtype)
    c, shape = assembly.coefficients, assembly.grid.shape
    generator = torch.Generator().manual_seed(1)
    if lossy:
        index = c.heterogeneous_index[::3]
        weight = torch.rand((len(index), 27), generator=generator).to(dtype)
        c = replace(c, loss_index=index, loss_weight=weight, loss_ground=weight[:, 0])
    inner = torch.zeros(shape, dtype=torch.bool)
    inner[1:-1, 1:-1, 1:-1] = True
    somewhere = torch.nonzero(inner.reshape(-1)).reshape(-1)[::97]
    special = c.heterogeneous_index, c.sound_hard_index, c.columns.index[:, 1:-1]
    index = torch.unique(torch.cat((somewhere, *(each.reshape(-1)[::5] for each in special))))
    index = index[torch.randperm(len(index), generator=generator)]
    force = torch.randn((RUNS, len(index), 3), dtype=torch.float64, generator=generator)
    weight = torch.rand((len(index) // 2, 2), dtype=torch.float64, generator=generator).to(dtype)
    receivers = Receivers(index[: 2 * len(weight)].reshape(-1, 2), weight)
    return shape, c, Sources(index, force.to(dtype)), receivers


def noise(shape, c, runs):
    """Noise in all cells exercises every part of a step."""
    state = uniform_state(shape, c, 0.0, runs)
    generator = torch.Generator().manual_seed(0)
    for field in (state.now, state.before):
        core = field[:, 1:-1, 1:-1, 1:-1]
        core.copy_(torch.randn(core.shape, generator=generator, dtype=torch.float64))
    return state


def advance(kernel, case, blocks):
    """Step from noise in calls of several steps each."""
    shape, coefficients, sources, receivers = case
    state, recorded = noise(shape, coefficients, len(sources.force)), []
    signal = torch.randn((sum(blocks), 3), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for part in signal.to(coefficients.layer_decay.dtype).split(blocks):
        state, record = kernel.advance(state, coefficients, sources, receivers, part)
        recorded.append(record)
    return state, torch.cat(recorded, dim=1)


def assert_same(one, other, tolerance):
    """Fields, all memory and what was recorded, relative to the peak of each."""
    for value, reference in zip(all_tensors(*one), all_tensors(*other), strict=True):
        assert value.shape == reference.shape
        if reference.numel():
            assert (value.cpu() - reference).abs().max() <= tolerance * reference.abs().max()


# float64: rounding of sums of 27 terms; float32: the design's parity figure, 1e-4 of the peak, of which
# rounding takes a hundredth
def test_losses_in_two_calls_are_those_of_the_reference_kernel():
    case = parts((HEAVY, WALL), torch.float64, 40.0, lossy=True)
    c = case[1]
    assert len(c.heterogeneous_index) > len(c.loss_index) > 0 == len(c.sound_hard_index)
    assert len(c.columns.index) > 0 < len(c.crossed.index)
    expected = advance(ReferenceKernel(), case, (2,))
    assert_same(advance(CudaKernel(BLOCKS), case, (1, 1)), expected, 1e-12)


def test_programs_run_in_any_order(monkeypatch):
    """Interpreted, they run one after the other: here the last one first."""
    builder = interpreter.InterpreterBuilder
    place = builder.set_grid_idx
    monkeypatch.setattr(
        builder, "set_grid_idx", lambda self, x, y, z: place(self, self.grid_dim[0] - 1 - x, y, z)
    )
    shape, c, sources, receivers = parts((RIGID, WALL), torch.float32)
    assert len(c.sound_hard_index) > 0
    case = shape, c, sources.chosen(slice(1)), receivers
    expected = advance(ReferenceKernel(), case, (1,))
    halves = BlockSizes(x=16, y=16, z=16, rows=4, lanes=512)  # of each axis
    assert_same(advance(CudaKernel(halves), case, (1,)), expected, 1e-6)


def test_a_returned_state_of_air_stays_while_another_is_stepped():
    shape, c, sources, receivers = parts((), torch.float64)
    assert not len(c.heterogeneous_index)
    case = shape, c, sources.chosen(slice(1)), receivers
    kernel, expected = CudaKernel(BLOCKS), advance(ReferenceKernel(), case, (1,))
    returned = advance(kernel, case, (1,))
    advance(kernel, case, (1,))
    assert_same(returned, expected, 1e-12)


@pytest.mark.parametrize(("reserved", "allocated"), [(0, 0), (3 * 2**28, 0), (2**29, 2**27)])
def test_runs_together_do_not_depend_on_memory_that_pytorch_keeps(reserved, allocated, monkeypatch):
    """As after runs before: PyTorch does not return to the driver what it has freed."""
    kernel = CudaKernel()
    kernel.device = torch.device("cuda")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (2**30 - reserved + allocated, 2**31))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda: reserved)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda: allocated)
    # in double precision, two fields and their records fit half of the memory
    runs = kernel.together((60, 60, 60), 20_000)
    assert runs == 7
    assert 2 * runs * 60**3 * torch.float64.itemsize < 2**29


def small_propagator(**options):
    return make_propagator(small_scene((HEAVY,), SIZE), "full", **options)


@pytest.mark.parametrize("name", ["device", "kernel"])
def test_a_missing_gpu_or_triton_is_named(name, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for version, why in (("12.8", "it finds no GPU or driver"), (None, "it is built for the CPU")):
        monkeypatch.setattr(torch.version, "cuda", version)
        monkeypatch.setattr("triton.knobs.runtime.interpret", False)
        with pytest.raises(ValueError, match=f"{name}: 'cuda'; needs an NVIDIA GPU .*{why}.*the CPU gives"):
            small_propagator(**{name: "cuda"})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(ValueError, match=rf"{name}: 'cuda'; needs Triton: pip install .*\[cuda\]"):
        small_propagator(**{name: "cuda"})


@pytest.mark.parametrize("device", ["cuda", "cuda:0", torch.device("cuda")], ids=str)
def test_a_device_chooses_its_kernel(device, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    scene = small_scene((HEAVY,), SIZE)
    assert plan(scene, device=device).kernel == "cuda"
    assert plan(scene, device=device, kernel="cuda").kernel == "cuda"
    assert plan(scene, device="cpu").kernel == "cpu"
    assert plan(scene, device=torch.device("cpu"), kernel="reference").kernel == "reference"
    for options, message in (
        ({"device": device, "kernel": "cpu"}, "device: 'cuda.*'; must fit kernel 'cpu'"),
        ({"device": "cpu", "kernel": "cuda"}, "device: 'cpu'; must fit kernel 'cuda'"),
        ({"device": "cuda:1"}, "device: 'cuda:1'; must be the current one, cuda:0"),
        ({"device": "mps"}, "device: 'mps'; must be 'cpu', 'cuda' or a torch.device"),
        ({"device": "gpu"}, "device: 'gpu'; must be 'cpu', 'cuda' or a torch.device"),
    ):
        with pytest.raises(ValueError, match=message):
            plan(scene, **options)


@pytest.mark.processes
def test_every_launch_compiles_for_a_gpu(tmp_path):
    """The interpreter accepts more than the compiler."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    run = subprocess.run(
        [sys.executable, Path(__file__).parents[2] / "scripts" / "check.py", "cuda"],
        env=environment | {"TRITON_CACHE_DIR": str(tmp_path)}, check=True, capture_output=True, text=True,
    )  # fmt: skip
    rows = [line.split("|")[1:-1] for line in run.stdout.splitlines()[2:]]
    stack = {row[0].strip(): int(row[-1]) for row in rows}
    assert stack.pop("_write_waves") < 100  # of sine and cosine in double precision
    assert stack == dict.fromkeys(("prepare", "sweep", "settle", "read_last"), 0)  # nothing spilled


@needs_gpu
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_captured_steps_are_those_of_the_cpu_kernel(dtype, tolerance, monkeypatch):
    """Odd blocks, so that graphs are captured for both fields in turn; the design's parity figures."""
    monkeypatch.setattr("autdtorch.fdtd.kernels.cuda._LAUNCHED", 53)
    case = parts((RIGID, WALL), dtype, 40.0)
    expected = advance(CpuKernel(), case, 4 * (53,))
    assert_same(advance(CudaKernel(), case, 4 * (53,)), expected, tolerance)


FLOOR = Reflector((0.0, 0.0, -3e-3), (0.0, 0.0, 1.0))
LOSSY = Sphere((11e-3, 12e-3, 12e-3), 4e-3, density=20 + 1j, sound_speed=300 - 20j)
LINED = Box((14e-3, 13e-3, 11e-3), (5e-3, 6e-3, 4e-3), impedance=2 - 1j, rotation=(0.2, 0.3, 0.1))
SCENES = {
    "fluid": small_scene((CUBE,)),
    "lossy": small_scene((LOSSY,), absorption=40.0),
    "impedance": small_scene((LINED,)),
    "reflector": replace(small_scene((CUBE,)), reflectors=[FLOOR]),
}


# rounding in float32, of all of a run
@needs_gpu
@pytest.mark.parametrize("method", ["full", "box"])
@pytest.mark.parametrize("name", SCENES)
def test_pressures_are_those_of_the_cpu_kernel(name, method):
    scene, drive = SCENES[name], drive_from_phases([0.0, 1.0, 2.0, 3.0])
    on_gpu, on_cpu = (make_propagator(scene, method, 2e-3, device=device) for device in ("cuda", "cpu"))
    assert relative_error(on_gpu.transfer_matrix(), on_cpu.transfer_matrix()) < 1e-4
    points = scene.control_points + 1e-3
    by_gpu = on_gpu.field(drive.cuda(), points)
    assert relative_error(by_gpu.cpu(), on_cpu.field(drive, points)) < 1e-4


@needs_gpu
@pytest.mark.filterwarnings("ignore::autdtorch.SteadyStateWarning")
def test_gradients_are_those_of_the_cpu_kernel():
    scene, drive = small_scene((CUBE,)), drive_from_phases([0.0, 1.0, 2.0, 3.0])

    def slopes(device):
        leaf, density = drive.clone().requires_grad_(), torch.tensor([20.0], requires_grad=True)
        field = differentiable_field(scene, leaf, spacing=2e-3, periods=6, density=density, device=device)
        return torch.autograd.grad(field.abs().sum(), (leaf, density))

    for by_gpu, by_cpu in zip(slopes("cuda"), slopes("cpu"), strict=True):
        assert relative_error(by_gpu.cpu(), by_cpu) < 1e-4
