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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any, NoReturn, TextIO, Union, cast

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
"""Names of the commands. A command is a function in a module of the same name, which is imported on
use."""


class _EscapingStream:
    """A text stream that escapes control characters, such as those in a file name. Colours and
    cursor moves of progress bars pass, unless it is ``plain``: then libraries see no terminal, and
    send none."""

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
        # Colours and cursor moves, which the program sends; then all other control characters.
        allowed_or_control = (
            r"\x1b\[(?:[\d;]*m|\?25[lh]|\d*[AK])|[^\t\n\r\x20-\x7e\xa0-\U0010ffff]+"
        )
        self._stream.write(
            re.sub(
                allowed_or_control,
                lambda m: m[0] if m[0].startswith("\x1b[") else printable(m[0]),
                text,
            )
        )
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def any_text_printable(plain: bool = False) -> Iterator[None]:
    """Make standard output and standard error accept any text in this context.

    Output to closed streams is discarded. Characters outside of the encoding are replaced. Control
    characters are escaped as in Python, such as ``\\x1b``; only colours and progress bars reach a
    terminal, and not even those if ``plain``.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:  # takes the lowest free number, this one, so that no output file gets it
            os.open(os.devnull, os.O_RDWR)
    before = sys.stdout, sys.stderr
    out, err = (stream or open(os.devnull, "w", encoding="utf-8") for stream in before)
    errors = out.errors
    if isinstance(out, io.TextIOWrapper):
        out.reconfigure(errors="replace")
    sys.stdout, sys.stderr = (cast(TextIO, _EscapingStream(stream, plain)) for stream in (out, err))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        if isinstance(out, io.TextIOWrapper):
            out.reconfigure(errors=errors)


class _PrintHandler(logging.Handler):
    """Prints log records of the package: information on standard output, warnings on standard
    error."""

    def emit(self, record: logging.LogRecord) -> None:
        is_warning = record.levelno >= logging.WARNING
        say(self.format(record), error=is_warning)


@contextmanager
def _log_printed(level_printed: int) -> Iterator[None]:
    """Print log records of the package of at least a level in this context."""
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
    """Make SIGHUP (a lost terminal) and SIGTERM unwind the program like Ctrl-C, so that unfinished
    files are removed and workers are stopped."""

    def end(number: int, frame: Any) -> None:
        sys.exit(128 + number)

    names = ("SIGHUP", "SIGTERM")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]  # none on Windows
    # Only the main thread may set handlers.
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    before = {n: signal.signal(n, end) for n in numbers if signal.getsignal(n) is signal.SIG_DFL}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _system_error_text(error: Exception) -> str:
    """A system error in one line."""
    if isinstance(error, ModuleNotFoundError):
        return f"{error.name} is not installed; pip install pointsplat-ns installs it"
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
    """Whether an error is a bug, not a fault of the input or the machine: a missing module or name
    of this package, or a RuntimeError other than torch's lack of memory, which has no type of its
    own on a CPU."""
    if isinstance(error, ModuleNotFoundError):
        return error.name is None or error.name.startswith(__package__.partition(".")[0])
    if isinstance(error, ImportError):
        return "shared object" not in str(error)
    if not isinstance(error, RuntimeError) or isinstance(error, RecursionError):
        return False
    import torch

    if isinstance(error, torch.cuda.OutOfMemoryError):
        return False
    return "can't allocate memory" not in str(error)


def _ignore_matplotlibrc() -> None:
    """Make matplotlib ignore an untrusted ``matplotlibrc`` in the current folder. It reads the file
    on import, so it is imported from another folder."""
    if not os.path.lexists("matplotlibrc"):
        return
    here = os.getcwd()
    os.chdir(os.sep)
    try:
        import matplotlib  # noqa: F401
    finally:
        os.chdir(here)


def _command(name: str) -> Callable[..., None]:
    """The function of a command."""
    return getattr(importlib.import_module(f"{__package__}.{name}"), name)


def _subcommands(summaries: bool) -> Any:
    """The union of all commands, for tyro. With ``summaries``, the first sentences of their
    docstrings describe them in the list of commands."""
    import tyro

    kinds = []
    for name in COMMANDS:
        command = _command(name)
        text = inspect.getdoc(command) or ""
        first = re.split(r"(?<=\.)\s", text, maxsplit=1)[0] if summaries else None
        kinds.append(
            Annotated[Any, tyro.conf.subcommand(name=name, constructor=command, description=first)]
        )
    return Union[tuple(kinds)]  # noqa: UP007, of any number


def program() -> NoReturn:
    """The program ``pointsplat``: :func:`main`, then exit with status 0, without unloading torch's
    libraries, which takes 0.4 CPU seconds."""
    gc.set_threshold(100_000)  # by default, collecting the objects of torch's modules takes 0.2 s
    main()
    atexit._run_exitfuncs()
    for stream in filter(None, (sys.stdout, sys.stderr)):
        stream.flush()
    os._exit(0)


def main(args: list[str] | None = None) -> None:
    """Run one subcommand, by default with the program's own arguments.

    Unusable input, unreadable or unwritable files, lack of memory and missing packages give an
    error of one line and exit status 1. Ctrl-C gives 130, another signal 128 plus its number. With
    ``--json``, standard output is one JSON value and nothing else.
    """
    args = sys.argv[1:] if args is None else args
    with any_text_printable(plain=not all(map(str.isprintable, args))):  # what tyro prints of them
        try:
            _run(args)
        except PointSplatError as error:
            text = f"error: {error}"
            status = 1
        except BrokenPipeError:  # of `pointsplat ... | head`
            # The rest of the output must not be written again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except (ImportError, OSError, MemoryError, RuntimeError) as error:
            if _is_bug(error):
                raise
            text = f"error: {printable(_system_error_text(error))}"
            status = 1
        except KeyboardInterrupt:
            text = "interrupted"
            status = 130
        else:
            return
        say(text, error=True)
        sys.exit(status)


def _run(args: list[str]) -> None:
    """Run one subcommand, and flush its output."""
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
                about = "Make trained 3D Gaussian Splatting scenes smaller, and view them."
                about += " `--version` prints the version."
                kinds = _subcommands(summaries=args in (["-h"], ["--help"]))
                tyro.cli(kinds, prog="pointsplat", description=about, args=args)
    except SystemExit as end:
        if not end.code and (text := after_help(args)):
            say("", *text.splitlines())
        raise
    finally:
        sys.stdout.flush()  # raises an error for a full disk or a closed pipe
