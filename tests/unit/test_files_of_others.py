"""Arrays and phases in files that other programs and people write."""

import contextlib
import gzip
import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch.io.array_file import load_array
from autdtorch.io.drive_file import load_drive, save_drive
from autdtorch.scene.arrays import TransducerArray, phase_offsets_of, radii_of, strengths_of
from autdtorch.scene.drive import drive_from_phases
from autdtorch.scene.scene import ScaleWarning

TRIANGLE = [[0.0, 0.0, 0.0], [10.5e-3, 0.0, 2e-3], [0.0, 12e-3, 0.0]]
IN_METRES = "0,0,0\n0.0105,0,0.002\n0,0.012,0\n"
IN_MM = "0,0,0\n10.5,0,2\n0,12,0\n"


def written(tmp_path, text, name="a.csv"):
    (tmp_path / name).write_text(text, "utf-8")
    return tmp_path / name


@pytest.mark.parametrize(
    "text",
    [
        "# x [mm], y [mm], z [mm]\n" + IN_MM,
        "# my board\n#x [mm];y [mm];z [mm]\n" + IN_MM.replace(",", ";").replace(".", ","),
        "# units: mm\n" + IN_MM,
        "# positions in mm\nx,y,z\n" + IN_MM,
        "# x y z [mm]\n" + IN_MM.replace(",", " "),
        "X (mm),Y (mm),Z (mm)\n" + IN_MM,
        "x_mm;y_mm;z_mm\n" + IN_MM.replace(",", ";").replace(".", ","),
        "x/cm\ty/cm\tz/cm\n0\t0\t0\n1,05\t0\t0,2\n0\t1.2\t0\n".replace("1.2", "1,2"),
        "x [mm] y [mm] z [mm]\n" + IN_MM.replace(",", "  "),
        "# mm\n0,0 0,0 0,0\n10,5 0,0 2,0\n0,0 12,0 0,0\n",
        "x [mm],y [mm],z [mm],\n" + IN_MM.replace("\n", ",\n"),
        "# units: millimetres\n" + IN_MM,
        "# positions in Millimeters, made by M. in m/s\n" + IN_MM,
        "# units: length mm, angle rad, strength Pa m\n" + IN_MM,
        "# units: meters, made in cm steps\n" + IN_METRES,
        "x [millimeters],y [millimetre],z [mm]\n" + IN_MM,
        ",x [mm],y [mm],z [mm]\n0,0,0,0\n1,10.5,0,2\n2,0,12,0\n",  # as pandas writes its index
    ],
)
def test_units_and_names_are_found_where_they_are(tmp_path, text):
    array = load_array(written(tmp_path, text))
    torch.testing.assert_close(
        array.positions, torch.tensor(TRIANGLE, dtype=torch.float64), rtol=0, atol=1e-9
    )
    assert array.normals.tolist() == [[0, 0, 1]] * 3


