"""Compiled kernels, cold or warm, and PyTorch's global settings change no result."""

import ast
import contextlib
import gc
import importlib.util
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numba
import numpy as np
import pytest
import torch
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch.fdtd.kernels import cpu, cpu_steps, cpu_waves
from autdtorch.utils import compiled
from autdtorch.utils.process import one_library_thread, spread


def test_any_change_of_the_kernels_changes_the_digest(tmp_path):
    (tmp_path / "one.py").write_text("a = 1\n", "utf-8")
    (tmp_path / "two.py").write_text("b = 2\n", "utf-8")
    before = compiled._digest.__wrapped__(tmp_path)
    times = (tmp_path / "two.py").stat()
    (tmp_path / "two.py").write_text("b = 3\n", "utf-8")
    # wheels of two versions have the same times
    os.utime(tmp_path / "two.py", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert compiled._digest.__wrapped__(tmp_path) != before


SOURCE = """
from pathlib import Path
from autdtorch.utils.compiled import entry

@entry(Path(__file__).parent / "others")
def doubled(x):
    return 2 * x

@entry()
def tripled(x):
    return 3 * x

@entry()
def halved(x):
    return x / 2
"""


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Return a function that makes the kernel as a new process does, and the folder of its files."""
    (tmp_path / "module.py").write_text(SOURCE, "utf-8")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def made(name="doubled"):
        spec = importlib.util.spec_from_file_location("module", tmp_path / "module.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "module", module)
        spec.loader.exec_module(module)
        return getattr(module, name)

    return made, tmp_path / "cache"


def hits(dispatcher):
    return sum(dispatcher.stats.cache_hits.values())


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_what_is_damaged_is_compiled_again(kernel, suffix, caplog):
    made, folder = kernel
    made()(3)
    (path,) = folder.rglob(f"*{suffix}")
    whole, random = path.read_bytes(), np.random.default_rng(0)
    damages = [b"", whole[: len(whole) // 2], whole[:-1]]
    for place in random.integers(0, len(whole), 8).tolist():
        damages.append(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
    for damaged in damages:
        path.write_bytes(damaged)
        caplog.clear()
        again = made()
        assert again(3) == 6
        assert hits(again) == 0
        assert "compiling again" in caplog.text
        after = made()
        assert after(3) == 6
        assert hits(after) == 1


def test_kernels_of_other_folders_are_compiled_again_after_a_change_of_those_they_call(kernel, tmp_path):
    made, _ = kernel
    made()(3)
    same = made()
    assert (same(3), hits(same)) == (6, 1)
    (tmp_path / "others").mkdir()
    (tmp_path / "others" / "intrinsics.py").write_text("a = 1\n", "utf-8")
    compiled._digest.cache_clear()
    changed = made()
    assert (changed(3), hits(changed)) == (6, 0)


def test_processes_that_compile_two_dtypes_at_once_write_two_files(kernel, monkeypatch):
    made, folder = kernel
    with monkeypatch.context() as patch:
        patch.setattr(compiled._CheckedFiles, "_load_index", lambda self: {})  # neither sees the other's
        assert (made()(3), made()(1.5)) == (6, 3.0)
    assert len(list(folder.rglob("*.nbc"))) == 2
    assert made()(1.5) == 3.0
    assert made()(3) == 6


needs_fork = pytest.mark.skipif(sys.platform != "linux", reason="compiles in one process")


@needs_fork
def test_another_process_compiles_what_is_needed_next(kernel):
    made, _ = kernel
    ahead, then = made("tripled"), made("halved")
    calls = lambda: spread(ahead, (3, 3)), lambda: then(4)
    # a second thread there would wait for numba's lock, which the first holds
    with threads(2), one_library_thread(), compiled.meanwhile(ahead, *calls):
        assert made()(3) == 6
    assert len(then.signatures) == 1
    assert ahead(3) == 9
    assert (hits(ahead), hits(then)) == (1, 0)
    assert gc.isenabled()
    with threads(2), compiled.meanwhile(ahead, lambda: ahead(3)):
        made()(3)  # loaded from disk
    assert not compiled._children


@needs_fork
def test_a_kernel_is_compiled_by_one_other_process(kernel, tmp_path):
    made, _ = kernel
    ahead, go, begun = made("tripled"), tmp_path / "go", tmp_path / "begun"

    def compile_later():
        with begun.open("a", encoding="utf-8") as file:
            file.write("once\n")
        end = time.monotonic() + 60
        while not go.exists() and time.monotonic() < end:
            time.sleep(0.01)
        ahead(3)

    for name in ("doubled", "halved"):
        with threads(2), compiled.meanwhile(ahead, compile_later):
            made(name)(3)
    go.touch()
    assert ahead(3) == 9
    assert hits(ahead) == 1
    assert begun.read_text("utf-8") == "once\n"


@needs_fork
def test_what_no_other_process_can_compile_is_compiled_here(kernel, monkeypatch):
    made, _ = kernel
    forks = mock.Mock(side_effect=BlockingIOError("Resource temporarily unavailable"))
    monkeypatch.setattr(os, "fork", forks)
    first, ahead, then = made(), made("tripled"), mock.Mock()
    with threads(2), compiled.meanwhile(first, lambda: None, then), compiled.meanwhile(ahead, then, then):
        assert first(3) == 6
    forks.assert_called_once()  # for the one that is not compiled here
    assert not then.called
    assert not compiled._ahead


def test_kernels_are_compiled_ahead_for_the_types_of_a_simulation(monkeypatch):
    calls = []

    def noted(kernel, *some):
        assert kernel is cpu_steps.advance
        calls.extend(some)
        return contextlib.nullcontext()

    monkeypatch.setattr(cpu, "meanwhile", noted)
    at.make_propagator(small_scene((CUBE,)), "box", 2e-3, cache=False).transfer_matrix()
    kernels = cpu_steps.advance, cpu_waves._sum_at_points, cpu_waves._sum_over_sources
    before = [set(kernel.signatures) for kernel in kernels]
    for call in calls:
        call()
    assert calls
    assert [set(kernel.signatures) for kernel in kernels] == before


@needs_fork
def test_a_process_that_hangs_is_not_waited_for(kernel, monkeypatch):
    made, _ = kernel
    monkeypatch.setattr(compiled, "thread_count", lambda: 2)
    monkeypatch.setattr(compiled, "_PATIENCE", 0.1)
    with compiled.meanwhile(made("tripled"), lambda: time.sleep(600)):
        made()(3)
    begin = time.monotonic()
    assert made("tripled")(3) == 9
    assert time.monotonic() - begin < 60


@needs_fork
def test_a_process_that_works_is_waited_for_however_slow_it_is(kernel, monkeypatch, tmp_path, caplog):
    caplog.set_level("INFO", compiled.__name__)
    made, _ = kernel
    monkeypatch.setattr(compiled, "thread_count", lambda: 2)
    monkeypatch.setattr(compiled, "_PATIENCE", 0.01)
    monkeypatch.setattr(compiled, "_processor_seconds", lambda child: time.monotonic())
    go, ended = tmp_path / "go", tmp_path / "ended"

    def wait():
        end = time.monotonic() + 60
        while not go.exists() and time.monotonic() < end:
            time.sleep(0.01)
        time.sleep(0.3)
        ended.touch()

    with compiled.meanwhile(made("tripled"), wait):
        made()(3)
    assert made("halved")(3) == 1.5
    assert not ended.exists()  # other kernels do not wait for it
    caplog.clear()
    go.touch()
    made("tripled")(3)
    assert ended.exists()
    assert caplog.messages[0] == "compiling tripled (once per machine)"  # a user waits, and sees for what


@needs_fork
def test_processor_time_is_that_of_a_process():
    before = time.process_time()
    assert before <= compiled._processor_seconds(os.getpid()) <= time.process_time()


def test_without_a_folder_to_write_to_kernels_run_and_say_so_once(kernel, monkeypatch, caplog):
    def refusing(cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**options)

    made, folder = kernel
    compiled._log_once.cache_clear()
    monkeypatch.setattr(compiled, "njit", refusing)
    monkeypatch.setattr(compiled, "_fork", None)  # is not called: another process could save nothing
    with threads(2), compiled.meanwhile(made("tripled"), lambda: None):
        assert made()(3) == made()(3) == 6
    assert caplog.text.count("compiled in every process") == 1
    assert not os.path.exists(folder)


PACKAGE = Path(at.__file__).parent


@contextlib.contextmanager
def setting(name: str, value: object) -> Iterator[None]:
    """One of PyTorch's settings that has a function to get it and one to set it."""
    before = getattr(torch, f"get_{name}")()
    getattr(torch, f"set_{name}")(value)
    try:
        yield
    finally:
        getattr(torch, f"set_{name}")(before)


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    processors = mock.patch("autdtorch.utils.process._processors", return_value=count)
    with setting("num_threads", count), processors:
        yield


def other_settings() -> list[contextlib.AbstractContextManager[object]]:
    """Several of PyTorch's settings at once, as each run takes seconds."""
    return [
        setting("default_dtype", torch.float16),
        setting("float32_matmul_precision", "medium"),
        torch.device("meta"),
        torch.inference_mode(),
        threads(3),
    ]


def numbers(folder: Path) -> dict[str, torch.Tensor]:
    """Return the numbers of a study, from the scene to files and metrics."""
    values: dict[str, torch.Tensor] = {}
    ball = at.Sphere((12e-3, 20e-3, 5e-3), 3e-3, density=0.2, sound_speed=900.0)
    scene = small_scene((CUBE, ball), radius=1e-3, absorption=2.0)
    propagators = {}
    for method in ("box", "full", "free_space"):
        propagators[method] = propagator = at.make_propagator(scene, method, 2e-3, 0.1, cache=False)
        values[method] = propagator.transfer_matrix()
        drive = at.drive_from_phases(torch.arange(4, dtype=torch.float64, device="cpu"))
        values[f"{method} field"] = propagator.field(drive, scene.control_points + 1e-4)
    _, error = propagators["box"].transfer_matrix(return_error=True)
    values["error"] = torch.tensor(error, dtype=torch.float64, device="cpu")
    objective = at.SimulatedObjective(scene, propagators["box"])
    noisy = at.Noise(at.Quantised(at.Drift(at.FailedTransducers(objective, [1]), 0.1, 5), 16), 30.0)
    for name, solution in {
        "lss": at.lss(objective),
        "lssg": at.lssg(objective, passes=2),
        "gabs": at.gabs(objective, order="strength", trials=3),
        "random": at.random_search(objective, levels=7, trials=2),
        "bo": at.bayes_opt(objective, 17, trials=2, fixed_transducer=0),
        "identify": at.identify(objective, 12, trials=2),
        "gradient": at.gradient_ascent(objective, starts=3, steps=20),
        "noisy": at.gabs(noisy, trials=2),
    }.items():
        values |= {f"{name} {key}": getattr(solution, key) for key in ("drive", "pressure", "history")}
    metrics = at.focus_metrics(
        values["gabs pressure"][0], values["gabs pressure"][:1].repeat(7, 1), cell_area=1e-6 / 3
    )
    assert metrics.area is not None
    values |= {"mean": metrics.mean, "uniformity": metrics.uniformity, "area": metrics.area}
    values["bound"] = torch.tensor(at.focus_bound(values["box"]), dtype=torch.float64, device="cpu")
    at.save_drive(folder / "drive.csv", values["gabs drive"][0], scene.array)
    values["saved"] = at.load_drive(folder / "drive.csv")
    values["gradient of the drive"] = at.differentiable_field(scene, drive, spacing=2e-3)
    values["volume"] = at.volume_field(propagators["free_space"], drive).nan_to_num()
    return values


def test_no_bit_changes(tmp_path: Path) -> None:
    expected = numbers(tmp_path)
    with contextlib.ExitStack() as settings:
        for one in other_settings():
            settings.enter_context(one)
        computed = numbers(tmp_path)
    for name, value in expected.items():
        assert computed[name].device.type == "cpu", name
        assert computed[name].dtype == value.dtype, name
        assert torch.equal(computed[name].detach(), value.detach()), name


def test_what_inference_mode_has_made_serves_gradients_later() -> None:
    with torch.inference_mode():
        scene = small_scene((CUBE,))
        propagator = at.make_propagator(scene, "box", 2e-3, cache=False)
        propagator.transfer_matrix()
    drive = torch.ones(4, dtype=torch.complex128, requires_grad=True)
    propagator.field(drive, scene.control_points).abs().sum().backward()
    assert drive.grad is not None
    assert drive.grad.abs().sum() > 0


BOTH = {"REAL", "COMPLEX"}
MAKERS = {"arange", "as_tensor", "empty", "eye", "full", "linspace"}
MAKERS |= {"ones", "rand", "randn", "tensor", "zeros"}


def test_every_tensor_is_made_with_its_dtype_and_device() -> None:
    count = 0
    for path in PACKAGE.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match call:
                case ast.Call(func=ast.Attribute(value=ast.Name("torch"), attr=name)) if name in MAKERS:
                    keywords = {keyword.arg for keyword in call.keywords}
                    if {ast.unparse(each.value) for each in call.keywords if each.arg is None} & BOTH:
                        keywords |= {"device", "dtype"}
                    # integers have one dtype, and what is there keeps its own
                    required = {"device"} if name in ("arange", "as_tensor") else {"device", "dtype"}
                    assert required <= keywords, f"{path}:{call.lineno}: {ast.unparse(call)}"
                    count += 1
    assert count > 100
