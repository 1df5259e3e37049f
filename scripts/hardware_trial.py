"""Run a method on a device over USB, or on its emulator: `autdtorch` with the emulator by default.

    python scripts/hardware_trial.py method=gabs hardware.limits.amplitude=1
    python scripts/hardware_trial.py hardware=sonicsurface hardware/sensor=manual hardware.limits.amplitude=1

An interrupted trial goes on with the same command.
"""

import sys

from autdtorch.cli import main as command_line


def main() -> None:
    """Run the command line; its help begins with the docstring of this file."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
    if not any(word.startswith("hardware=") for word in sys.argv[1:]):
        sys.argv.append("hardware=emulated")
    command_line.main()


if __name__ == "__main__":
    main()
