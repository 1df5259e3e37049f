"""A bench without hardware: an emulated USB bus, the chips and firmwares on it, and an oscilloscope."""
