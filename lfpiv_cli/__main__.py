"""`python -m lfpiv_cli` is the same as `lfpiv`."""

from lfpiv_cli.cli import main

if __name__ == "__main__":
    main()
