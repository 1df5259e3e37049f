"""``python -m autdtorch`` is the command line."""

from autdtorch.cli.main import main

if __name__ == "__main__":
    main()
