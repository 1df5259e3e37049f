"""AUTD3 by its kit, against the emulator of its network protocol that the kit brings."""

import asyncio
import contextlib
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch
from small_scenes import random_frames

from autdtorch.hardware import AUTD3, LimitedLink, LimitError, Limits, LinkError, open_autd3
from autdtorch.hardware.devices import autd3 as module
from autdtorch.hardware.devices.autd3 import Autd3Port
from autdtorch.hardware.safety import Signalled, ended_by_signals

#: A process of its own can be stopped: boards that fall silent.
BOARDS = """
import autd3, sys
boards = autd3.UdpEmulator(1)
print(str(boards.option().iface).split('"')[1], flush=True)
sys.stdin.read()
"""


def noted(monkeypatch, method, note):
    """A list that grows by `note` of the arguments with each call of a method of `Autd3Port`."""

    def call(port, *arguments):
        real(port, *arguments)
        notes.append(note(*arguments))

    real, notes = getattr(Autd3Port, method), []
    monkeypatch.setattr(Autd3Port, method, call)
    return notes


class Noting:
    """The kit's client, noting what the boards have taken: of each pattern, whether something is on."""

    def __init__(self, client, monkeypatch):
        def labelled(data, boards):
            return any(data), pattern(data, boards)

        pattern = module.autd3_pattern
        monkeypatch.setattr(module, "autd3_pattern", labelled)
        self.client = client
        self.sending = False
        self.on = []

    async def send(self, labelled):
        on, command = labelled
        assert not self.sending, "two commands at once"
        self.sending = True
        try:
            await self.client.send(command)
        finally:
            self.sending = False
        self.on.append(on)

    async def close(self):
        await self.client.close()


class Mute:
    """A client whose boards never answer."""

    async def send(self, command):
        await asyncio.Event().wait()

    async def close(self):
        await asyncio.Event().wait()


