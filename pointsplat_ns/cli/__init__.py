"""The ``pointsplat`` command: a thin layer over :mod:`pointsplat_ns`."""

from __future__ import annotations

import atexit
import gc
import importlib
import inspect
import io
import logging
import os
import re
import signal
import sys
import threading
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TextIO, cast

from pointsplat_ns.errors import PointSplatError, printable
from pointsplat_ns.system.terminal import say

COMMANDS = (
    "prune",
    "compact",
    "clean",
    "lod",
    "tradeoff",
    "convert",
    "info",
    "view",
    "render",
    "export",
    "demo",
)
"""The commands. Each is a function in a module of the same name, which is imported when the command
runs."""


class _Shown:
    """A text stream that shows control characters, such as those in the name of a file, instead of
    sending them. Colours and the moves of progress bars are sent, unless it is ``plain``; then it
    is no terminal to libraries, and gets none."""

    def __init__(self, stream: TextIO, plain: bool = False):
        self._stream = stream
        self._plain = plain

    def isatty(self) -> bool:
        return not self._plain and self._stream.isatty()

    def write(self, text: str) -> int:
        if self._plain:
            lines = text.split("\n")
            self._stream.write("\n".join(map(printable, lines)))
            return len(text)
        # Colours and the moves of progress bars, which are ours; then any other control characters,
        # which are not.
        steering = r"\x1b\[(?:[\d;]*m|\?25[lh]|\d*[AK])|[^\t\n\r\x20-\x7e\xa0-\U0010ffff]+"
        self._stream.write(
            re.sub(steering, lambda m: m[0] if m[0].startswith("\x1b[") else printable(m[0]), text)
        )
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def any_text_printable(plain: bool = False) -> Iterator[None]:
    """Let standard output and standard error take any text while the context is open.

    Streams that are closed go nowhere. Characters that an encoding lacks are replaced. Control
    characters are shown as Python writes them, such as ``\\x1b``; only colours and progress bars
    reach a terminal, and not these if ``plain``.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:  # the lowest free number is this one: no file that is written gets it
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    out, err = (stream or open(os.devnull, "w", encoding="utf-8") for stream in before)
    errors = out.errors
    if isinstance(out, io.TextIOWrapper):
        out.reconfigure(errors="replace")
    sys.stdout, sys.stderr = (cast(TextIO, _Shown(stream, plain)) for stream in (out, err))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        if isinstance(out, io.TextIOWrapper):
            out.reconfigure(errors=errors)


class _PrintHandler(logging.Handler):
    """Prints what the package logs: findings on standard output, warnings on standard error."""

    def emit(self, record: logging.LogRecord) -> None:
        is_warning = record.levelno >= logging.WARNING
        say(self.format(record), error=is_warning)


@contextmanager
def _log_printed(level_printed: int) -> Iterator[None]:
    """Print the package's log, from a level on, while the context is open."""
    logger = logging.getLogger("pointsplat_ns")
    handlers = logger.handlers
    propagate = logger.propagate
    level = logger.level
    logger.handlers = [_PrintHandler()]
    logger.propagate = False
    logger.setLevel(level_printed)
    try:
        yield
    finally:
        logger.handlers = handlers
        logger.propagate = propagate
        logger.setLevel(level)


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let a lost terminal (SIGHUP) and a termination request (SIGTERM) unwind the program as Ctrl-C
    does instead of killing it, so that unfinished files are removed and workers stopped."""

    def end(number: int, frame: Any) -> None:
        sys.exit(128 + number)

    numbers = [
        getattr(signal, name) for name in ("SIGHUP", "SIGTERM") if hasattr(signal, name)
    ]  # none on Windows
    if (
        threading.current_thread() is not threading.main_thread()
    ):  # only the main thread may set handlers
        numbers = []
    before = {n: signal.signal(n, end) for n in numbers if signal.getsignal(n) is signal.SIG_DFL}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _what_failed(error: Exception) -> str:
    """An error of the system in one line."""
    if isinstance(error, ModuleNotFoundError):
        return f"{error.name} is not installed; pip install pointsplat-ns adds what is missing"
    if isinstance(error, ImportError):
        return f"{error}; torch takes 4 GB of address space (ulimit -v)"
    from pointsplat_ns.system.files import one_line  # which imports torch

    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, RecursionError):
        return f"the input is nested too deeply ({one_line(error)})"
    if isinstance(error, (MemoryError, RuntimeError)):
        return f"not enough memory ({one_line(error)})"
    return one_line(error)


def _is_bug(error: Exception) -> bool:
    """Whether an error is none of the input or of the machine: a module of ours that is missing, a
    name that a module lacks, or a RuntimeError other than of torch's memory, which has no type of
    its own on a CPU."""
    if isinstance(error, ModuleNotFoundError):
        return error.name is None or error.name.startswith(__package__.partition(".")[0])
    if isinstance(error, ImportError):
        return "shared object" not in str(error)
    if not isinstance(error, RuntimeError) or isinstance(error, RecursionError):
        return False
    import torch

    return not isinstance(
        error, torch.cuda.OutOfMemoryError
    ) and "can't allocate memory" not in str(error)


def _ignore_matplotlibrc() -> None:
    """Keep matplotlib from obeying a file ``matplotlibrc`` in the current folder, which may be a
    stranger's, before the user's own. It looks for one when it is imported, so that is done
    elsewhere."""
    if not os.path.lexists("matplotlibrc"):
        return
    here = os.getcwd()
    os.chdir(os.sep)
    try:
        import matplotlib  # noqa: F401
    finally:
        os.chdir(here)


def _command(name: str, short: bool = False) -> Callable[..., None]:
    """The function of a command, in the module of the same name, with each option of its docstring
    on one line, as tyro's help and its completion in bash want it; if ``short``, with the first
    sentence alone. It is a copy, because tyro unwraps wrappers."""
    command: Any = getattr(importlib.import_module(f"{__package__}.{name}"), name)
    same = types.FunctionType(
        command.__code__, command.__globals__, command.__name__, command.__defaults__
    )
    same.__annotations__ = command.__annotations__
    same.__kwdefaults__ = command.__kwdefaults__
    text = inspect.getdoc(command) or ""
    same.__doc__ = (
        re.split(r"(?<=\.)\s", text, maxsplit=1)[0] if short else re.sub(r"\n {8,}", " ", text)
    )
    return same


def program() -> NoReturn:
    """The program ``pointsplat``: :func:`main`, then the end of the process with status 0, without
    unloading torch's libraries, which takes 0.4 CPU seconds."""
    gc.set_threshold(
        100_000
    )  # searching the objects of torch's modules for garbage takes 0.2 s by default
    main()
    atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    os._exit(0)


