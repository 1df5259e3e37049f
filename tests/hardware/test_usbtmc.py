"""Messages of USBTMC, against bytes worked out by hand and against the emulated instrument."""

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from autdtorch.hardware import LinkError
from autdtorch.hardware.emulator.bench import EmulatedBus
from autdtorch.hardware.emulator.emulated_scope import EmulatedInstrument
from autdtorch.hardware.sensors.scpi_scope import KEYSIGHT, RIGOL
from autdtorch.hardware.transport.usb import find_device
from autdtorch.hardware.transport.usbtmc import END, TELL, UsbtmcPort, announced, block, message

CHIP = (0x1AB1, 0x04CE)


class Echo:
    """Answers every line alike."""

    def __init__(self, said: bytes) -> None:
        self.said = said
        self.lines: list[str] = []

    def execute(self, line: str) -> bytes:
        self.lines.append(line)
        return self.said


def port_of(instrument: EmulatedInstrument) -> UsbtmcPort:
    return UsbtmcPort(find_device([CHIP], backend=EmulatedBus([instrument])))


def port_to(said: bytes, longest: int = 512, empty: bool = True) -> tuple[UsbtmcPort, Echo]:
    instrument = EmulatedInstrument(*CHIP, "E1", echo := Echo(said))
    instrument.longest, instrument.sends_empty_packets = longest, empty
    return port_of(instrument), echo


def test_a_message_is_header_text_and_padding():
    # MsgID 1, tag 2, its complement, 0; length 6; end; the text and two zeros.
    expected = "01 02 fd 00 06 00 00 00 01 00 00 00 2a 49 44 4e 3f 0a 00 00"
    assert message(TELL, 2, 6, END, b"*IDN?\n").hex(" ") == expected


def test_a_header_says_how_much_follows_and_whether_that_is_all():
    header = bytes([2, 7, 0xF8, 0, 3, 1, 0, 0])
    assert announced(header + b"\x01\0\0\0abc", 7) == (0x103, True)
    assert announced(header + b"\0\0\0\0abc", 7) == (0x103, False)


@pytest.mark.parametrize(
    "header",
    [
        "02 07 f8 00 03 00 00 00 01 00 00",  # too short
        "01 07 f8 00 03 00 00 00 01 00 00 00",  # another message
        "02 06 f9 00 03 00 00 00 01 00 00 00",  # another request
        "02 07 f9 00 03 00 00 00 01 00 00 00",  # tag and complement at odds
        "02 07 f8 00 00 00 00 80 01 00 00 00",  # 2 GiB
    ],
)
def test_a_header_that_is_no_answer_is_refused(header):
    with pytest.raises(LinkError, match=r"does not answer request 7|a header has 12"):
        announced(bytes.fromhex(header), 7)


@settings(max_examples=30, deadline=None)
@example(data=bytes(46), longest=52, empty=False)  # 12 + 52 bytes, a whole packet
@example(data=bytes(174), longest=500, empty=True)  # three whole packets
@example(data=bytes(174), longest=500, empty=False)
@given(data=st.binary(max_size=600), longest=st.integers(1, 700), empty=st.booleans())
def test_a_block_of_any_bytes_comes_back_from_transfers_of_any_length(data, longest, empty):
    port, echo = port_to(f"#3{len(data):03d}".encode() + data + b"\n", longest, empty)
    for _ in range(2):
        assert port.ask_block(":WAV:DATA?") == data
    assert echo.lines == 2 * [":WAV:DATA?"]


def test_what_broke_off_is_cleared_before_the_first_question():
    instrument = EmulatedInstrument(*CHIP, "E1", echo := Echo(b"1\n"))
    instrument.write(message(TELL, 1, 4, 0, b"*RST"))  # a message that does not end
    assert port_of(instrument).ask("*OPC?") == "1"
    assert echo.lines == ["*OPC?"]


def test_an_answer_that_nobody_read_is_read_before_the_clear_is_done():
    class Full(EmulatedInstrument):
        """Clears only once its endpoint is empty."""

        rest = b"1\n"

        def answer(self, kind: int, request: int) -> bytes | None:
            pending = request == 6 and self.rest  # CHECK_CLEAR_STATUS: STATUS_PENDING, bmClear
            return b"\x02\x01" if pending else super().answer(kind, request)

        def read(self, most: int) -> bytes:
            rest, self.rest = self.rest, b""
            return rest or super().read(most)

    assert port_of(Full(*CHIP, "E1", Echo(b"2\n"))).ask("*OPC?") == "2"


def test_tags_go_round():
    port, _ = port_to(b"1\n")
    assert {port.ask("*OPC?") for _ in range(150)} == {"1"}  # two tags each, of 255


@pytest.mark.parametrize(("said", "message"), [(b"\xff\xfe\n", "which is no text"), (b"", "timed out")])
def test_an_answer_that_is_no_text_or_does_not_come_is_an_error(said, message):
    with pytest.raises(LinkError, match=message):
        port_to(said)[0].ask("*IDN?")


@pytest.mark.parametrize(
    "data", [b"", b"abc", b"#", b"#0abc", b"#x12", b"#12", b"#3005abcd", b"#9-00000001a"]
)
def test_what_is_no_block_or_a_short_one_is_refused(data):
    with pytest.raises(LinkError, match="block"):
        block(data)


@pytest.mark.parametrize("preamble", ["", "1,2,3", ",".join(["x"] * 10), "0,0,3,1,0,0,0,1,0,0"])
def test_a_preamble_that_makes_no_waveform_is_refused(preamble):
    with pytest.raises(LinkError, match="preamble"):
        KEYSIGHT.waveform(preamble, b"abc")


def test_codes_become_volts_as_each_makers_guide_says():
    preamble, codes = "0,0,4,1,1e-6,0,0,0.02,0.5,100", bytes([0, 1, 110, 255])
    keysight = KEYSIGHT.waveform(preamble, codes)  # (code - reference) increment + origin
    torch.testing.assert_close(keysight.volts, torch.tensor([-1.5, -1.48, 0.7, 3.6], dtype=torch.float64))
    rigol = RIGOL.waveform(preamble.replace("0.5", "5"), codes)  # (code - origin - reference) increment
    torch.testing.assert_close(rigol.volts, torch.tensor([-2.1, -2.08, 0.1, 3.0], dtype=torch.float64))
    assert (keysight.clipped, rigol.clipped, keysight.time_step, keysight.resolution) == (3, 2, 1e-6, 0.02)