@pytest.mark.usefixtures("kit")
class TestWithTheKit:
    def test_boards_on_the_network_take_the_drives_and_are_off_in_the_end(self, kit, monkeypatch):
        from autd3.commands import Clear, Pattern

        sent = noted(monkeypatch, "_send", lambda what, command: type(command))
        boards = kit.UdpEmulator(2)
        with open_autd3(2, range(300), boards.option(), settle=0) as link:
            link.play(random_frames(1, 300)[0])
        assert sent == [Clear, *5 * [Pattern]]  # off twice, the drive, off twice
        with pytest.raises(ValueError, match=r"from 0 to 497"):
            open_autd3(2, [498], boards.option())

    def test_the_timer_of_a_limited_link_switches_them_off(self, kit, monkeypatch):
        played = noted(monkeypatch, "write", any)
        boards = kit.UdpEmulator(1)
        with open_autd3(1, network=boards.option(), settle=0) as link:
            limited = LimitedLink(link, Limits(1.0, seconds_in_a_row=0.02))
            limited.play(random_frames(1, 249)[0])
            limited._timer.join()
            loops = [thread.daemon for thread in threading.enumerate() if thread.name == "AUTD3"]
            assert loops
            assert all(loops)  # for others Python would wait before it exits
            assert played[2:] == [True, False, False]  # after the two of opening; on, then off twice
            with pytest.raises(LimitError, match="in a row"):
                limited.require_on()

    @pytest.mark.timeout(120)
    def test_signals_at_any_moment_leave_the_boards_off(self, kit, monkeypatch, signalled_all_the_time):
        drive, boards = random_frames(1, 249)[0], kit.UdpEmulator(1)
        with open_autd3(1, network=boards.option(), settle=0) as link:
            link._port._client = client = Noting(link._port._client, monkeypatch)
            with signalled_all_the_time():
                for _ in range(200):
                    with contextlib.suppress(Signalled), ended_by_signals():
                        try:
                            while True:
                                link.play(drive)
                        finally:
                            link.off()
                    assert not any(client.on[-2:])  # none yet where a signal came before the first `try`
        assert any(client.on)

    @pytest.mark.usefixtures("stray_signals_do_no_harm")
    def test_a_signal_while_boards_are_looked_for_lets_go_of_them(self, kit, monkeypatch):
        def run(port, what, work, seconds):
            async def signalled():
                if what == "be opened":
                    signal.pthread_kill(main, signal.SIGTERM)
                await work()

            real(port, what, signalled, seconds)

        real, main = Autd3Port._run, threading.main_thread().ident
        closed = noted(monkeypatch, "close", lambda: True)
        monkeypatch.setattr(Autd3Port, "_run", run)
        boards = kit.UdpEmulator(1)
        with pytest.raises(Signalled), ended_by_signals():
            open_autd3(1, network=boards.option())
        assert len(closed) == 1
        with open_autd3(1, network=boards.option()):
            pass

    def test_boards_that_vanish_are_an_error_and_no_hang(self, kit):
        boards = kit.UdpEmulator(1)
        link = open_autd3(1, network=boards.option(), settle=0)
        link.play(random_frames(1, 249)[0])
        del boards
        with pytest.raises(LinkError, match=r"AUTD3 cannot be written to: .*did not reply"):
            link.play(random_frames(1, 249)[0])
        with pytest.raises(LinkError, match=r"the outputs may still be on: switch the device's power off"):
            link.close()

    def test_no_answer_at_all_is_a_time_out(self, kit, monkeypatch):
        boards = kit.UdpEmulator(1)
        link = open_autd3(1, network=boards.option(), settle=0)
        client, link._port._client = link._port._client, Mute()
        with monkeypatch.context() as impatient:
            impatient.setattr(module, "_TIMEOUT", 0.02)
            with pytest.raises(LinkError, match=r"AUTD3 cannot be written to: no answer within 0.02 s"):
                link.play(random_frames(1, 249)[0])
        link._port._client = client  # the cable is in again
        link.play(random_frames(1, 249)[0])
        link._port._client = Mute()
        monkeypatch.setattr(module, "_TIMEOUT", 0.02)
        with pytest.raises(LinkError, match=r"no answer within 0.02 s; the outputs may still be on"):
            link.close()
        monkeypatch.setattr(module, "_OPENING_TIMEOUT", 0.02)
        with pytest.raises(LinkError, match=r"AUTD3 cannot be opened: no answer within 0.02 s"):
            open_autd3(1, network=boards.option())  # takes 0.3 s

    def test_a_network_that_pauses_loses_no_boards(self, kit):
        """By the kit's defaults 0.1 s of silence ends the link, and no board can be switched off any more."""
        command, pipe = [sys.executable, "-c", BOARDS], subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as boards:
            try:
                option = kit.UdpOption(kit.Interface.Addr(boards.stdout.readline().strip()))
                with open_autd3(1, network=option, settle=0) as link:
                    link.play(random_frames(1, 249)[0])
                    for pause in (0.3, 2.5):  # boards are lost in the second
                        boards.send_signal(signal.SIGSTOP)
                        time.sleep(pause)
                        boards.send_signal(signal.SIGCONT)
                        link.off()
            finally:
                boards.kill()

    def test_no_boards_are_an_error(self, kit):
        option = kit.UdpOption("127.0.0.1", enumeration_timeout=kit.Duration.from_millis(50))
        with pytest.raises(LinkError, match=r"AUTD3 cannot be opened: "):
            open_autd3(network=option)

    def test_the_emulated_firmware_plays_the_levels(self):
        emulator = pytest.importorskip("autd3_emulator", reason="install autdtorch[crosscheck]")
        from autd3.commands import SetSilencer
        from autd3_core import Autd3, Duration, Geometry

        drive = random_frames(1, 249)[0]

        def play(recorder):
            recorder.send([SetSilencer.disable(), module.autd3_pattern(AUTD3.frame(drive), 1)])
            recorder.tick(Duration.from_micros(100))

        record = emulator.Emulator(Geometry([Autd3()])).record(play)
        played = torch.from_numpy(record.phase().to_numpy()[:, -1].astype("int64"))
        assert torch.equal(played, AUTD3.levels(drive)[0])