def main(args: list[str] | None = None) -> None:
    """Run one subcommand; by default that of the program's own arguments.

    Unusable input, files that cannot be read or written, a lack of memory and a missing package end
    it with one line and exit status 1; Ctrl-C ends it with 130, another signal with 128 plus its
    number. With ``--json``, standard output has one JSON value and nothing else.
    """
    args = sys.argv[1:] if args is None else args
    with any_text_printable(plain=not all(map(str.isprintable, args))):  # what tyro prints of them
        try:
            _run(args)
        except PointSplatError as error:
            text = f"error: {error}"
            status = 1
        except BrokenPipeError:  # of `pointsplat ... | head`
            os.dup2(
                os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
            )  # what it did not take is not tried again
            sys.exit(1)
        except (ImportError, OSError, MemoryError, RuntimeError) as error:
            if _is_bug(error):
                raise
            text = f"error: {printable(_what_failed(error))}"
            status = 1
        except KeyboardInterrupt:
            text = "interrupted"
            status = 130
        else:
            return
        say(text, error=True)
        sys.exit(status)


def _run(args: list[str]) -> None:
    """Run one subcommand. What it printed is with the reader when this returns or raises."""
    try:
        import tyro

        from pointsplat_ns import __version__
        from pointsplat_ns.cli.help import after_help
        from pointsplat_ns.cli.printing import only_json
        from pointsplat_ns.cli.scene_options import quantities
        from pointsplat_ns.system.memory import keep_freed_memory
        from pointsplat_ns.system.outputs import outputs_claimed

        keep_freed_memory()
        _ignore_matplotlibrc()
        level = logging.DEBUG if "--verbose" in args else logging.INFO
        with (
            _log_printed(level),
            _ended_by_signals(),
            outputs_claimed(),
            only_json(args),
            quantities(),
        ):
            if args == ["--version"]:
                say(f"pointsplat-ns {__version__}")
            elif args and args[0] in COMMANDS:
                tyro.cli(_command(args[0]), prog=f"pointsplat {args[0]}", args=args[1:])
            else:
                about = "Makes trained 3D Gaussian Splatting scenes smaller, and looks at them."
                about += " `--version` prints the version."
                commands = {
                    name: _command(name, short=args in (["-h"], ["--help"])) for name in COMMANDS
                }
                tyro.extras.subcommand_cli_from_dict(
                    commands, prog="pointsplat", description=about, args=args
                )
    except SystemExit as end:
        if not end.code and (text := after_help(args)):
            say("", *text.splitlines())
        raise
    finally:
        sys.stdout.flush()  # a full disk or a closed pipe is noticed here
