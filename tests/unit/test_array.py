"""Arrays, and files of them."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

import autdtorch as at
from autdtorch.scene.arrays import apertures_of
from autdtorch.scene.boards import AUTD3_UNIT, OPENMPD_SOURCE_STRENGTH
from autdtorch.utils.spatial import distances

PITCH = 10.16e-3
ROUNDING = 1e-12  # of lengths below 1 m in float64, with margin


def test_grids_are_row_major_and_transducers_point_their_own_way():
    array = at.TransducerArray.grid((2, 3), pitch=10e-3, center=(1e-3, 50e-3, 50e-3))
    expected = [[1, y, z] for y in (45, 55) for z in (40, 50, 60)]  # normal x: u is y, v is z
    # Decimal millimetres are not exact in binary: a few roundings at 0.1 m.
    torch.testing.assert_close(1e3 * array.positions, torch.tensor(expected).double(), rtol=1e-14, atol=0)
    assert torch.equal(array.normals, torch.tensor([[1.0, 0.0, 0.0]]).double().repeat(6, 1))
    assert len(array) == 6
    positions = torch.tensor([[0.0, 0, 0], [0, 0.01, 0]], requires_grad=True)
    array = at.TransducerArray(positions, [[2, 0, 0], [0, 3, 4]])
    assert not array.positions.requires_grad
    assert array.source_strength == at.PAPER_SOURCE_STRENGTH == 1 / (4 * np.pi)
    assert array.normals.tolist() == [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]


@pytest.mark.parametrize("convert", [torch.from_numpy, np.asarray], ids=["tensor", "numpy"])
def test_array_keeps_its_own_copy(convert):
    positions = convert(np.array([[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]))
    array = at.TransducerArray(positions, (1, 0, 0))
    positions[1, 1] = 5.0
    assert array.positions.tolist() == [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]
    assert array.positions.dtype == torch.float64


def test_nodes_of_a_point_and_half_extents_of_a_disc():
    points, zero = (
        at.TransducerArray.grid((2, 2), pitch=10e-3, center=(0, 0, 0), radius=radius) for radius in (None, 0)
    )
    assert points.radius == zero.radius == 0
    for array in (points, zero):
        positions, weights = array.nodes
        assert torch.equal(positions[:, 0], array.positions)
        assert weights.tolist() == [1.0]
        assert not array.half_extents.any()
    array = at.TransducerArray([[0, 0, 0]], (1, 2, 3), radius=5e-3)
    circle = at.circle_points((0, 0, 0), 5e-3, 3600, (1, 2, 3))
    # the nearest of 3600 points is at most 1/20 degree off: 4e-7 of the radius
    torch.testing.assert_close(array.half_extents[0], circle.amax(dim=0), rtol=1e-6, atol=0)


def test_nodes_lie_on_the_discs_and_have_their_moments():
    """Mean of x^2 over a disc of radius a: a^2/4; of x^4: a^4/8; of x^2 y^2: a^4/24; odd powers vanish."""
    normals = torch.tensor([[0, 0, 1], [1, 2, 3]]).double()
    array = at.TransducerArray([[0, 0, 0], [0.01, 0, 0]], normals, radius=5e-3)
    positions, weights = array.nodes
    assert positions.shape == (2, len(weights), 3)
    x, y, z = (positions[0] / 5e-3).unbind(dim=1)
    moments = [x**0, x, x**2, x**4, x**2 * y**2, x * y, x**3, z**2]
    found = torch.stack([weights @ moment for moment in moments])
    expected = torch.tensor([1, 0, 1 / 4, 1 / 8, 1 / 24, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=1e-15)  # rounding of 80 terms
    # tilted: in the plane of the disc, and around its middle
    offset = positions[1] - array.positions[1]
    assert (offset @ array.normals[1]).abs().max() < 1e-17
    torch.testing.assert_close(weights @ offset, torch.zeros(3).double(), rtol=0, atol=1e-17)
    assert offset.norm(dim=1).max() < 5e-3
    assert (offset.abs().amax(dim=0) <= array.half_extents[1]).all()


@pytest.mark.parametrize("size", [6.0, 11.0, 40.0])
def test_monopoles_on_a_grid_have_the_directivity_of_a_disc(size):
    """Waves along the disc, between the directions of its monopoles too; 1.2e-7 was measured."""
    array = at.TransducerArray([[0, 0, 0]], (0, 0, 1), radius=size / 733.0)
    discs, turns = apertures_of(array, 733.0), torch.linspace(0, 0.4, 9, dtype=torch.float64)
    ways = torch.stack([torch.cos(turns), torch.sin(turns), 0 * turns])
    mean = discs.weights.to(torch.complex128) @ torch.exp(733j * (discs.positions[0] @ ways))
    assert (mean - 2 * j1(size) / size).abs().max() < 1e-6


def test_autd3_counts_row_by_row_and_its_units_lie_side_by_side():
    array = at.TransducerArray.autd3((0, 0, 0), normal=(0, 0, 1))
    place = (array.positions[:, :2] - array.positions[0, :2]) / PITCH
    counted = place.round().long().tolist()
    # As autd3-core 0.12 has them: 18 in the first row; (1, 1), (2, 1) and (16, 1) are missing in the second.
    assert len(array) == 249
    assert counted[17:20] == [[17, 0], [0, 1], [3, 1]]
    assert counted[31:34] == [[15, 1], [17, 1], [0, 2]]
    assert counted[248] == [17, 13]
    torch.testing.assert_close(place, place.round(), rtol=0, atol=1e-9)
    corners = torch.stack((array.positions[0], array.positions[248]))
    assert corners.mean(dim=0).abs().max() < ROUNDING
    one = at.TransducerArray.autd3((1e-3, 50e-3, 50e-3))
    four = at.TransducerArray.autd3((1e-3, 50e-3, 50e-3), units=(2, 2))
    assert (len(one), len(four)) == (249, 996)
    assert four.positions.mean(0) == pytest.approx(one.positions.mean(0), abs=ROUNDING)
    extent = four.positions.amax(0) - four.positions.amin(0)
    assert extent[1:] == pytest.approx([AUTD3_UNIT[0] + 17 * PITCH, AUTD3_UNIT[1] + 13 * PITCH], abs=ROUNDING)
    assert four.positions[249] - four.positions[0] == pytest.approx([0, 0, AUTD3_UNIT[1]], abs=ROUNDING)
    nearest = distances(four.positions, four.positions).fill_diagonal_(1)
    assert float(nearest.min()) == pytest.approx(PITCH, abs=ROUNDING)


def test_square_boards_begin_at_the_top_left():
    rows = at.TransducerArray.sonicsurface((0, 0, 0), normal=(0, 0, 1)).positions * 1e3
    columns = at.TransducerArray.openmpd((0, 0, 0), normal=(0, 0, 1)).positions * 1e3
    first, right, below, last = [-78.75, 78.75, 0], [-68.25, 78.75, 0], [-78.75, 68.25, 0], [78.75, -78.75, 0]
    for positions, second, seventeenth in ((rows, right, below), (columns, below, right)):
        for index, place in ((0, first), (1, second), (16, seventeenth), (255, last)):
            assert positions[index].tolist() == pytest.approx(place, abs=1e-9)


@pytest.mark.parametrize("device", ["autd3", "sonicsurface", "openmpd"])
def test_devices_go_where_they_are_put(device):
    make = getattr(at.TransducerArray, device)
    flat = make((0, 0, 0), normal=(0, 0, 1))
    turned = make((0.1, 0.2, 0.3), normal=(0, 2, 0), angle=math.pi / 2)
    # Facing +y, (u, v) is (z, x); turned by a right angle, the device's x is v = x and its y is -u = -z.
    x, y, _ = flat.positions.T
    expected = torch.stack((0.1 + x, torch.full_like(x, 0.2), 0.3 - y), dim=1)
    torch.testing.assert_close(turned.positions, expected, rtol=0, atol=ROUNDING)
    assert turned.normals[0].tolist() == [0, 1, 0]
    assert turned.radius == 4.5e-3
    assert make((0, 0, 0), source_strength=2.0, radius=0).source_strength == 2.0


BOARD = """FT123456
4
128
(-0.005, 0.005, 0.0),(-0.005, -0.005, 0.0),(0.005, 0.005, 0.0),(0.005, -0.005, 0.0),
2,0,
3,1,
90,-45,0,
180,
1.000000,0.500000,1.000000,1.000000,
"""


@pytest.fixture
def board(tmp_path):
    path = tmp_path / "board_1.pat"
    path.write_text(BOARD)
    return path


def test_a_board_is_read_in_full_calibrates_drives_and_orders_them_by_pin(board):
    read = at.OpenMPDBoard.load(board)
    assert (read.name, read.pins) == ("FT123456", (2, 0, 3, 1))
    assert read.positions.tolist() == [[-5e-3, 5e-3, 0], [-5e-3, -5e-3, 0], [5e-3, 5e-3, 0], [5e-3, -5e-3, 0]]
    assert read.phase_offsets.tolist() == pytest.approx([math.pi / 2, -math.pi / 4, 0, math.pi])
    assert read.gains.tolist() == [1, 0.5, 1, 1]
    sent = at.OpenMPDBoard.load(board).calibrated([1 + 0j, 1 + 0j, 1j, 1 + 0j])
    # A transducer that is a quarter of a period ahead in arg q is sent a quarter less.
    expected = torch.tensor([-1j, 0.5 * np.exp(0.25j * np.pi), 1j, -1 + 0j], dtype=torch.complex128)
    torch.testing.assert_close(sent, expected, rtol=0, atol=1e-15)
    drive = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.complex128)
    assert at.OpenMPDBoard.load(board).by_pin(drive).tolist() == [0.2, 0.4, 0.1, 0.3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("(0.005, 0.005, 0.0)", "(0.005, 0.005)"), r"board_1.pat, line 4: position .*; must be \(x, y, z\)"),
        (("(-0.005, 0.005, 0.0),", ""), r"board_1.pat: 3 positions \(x, y, z\); must be 4"),
        (("(-0.005,", "(abc,"), r"line 4: position 'abc'; must be a finite number"),
        (("3,1,", "3,3,"), r"line 6: pin '3'; must be one of 0 to 3, each once"),
        (("2,0,", "2,0.5,"), r"line 5: pin '0.5'; must be an integer"),
        (("180,", "nan,"), r"line 8: phase offset 'nan'; must be a finite number"),
        (("180,", ""), r"board_1.pat: 11 numbers after the positions; must be 4 pins, 4 phase offsets"),
        (("0.500000", "1.5"), r"line 9: gain '1.5'; must be in \[0, 1\]"),
        (("\n128\n", "\n256\n"), r"line 3: number of phase levels '256'; must be 128"),
        (("\n4\n", "\nfour\n"), r"line 2: number of transducers 'four'; must be an integer"),
        ((BOARD, "1\n"), r"board_1.pat: 1 lines; must hold"),
    ],
)
def test_what_is_wrong_with_a_board_is_said_with_its_line(board, change, message):
    board.write_text(BOARD.replace(*change))
    with pytest.raises(ValueError, match=message):
        at.OpenMPDBoard.load(board)


def test_board_becomes_the_array_of_a_scene(board):
    (board.parent / "scene.yaml").write_text("""
