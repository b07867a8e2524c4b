"""Registration, options and warnings."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from pointsplat_ns.nerfstudio_plugin.registration import load_specification, quiet_nerfstudio

FORKED = """
import importlib, os, sys, traceback, warnings
warnings.simplefilter("ignore")
# What nerfstudio imports of others takes most of the time; it is imported once for all cases.
import cv2, torch, torchmetrics, torchvision, viser, wandb, gsplat, nerfacc, sklearn.neighbors, scipy.signal, networkx
import torch.utils.tensorboard, functorch.compile, tensorly, tyro, jaxtyping, pytorch_msssim, rawpy, pyquaternion

def refuse(*args, **kwargs):
    raise OSError("an import used the network or CUDA")

def new_modules():
    import nerfstudio.plugins.registry as methods, nerfstudio.plugins.registry_dataparser as dataparsers
    from importlib.metadata import EntryPoints
    methods.entry_points = dataparsers.entry_points = lambda group: EntryPoints()
    import nerfstudio.configs.external_methods as external
    external.get_external_methods = lambda: ({}, {})  # it takes ten seconds to list what others offer
    import nerfstudio.configs.method_configs
    before = set(sys.modules)
    import method_configs.methods, method_configs.dataparsers
    return {name.split(".")[0] for name in set(sys.modules) - before}

def case(name):
    import socket
    socket.socket.connect = socket.getaddrinfo = torch.cuda.init = torch.cuda._lazy_init = refuse
    if name == "new modules":
        new = new_modules() - {"method_configs", "pointsplat_ns"}
        # What the two modules import beyond nerfstudio must be nothing that takes time.
        assert new <= {"plyfile", "cachetools"}, f"the plugin also imports {sorted(new)}"
        return
    importlib.import_module(name)
    import method_configs.methods, method_configs.dataparsers
    from nerfstudio.plugins.registry_dataparser import DataParserSpecification
    from nerfstudio.plugins.types import MethodSpecification
    for spec, kind in ((method_configs.methods.splatfacto_cpu, MethodSpecification),
                       (method_configs.methods.pointsplat, MethodSpecification),
                       (method_configs.methods.pointsplat_paper, MethodSpecification),
                       (method_configs.methods.pointsplat_authors, MethodSpecification),
                       (method_configs.dataparsers.replica, DataParserSpecification),
                       (method_configs.dataparsers.scannetpp, DataParserSpecification)):
        assert isinstance(spec, kind), spec

for name in sys.argv[1:]:
    child = os.fork()
    if child == 0:
        try:
            case(name)
        except BaseException as error:
            traceback.print_exc()
            print(f"{name}: {type(error).__name__}: {error}", flush=True)
        else:
            print(f"{name}: fine", flush=True)
        os._exit(0)
    os.waitpid(child, 0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="saves imports by forking")
def test_any_module_may_be_imported_first_and_needs_no_network():
    # nerfstudio imports entry points from inside its own imports, so the order decides what is half imported.
    # (That nerfstudio itself may come first is what every test that parses its command line proves.)
    # pointsplat.scenes is what dataset_views imports.
    modules = (f"pointsplat_ns.nerfstudio_plugin.{name}" for name in ("splatfacto_cpu.model", "pointsplat.scenes"))
    cases = [*modules, "new modules"]
    result = subprocess.run([sys.executable, "-c", FORKED, *cases], capture_output=True, text=True, timeout=300)
    lines = [line for line in result.stdout.splitlines() if line.split(":")[0] in cases]
    assert lines == [f"{name}: fine" for name in cases], result.stdout + result.stderr


def test_a_specification_that_fails_to_load_becomes_one_line():
    def broken():
        raise ImportError("no module named 'x'")

    line = load_specification("some-method", broken)
    assert line == "some-method of pointsplat-ns, which failed to load (ImportError: no module named 'x')"
    assert load_specification("some-method", dict) == {}


def test_an_input_error_ends_a_command_with_one_line_and_status_1():
    # Run without nerfstudio, whose import takes seconds; method_configs.methods installs this same hook.
    code = (
        "from pointsplat_ns.errors import DataError\n"
        "from pointsplat_ns.nerfstudio_plugin.registration import errors_in_one_line\n"
        "errors_in_one_line()\n"
        "raise {}\n"
    )
    run = [sys.executable, "-c"]
    ours = subprocess.run([*run, code.format("DataError('traj.txt: 3 poses')")], capture_output=True, text=True)
    assert (ours.returncode, ours.stderr) == (1, "error: traj.txt: 3 poses\n")
    bug = subprocess.run([*run, code.format("ValueError('a bug')")], capture_output=True, text=True)
    assert bug.returncode == 1 and "Traceback" in bug.stderr and "a bug" in bug.stderr
    methods = Path(__file__).parents[2] / "method_configs" / "methods.py"
    assert "errors_in_one_line()" in methods.read_text()


def test_warnings_for_nerfstudio_are_hidden_and_all_others_are_printed():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        quiet_nerfstudio()
        for module in ("nerfstudio.engine.trainer", "nerfstudio_of_another", "pointsplat_ns.io.nerfstudio.x"):
            warnings.warn_explicit("it is deprecated", FutureWarning, f"{module}.py", 1, module=module)
        warnings.warn_explicit("division", RuntimeWarning, "a.py", 1, module="nerfstudio.engine.trainer")
    assert [(warning.filename, warning.category) for warning in caught] == [
        ("nerfstudio_of_another.py", FutureWarning), ("pointsplat_ns.io.nerfstudio.x.py", FutureWarning),
        ("a.py", RuntimeWarning),
    ]  # fmt: skip
