"""A serial port by its name, on a pseudo-terminal in front of the emulated firmware."""

import os
import pty
import select
import tty

import pytest
import torch

from autdtorch.hardware import AUTD3, OPENMPD, SONICSURFACE, ULTRAINO, LinkError, open_link

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")


@pytest.fixture
def line():
    """The far end of a serial line, and the name of its port."""
    far, near = pty.openpty()
    tty.setraw(far)
    yield far, os.ttyname(near)
    os.close(far)
    os.close(near)


def received(far: int, count: int) -> bytes:
    """A number of bytes from the line; a busy kernel passes them on late, and in pieces."""
    data = b""
    while len(data) < count and select.select([far], [], [], 30)[0]:
        data += os.read(far, count - len(data))
    return data


@pytest.mark.parametrize("device", [SONICSURFACE, ULTRAINO])
def test_a_device_at_a_named_port_plays_and_is_off_in_the_end(line, device, monkeypatch):
    waited = []
    monkeypatch.setattr("time.sleep", waited.append)
    far, name = line
    firmware = device.firmware(device.transducers)
    full = torch.ones(device.transducers).cdouble()
    frame = len(device.frame(full))
    with open_link(device, port=name, settle=0) as link:
        assert waited[0] == device.boot_time
        firmware.receive(received(far, 2 * frame))
        assert not firmware.drive().any()
        os.write(far, b"an echo")  # dropped
        link.play(-full)
        firmware.receive(received(far, frame))
        torch.testing.assert_close(firmware.drive(), -full, rtol=0, atol=1e-14)
        with pytest.raises(LinkError, match=f"{name} cannot be opened"):
            open_link(device, port=name)
    firmware.receive(received(far, 2 * frame))
    assert not firmware.drive().any()


def test_a_line_that_takes_nothing_is_an_error_and_no_hang(line, monkeypatch):
    monkeypatch.setattr("autdtorch.hardware.transport.port._TIMEOUT", 0.02)
    _, name = line
    link = open_link(SONICSURFACE, port=name, settle=0)
    with pytest.raises(LinkError, match=rf"{name} cannot be written to: .*[Tt]imeout"):
        link._port.write(bytes(10**6))  # more than the line holds
    monkeypatch.setattr(link._port._port, "write", lambda data: (_ for _ in ()).throw(OSError("gone")))
    with pytest.raises(LinkError, match="gone; the outputs may still be on"):
        link.close()


@pytest.mark.parametrize(
    ("device", "port", "error", "message"),
    [
        (SONICSURFACE, "/dev/none", LinkError, r"/dev/none cannot be opened: .*\. Ports: "),
        (SONICSURFACE, 3, ValueError, "port: 3; must be a str"),
        (AUTD3, "/dev/none", ValueError, "port: '/dev/none'; must be None, as AUTD3 is on the network"),
        (OPENMPD, "/dev/none", ValueError, "port: '/dev/none'; must be None, as OpenMPD has no serial line"),
    ],
)
def test_a_port_that_cannot_be_opened_is_named(device, port, error, message):
    with pytest.raises(error, match=message):
        open_link(device, port=port)
