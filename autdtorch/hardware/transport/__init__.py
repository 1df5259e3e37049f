"""The wires to devices: USB, the serial chips on it, measuring instruments, and the network of AUTD3."""
