"""``python -m autdtorch`` is the command line."""

from autdtorch.cli import main

if __name__ == "__main__":
    main()
