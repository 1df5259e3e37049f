"""Benches of the command line: devices and sensors, ours and one's own, with the settings that reach them."""

import contextlib
import json
import math
import re
from dataclasses import dataclass, replace
from unittest import mock

import pytest
import torch
import yaml

from autdtorch.cli.configured_bench import Bench
from autdtorch.cli.main import CONFIGS
from autdtorch.hardware import (
    DEVICES,
    SENSORS,
    Device,
    LinkError,
    MovedMicrophone,
    Oscilloscope,
    Quantity,
    ScopeSensor,
)
from autdtorch.hardware.sensors.sensor import SensorConfig
from autdtorch.io.drive_file import load_drive
from autdtorch.io.readings_file import load_readings
from autdtorch.io.scene_file import load_scene
from autdtorch.scene.drive import PhaseLevels
from autdtorch.utils.validation import integer_at_least

EMULATED = ("hardware=emulated", "hardware.limits.amplitude=1")


def write_board(folder, name, gain=1.0):
    path = folder / f"{name}.pat"
    positions = "\n".join(f"({0.0105 * (n % 16)}, {0.0105 * (n // 16)}, 0)" for n in range(256))
    rest = "\n".join(" ".join(map(str, column)) for column in (range(255, -1, -1), [0] * 256, [gain] * 256))
    path.write_text(f"{name}\n256\n128\n{positions}\n{rest}\n")
    return str(path)


@pytest.mark.parametrize("device", ["autd3", "openmpd"])
def test_devices_of_boards_find_the_drive_of_the_simulation(trial, tmp_path, device):
    if device == "autd3":
        pytest.importorskip("autd3", reason="the kit of AUTD3: install autdtorch[autd3]")
    files = ",".join(write_board(tmp_path, name) for name in ("left", "right"))
    boards = "2" if device == "autd3" else f"[{files}]"
    words = (f"hardware.device={device}", f"hardware.boards={boards}", "hardware.transducers='251-259'")
    assert trial(*EMULATED, "method.levels=4", *words)[0] == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert "transducers driven as in the simulated trial, up to a phase common to all: 9 of 9" in report
    assert report.count("| 1.000 |\n") == 3
    if device == "openmpd":  # another file of the same name is another board
        write_board(tmp_path, "left", gain=0.5)
        status, _, log = trial(*EMULATED, "method.levels=4", *words)
        assert (status, "of another trial, whose boards is ['left " in log) == (2, True)


@pytest.mark.parametrize(
    ("bench", "message"),
    [
        ("device: openmpd\n", "hardware: no emulated, transducers, "),
        ("defaults: [base, _self_]\nsensor: {kind: scope}\n", "hardware.sensor: no chip, maker, "),
    ],
)
def test_a_bench_with_keys_left_out_is_refused_by_their_names(trial, write, bench, message):
    write("ours/hardware/mine.yaml", f"{bench}limits: {{amplitude: 1}}\n")
    status, _, log = trial("hardware=mine", "++hardware.device=ultraino")
    assert (status, message in log) == (2, True)


def test_a_bench_of_ones_own_is_a_config(trial, write, tmp_path):
    bench = "device: openmpd\nemulated: true\nfailed: [4]  # it fell\nlimits: {amplitude: 0.5}\n"
    write("ours/hardware/mine.yaml", f"defaults: [base, sensor: emulated, _self_]\n{bench}")
    status, _, log = trial("hardware=mine", "method=lssg")
    assert (status, "failed transducers, counted from 0: 4" in log) == (0, True)
    assert "hardware=mine" in (tmp_path / "out/report.md").read_text()


class Row(Device):
    """A device with a key `phases` in its config; a frame is a phase level a byte, 255 for off."""

    keys = ("phases",)
    port_keys = ("line",)

    def configured(self, section):
        phases = integer_at_least("hardware.phases", section.get("phases"), 2)
        return replace(self, phase_levels=PhaseLevels(phases, amplitudes=1))

    def open_port(self, place, backend=None):
        raise LinkError(f"nothing at {place['line']}")

    @property
    def settings(self):
        return {"phases": self.phase_levels.phases}

    def pack(self, phase, on):
        return bytes(torch.where(on > 0, phase, 255).tolist())

    def firmware(self, transducers):
        return RowFirmware(self.phase_levels.phases)