frequency: 40e3
medium: {density: 1.2, sound_speed: 343.0}
array: {type: file, path: board_1.pat, center: [0, 0, 20e-3], normal: [0, 0, -1], radius: 0}
control_points: {type: points, positions: [[0, 0, -80e-3]]}
""")
    array = at.load_scene(board.parent / "scene.yaml").array
    # Facing -z, (u, v) is (x, -y), so that the board is turned over about x.
    expected = at.OpenMPDBoard.load(board).positions * torch.tensor([1.0, -1.0, -1.0])
    expected[:, 2] += 20e-3
    torch.testing.assert_close(array.positions, expected, rtol=0, atol=1e-15)
    assert (array.normals == torch.tensor([0.0, 0.0, -1.0])).all()
    assert (array.source_strength, array.radius) == (OPENMPD_SOURCE_STRENGTH, 0)


def test_csv_and_npz_files_have_units_normals_and_defaults(tmp_path):
    path = tmp_path / "array.csv"
    path.write_text("# my array\nz [m], x [mm], y [mm]\n0.5, 10, 20\n\n0.5, -10, 20\n")
    array = at.load_array(path, source_strength=2.0)
    torch.testing.assert_close(
        array.positions, torch.tensor([[10e-3, 20e-3, 0.5], [-10e-3, 20e-3, 0.5]]).double(), rtol=0, atol=1e-9
    )
    assert array.normals.tolist() == [[0, 0, 1], [0, 0, 1]]
    assert (array.source_strength, array.radius) == (2.0, 0)
    path = tmp_path / "array.csv"
    path.write_text("x [m],y [m],z [m],nx,ny,nz\n0.01,0,0,1,0,0\n0,0,0,0,0,2\n")
    array = at.load_array(path, center=(0, 0, 1), normal=(1, 0, 0))
    # Facing +x, the file's x goes to u = y and its z to x.
    assert array.positions.tolist() == [[0, 0.01, 1], [0, 0, 1]]
    assert array.normals.tolist() == [[0, 1, 0], [1, 0, 0]]
    array = at.TransducerArray.grid((2, 3), 10e-3, (0, 0, 0), radius=4e-3)
    np.savez(tmp_path / "array.npz", positions=array.positions, normals=array.normals)
    read = at.load_array(tmp_path / "array.npz")
    assert torch.equal(read.positions, array.positions)
    assert torch.equal(read.normals, array.normals)
    assert (read.source_strength, read.radius) == (at.PAPER_SOURCE_STRENGTH, 0)
    for name, message in (
        ("a.npz", "must hold plain NumPy arrays"),
        ("a.txt", "must end in one of .csv, .npz, .pat"),
    ):
        (tmp_path / name).write_text("text")
        with pytest.raises(ValueError, match=rf"{name}.*; {message}"):
            at.load_array(tmp_path / name)
