"""`python -m rtec` is `rtec`."""

from rtec.cli.start import main

if __name__ == "__main__":
    main()
