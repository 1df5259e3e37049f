"""Measure run times and errors, and write their tables in the documentation."""

import sys

from shared.runner import run

if __name__ == "__main__":
    sys.exit(run("benchmarks", __doc__))