@pytest.mark.parametrize("names", ["", "x,y,z\n"])
@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("m", 1.0)])
def test_a_unit_that_is_not_stated_is_inferred_and_told(tmp_path, names, unit, factor):
    rows = "\n".join(",".join(repr(factor * entry) for entry in row) for row in TRIANGLE)
    with pytest.warns(ScaleWarning, match=f"taken as {unit}, since neighbours are"):
        array = load_array(written(tmp_path, names + rows))
    torch.testing.assert_close(
        array.positions, torch.tensor(TRIANGLE, dtype=torch.float64), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0,0\n", r"a.csv: columns x, y, z have no unit; .* x \[m\] or x \[mm\]"),
        ("0,0,0\n1,0,0\n2,0,0\n", r"neighbours 1 apart are no array.* or x \[cm\]"),
        ("# units: furlongs\n" + IN_MM, r"state the unit 'furlongs'; must be one of m, mm, cm"),
        ("# x y z in inches\n" + IN_MM, r"state the unit 'inches'"),
        ("# all mm\n" + IN_METRES, r"seem to be in m, but a comment has mm; .*x \[m\]"),
        # Decimals with commas, whose cells are separated by commas, too
        ("0,010,0,020,0,000\n0,020,0,020,0,000\n", r"columns 4 to 6 .* of length 20 .*semicolons"),
        ("0,1, 0,2, 0,3\n", r"normals of length 1"),
        (",x [mm],y [mm],z [mm]\n7,0,0,0\n9,10.5,0,2\n", r"line 1: unknown column ''"),
        ("x [mm] why [mm]\n0 0\n", r"unknown column 'why'"),
        ("x [mm] y [foot]\n0 0\n", r"column 'y \[foot\]'"),
        ("0,0,0\n0.3,0,0\n", r"have no unit"),  # a pitch of 300 or 0.3 mm
        ("# in mm\n# x [m] to the right\nx,y,z\n0,0,0\n0.3,0,0\n", r"the unit 'mm' and 'm'; must be one of"),
        ("0,0\n1,0\n", r"2 columns without names; must be 3 or 6"),
        ("0,0,0,1\n1,0,0,1\n", r"4 columns without names; must be 3 or 6"),
        ("x [mm];y [mm];z [mm]\n0;0.5;0\n1,5;0;0\n", r"decimals begin with \. and with a comma"),
        ("x [mm];y [mm];z [mm]\n0;1.234,5;0\n", r"decimals begin with"),
        ("x [mm];y [mm];z [mm]\n0;1,234,5;0\n", r"line 2, y: '1,234,5'; must be a finite number"),
        ("0,0,0\n1,0\n", r"line 2: 2 cells; must be 3 as in the first row"),
        ("0,0,0\n1,0,nan\n", r"line 2, column 3: 'nan'; must be a finite number"),
        ("x [mm],y [mm],z [in]\n0,0,0\n", r"line 1: column 'z \[in\]'; must be z \[m\] or z \[mm\]"),
        ("x,y [m],z [m]\n", r"a.csv, line 1: column 'x'; must be x \[m\] or x \[mm\]"),
        ("x [m],y [m],zz [m]\n", r"a.csv, line 1: unknown column 'zz'.*; allowed columns: x, y"),
        ("x [m],x [mm]\n", r"line 1: columns x, x; every name must occur once"),
        ("x [m],y [m]\n1,2\n", r"a.csv: no column z; must have x, y, z"),
        ("x [m],y [m],z [m]\n1,2,3\n1,2\n", r"line 3: 2 cells; must be 3 as in the header"),
        ("x [m],y [m],z [m],phase_offset\n1,2,3,4\n", r"column phase_offset has no unit; .*\[rad\] or"),
        ("x [m],y [m],z [m]\n\n1,2,a\n", r"line 3, z: 'a'; must be a finite number"),
        ("x [m],y [m],z [m]\n", r"a.csv: no row under the header"),
        ("", r"a.csv: empty"),
        ("x [m],y [m],z [m]\n0,0,0\n0,0,0\n", r"a.csv: TransducerArray.positions: points 0 and 1"),
    ],
)
def test_what_is_ambiguous_or_wrong_is_refused_with_its_line_and_what_to_write(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        load_array(written(tmp_path, text))


@given(
    st.lists(
        st.tuples(st.floats(-1, 1), st.floats(1e-3, 10), st.floats(0, 4e-3), st.sampled_from([0.0, 0.3, -4])),
        min_size=1,
        max_size=6,
    ),
    st.sampled_from([".csv", ".NPZ"]),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: math.hypot(*n) > 0.1),
)
@settings(max_examples=40, deadline=None)
def test_an_array_comes_back_from_every_format(tmp_path_factory, rows, suffix, normal):
    heights, *values = zip(*rows, strict=True)
    places = [(0.01 * number, 0.0, height) for number, height in enumerate(heights)]
    array = TransducerArray(places, normal, *values)
    drive = drive_from_phases(torch.linspace(0, 6, len(rows)).double(), 0.5)
    path = tmp_path_factory.mktemp("array") / f"drive{suffix}"
    save_drive(path, drive, array)
    found = load_array(path)
    assert torch.equal(found.positions, array.positions)
    torch.testing.assert_close(found.normals, array.normals, rtol=0, atol=1e-15)
    assert torch.equal(strengths_of(found), strengths_of(array))
    assert torch.equal(radii_of(found), radii_of(array))
    assert torch.equal(phase_offsets_of(found), phase_offsets_of(array))
    torch.testing.assert_close(load_drive(path), drive, rtol=0, atol=1e-14)
    given = load_array(path, source_strength=2.0, radius=0)
    assert (given.source_strength, given.radius) == (2.0, 0.0)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("phase [deg]\n0\n90\n180\n", None),
        ("phase [deg];amplitude\n0;1\n90;1\n180;1\n", None),
        ("# phase [deg]\n0\n90\n180\n", None),
        ("# in degrees or so\n# phase_deg\n0\n90\n180\n", None),
        ("# phases in degrees\n0\n90\n180\n", None),
        ("phase [degrees]\n0\n90\n180\n", None),
        ("phase_degree\n0\n90\n180\n", None),
        ("# units: radians\n0\n1.5707963267948966\n3.141592653589793\n", None),
        (",phase [deg]\n0,0\n1,90\n2,180\n", None),
        ("phase\n0\n1.5707963267948966\n3.141592653589793\n", "taken as rad"),
        ("0\n1,5707963267948966\n3,141592653589793\n", "taken as rad"),
        ("1\t0\n1\t1.5707963267948966\n1\t3.141592653589793\n", "taken as amplitude and phase"),
    ],
)
def test_phases_are_read_as_they_come(tmp_path, text, told):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        drive = load_drive(written(tmp_path, text))
    torch.testing.assert_close(drive, torch.tensor([1, -1j, -1], dtype=torch.complex128), rtol=0, atol=1e-12)
    assert any(told in str(warning.message) for warning in caught) if told else not caught


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0\n64\n127\n", r"phases from 0 to 127 without a unit; .*phase \[rad\] or phase \[deg\]"),
        ("0\n1\n2\n", r"phases from 0 to 2 without a unit"),
        ("0.5,0.2\n0.1,0.9\n", r"2 columns without names; the first line must name them"),
        ("0,5\n1,5\n", r"2 columns without names; .*decimals begin with a point"),
        ("# in rad\n0,5\n1,5\n", r"2 columns without names; .*decimals begin with a point"),
        ("# in units of pi\n0.5\n1.5\n", r"state the unit 'pi'; must be one of rad, deg"),
        ("# degrees of freedom\n0.5\n1.5\n", r"seem to be in rad, but a comment has deg"),
        ("1,2,3\n3,4,5\n", r"3 columns without names"),
        ("2,4\n0,1,2,3\n", r"1 rows of 4 phases; must be 2 of 4, as in the first line"),
        ("2,4\n0,1,2,3\n0,1,2\n", r"line 3: 3 cells; must be 4"),
        ("transducer,amplitude\n0,1\n", r"a.csv: no column phase; must have phase"),
        ("phase [rad],amplitude\n0,2\n", r"a.csv: amplitudes: from 2 to 2"),
        ("unit,transducer,autd3 phase\n0,0,1\n", r"a.csv: no autd3 intensity; must have autd3 phase, "),
        ("frame,phase [rad],amplitude\n0,1,1\n0,1,1\n1,1,1\n", r"a.csv: column frame; must count"),
        ("frame,phase [rad],amplitude\n1,1,1\n2,1,1\n", r"a.csv: column frame; must count"),
        ("autd3 phase,autd3 intensity\n256,0\n", r"a.csv: AUTD3 phase: .*0 to 255"),
        ("autd3 phase,autd3 intensity\n1.5,0\n", r"a.csv: AUTD3 phase: .*0 to 255"),
    ],
)
def test_phases_that_are_wrong_or_could_be_something_else_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        load_drive(written(tmp_path, text))


