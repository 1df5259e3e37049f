"""Frames of a camera from files, functions and a USB camera, and files that are wrong."""

import contextlib
import io
import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from autdtorch import hardware as hw
from autdtorch.hardware.camera import frames as camera_frames

DEGREES = np.array([[21.5, 22.25, 23.0], [24.0, -3.5, 150.25]])


@pytest.fixture
def clock():
    """A clock that goes on in sleeps alone, with `events` by the time they are due."""

    def sleep(seconds):
        clock.now += seconds
        for due in [time for time in clock.events if time <= clock.now]:
            clock.events.pop(due)()

    clock = SimpleNamespace(now=1000.0, sleep=sleep, events={})
    return clock


def folder_frames(folder, clock, **settings):
    return hw.FolderFrames(folder, clock=lambda: clock.now, sleep=clock.sleep, **settings)


def frames_of(source, seconds):
    source.wait(seconds)
    return source.frames()


def write(path, degrees=DEGREES, time=1000.0):
    """Write a file by its suffix; integers are hundredths of a kelvin."""
    counts = np.round(100 * (degrees + 273.15)).astype(np.uint16)
    if path.suffix == ".npy":
        np.save(path, counts if path.stem.startswith("counts") else degrees)
    elif path.suffix == ".csv":
        np.savetxt(path, degrees, delimiter=",", fmt="%.6f")
    else:
        Image.fromarray(counts).save(path)
    os.utime(path, (time, time))


@pytest.mark.parametrize("name", ["a1.csv", "a1.tif", "a1.tiff", "a1.npy", "counts1.npy", "a1.TIFF"])
def test_files_of_every_kind_are_degrees(tmp_path, clock, name):
    source = folder_frames(tmp_path, clock, scale=0.01, zero=-273.15)
    write(tmp_path / name, time=1000.5)
    write(tmp_path / f".hidden{name}")
    (frame,) = frames_of(source, 0.1)
    assert frame.time == 1000.5
    np.testing.assert_allclose(frame.image, DEGREES, atol=5.1e-3)  # half a count
    assert frames_of(source, 0.1) == []


@pytest.mark.parametrize(
    "text",
    [
        "21.5,22.25\r\n23,24\r\n",
        "21,5;22,25\n23;24\n",
        "\ufeff21.5,22.25,\n\n23,24,\n",
        "21.5;22.25\n23;24\n",
    ],
)
def test_csv_of_many_programs_is_read(tmp_path, clock, text):
    source = folder_frames(tmp_path, clock)
    (tmp_path / "1.csv").write_bytes(text.encode())
    assert frames_of(source, 0.1)[0].image.tolist() == [[21.5, 22.25], [23.0, 24.0]]


def test_frames_come_in_the_order_of_their_numbers_and_old_ones_are_dropped(tmp_path, clock):
    for number in (1, 2):
        write(tmp_path / f"frame{number}.npy")
    source = folder_frames(tmp_path, clock, rate=10)
    for number in (10, 9, 12):
        write(tmp_path / f"frame{number}.npy", DEGREES + number, time=1000 + 0.1 * number)
    clock.events[1000.2] = lambda: write(tmp_path / "frame13.npy", DEGREES + 13)
    frames = frames_of(source, 0.5)
    assert [float(frame.image[0, 0] - 21.5) for frame in frames] == [9, 10, 12, 13]
    assert [frame.time for frame in frames] == pytest.approx([1000.9, 1001.0, 1001.2, 1001.3])
    write(tmp_path / "frame14.npy")
    source.begin()
    assert frames_of(source, 0.1) == []


def test_files_that_were_read_are_deleted_if_asked(tmp_path, clock):
    source = folder_frames(tmp_path, clock, delete=True)
    write(tmp_path / "1.npy")
    assert len(frames_of(source, 0.1)) == 1
    write(tmp_path / "1.npy")  # a name may come again
    assert len(frames_of(source, 0.1)) == 1
    write(tmp_path / "2.npy")
    source.begin()
    assert not list(tmp_path.iterdir())


def test_a_file_that_grows_is_read_once_it_is_whole(tmp_path, clock):
    write(tmp_path / "whole.csv")
    whole = (tmp_path / "whole.csv").read_bytes()
    source = folder_frames(tmp_path, clock)
    write(tmp_path / "1.csv")
    path = tmp_path / "2.csv"
    for time, size in ((1000.02, 0), (1000.05, 10), (1000.1, len(whole) // 2), (1000.15, len(whole))):
        clock.events[time] = lambda size=size: path.write_bytes(whole[:size])
    frames = frames_of(source, 0.5)
    assert [frame.image.shape for frame in frames] == [DEGREES.shape] * 2


def tiff_of(width: int, height: int) -> bytes:
    """A file of 2 x 2 pixels that says it has others."""
    file = io.BytesIO()
    Image.fromarray(np.zeros((2, 2), np.uint16)).save(file, format="TIFF")
    content = bytearray(file.getvalue())
    start = int.from_bytes(content[4:8], "little") + 2
    for entry in range(int.from_bytes(content[start - 2 : start], "little")):
        place = start + 12 * entry
        tag = int.from_bytes(content[place : place + 2], "little")
        if tag in (256, 257):
            content[place + 2 : place + 4] = (4).to_bytes(2, "little")
            content[place + 8 : place + 12] = (width if tag == 256 else height).to_bytes(4, "little")
    return bytes(content)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("1.csv", b"21.5,hot\n"),
        ("1.csv", b"1,2\n3\n"),
        ("1.csv", b"21.5,22"),
        ("1.npy", b"\x93NUMPY\x01"),
        ("1.tif", b"II*\x00\x08\x00\x00\x00"),
        ("1.tif", b""),
        ("1.tif", tiff_of(60_000, 60_000)),
        ("1.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': '<u2',("),
    ],
)
def test_a_file_that_stays_broken_is_left_out_with_a_warning(tmp_path, clock, caplog, name, content):
    source = folder_frames(tmp_path, clock)
    (tmp_path / name).write_bytes(content)
    write(tmp_path / "2.npy")
    assert len(frames_of(source, 1.0)) == 1
    (line,) = caplog.messages
    assert "no whole frame" in line
    assert "\n" not in line


