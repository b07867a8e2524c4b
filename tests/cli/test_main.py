"""Whatever goes wrong around a command ends it with one line and exit status 1."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.cli import main

ALLOCATION = 1 << 60
"""Bytes that no machine has."""


def deep(*_) -> int:
    return 1 + deep()


def raising(error: BaseException):
    def fail(*_):
        raise error

    return fail


@pytest.mark.parametrize(
    "fail, said",
    [
        (raising(PermissionError(13, "Permission denied", "a.ply")), "a.ply: Permission denied"),
        (raising(OSError(28, "No space left on device")), "No space left on device"),
        (raising(OSError("odd\nsecond line")), "odd"),
        (raising(MemoryError()), "not enough memory (MemoryError)"),
        (lambda *_: torch.empty(ALLOCATION, dtype=torch.uint8), "not enough memory ("),
        (lambda *_: bytearray(ALLOCATION), "not enough memory (MemoryError)"),
        (deep, "the input is nested too deeply (maximum recursion depth exceeded"),
    ],
)
def test_an_error_of_the_system_is_one_line_and_status_1(fail, said, monkeypatch, capsys):
    monkeypatch.setattr("pointsplat_ns.report", fail)
    with pytest.raises(SystemExit) as end:
        main(["report", "evaluation.json"])
    assert end.value.code == 1
    errors = capsys.readouterr().err
    assert errors.startswith(f"error: {said}") and errors.count("\n") == 1


def test_a_bug_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("pointsplat_ns.report", raising(RuntimeError("a bug")))
    with pytest.raises(RuntimeError, match="a bug"):
        main(["report", "evaluation.json"])


def test_the_version_is_printed(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"pointsplat-ns {ps.__version__}\n"


def test_commands_run_in_a_thread_too(capsys):
    thread = threading.Thread(target=main, args=(["--version"],))
    thread.start()
    thread.join()
    assert ps.__version__ in capsys.readouterr().out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("where", ["full", "closed"])
def test_output_that_nobody_can_take_ends_without_a_traceback(where):
    if where == "full":
        output = os.open("/dev/full", os.O_WRONLY)
    else:
        reader, output = os.pipe()
        os.close(reader)
    words = [sys.executable, "-c", "from pointsplat_ns.cli import main; main(['--version'])"]
    ended = subprocess.run(words, stdout=output, stderr=subprocess.PIPE, text=True)
    os.close(output)
    assert ended.returncode == 1
    assert ended.stderr == ("error: No space left on device\n" if where == "full" else "")
