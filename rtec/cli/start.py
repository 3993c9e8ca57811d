"""Start of the program `rtec`: Ctrl-C ends it without a traceback, also while Python still loads its modules."""

import sys


def main() -> None:
    """Run the command line and leave with its status."""
    try:
        from rtec.cli.main import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(130)