def test_colours_objects_and_the_largest_integer(tmp_path, clock, caplog):
    source = folder_frames(tmp_path, clock, scale=0.1)
    np.save(tmp_path / "1.npy", np.zeros((2, 3, 3)))
    np.save(tmp_path / "2.npy", np.array([{}]), allow_pickle=True)
    np.save(tmp_path / "3.npy", np.array([[2**16 - 1, 100]], np.uint16))
    (frame,) = frames_of(source, 1.0)
    np.testing.assert_allclose(frame.image, [[np.nan, 10.0]])
    assert len(caplog.messages) == 2


def test_a_folder_that_is_not_there_or_may_not_be_read_says_so(tmp_path, clock, monkeypatch):
    with pytest.raises(hw.SensorError, match="must be the folder into which"):
        folder_frames(tmp_path / "nowhere", clock)
    source = folder_frames(tmp_path, clock)
    write(tmp_path / "1.npy")
    with monkeypatch.context() as patch:
        patch.setattr(np, "load", lambda *_, **__: (_ for _ in ()).throw(PermissionError("denied")))
        with pytest.raises(hw.SensorError, match=r"1\.npy: may not be read"):
            frames_of(source, 0.1)
    source = folder_frames(tmp_path, clock, rate=30)
    write(tmp_path / "frame.npy")
    with pytest.raises(hw.SensorError, match="names must count the frames"):
        frames_of(source, 0.1)


def test_infinite_numbers_are_gaps(tmp_path, clock):
    source = folder_frames(tmp_path, clock)
    (tmp_path / "1.csv").write_text("21.5,inf\n-inf,22\n")
    (frame,) = frames_of(source, 0.1)
    np.testing.assert_array_equal(frame.image, [[21.5, np.nan], [np.nan, 22]])


def test_a_function_that_does_not_wait_for_the_next_frame_is_refused(monkeypatch):
    monkeypatch.setattr(camera_frames, "_MOST_VALUES", 100)
    source = hw.CallableFrames(lambda: DEGREES, clock=lambda: 0.0)
    with pytest.raises(hw.SensorError, match=r"take: \d+ frames in a reading; must wait"):
        source.wait(1.0)


def test_a_function_gives_frames_until_it_fails():
    images = iter([DEGREES, None, DEGREES + 1, DEGREES[0]])
    times = iter(np.arange(0, 9, 0.05))
    source = hw.CallableFrames(lambda: next(images), clock=lambda: next(times))
    frames = frames_of(source, 0.3)
    assert [float(frame.image[0, 0]) for frame in frames] == [21.5, 22.5]
    with pytest.raises(hw.SensorError, match=r"no frame of the camera: .*one number a pixel"):
        frames_of(source, 0.4)
    with pytest.raises(hw.SensorError, match="no frame of the camera"):
        source.begin() or frames_of(source, 0.4)


@contextlib.contextmanager
def usb_camera(monkeypatch, images):
    """A stand-in for OpenCV with one camera."""

    class Camera:
        def __init__(self, number):
            self.settings, self.is_there = {}, number == 0

        def set(self, key, value):
            self.settings[key] = value

        def isOpened(self):
            return self.is_there

        def read(self):
            image = next(images, None)
            return image is not None, image

        def release(self):
            released.append(self.settings)

    released = []
    fourcc = SimpleNamespace(
        VideoCapture=Camera,
        CAP_PROP_FOURCC=6,
        CAP_PROP_CONVERT_RGB=16,
        VideoWriter_fourcc=lambda *letters: "".join(letters),
    )
    monkeypatch.setitem(sys.modules, "cv2", fourcc)
    yield released
    assert released[-1] == {6: "Y16 ", 16: 0}


def test_a_usb_camera_gives_degrees_and_is_released_when_it_is_unplugged(monkeypatch):
    counts = np.full((2, 3), 29515, np.uint16)
    with usb_camera(monkeypatch, iter([counts] * 12)) as released:
        with pytest.raises(hw.SensorError, match="unplugged"), hw.uvc_frames() as source:
            source.begin() or frames_of(source, 10.0)
        assert len(released) == 1
        with pytest.raises(hw.SensorError, match="cannot be opened"), hw.uvc_frames(1):
            pass
    with usb_camera(monkeypatch, iter([counts])), hw.uvc_frames() as source:
        image = source._image()
        np.testing.assert_allclose(image, 22.0)
    colours = np.zeros((2, 3, 3), np.uint8)
    with (
        usb_camera(monkeypatch, iter([colours])),
        hw.uvc_frames() as source,
        pytest.raises(hw.SensorError, match="16-bit integers"),
    ):
        frames_of(source, 1.0)


def test_a_usb_camera_needs_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"autdtorch\[camera\]"), hw.uvc_frames():
        pass
