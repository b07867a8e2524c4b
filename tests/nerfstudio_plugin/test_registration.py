"""Registration, options and warnings."""

import signal
import subprocess
import sys
import warnings
from pathlib import Path

from making import quick_start
from pointsplat_ns.nerfstudio_plugin.registration import load_specification, quiet_nerfstudio

OURS_FIRST = """
import socket, torch

def refuse(*args, **kwargs):
    raise OSError("an import used the network or CUDA")

socket.socket.connect = socket.getaddrinfo = torch.cuda.init = torch.cuda._lazy_init = refuse
import pointsplat_ns.nerfstudio_plugin.pointsplat.scenes
from method_configs import dataparsers, methods
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.plugins.types import MethodSpecification

for found in (methods.splatfacto_cpu, methods.pointsplat, methods.pointsplat_paper, methods.pointsplat_authors):
    assert isinstance(found, MethodSpecification), found
for found in (dataparsers.replica, dataparsers.scannetpp):
    assert isinstance(found, DataParserSpecification), found
"""


def test_our_modules_may_be_imported_before_nerfstudio_and_need_no_network():
    # nerfstudio imports entry points from inside its own imports, so the order decides what is half
    # imported. That nerfstudio itself may come first is what every test that parses its command
    # line proves.
    words = [sys.executable, "-c", OURS_FIRST]
    result = subprocess.run(words, capture_output=True, text=True, timeout=300, env=quick_start())
    assert result.returncode == 0, result.stderr


def test_a_specification_that_fails_to_load_becomes_one_line():
    def broken():
        raise ImportError("no module named 'x'")

    line = load_specification("some-method", broken)
    assert (
        line
        == "some-method of pointsplat-ns, which failed to load (ImportError: no module named 'x')"
    )


def test_an_input_error_ends_a_command_with_one_line_and_status_1():
    # Run without nerfstudio, whose import takes seconds; method_configs.methods installs this same
    # hook.
    code = (
        "from pointsplat_ns.nerfstudio_plugin.registration import *; errors_in_one_line(); raise {}"
    )
    wanted = {
        "PointSplatError('traj.txt: 3 poses')": "error: traj.txt: 3 poses\n",
        "ValueError('a bug')": "Traceback",
    }
    for error, said in wanted.items():
        run = subprocess.run(
            [sys.executable, "-c", code.format(error)], capture_output=True, text=True
        )
        assert run.returncode == 1 and run.stderr.startswith(said)
    interrupted = subprocess.run(
        [sys.executable, "-c", code.format("KeyboardInterrupt")], capture_output=True, text=True
    )
    assert interrupted.stderr == "interrupted\n"
    assert interrupted.returncode in (-signal.SIGINT, 128 + signal.SIGINT)
    methods = Path(__file__).parents[2] / "method_configs" / "methods.py"
    assert "errors_in_one_line()" in methods.read_text()


def test_a_failed_export_of_nerfstudio_names_the_one_that_needs_no_gpu():
    code = (
        "import sys; sys.argv = {!r}\n"
        "from pointsplat_ns.nerfstudio_plugin.registration import errors_in_one_line\n"
        "errors_in_one_line()\n"
        "assert False"
    )
    for program, named in (("/bin/ns-export", True), ("/bin/ns-eval", False)):
        words = [program, "gaussian-splat", "--load-config", "outs/config.yml"]
        run = subprocess.run(
            [sys.executable, "-c", code.format(words)], capture_output=True, text=True
        )
        assert run.returncode == 1 and "AssertionError" in run.stderr
        last = run.stderr.splitlines()[-1]
        assert last.endswith("pointsplat export outs/config.yml -o scene.ply") == named


def test_warnings_for_nerfstudio_are_hidden_and_all_others_are_printed():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        quiet_nerfstudio()
        for module in (
            "nerfstudio.engine.trainer",
            "nerfstudio_of_another",
            "pointsplat_ns.scene.nerfstudio.x",
        ):
            warnings.warn_explicit(
                "it is deprecated", FutureWarning, f"{module}.py", 1, module=module
            )
        warnings.warn_explicit(
            "division", RuntimeWarning, "a.py", 1, module="nerfstudio.engine.trainer"
        )
    assert [(warning.filename, warning.category) for warning in caught] == [
        ("nerfstudio_of_another.py", FutureWarning),
        ("pointsplat_ns.scene.nerfstudio.x.py", FutureWarning),
        ("a.py", RuntimeWarning),
    ]
