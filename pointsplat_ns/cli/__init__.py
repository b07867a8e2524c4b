"""The ``pointsplat`` command: a thin layer over :mod:`pointsplat_ns`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class _PrintHandler(logging.Handler):
    """Prints what the package logs: findings on standard output, warnings on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        is_warning = record.levelno >= logging.WARNING
        print(self.format(record), file=sys.stderr if is_warning else sys.stdout)


@contextmanager
def _log_printed() -> Iterator[None]:
    """Print the package's log, from level INFO on, while the context is open."""
    logger = logging.getLogger("pointsplat_ns")
    handlers, propagate, level = logger.handlers, logger.propagate, logger.level
    logger.handlers, logger.propagate = [_PrintHandler()], False
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.handlers, logger.propagate = handlers, propagate
        logger.setLevel(level)


def main(args: list[str] | None = None) -> None:
    """Run one subcommand. Input that cannot be used ends it with one line and exit status 1."""
    import tyro

    from pointsplat_ns.cli.compact import compact
    from pointsplat_ns.cli.demo import demo
    from pointsplat_ns.cli.export import export
    from pointsplat_ns.cli.lod import lod
    from pointsplat_ns.cli.make_refiner import make_refiner
    from pointsplat_ns.cli.prune import prune
    from pointsplat_ns.cli.report import report
    from pointsplat_ns.cli.rooms import rooms
    from pointsplat_ns.errors import PointSplatError
    from pointsplat_ns.system.memory import keep_freed_memory

    keep_freed_memory()
    commands: dict[str, Callable[..., None]] = {
        "prune": prune,
        "compact": compact,
        "lod": lod,
        "export": export,
        "report": report,
        "rooms": rooms,
        "make-refiner": make_refiner,
        "demo": demo,
    }
    try:
        with _log_printed():
            tyro.extras.subcommand_cli_from_dict(commands, prog="pointsplat", args=args)
    except PointSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
