"""The program ``pointsplat`` from its first moment, with as little as can be imported before Ctrl-C
is caught."""

import signal
import threading
from types import FrameType


class _Asked(BaseException):
    """The program was asked to end while it was being imported."""


def program() -> None:
    """Import the command line and run it (:func:`pointsplat_ns.cli.program`).

    Ctrl-C, a lost terminal or a termination request while it is being imported ends the program as
    it does later, as soon as the module at hand is imported: in the middle of one, libraries print
    tracebacks or swallow the interrupt.
    """
    asked: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        asked.append(number)

    numbers = [
        getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
    ]
    usual = (signal.SIG_DFL, signal.default_int_handler)
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            if signal.getsignal(number) in usual:
                before[number] = signal.signal(number, note)