class RowFirmware:
    baud = None

    def __init__(self, phases):
        self.phases, self.levels = phases, [255] * 9

    def receive(self, data):
        self.levels = list(data)

    def drive(self):
        levels = torch.tensor(self.levels, dtype=torch.float64)
        return torch.polar((levels < 255).double(), 2 * torch.pi * levels / self.phases)


@dataclass(frozen=True)
class DeafConfig(SensorConfig):
    """The config of a sensor that reads a fraction of the pressure on an emulated bench."""

    fraction: float

    @property
    def settings(self):
        return {"fraction": self.fraction}

    @contextlib.contextmanager
    def open(self, setup):
        yield mock.Mock(["read"], read=lambda: self.fraction * setup.bench.pressure().abs())


class Balance:
    """A force that is the square of the pressure on an emulated bench."""

    quantity = Quantity("force", "mN")

    def __init__(self, bench):
        self.bench = bench

    def read(self):
        return self.bench.pressure().abs().square()


@dataclass(frozen=True)
class BalanceConfig(SensorConfig):
    """The config of a `Balance`."""

    @contextlib.contextmanager
    def open(self, setup):
        yield Balance(setup.bench)


def test_readings_of_another_quantity_have_its_name_and_unit_and_are_not_compared(
    trial, write, tmp_path, monkeypatch
):
    monkeypatch.setitem(SENSORS, "balance", BalanceConfig)
    bench = "device: sonicsurface\nlimits: {amplitude: 1}\nsensor: {kind: balance}\n"
    write("ours/hardware/mine.yaml", f"defaults: [base, _self_]\n{bench}")
    words = ("hardware=mine", "hardware.emulated=true")
    status, out, _ = trial(*words, "method.levels=4")
    assert (status, "force " in out, " mN, measured once more" in out) == (0, True, True)
    folder = tmp_path / "out"
    report, trial_log = (folder / "report.md").read_text(), folder / "trial.jsonl"
    assert "- force: **" in report
    assert "| control point [mm] | when found [mN] | again [mN] |" in report
    assert "simulated pressures" not in report
    assert "failed transducers: not tested" in report
    assert " Pa" not in report.split("## Settings")[0]
    assert json.loads(trial_log.read_text().splitlines()[0])["origin"]["quantity"] == "force [mN]"
    with pytest.raises(ValueError, match=r"readings of force \[mN\]; must be pressures"):
        load_readings(trial_log)
    for setting, message in [
        ("method=identify", "goal: 'force'; must be of pressures at control points"),
        ("method=gs", "goal: 'force'; must be of pressures at control points"),
        ("method=gradient", "must have a transfer matrix, .* take gabs or bayes_opt"),
        ("goal=mean_pressure", "goal: 'mean_pressure'; must be weakest_focus with a sensor of force"),
    ]:
        status, _, log = trial(*words, setting, folder="output=other")
        assert status == 2
        assert re.search(message, log), log
        assert "a first reading" not in log


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("hardware.sensor.quantity=force", "hardware.sensor.unit=null"),
            "hardware.sensor.quantity: unit: None; a name",
        ),
        (("hardware.sensor.unit=mN",), "quantity: unit: 'mN'; must be Pa for the quantity pressure"),
    ],
)
def test_a_quantity_without_a_unit_of_it_is_refused(trial, words, message):
    status, _, log = trial(*EMULATED, "hardware/sensor=manual", *words)
    assert (status, message in log) == (2, True), log


