"""The ``pointsplat`` command."""

from __future__ import annotations

import logging
import sys


def main(args: list[str] | None = None) -> None:
    """Run one subcommand; input that cannot be used ends it with one line and exit status 1."""
    import tyro

    from pointsplat_ns.cli.compact import compact
    from pointsplat_ns.cli.demo import demo
    from pointsplat_ns.cli.make_refiner import make_refiner
    from pointsplat_ns.cli.scenes import export, prune
    from pointsplat_ns.cli.view import report, rooms
    from pointsplat_ns.errors import PointSplatError
    from pointsplat_ns.memory import keep_freed_memory

    keep_freed_memory()
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    commands = {
        "compact": compact,
        "prune": prune,
        "export": export,
        "report": report,
        "rooms": rooms,
        "make-refiner": make_refiner,
        "demo": demo,
    }
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="pointsplat", args=args)
    except PointSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