@given(st.lists(st.lists(st.floats(-7, 7), min_size=3, max_size=3), min_size=1, max_size=4))
@settings(max_examples=25)
def test_rows_of_openmpd_are_frames_of_arg_q(tmp_path_factory, frames):
    lines = [f"{len(frames)},3", *(",".join(map(repr, row)) for row in frames)]
    path = written(tmp_path_factory.mktemp("rows"), "\n".join(lines))
    expected = torch.polar(torch.ones(len(frames), 3).double(), torch.tensor(frames, dtype=torch.float64))
    torch.testing.assert_close(load_drive(path), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("load", "text"),
    [
        (load_array, IN_MM),
        (load_drive, "0.5\n1.5\n"),
        (load_drive, "0.5,1\n1.5,1\n"),
        (load_drive, "1,3\n0,-90,180\n"),  # degrees as rows of OpenMPD
    ],
)
def test_a_guess_is_told_once_with_the_file_at_the_line_that_reads_it(tmp_path, load, text):
    with pytest.warns(ScaleWarning, match=r"a.csv: ") as caught:
        load(written(tmp_path, text))
    assert {one.filename for one in caught} == {__file__}
    assert all(str(one.message).count("a.csv") == 1 for one in caught)


@given(st.text(" \tinuts:=[](),.m°/Pad", max_size=60))
@settings(max_examples=100)
def test_any_comment_is_read_or_refused(tmp_path_factory, comment):
    path = written(tmp_path_factory.mktemp("comment"), f"# {comment}\n{IN_MM}")
    with contextlib.suppress(ValueError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        unit = 1e-3 if "m" not in comment.replace("mm", "") else None
        pitch = load_array(path).positions[1, 0].item()
        assert unit is None or pitch == pytest.approx(10.5 * unit)


def test_two_boards_of_openmpd_have_the_order_of_its_rows():
    """The order of AcousTools: x falls from column to column above, and rises below; y falls in each."""
    above = TransducerArray.openmpd((0, 0, 0.12), (0, 0, -1), angle=math.pi)
    both = above + TransducerArray.openmpd((0, 0, -0.12), (0, 0, 1))
    side = torch.linspace(-78.75e-3, 78.75e-3, 16, dtype=torch.float64)
    top = torch.cartesian_prod(side.flip(0), side.flip(0))
    bottom = torch.cartesian_prod(side, side.flip(0))
    torch.testing.assert_close(both.positions[:256, :2], top, rtol=0, atol=1e-12)
    torch.testing.assert_close(both.positions[256:, :2], bottom, rtol=0, atol=1e-12)


# Two styles of setting values; a transducer may be made anywhere and named later
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<java version="11.0.9" class="java.beans.XMLDecoder">\n'
SIMULATION = '<object class="acousticfield3d.simulation.Simulation" id="Simulation0"/>\n'


def field(kind, name, owner, value):
    return (
        f'<void class="acousticfield3d.{kind}" method="getField"><string>{name}</string>'
        f'<void method="set"><object idref="{owner}"/>{value}</void></void>'
    )


def transducer(number, place, rot, values):
    """The text of a transducer; only what differs from Ultraino's defaults is written."""
    me, at = f"Transducer{number}", f"Vector3f{number}"
    parts = [field("simulation.Transducer", k, me, f"<float>{v!r}</float>") for k, v in values.items()]
    turn = "".join(
        f'<void property="{axis}"><float>{v!r}</float></void>' for axis, v in zip("wxyz", rot, strict=True)
    )
    moved = "".join(
        field("math.Vector3f", axis, at, f"<float>{v!r}</float>")
        for axis, v in zip("xyz", place, strict=True)
        if v
    )
    return (
        f'<void class="acousticfield3d.simulation.Transducer" id="{me}">{"".join(parts)}'
        f'<void property="orderNumber"><int>{number}</int></void><void property="tag"><int>2</int></void>'
        f'<void id="Transform{number}" property="transform"><void property="rot">{turn}</void>'
        f'<void id="{at}" property="translation">{moved}</void></void></void>'
    )


def simulation(transducers, listed):
    added = "".join(f'<void method="add"><object idref="Transducer{number}"/></void>' for number in listed)
    return (
        f"{HEAD}{SIMULATION}{''.join(transducers)}"
        '<void class="acousticfield3d.simulation.Simulation" method="getField"><string>transducers</string>'
        f'<void id="ArrayList0" method="get"><object idref="Simulation0"/>{added}</void></void>'
        '<void idref="ArrayList0"/></java>'
    )


def packed(tmp_path, text, name="board.xml.gz"):
    (tmp_path / name).write_bytes(gzip.compress(text.encode()))
    return tmp_path / name


@given(
    st.lists(
        st.tuples(
            st.floats(-0.1, 0.1),
            st.floats(0.1, 9),
            st.floats(1e-3, 9e-3),
            st.floats(-2, 2),
            st.floats(0.1, 1),
        ),
        min_size=1,
        max_size=5,
    ),
    st.randoms(use_true_random=False),
    st.floats(-3, 3),
)
@settings(max_examples=30, deadline=None)
def test_a_simulation_of_ultraino_is_an_array_and_a_drive(tmp_path_factory, rows, random, turn):
    """Positions with y up, normals q y q*, apertures that are diameters, phases in units of pi."""
    rot = (math.cos(turn / 2), math.sin(turn / 2), 0.0, 0.0)  # about x
    texts = [
        transducer(
            number, (0.01 * number, height, 0.02), rot,
            {"power": power, "apperture": width, "phase": phase, "amplitude": amplitude},
        )
        for number, (height, power, width, phase, amplitude) in enumerate(rows)
    ]  # fmt: skip
    listed = random.sample(range(len(rows)), len(rows))
    path = packed(tmp_path_factory.mktemp("ultraino"), simulation(texts, listed))
    array, drive = load_array(path), load_drive(path)
    heights, powers, widths, phases, amplitudes = (
        torch.tensor(column, dtype=torch.float64) for column in zip(*rows, strict=True)
    )
    numbers = 0.01 * torch.arange(len(rows), dtype=torch.float64)
    expected = torch.stack([numbers, torch.full_like(numbers, -0.02), heights], dim=1)
    torch.testing.assert_close(array.positions, expected, rtol=0, atol=1e-15)
    normal = torch.tensor([0.0, -math.sin(turn), math.cos(turn)], dtype=torch.float64)
    torch.testing.assert_close(array.normals, normal.expand(len(rows), 3), rtol=0, atol=1e-12)
    assert torch.equal(strengths_of(array), powers)
    torch.testing.assert_close(radii_of(array), widths / 2, rtol=1e-15, atol=0)
    torch.testing.assert_close(drive, torch.polar(amplitudes, math.pi * phases), rtol=0, atol=1e-12)
    assert load_array(path, radius=0.0).radius == 0


def test_what_ultraino_leaves_out_has_its_default_and_huge_values_are_not_repeated(tmp_path):
    path = packed(tmp_path, simulation([transducer(0, (0, 0, 0), (1, 0, 0, 0), {"phase": 0.5})], [0]))
    array = load_array(path)
    assert (array.source_strength, array.radius, array.normals.tolist()) == (2.53, 4.5e-3, [[0, 0, 1]])
    with pytest.warns(ScaleWarning, match="all amplitudes are 0"):
        assert load_drive(path)[0] == pytest.approx(1j)
    huge = transducer(0, (0, 0, 0), (1, 0, 0, 0), {"phase": 0.5}).replace(
        "<float>0.5</float>", f"<string>{'x' * 100_000}</string>"
    )
    with pytest.raises(ValueError, match=r"board.xml.gz: transducer 0, phase: 'xx") as caught:
        load_drive(packed(tmp_path, simulation([huge], [0])))
    assert len(str(caught.value)) < 500 + len(str(tmp_path))


BOMB = (
    '<!DOCTYPE java [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    + "]><java>&i;</java>"
)


ATTACKS = {
    "doctype and entities": (gzip.compress(BOMB.encode()), "document type"),
    "doctype of a file": (
        gzip.compress(b'<!DOCTYPE java SYSTEM "file:///etc/passwd"><java/>'), "document type",
    ),
    "long text": (gzip.compress(b"<java>" + b" " * 2**26 + b"</java>"), "more than 67108864 bytes"),
    "deep": (gzip.compress(b"<void>" * 300 + b"</void>" * 300), "more than 200 levels"),
    "cut short": (gzip.compress(HEAD.encode() + b"</java>" + bytes(1000))[:40], "breaks off"),
    "HTML": (gzip.compress(b"<html><body>Not found</body></html>"), "no transducers"),
    "pointer": (b"version https://git-lfs.github.com/spec/v1\n", "must be a simulation saved by Ultraino"),
    "empty": (b"", "must be a simulation saved by Ultraino"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), ATTACKS.values(), ids=ATTACKS)
def test_files_that_are_none_or_attack_are_refused(tmp_path, content, message):
    path = tmp_path / "board.xml.gz"
    path.write_bytes(content)
    for load in (load_array, load_drive):
        with pytest.raises(ValueError, match=rf"board.xml.gz: .*{message}"):
            load(path)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_a_damaged_simulation_ends_in_an_array_or_a_message(tmp_path_factory, data):
    whole = simulation(
        [transducer(n, (0.02 * n, 0, 0), (1, 0, 0, 0), {"power": 2.0}) for n in range(2)], [1, 0]
    )
    first = data.draw(st.integers(len(HEAD), len(whole)))
    last = data.draw(st.integers(first, min(len(whole), first + 60)))
    text = (
        whole[:first]
        + data.draw(st.sampled_from(["", "<void/>", "<int>x</int>", "<float>1</float>"]))
        + whole[last:]
    )
    path = packed(tmp_path_factory.mktemp("damaged"), text)
    with contextlib.suppress(ValueError):  # other exceptions fail
        assert np.isfinite(load_array(path).positions.numpy()).all()
