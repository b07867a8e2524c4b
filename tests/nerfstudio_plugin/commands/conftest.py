"""Each method trained once by ``ns-train``, with the viewer open, on a tiny capture taken through a lens."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from captures import Capture, Lens
from ns_commands import METHODS, Run, with_the_viewer_open


@pytest.fixture(scope="session")
def capture() -> Capture:
    return Capture(Lens(distortion=(0.12, -0.05, 0.004, -0.003)))


@pytest.fixture(scope="session")
def trained_by_ns_train(capture, tmp_path_factory) -> Callable[[str], Run]:
    """A function that gives the run of a method."""
    folder = tmp_path_factory.mktemp("commands")
    capture.write_nerfstudio(folder / "capture")
    runs: dict[str, Run] = {}

    def trained(method: str) -> Run:
        if method not in runs:
            words = [method, "--output-dir", folder / method, "--experiment-name", "room"]
            words += ["--machine.device-type", "cpu", "--logging.steps-per-log", "1"]
            data: list[object] = []
            if method == "splatfacto-cpu":
                words += ["--data", folder / "capture", "--pipeline.model.num-downscales", "0"]
                data = ["nerfstudio-data", "--load-3D-points", "True", "--train-split-fraction", "0.8"]
            else:
                words += ["--data", trained("splatfacto-cpu").folder, "--pipeline.model.size", "tiny"]
                words += ["--pipeline.model.by", "paper", "--pipeline.model.lpips-weight", "0"]
                words += ["--pipeline.model.keep", "0.5"]
            runs[method] = with_the_viewer_open(method, capture, folder / method, [*map(str, words)], [*map(str, data)])
        return runs[method]

    return trained


@pytest.fixture(params=METHODS)
def run(request, trained_by_ns_train) -> Run:
    return trained_by_ns_train(request.param)
