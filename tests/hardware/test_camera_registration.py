"""Registration of a camera by marks and by foci."""

import numpy as np
import pytest
import torch
from shared.heated_screen import pinhole

from autdtorch.hardware import CallableFrames, ThermalCamera
from autdtorch.hardware.camera.registration import Registration, hot_spot
from autdtorch.scene.geometry import Plane

PLANE = Plane((0.01, 0.0, 0.15), (0.0, 0.0, 1.0), (0.1, 0.08))
IMAGE = (150, 160)


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_four_corners_register_a_camera(tilt: float) -> None:
    truth = pinhole(PLANE, IMAGE, tilt)
    half = np.array(PLANE.size) / 2
    corners = truth.to_pixels(half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]))
    registration = Registration.of(PLANE, corners, PLANE.corners)
    inside = np.random.default_rng(0).uniform(-1, 1, (20, 2)) * half
    np.testing.assert_allclose(registration.to_pixels(inside), truth.to_pixels(inside), atol=1e-8)
    np.testing.assert_allclose(registration.to_plane(truth.to_pixels(inside)), inside, atol=1e-11)
    assert registration.residual == 0


def test_the_residual_tells_the_error_of_the_marks() -> None:
    generator, truth = np.random.default_rng(1), pinhole(PLANE, IMAGE, 0.5)
    places = np.stack(np.meshgrid([-0.04, -0.01, 0.02, 0.05], [-0.03, 0.0, 0.03]), -1).reshape(-1, 2) * 0.9
    marks = torch.tensor(np.column_stack([places + np.array(PLANE.center[:2]), np.full(12, 0.15)]))
    pixels = truth.to_pixels(places) + generator.normal(0, 0.1, (12, 2))
    registration = Registration.of(PLANE, pixels, marks)
    # 0.1 pixels of 0.8 mm in each of two axes; 16 degrees of freedom scatter by a fifth.
    assert registration.residual == pytest.approx(0.08e-3 * 2**0.5, rel=0.6)
    pixels[3] += 10
    with pytest.warns(UserWarning, match="mark 3"):
        Registration.of(PLANE, pixels, marks)


def test_marks_in_a_line_are_refused() -> None:
    places = [[0.01, 0.0, 0.15], [0.02, 0.0, 0.15], [0.03, 0.0, 0.15], [0.04, 0.02, 0.15]]
    with pytest.raises(ValueError, match="line"):
        Registration.of(PLANE, [[0, 0], [10, 0], [20, 0], [30, 20]], places)
    with pytest.raises(ValueError, match="K >= 4"):
        Registration.of(PLANE, [[0, 0], [10, 0], [20, 10]], places[1:])
    with pytest.raises(ValueError, match="plane"):
        Registration.of(PLANE, [[0, 0], [10, 0], [20, 0], [30, 20]], [*places[:3], [0, 0, 0.2]])


def test_pixels_in_an_order_that_no_camera_sees_are_refused() -> None:
    corners = np.array([[10.0, 10.0], [12.0, 110.0], [150.0, 8.0], [155.0, 120.0]])
    registration = Registration.of(PLANE, corners, PLANE.corners)
    half = np.array(PLANE.size) / 2
    np.testing.assert_allclose(registration.to_pixels(-half), corners[0])
    for order in ([0, 1, 3, 2], [0, 3, 2, 1], [1, 0, 2, 3]):  # round the plane, and others that cross
        with pytest.raises(ValueError, match=r"pixels: .*order of the places"):
            Registration.of(PLANE, corners[order], PLANE.corners)
    with pytest.raises(ValueError, match=r"corners: pixels: .*order of the places"):
        ThermalCamera(CallableFrames(lambda: None), PLANE, corners[[0, 1, 3, 2]])
    with pytest.raises(ValueError, match=r"pixels: .*three of four in a line"):
        Registration.of(PLANE, [[0, 0], [1, 1], [2, 2], [3, 9]], PLANE.corners)
    with pytest.raises(ValueError, match="before the camera"):
        Registration(PLANE, np.array([[1.0, 0, 0], [0, 1, 0], [100 / half[0], 0, 1]]))


def test_an_image_is_sampled_on_the_plane() -> None:
    truth = pinhole(PLANE, IMAGE, 0.4)
    rows, columns = np.mgrid[:150, :160]
    places = truth.to_plane(np.stack([columns, rows], -1).astype(float))
    image = 20 + 100 * places[..., 0] - 50 * places[..., 1]
    image[60:62, 80] = np.nan
    grid = truth.on_grid(image, (50, 40))
    u, v = np.meshgrid(
        PLANE.size[0] * ((np.arange(50) + 0.5) / 50 - 0.5),
        PLANE.size[1] * ((np.arange(40) + 0.5) / 40 - 0.5),
        indexing="ij",
    )
    seen = np.isfinite(grid)
    assert 0.95 < seen.mean() < 1
    np.testing.assert_allclose(grid[seen], (20 + 100 * u - 50 * v)[seen], atol=0.01)


def test_a_hot_spot_is_found_to_a_part_of_a_pixel() -> None:
    generator = np.random.default_rng(2)
    rows, columns = np.mgrid[:60, :80]
    for _ in range(5):
        x, y = generator.uniform(15, 45, 2)
        rise = np.exp(-0.5 * (((columns - x) / 4.5) ** 2 + ((rows - y) / 3) ** 2)) + generator.normal(
            0, 0.02, (60, 80)
        )
        rise[generator.integers(60, size=40), generator.integers(80, size=40)] = np.nan
        # Noise of 2 % over about 40 pixels allows 0.02 pixels.
        np.testing.assert_allclose(hot_spot(rise), [x, y], atol=0.1)
    with pytest.raises(ValueError, match="noise"):
        hot_spot(generator.normal(0, 0.02, (60, 80)))