def test_a_device_and_a_sensor_are_one_entry_each(trial, write, tmp_path, monkeypatch):
    monkeypatch.setitem(DEVICES, "row", Row("Row", 9, PhaseLevels(8, amplitudes=1), ("phase", "on")))
    monkeypatch.setitem(SENSORS, "deaf", DeafConfig)
    bench = "device: row\nphases: 12\nlimits: {amplitude: 1}\nsensor: {kind: deaf, fraction: 0.25}\n"
    write("ours/hardware/mine.yaml", f"defaults: [base, _self_]\n{bench}")
    assert trial("hardware=mine", "hardware.emulated=true", "method.levels=4")[0] == 0
    report = (tmp_path / "out" / "report.md").read_text()
    assert "transducers driven as in the simulated trial, up to a phase common to all: 9 of 9" in report
    origin = json.loads((tmp_path / "out" / "trial.jsonl").read_text().splitlines()[0])["origin"]
    assert (origin["device"], origin["phases"], origin["sensor"], origin["fraction"]) == (
        "Row",
        12,
        "deaf",
        0.25,
    )
    readings = load_drive(tmp_path / "out" / "drive.npz")
    assert len({round(12 * float(phase) / (2 * math.pi), 6) % 1 for phase in readings.angle()}) == 1
    for words, message in [
        (("+hardware.line=A",), "nothing at A"),
        (
            ("hardware.emulated=true", "+hardware.line=A"),
            "hardware.line: 'A'; must be null: it is for a real device",
        ),
        (("hardware.phases=1",), "hardware.phases: 1; must be an integer >= 2"),
        (("~hardware.sensor.fraction",), "hardware.sensor: no fraction; must be there"),
        (
            ("hardware.device=ultraino", "hardware.emulated=true"),
            "hardware.phases: 12; must be null: it is for row",
        ),
    ]:
        status, _, log = trial("hardware=mine", "method=lssg", *words, folder="output=other")
        assert (status, message in log) == (2, True)


REAL = ("hardware.limits.amplitude=1", "hardware.transducers='0-8'")


@pytest.mark.parametrize(
    ("words", "place"),
    [
        (("hardware=sonicsurface", "hardware.port=COM3"), {"port": "COM3"}),
        (("hardware=ultraino", "hardware.boards=2", "hardware.serial=7"), {"serial": "7"}),
        (("hardware=autd3", "hardware.network='server:8080'"), {"network": "server:8080"}),
    ],
)
def test_the_settings_of_a_real_bench_reach_its_device(trial, monkeypatch, words, place):
    def nothing_there(device, at, backend=None):
        assert (device.boards, at) == (2 if "hardware.boards=2" in words else 1, place)
        raise LinkError("nothing there")

    for device in DEVICES.values():
        monkeypatch.setattr(type(device), "open_port", nothing_there)
    status, _, log = trial(*REAL, *words, "hardware/sensor=file", "hardware.sensor.path=readings.csv")
    assert (status, log.splitlines()[-1]) == (2, "autdtorch: nothing there")


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.usefixtures("trial")
def test_the_settings_of_an_oscilloscope_reach_it(tmp_path, monkeypatch, moved):
    base, scope = (CONFIGS / "hardware" / name for name in ("base.yaml", "sensor/scope.yaml"))
    section = yaml.safe_load(base.read_text()) | {"device": "sonicsurface", "transducers": "0-8"}
    section["limits"]["amplitude"] = 1.0
    section["sensor"] = yaml.safe_load(scope.read_text()) | {"chip": "0x2a8d:1770", "moved": moved}
    instrument = mock.MagicMock(spec=Oscilloscope)
    instrument.__enter__.return_value = instrument
    opened = mock.Mock(return_value=instrument)
    monkeypatch.setattr("autdtorch.hardware.sensors.scope_microphones.open_scope", opened)
    with Bench(section, load_scene(tmp_path / "ours/scene/two.yaml"), 0).sensor() as found:
        assert isinstance(found, MovedMicrophone if moved else ScopeSensor)
    assert opened.call_args.args[0] == (0x2A8D, 0x1770)
    inputs, _ = instrument.set_up.call_args.args
    assert list(inputs) == ([1] if moved else [1, 2])


@pytest.mark.parametrize("network", ["server:0", "server:http"])
def test_a_network_without_a_port_is_refused(trial, network):
    status, _, log = trial(*REAL, "hardware=autd3", f"hardware.network='{network}'", "hardware/sensor=manual")
    assert (status, "must be server:PORT with a port from 1 to 65535" in log) == (2, True)
