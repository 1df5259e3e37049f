"""Compare methods, and show what can be done with them."""

import sys

from shared.runner import run

if __name__ == "__main__":
    sys.exit(run("studies", __doc__))
