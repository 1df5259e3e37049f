"""Check what the documentation promises, by experiment and against other programs."""

import sys

from shared.runner import run

if __name__ == "__main__":
    sys.exit(run("checks", __doc__))
