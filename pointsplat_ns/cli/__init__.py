"""The ``pointsplat`` command: a thin layer over :mod:`pointsplat_ns`."""

from __future__ import annotations

import logging
import sys


class _Printed(logging.Handler):
    """Prints what the package finds to the person: findings on standard output, warnings on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        warns = record.levelno >= logging.WARNING
        print(self.format(record), file=sys.stderr if warns else sys.stdout)


def main(args: list[str] | None = None) -> None:
    """Run one subcommand; input that cannot be used ends it with one line and exit status 1."""
    import tyro

    from pointsplat_ns.cli.compact import compact
    from pointsplat_ns.cli.demo import demo
    from pointsplat_ns.cli.export import export
    from pointsplat_ns.cli.make_refiner import make_refiner
    from pointsplat_ns.cli.prune import prune
    from pointsplat_ns.cli.report import report
    from pointsplat_ns.cli.rooms import rooms
    from pointsplat_ns.errors import PointSplatError
    from pointsplat_ns.system.memory import keep_freed_memory

    keep_freed_memory()
    logger = logging.getLogger("pointsplat_ns")
    logger.handlers, logger.propagate = [_Printed()], False
    logger.setLevel(logging.INFO)
    commands = {
        "prune": prune,
        "compact": compact,
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
