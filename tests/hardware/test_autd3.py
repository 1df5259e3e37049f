"""AUTD3 by its kit, against the emulator of its network protocol that the kit brings."""

import builtins

import pytest
import torch

from autdtorch.drive import drive_from_phases
from autdtorch.hardware import LimitedLink, LimitError, Limits, LinkError, open_autd3
from autdtorch.hardware.autd3 import Autd3Port, autd3_device
from autdtorch.hardware.levels import Levels, autd3_levels


def random_drive(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    phases, amplitudes = torch.rand((2, count), generator=generator, dtype=torch.float64)
    return drive_from_phases(2 * torch.pi * phases, amplitudes)


def test_a_frame_is_all_phases_then_all_intensities():
    drive = random_drive(498)
    frame = torch.tensor(list(autd3_device(boards=2).frame(drive)))
    assert all(map(torch.equal, Levels(frame[:498], frame[498:]), autd3_levels(drive)))
    assert not any(autd3_device().frame(0 * drive[:249]))
    played = autd3_device(boards=2).played(autd3_device(boards=2).frame(drive))
    torch.testing.assert_close(played, drive, rtol=0, atol=1 / 510 + torch.pi / 256)  # half a level each


def test_without_the_kit_there_is_a_hint(monkeypatch):
    def without(name: str, *arguments: object, **named: object):
        if name.split(".")[0] == "autd3":
            raise ModuleNotFoundError("No module named 'autd3'")
        return real(name, *arguments, **named)

    real = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'autdtorch\[autd3\]'"):
        open_autd3()


class TestWithTheKit:
    @pytest.fixture(autouse=True)
    def kit(self):
        pytest.importorskip("autd3_pattern", reason="the kit of AUTD3: install autdtorch[autd3]")
        return pytest.importorskip("autd3", reason="the kit of AUTD3: install autdtorch[autd3]")

    def test_boards_on_the_network_take_the_drives_and_are_off_in_the_end(self, kit, monkeypatch):
        from autd3.commands import Clear, Pattern

        def send_and_note(port, what, command):
            send(port, what, command)
            sent.append(type(command))

        send, sent = Autd3Port._send, []
        monkeypatch.setattr(Autd3Port, "_send", send_and_note)
        boards = kit.UdpEmulator(2)
        with open_autd3(2, range(300), boards.option(), settle=0) as link:
            link.play(random_drive(300))
        assert sent == [Clear, *5 * [Pattern]]  # off twice, the drive, off twice
        with pytest.raises(ValueError, match=r"from 0 to 497"):
            open_autd3(2, [498], boards.option())

    def test_the_timer_of_a_limited_link_switches_them_off(self, kit, monkeypatch):
        def write(port, data):
            real(port, data)
            played.append(any(data))

        real, played = Autd3Port.write, []
        monkeypatch.setattr(Autd3Port, "write", write)
        boards = kit.UdpEmulator(1)
        with open_autd3(1, network=boards.option(), settle=0) as link:
            limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.02))
            limited.play(random_drive(249))
            limited._timer.join()
            assert played[2:] == [True, False, False]  # after the two of opening; on, then off twice
            with pytest.raises(LimitError, match="in a row"):
                limited.require_on()

    def test_no_boards_are_an_error(self, kit):
        option = kit.UdpOption("127.0.0.1", enumeration_timeout=kit.Duration.from_millis(50))
        with pytest.raises(LinkError, match=r"AUTD3 cannot be opened: "):
            open_autd3(network=option)

    def test_the_emulated_firmware_plays_the_levels(self):
        emulator = pytest.importorskip("autd3_emulator", reason="install autdtorch[crosscheck]")
        from autd3.commands import SetSilencer
        from autd3_core import Autd3, Duration, Geometry

        from autdtorch.hardware.autd3 import autd3_pattern

        drive = random_drive(249)

        def play(recorder):
            recorder.send([SetSilencer.disable(), autd3_pattern(autd3_device().frame(drive), 1)])
            recorder.tick(Duration.from_micros(100))

        record = emulator.Emulator(Geometry([Autd3()])).record(play)
        played = torch.from_numpy(record.phase().to_numpy()[:, -1].astype("int64"))
        assert torch.equal(played, autd3_levels(drive).phase)
