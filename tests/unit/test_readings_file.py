"""Files of readings: what is stated is read, and what is broken is refused with its place."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at

STATED = {"phases": "rad", "pressure": "Pa peak"}
TABLE = """phase 0 [deg],phase 1 [deg],pressure 0 [Pa rms],pressure 1 [Pa rms]
0,90,1.5,2
180,45.5,,4
"""
Q = torch.exp(-1j * torch.deg2rad(torch.tensor([[0, 90], [180, 45.5]], dtype=torch.float64)))
RMS = torch.tensor([[1.5, 2], [math.nan, 4]], dtype=torch.float64)


def close(read, expected):
    torch.testing.assert_close(read, expected, rtol=1e-14, atol=1e-14, equal_nan=True)


@pytest.fixture
def load(tmp_path):
    """Load the text of a CSV file."""

    def load(text, **arguments):
        path = tmp_path / "trial.csv"
        path.write_text(text, encoding="utf-8")
        return at.load_readings(path, **arguments)

    return load


@pytest.mark.parametrize(
    ("text", "arguments"),
    [
        (TABLE, {}),
        (TABLE.replace(",", "\t"), {}),
        (TABLE.replace(",", ";").replace(".", ","), {}),
        (TABLE.replace("180,45.5,,4", "180,45.5,nan,4,"), {}),
        (
            TABLE.replace(",pressure 1 [Pa rms]", "").replace(",2\n", "\n").replace(",4\n", "\n"),
            {"one": True},
        ),
        ("# of a trial\n" + TABLE.replace("\n", "\r\n"), {}),
        (TABLE.replace(" [deg]", "").replace(" [Pa rms]", ""), {"phases": "deg", "pressure": "Pa rms"}),
        (TABLE.replace(" rms]", "]"), {"phases": "deg", "pressure": "rms"}),
        (TABLE.replace("phase 0 [deg]", "phi_1_deg").replace("phase 1 [deg]", "phi_2_deg"), {}),
        (
            TABLE.replace("pressure 0 [Pa rms]", "p1_rms (Pa)").replace("pressure 1 [Pa rms]", "p2_rms (Pa)"),
            {},
        ),
        (
            TABLE.partition("\n")[2],
            {"columns": {"phase": 2, "pressure": 2}, "phases": "deg", "pressure": "Pa rms"},
        ),
        (
            TABLE.replace("phase ", "ch").replace("pressure ", "level at "),
            {"columns": {"phase": "ch*", "pressure": ["level at 0 [Pa rms]", "level at 1 [Pa rms]"]}},
        ),
    ],
)
def test_a_table_is_read_in_any_spelling(load, text, arguments):
    columns = slice(0, 1) if arguments.pop("one", False) else slice(None)
    readings = load(text, **arguments)
    close(readings.drives, Q)
    close(readings.pressure, math.sqrt(2) * RMS[:, columns])
    assert readings.points is None
    assert readings.phase is None


def test_columns_are_sorted_by_their_numbers_and_others_skipped_by_the_call(load):
    close(load("p_rms_Pa,phase 2 [deg],phase 1 [deg]\n1.5,90,0\n,45.5,180").drives, Q)
    titled = {"phase": "ch*", "pressure": "mic"}  # in the order of text
    phases = load("ch1,ch10,ch2,mic\n1,10,2,3", columns=titled, phases="rad", pressure="Pa peak").drives
    close(phases, torch.exp(-1j * torch.tensor([[1, 2, 10]], dtype=torch.float64)))
    counted = {"skip": 1, "phase": 2, "pressure": 1}
    close(
        load("09:00,0,90,1.5\n09:01,180,45.5,2", columns=counted, phases="deg", pressure="mPa peak").drives, Q
    )


@pytest.mark.parametrize(
    ("unit", "value", "peak"),
    [
        ("Pa peak", 3.0, 3.0),
        ("kPa rms", 3.0, 3e3 * math.sqrt(2)),
        ("mPa peak-to-peak", 3.0, 1.5e-3),
        ("dB", 94.0, math.sqrt(2) * 20e-6 * 10**4.7),
        ("dB re 20 µPa", 0.0, math.sqrt(2) * 20e-6),
        ("dB SPL", -3.0, math.sqrt(2) * 20e-6 * 10**-0.15),
    ],
)
def test_pressures_become_peak_amplitudes_in_pascals(load, unit, value, peak):
    """Of a sine, the peak amplitude is sqrt(2) times the RMS, and half of peak to peak."""
    stated = load(f"phase 0 [rad],pressure 0 [{unit}]\n1,{value}")
    said = load(f"phase 0 [rad],p\n1,{value}", pressure=unit)
    assert stated.pressure.item() == said.pressure.item() == pytest.approx(peak, rel=1e-12)


@pytest.mark.parametrize(
    ("titles", "phases", "argument"),
    [
        ("phase 0 [rad]", 1.0, -1.0),
        ("phase 0 [arg rad]", 1.0, 1.0),
        ("arg q 0 [deg]", 90.0, math.pi / 2),
        ("phase 0 [levels of 32]", 8, math.pi / 2),
        ("sonicsurface phase 0", 8, math.pi / 2),
    ],
)
def test_phases_are_phi_unless_arg_q_or_levels_are_stated(load, titles, phases, argument):
    assert load(f"{titles},p [Pa peak]\n{phases},1").drives.angle().item() == pytest.approx(argument)


@pytest.mark.parametrize(
    ("text", "phases"),
    [
        ("phase,p\n8,1", 32),
        ("phase,p\n8,1", "sonicsurface"),
        ("level,p\n16,1", 64),
        ("phase,p\n90,1", "arg deg"),
    ],
)
def test_the_call_states_levels_and_the_sign(load, text, phases):
    drives = load(text, phases=phases, pressure="Pa peak").drives
    close(drives, torch.tensor([[1j]], dtype=torch.complex128))


@pytest.mark.parametrize("name", ["autd3", "openmpd", "sonicsurface", "ultraino"])
def test_levels_of_a_device_are_the_drive_that_it_plays(load, name):
    device = at.hardware.DEVICES[name]
    q = torch.polar(torch.rand(5, 3, dtype=torch.float64), 6 * torch.rand(5, 3, dtype=torch.float64))
    levels = torch.stack(device.levels(q)).permute(1, 0, 2).reshape(5, -1)
    titles = [f"{name} {column} {number}" for column in device.columns for number in range(3)]
    rows = [[*row, 1] for row in levels.tolist()]
    text = "\n".join(",".join(map(str, row)) for row in [[*titles, "p [Pa peak]"], *rows])
    assert torch.equal(load(text).drives, device.quantised(q))


def test_a_row_of_any_point_is_grouped_and_a_scan_needs_no_drive(load):
    rows = "x [mm],y [mm],z [mm],phase,p\n0,0,100,0,1\n0,5,100,0,2\n0,0,100,1,3\n"
    readings = load(rows, **STATED)
    close(readings.points, torch.tensor([[0, 0, 0.1], [0, 5e-3, 0.1]], dtype=torch.float64))
    close(readings.pressure, torch.tensor([[1, 2], [3, math.nan]], dtype=torch.float64))
    scan = load("x [m],y [m],z [m],p [Pa peak]\n0,0,1,1\n0,1,1,2\n", drives=Q[0])
    assert (len(scan), scan.count) == (1, 2)


def test_phases_of_pressures_are_read(load):
    readings = load("phase [rad],p [Pa peak],p phase [deg]\n1,2,180\n2,3,", phase="deg")
    close(readings.phase, torch.tensor([[math.pi], [math.nan]], dtype=torch.float64))


def test_two_hundred_rows_of_sixteen_phases_and_four_rms_pressures_load_in_a_line(load):
    generator = np.random.default_rng(0)
    phases, rms = generator.uniform(0, 360, (200, 16)), generator.rayleigh(300, (200, 4))
    titles = [*(f"phase {n}" for n in range(16)), *(f"pressure {n} [Pa]" for n in range(4))]
    rows = "\n".join(",".join(map(str, row)) for row in np.hstack([phases, rms]).tolist())
    readings = load(",".join(titles) + "\n" + rows, phases="deg", pressure="rms")
    np.testing.assert_allclose(readings.drives, np.exp(-1j * np.radians(phases)), rtol=1e-14)
    np.testing.assert_allclose(readings.pressure, rms * math.sqrt(2), rtol=1e-14)


def rows_of(title, numbers):
    """A table with a column of a title."""
    other = "phase [rad]" if re.match("p\\b", title) else "p [Pa peak]"
    return "\n".join([f"{title},{other}", *(f"{number},0.5" for number in numbers)])


BROKEN = [
    ("", "empty"),
    ("\n# nothing\n", "empty"),
    ("phase [rad],p [Pa peak]\n", "no row under the header"),
    (TABLE + "1,2,3\n", r"line 4: 3 cells; must be 4 as in the header"),
    (TABLE + "1,2,3,4,5\n", r"line 4: 5 cells; must be 4"),
    (
        TABLE.replace("2\n", "two\n"),
        r"line 2, column 'pressure 1 \[Pa rms\]': 'two'; must be a finite number",
    ),
    (TABLE.replace("45.5", "nan"), r"line 3, column 'phase 1 \[deg\]': 'nan'; must be a finite number$"),
    (TABLE.replace("1.5", "inf"), r"line 2, column 'pressure 0 \[Pa rms\]': 'inf'"),
    (TABLE.replace("1.5", "-1.5"), r"line 2, column 'pressure 0.*: '-1.5'; .* >= 0.*pressure='dB'"),
    (TABLE.replace(" [deg]", ""), "no unit of the phases; must be stated, .*phases='deg'"),
    (TABLE.replace(" [Pa rms]", ""), r"no unit \(Pa, kPa, mPa or dB\) of the pressures"),
    (TABLE.replace(" [Pa rms]", " [Pa]"), r"no kind \(peak, rms .*pressure='Pa rms'"),
    (TABLE.replace(" [Pa rms]", " [MPa]"), "column 'pressure 0 .MPa.': 'MPa'; must be Pa, kPa or mPa"),
    (TABLE.replace(" [Pa rms]", " [dB(A)]"), "must be Pa, kPa"),
    (TABLE.replace(" [Pa rms]", " [dB re 1 uPa]"), "must be Pa, kPa"),
    (TABLE.replace(" [Pa rms]", " [dB peak]"), "20 uPa are an RMS pressure"),
    (rows_of("p [dB]", range(800, 820)), "most above 101325 Pa, which no sound in air reaches"),
    (rows_of("p [kPa rms]", range(200, 220)), "most above 101325 Pa"),
    (rows_of("phase [rad]", range(0, 360, 30)), "phases from 0 to 330 rad, all whole numbers"),
    (rows_of("level", range(4)), "no number of levels of the phases.*phases=32"),
    (rows_of("autd3 phase 0", [256]), "'256'; must be a whole number from 0 to 255"),
    ("phase [rad],amplitude,p [Pa peak]\n0,1.2,1", "line 2, column 'amplitude': '1.2'; .* from 0 to 1"),
    ("phase [rad],amplitude,p [Pa peak]\n0,-1,1", "column 'amplitude': '-1'; .* from 0 to 1"),
    ("phase 0 [rad],phase 1 [rad],amplitude 0,p [Pa peak]\n0,1,1,1", "1 of amplitude and 2 of phase"),
    ("phase [rad],intensity,p [Pa peak]\n0,1,1", "amplitudes in levels beside phases in rad"),
    ("autd3 phase 0,intensity,p [Pa peak]\n0,256,1", "'256'; .* from 0 to 255"),
    (TABLE.replace("phase 1", "phase 0"), r"columns of phase, 'phase 0 \[deg\]' twice"),
    (TABLE.replace("phase 1", "phase 7"), "must have the numbers from 0 or 1, each once"),
    (
        TABLE.replace("phase 1 [deg]", "phase 1 [rad]"),
        "'phase 0 .deg.' and 'phase 1 .rad.'; must be in one unit",
    ),
    (TABLE.replace(",", "|"), "must be separated by commas, semicolons, tabs or blanks"),
    (TABLE.replace(",", ";").replace("1.5", "1,5"), "decimals begin with . and with a comma"),
    (TABLE.replace(",", ";").replace("1.5", "1.234,5"), "decimals begin with . and with a comma"),
    (
        TABLE.replace("pressure 1 [Pa rms]", "temperature"),
        "unknown column 'temperature'; must be as .*columns=",
    ),
    (TABLE.replace("pressure", "phase of"), "unknown column 'phase of 0|columns of phase"),
    ("phase [rad]\n1\n", "no column of pressures"),
    ("p [Pa peak]\n1\n", "no column of phases; must have them.* drives="),
    ("phase [rad],p [Pa peak]\n1,\n2,nan", "no pressure in any row"),
    (TABLE.partition("\n")[2], "4 columns without names; must be counted, as in columns="),
    ("x,y,z,phase [rad],p [Pa peak]\n1,2,3,0,1", "no unit of x, y, z"),
    ("x [mm],y [mm],phase [rad],p [Pa peak]\n1,2,0,1", "must be x, y, z and a single pressure"),
    ("x [in],y [in],z [in],phase [rad],p [Pa peak]\n1,2,3,0,1", "column 'x .in.'"),
]

CALLED_WRONGLY = [
    (TABLE.replace(" [Pa rms]", " [rms]"), {"pressure": "rms"}, "no unit .*pressure='Pa rms'"),
    (TABLE, {"pressure": "kPa"}, "pressure: 'kPa'; must agree with column 'pressure 0 .Pa rms.'"),
    (TABLE.replace("Pa rms", "dB"), {"pressure": "Pa rms"}, "pressure: 'Pa rms'; must agree .*states dB rms"),
    ("phase [rad],SPL 1\n1,120", {"pressure": "Pa rms"}, "pressure: 'Pa rms'; must agree"),
    (rows_of("p", range(110, 130)), STATED, "pressures from 110 to 129 look like dB; must be pressure='dB'"),
    (TABLE, {"phases": "rad"}, "phases: 'rad'; must agree with column 'phase 0 .deg.'"),
    (
        rows_of("phase", [1, 32]),
        {"phases": 32},
        "line 3, column 'phase': '32'; must be a whole number from 0 to 31",
    ),
    (rows_of("phase", [1, 2.5]), {"phases": 32}, "line 3, column 'phase': '2.5'; must be a whole number"),
    ("phase 0 [rad],amplitude 0,p [Pa peak]\n0,1,1", {"phases": "autd3"}, "phases: 'autd3 arg'; must agree"),
    ("phase,amplitude,p [Pa peak]\n0,1,1", {"phases": "autd3"}, "amplitudes beside phase levels of autd3"),
    (TABLE, {"columns": {"phase": 2, "pressure": 3}}, "columns: 5 in all; must be 4"),
    (
        TABLE,
        {"columns": {"phase": "phi*", "pressure": "p*"}},
        r"columns\['phase'\]: 'phi\*'; must be a title",
    ),
    ("ch1,mic\n1,3", {"columns": {"phase": "*", "pressure": "mic"}, **STATED}, "columns: 'mic' in .* twice"),
    (
        "0,9o,1\n1,2,3",
        {"columns": {"phase": 2, "pressure": 1}, **STATED},
        "line 1, column '2': '9o'; must be",
    ),
    ("0,1,2\n5,6,7", {"columns": {"phase": 2, "pressure": 1}, **STATED}, "the first line counts the columns"),
    (TABLE, {"drives": Q}, "drives: given, but .* has columns of phases"),
    (TABLE, {"points": torch.zeros(3, 3)}, r"points: shape \(3, 3\); must be \(2, 3\)"),
    (TABLE, {"phase": "deg"}, "phase: deg; but .* has no column of pressure phases"),
    ("p [Pa peak]\n1\n2\n3", {"drives": Q}, "drives: 2; must be 3, a drive for each row"),
]


@pytest.mark.parametrize(
    ("text", "message", "arguments"),
    [*((*case, {}) for case in BROKEN), *((text, message, call) for text, call, message in CALLED_WRONGLY)],
)
def test_a_broken_table_is_refused_with_its_place_and_the_reason(load, text, message, arguments):
    with pytest.raises(ValueError, match=message) as error:
        load(text, **arguments)
    named = str(error.value).partition(":")[0].partition("[")[0]
    assert "trial.csv" in str(error.value) or named in arguments


@pytest.mark.parametrize(
    ("title", "numbers"),
    [("phase [rad]", np.linspace(-170.3, 175.1, 20)), ("phase [deg]", np.linspace(0.1, 6.2, 20))],
)
def test_phases_that_look_like_another_unit_bring_a_warning(load, title, numbers):
    with pytest.warns(at.ScaleWarning, match="trial.csv: phases from .*; are these"):
        load(rows_of(title, numbers))


def broken_npz(**changes):
    arrays = {"drives": Q.numpy(), "pressure": RMS.numpy(), "unit": "Pa peak"} | changes
    return {name: value for name, value in arrays.items() if value is not None}


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (broken_npz(pressure=None), "no array 'pressure'"),
        (broken_npz(presure=RMS.numpy()), "unknown array 'presure'"),
        (broken_npz(drives=None), "no column of phases"),
        (broken_npz(drives=Q.numpy().real), "drives: .*must be an array of complex numbers"),
        (broken_npz(drives=Q.numpy()[:1]), "drives: 1; must be 2"),
        (broken_npz(drives=2 * Q.numpy()), r"drives\[0, 0\]: 2.0; every amplitude"),
        (broken_npz(pressure=np.zeros((2, 1, 1))), r"pressure: shape \(2, 1, 1\)"),
        (
            broken_npz(pressure=-RMS.numpy()),
            "row 0, column 'pressure 0 .*: -1.5; must be a finite number >= 0",
        ),
        (broken_npz(unit=None), "no unit .* of the pressures"),
        (broken_npz(unit="furlong"), "unit: 'furlong'; must be Pa peak"),
        (broken_npz(drives=np.array([None, {}], dtype=object)), "must hold plain NumPy arrays"),
    ],
)
def test_a_broken_file_of_numpy_is_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "trial.npz", **arrays)
    with pytest.raises(ValueError, match=rf"trial\.npz.*{message}|^{message}"):
        at.load_readings(tmp_path / "trial.npz")


@pytest.mark.parametrize("share", [0, 0.5, 0.99])
def test_a_file_of_numpy_that_broke_off_is_told(tmp_path, share):
    file = tmp_path / "trial.npz"
    np.savez(file, drives=Q.numpy(), pressure=RMS.numpy())
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(ValueError, match=r"trial\.npz: empty or broken off; must hold plain NumPy arrays$"):
        at.load_readings(file)


def test_arrays_of_others_are_read_with_their_units(tmp_path):
    np.savez(tmp_path / "trial.npz", phases=np.degrees(-Q.angle().numpy()), pressure=RMS.numpy())
    readings = at.load_readings(tmp_path / "trial.npz", phases="deg", pressure="kPa rms")
    close(readings.drives, Q)
    close(readings.pressure, 1e3 * math.sqrt(2) * RMS)
    np.savez(tmp_path / "scan.npz", drives=Q[0].numpy(), pressure=[1.0, 2, 3], points=np.eye(3))
    scan = at.load_readings(tmp_path / "scan.npz", pressure="Pa peak")
    assert (len(scan), scan.points.shape) == (1, (3, 3))


def test_a_data_frame_is_read_by_its_titles():
    cells = np.array([[0.0, 90, 1.5, 2], [180, 45.5, None, 4]], dtype=object)
    frame = SimpleNamespace(columns=TABLE.partition("\n")[0].split(","), to_numpy=lambda: cells)
    close(at.load_readings(frame).pressure, math.sqrt(2) * RMS)
    cells[1, 0] = "half"
    with pytest.raises(
        ValueError, match=r"^source, row 1, column 'phase 0 \[deg\]': 'half'; must be a finite number"
    ):
        at.load_readings(frame)
    unnamed = SimpleNamespace(columns=range(4), to_numpy=lambda: np.array([[0, 90, 1.5, 2]]))
    close(
        at.load_readings(
            unnamed, columns={"phase": 2, "pressure": 2}, phases="deg", pressure="Pa peak"
        ).drives,
        Q[:1],
    )


def test_a_file_that_is_not_there_or_of_another_kind_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"^source: .*there is no such file"):
        at.load_readings(tmp_path / "trial.csv")
    with pytest.raises(ValueError, match=r"^source: .*must end in one of \.csv, \.npz, \.jsonl"):
        at.load_readings(tmp_path / "trial.xlsx")


ONE = st.floats(0, 1)
ANGLE = st.floats(-10, 10)


@st.composite
def some_readings(draw):
    rows, transducers, points = (draw(st.integers(1, 3)) for _ in range(3))
    grid = [draw(st.tuples(ONE, ANGLE)) for _ in range(rows * transducers)]
    drives = torch.tensor([a * np.exp(1j * phi) for a, phi in grid], dtype=torch.complex128).reshape(rows, -1)
    gap = st.just(math.nan)
    pressure = [draw(gap | st.floats(1e-9, 1e4)) for _ in range(rows * points - 1)] + [
        draw(st.floats(1e-9, 1e4))
    ]
    phase = [draw(gap | ANGLE) for _ in pressure] if draw(st.booleans()) else None
    places = [[draw(ANGLE) for _ in range(3)] for _ in range(points)] if draw(st.booleans()) else None
    tensors = [
        None if one is None else torch.tensor(one).double().reshape(rows, -1) for one in (pressure, phase)
    ]
    return at.Readings(drives, tensors[0], places, tensors[1])


@given(some_readings(), st.sampled_from([".csv", ".npz"]))
def test_saved_readings_are_loaded_as_they_were(tmp_path_factory, readings, suffix):
    path = tmp_path_factory.mktemp("saved") / f"readings{suffix}"
    at.save_readings(path, readings)
    loaded = at.load_readings(path)
    exact = {"rtol": 0, "atol": 0, "equal_nan": True}
    polar = 1e-14 if suffix == ".csv" else 0.0  # of a phase within 2 pi, some rounding errors of 2e-16
    torch.testing.assert_close(loaded.drives, readings.drives, rtol=0, atol=polar)
    for name in ("pressure", "phase", "points"):
        expected, read = getattr(readings, name), getattr(loaded, name)
        assert (expected is None) == (read is None)
        if expected is not None:
            torch.testing.assert_close(read, expected, **exact)
