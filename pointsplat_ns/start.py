"""The program ``pointsplat`` from its first moment, with as little as can be imported before Ctrl-C
is caught."""

import signal
import sys
from types import FrameType


def program() -> None:
    """Import the command line and run it (:func:`pointsplat_ns.cli.program`). Ctrl-C while it is
    being imported ends the program as it does later: one word, status 130."""
    try:
        _defer_signals_while_importing()
        from pointsplat_ns import cli

        cli.program()
    except KeyboardInterrupt:
        if sys.stderr is not None:
            sys.stderr.write("interrupted\n")
        sys.exit(130)


def _defer_signals_while_importing() -> None:
    """Let Ctrl-C, a lost terminal (SIGHUP) and a termination request (SIGTERM) wait until no module
    is being imported. In the middle of one, libraries such as numpy print a traceback, swallow the
    interrupt, or end as if they were not installed."""
    if not hasattr(signal, "setitimer"):  # Windows
        return
    waiting: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        if number != signal.SIGALRM and number not in waiting:
            waiting.append(number)
        if _is_importing(frame):
            signal.setitimer(signal.ITIMER_REAL, 0.02)
            return
        if waiting:
            number = waiting.pop(0)
            waiting.clear()
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            sys.exit(128 + number)

    for number, usual in (
        (signal.SIGINT, signal.default_int_handler),
        (signal.SIGTERM, signal.SIG_DFL),
        (signal.SIGHUP, signal.SIG_DFL),
        (signal.SIGALRM, signal.SIG_DFL),
    ):
        if signal.getsignal(number) is usual:  # another one, as under nohup, stays
            signal.signal(number, end)


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a frame belongs to an import."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
