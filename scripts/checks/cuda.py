"""Compilation of the CUDA kernel without a GPU, and the resources of its launches.

Nothing runs: Triton compiles each launch for a scene that exercises all code of a step. The registers of a
thread limit the threads of a multiprocessor, which has 65536 registers; spilled registers go to the stack.
Takes some 10 seconds.
"""

import re
import subprocess
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
import triton
from shared.document import table
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

from autdtorch.fdtd.kernels.cuda import Cells, DeviceMedium, DeviceRun, blocks_of
from autdtorch.fdtd.kernels.cuda_waves import waves_on_gpu
from autdtorch.fdtd.stepping import assemble, drive_signal
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box
from autdtorch.scene.scene import Medium, Scene
from autdtorch.utils.apertures import Discs

CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


OPTIONS = {
    "--capability": {"type": int, "default": 90, "help": "of the GPU, times ten; 90 is Hopper"},
    "--dtype": {"choices": ("float32", "float64"), "default": "float32", "help": "of the fields"},
}


def main(capability: int, dtype: str) -> None:
    rows = []
    for name, kernel in compiled(capability, getattr(torch, dtype)).items():
        rows.append([name, str(32 * kernel.metadata.num_warps), *map(str, usage(kernel))])
    print(table(["launch", "threads of a program", "registers", "stack [byte]"], rows))


def compiled(capability: int, dtype: torch.dtype) -> dict[str, Any]:
    """Return the compiled launches of a step, and of waves, by name."""
    wall = Box((12e-3, 12e-3, 20e-3), (40e-3, 40e-3, 2e-3), density=5.0, sound_speed=300.0)
    solid = Box((12e-3, 12e-3, 10e-3), (5e-3, 6e-3, 7e-3), rigid=True)
    array = TransducerArray.grid((2, 2), pitch=8e-3, center=(1.2e-3, 12e-3, 12e-3))
    points, domain = [(22e-3, 8e-3, 14e-3)], ((0,) * 3, (24e-3,) * 3)
    scene = Scene(array, Medium(1.2, 340.0), 40e3, points, (wall, solid), domain=domain)
    assembly = assemble(region_of(scene), 1e-3, dtype)
    sources = assembly.sources(array.positions, torch.ones(4, dtype=torch.complex128))
    receivers = assembly.receivers(scene.control_points)
    signal = drive_signal(assembly.steps_per_period, 0, 2).to(dtype)
    launches = {}

    def compile_only(self: Any, *args: Any, grid: Any, warmup: bool, **options: Any) -> None:
        launches[self.fn.__name__] = launch(self, *args, grid=grid, warmup=True, **options)

    launch = JITFunction.run
    absent_gpu = SimpleNamespace(
        get_current_target=lambda: GPUTarget("cuda", capability, 32),
        get_current_device=lambda: 0,
        get_current_stream=lambda device: 0,
    )
    driver.set_active(absent_gpu)
    discs = Discs(array.positions, array.normals, torch.full((4,), 4e-3, dtype=torch.float64))
    with patch.object(JITFunction, "run", compile_only):
        waves_on_gpu(scene.control_points, discs, complex(740.0, 1.0))
        shape = Cells(*assembly.grid.shape)
        medium = DeviceMedium(assembly.coefficients, shape, 1, blocks_of(shape, 1), torch.device("cpu"))
        DeviceRun(medium, assembly.silence(sources), sources, receivers, len(signal)).advance(signal)
    return launches


def usage(kernel: Any) -> tuple[int, int]:
    """Return registers and bytes of stack of a thread."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        text = subprocess.run(
            [CUOBJDUMP, "--dump-resource-usage", file.name], check=True, capture_output=True, text=True
        ).stdout
    registers, stack = (int(re.search(rf"{name}:(\d+)", text)[1]) for name in ("REG", "STACK"))
    return registers, stack
