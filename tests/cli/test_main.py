"""The command line: help, words that are read, errors."""

import contextlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.cli import main
from pointsplat_ns.cli.help import EXAMPLES

ALLOCATION = 1 << 60
"""Bytes that no machine has."""


def deep(*_, **__) -> int:
    return 1 + deep()


def raising(error: BaseException):
    def fail(*_, **__):
        raise error

    return fail


@pytest.mark.parametrize(
    "fail, said",
    [
        (raising(PermissionError(13, "Permission denied", "a.ply")), "a.ply: Permission denied"),
        (raising(OSError(28, "No space left on device")), "No space left on device"),
        (raising(OSError("odd\nsecond line")), "odd"),
        (raising(MemoryError()), "not enough memory (MemoryError)"),
        (lambda *_, **__: torch.empty(ALLOCATION, dtype=torch.uint8), "not enough memory ("),
        (lambda *_, **__: bytearray(ALLOCATION), "not enough memory (MemoryError)"),
        (deep, "the input is nested too deeply (maximum recursion depth exceeded"),
    ],
)
def test_an_error_of_the_system_is_one_line_and_status_1(fail, said, monkeypatch, capsys):
    monkeypatch.setattr("pointsplat_ns.info", fail)
    with pytest.raises(SystemExit) as end:
        main(["info", __file__])
    assert end.value.code == 1
    errors = capsys.readouterr().err
    assert errors.startswith(f"error: {said}") and errors.count("\n") == 1


def test_a_bug_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("pointsplat_ns.info", raising(RuntimeError("a bug")))
    with pytest.raises(RuntimeError, match="a bug"):
        main(["info", __file__])


def test_the_version_is_printed(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"pointsplat-ns {ps.__version__}\n"


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


@pytest.mark.skipif(os.name != "posix", reason="closes file descriptors as a POSIX shell does")
def test_streams_that_are_closed_go_nowhere_and_no_file_gets_their_numbers(tmp_path):
    script = (
        "from pointsplat_ns.cli import main; main(['--version']); assert open('file', "
        "'w').fileno() > 2"
    )
    line = f"{shlex.quote(sys.executable)} -c {shlex.quote(script)} <&- >&- 2>&-"
    subprocess.run(["sh", "-c", line], cwd=tmp_path, check=True)


ORDERS = "\x1b]0;pwned\x07\x9b31m\x08\x1b[2J"
"""Sets the title of a terminal, colours and deletes."""


def commanding(folder: Path) -> None:
    properties = b"x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    names = [*properties, b"odd" + ORDERS.encode("latin-1")]
    header = [
        b"ply",
        b"format ascii 1.0",
        b"element vertex 1",
        *(b"property float " + name for name in names),
    ]
    (folder / f"{ORDERS}.ply").write_bytes(b"\n".join([*header, b"end_header", b"1 " * len(names)]))
    (folder / f"bad{ORDERS}.spz").touch()


@pytest.mark.parametrize(
    "words, shown",
    [
        (
            ("info", f"{ORDERS}.ply"),
            r"\x08\x1b[2J.ply: not read: the vertex properties odd\x1b]0;pwned\x07",
        ),
        (("info", f"bad{ORDERS}.spz"), r"error: bad\x1b]0;pwned\x07"),
        (("info", "new\nline.ply"), r"error: new\nline.ply: no such file"),
        (("convert", f"{ORDERS}.ply", f"made{ORDERS}.ply"), r"made\x1b]0;pwned\x07\x9b31m\x08"),
        (
            ("compact", ".", "-o", f"out{ORDERS}", "--keep", "1", "--effort", "instant"),
            r"out\x1b]0;pwned\x07",
        ),
        (("nonsense" + ORDERS,), r"nonsense\x1b]0;pwned"),
    ],
)
def test_no_name_steers_the_terminal(words, shown, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    commanding(tmp_path)
    with contextlib.suppress(SystemExit):
        main([*words])
    out, err = capsys.readouterr()
    assert shown in out + err
    assert not re.search(r"[^\n\x20-\x7e\xa0-\U0010ffff]", out + err)


def test_every_command_has_examples_of_itself(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    listed = re.search(r"usage: pointsplat \[-h\] \{([\w,-]+)\}", capsys.readouterr().out)[1].split(
        ","
    )
    assert not end.value.code and listed == [*EXAMPLES]
    for name, examples in EXAMPLES.items():
        assert examples and all(
            shlex.split(command)[:2] == ["pointsplat", name] for _, command in examples
        )


@pytest.mark.parametrize(
    ("words", "why"),
    [("prune room.ply --keeep 10%", "--keeep"), ("view a.ply --port 1.5", "is not a whole number")],
)
def test_a_command_line_that_is_not_understood_has_status_2(words, why, capsys):
    with pytest.raises(SystemExit) as end:
        main(words.split())
    said = capsys.readouterr()
    assert end.value.code == 2 and why in " ".join(said.err.split()) and said.out == ""
