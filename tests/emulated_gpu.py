"""Tensors on a GPU or, without one, on the CPU in the guise of a GPU's, which refuse to be mixed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

HAS_GPU = torch.cuda.is_available()

needs_gpu = pytest.mark.skipif(not HAS_GPU, reason="needs an NVIDIA GPU: modules are not emulated")

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
OF_INDEX = ("index", "index_put", "index_put_", "_index_put_impl_")
ATTRIBUTES = {torch.Tensor.device: GPU, torch.Tensor.is_cuda: True, torch.Tensor.is_cpu: False}


@contextmanager
def gpu() -> Iterator[Callable[[torch.Tensor], torch.Tensor]]:
    """Yield a function that moves tensors to the GPU."""
    if HAS_GPU:
        yield torch.Tensor.cuda
        return
    parsed = torch._C._nn._parse_to

    def of_module(*args, **kwargs):  # what `Module.to` gets
        device, *others = parsed(*args, **kwargs)
        return GPU if any(map(_on_gpu, args)) else device, *others

    ready = patch("torch.cuda._lazy_init", lambda: None), patch("torch._C._nn._parse_to", of_module)
    no_triton = patch("autdtorch.fdtd.kernels.waves.find_spec", lambda name: None)
    with ready[0], ready[1], no_triton, Emulation():
        yield _Up.apply


class EmulatedTensor(torch.Tensor):
    """A tensor that holds another one, on which operations are done."""

    @staticmethod
    def __new__(cls, held):
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, held.shape, **layout)

    def __init__(self, held):
        self.held = held

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        return called(function, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return done(operation, args, kwargs or {})


class Emulation(TorchFunctionMode):
    """Takes tensors to the emulated GPU and back."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        return called(function, args, kwargs or {})


class _Up(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return EmulatedTensor(tensor.resolve_conj().clone())

    @staticmethod
    def backward(ctx, slope):
        return _held(slope)


class _Down(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor):
        return tensor.held.clone()

    @staticmethod
    def backward(ctx, slope):
        return EmulatedTensor(slope)


def _on_gpu(value: Any) -> bool:
    return isinstance(value, EmulatedTensor)


def _held(value: Any) -> Any:
    return value.held if _on_gpu(value) else value


def _moved(tensor: torch.Tensor, device: Any) -> torch.Tensor:
    to_gpu = torch.device(device).type == "cuda"
    if to_gpu == _on_gpu(tensor):
        return tensor
    return _Up.apply(tensor) if to_gpu else _Down.apply(tensor)


def called(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Call a function of PyTorch, the parts of which that ask for a GPU's driver are done here."""
    kind, first = torch.Tensor, args[0] if args else None
    if _on_gpu(first):
        if getattr(function, "__self__", None) in ATTRIBUTES:
            return ATTRIBUTES[function.__self__]
        if function in (kind.numpy, kind.__array__) and not kwargs.get("force"):
            raise TypeError("can't convert a tensor on cuda:0 to numpy")
        if function is kind.as_subclass:
            return first
        if function in (kind.conj, torch.conj):  # a lazy one would be done nowhere
            return first.conj_physical()
        if getattr(function, "__self__", None) is kind.mH:
            return first.mT.conj_physical()
        if function in (kind.tolist, kind.numpy, kind.__repr__):
            return function(first.held.detach(), *args[1:], **kwargs)
    if function in (kind.cpu, kind.cuda):
        return _moved(first, function.__name__)
    if function is kind.to:
        wanted = [*args[1:], *kwargs.values()]
        others = [part for part in wanted if isinstance(part, kind)]
        devices = [part.device for part in others] + [p for p in wanted if isinstance(p, str | torch.device)]
        types = [part.dtype for part in others] + [p for p in wanted if isinstance(p, torch.dtype)]
        tensor = _moved(first, devices[0]) if devices else first
        return tensor.type(types[0]) if types else tensor
    of_gpu = kwargs.get("device") is not None and torch.device(kwargs["device"]).type == "cuda"
    if of_gpu or (function is kind.new_tensor and _on_gpu(first)):
        args, kwargs = tree_map(_held, args), kwargs | ({"device": CPU} if of_gpu else {})
        with torch._C.DisableTorchFunctionSubclass():
            return tree_map(lambda made: _Up.apply(made), function(*args, **kwargs))
    with torch._C.DisableTorchFunctionSubclass():
        return function(*args, **kwargs)


def done(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Do an operation on tensors of the emulated GPU; a `RuntimeError` if others have any dimension."""
    name = operation.overloadpacket.__name__
    tensors = [each for each in tree_leaves((args, kwargs)) if isinstance(each, torch.Tensor)]
    if name in OF_INDEX:  # indices may be on the CPU
        tensors = [each for each in tensors if _on_gpu(each) or not _on_gpu(args[0])]
        tensors += [each for each in args[2:3] if isinstance(each, torch.Tensor)]
    if name != "copy_" and any(each.ndim and not _on_gpu(each) for each in tensors):
        raise RuntimeError(f"{name}: tensors on cuda:0 and cpu")
    result = operation(*tree_map(_held, args), **tree_map(_held, kwargs))
    if operation._schema.is_mutable:
        return kwargs.get("out", args[0])
    return tree_map(lambda part: EmulatedTensor(part) if isinstance(part, torch.Tensor) else part, result)
