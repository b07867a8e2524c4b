"""The program ``pointsplat`` from its first moment, with as little as can be imported before Ctrl-C
is caught."""

import sys


def program() -> None:
    """Import the command line and run it (:func:`pointsplat_ns.cli.program`). Ctrl-C while it is
    being imported ends the program as it does later: one word, status 130."""
    try:
        from pointsplat_ns import cli

        cli.program()
    except KeyboardInterrupt:
        if sys.stderr is not None:
            sys.stderr.write("interrupted\n")
        sys.exit(130)
