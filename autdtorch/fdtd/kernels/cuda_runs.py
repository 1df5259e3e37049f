"""Tasks of programs on a GPU, in Triton, and where the field, the memory and the weights of a run are."""

# The arguments are values of Triton's compiler, which has no types for them.
# mypy: disable-error-code="assignment, no-untyped-def, untyped-decorator, var-annotated"

from __future__ import annotations

import triton
import triton.language as tl
from triton.language.extra.cuda import gdc_launch_dependents, gdc_wait

from autdtorch.fdtd.kernels.contract import Layer

# Places in the tensor of weights; scalars would be passed in single precision
CENTER, FACE, EDGE, CORNER, KEEP = (tl.constexpr(place) for place in range(5))


@triton.jit
def begin(EARLY: tl.constexpr):
    """Wait for the launch before, and let the next one come: where `EARLY`, its programs wait here too."""
    if EARLY:
        gdc_wait()
        gdc_launch_dependents()


@triton.jit
def task_of(runs):
    """Return the task of a program, and its run."""
    program = tl.program_id(0)
    return program // runs, tl.cast(program % runs, tl.int64)


@triton.jit
def field_of(p, shape, run):
    """Return the field of a run."""
    return p + run * (tl.cast(shape.nx, tl.int64) * shape.ny * shape.nz)


@triton.jit
def layer_of(layer, across, run, CELLS: tl.constexpr):
    """Return the memory of a run at the low and the high layer, or at columns, with cells `across` it."""
    return Layer(layer.psi + run * ((CELLS + 1) * across), layer.zeta + run * (CELLS * across))
