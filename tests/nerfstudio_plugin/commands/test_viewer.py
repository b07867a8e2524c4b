"""``ns-viewer``, opened by a client."""

from __future__ import annotations

import types
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.viewer.viewer import Viewer

from captures import Capture
from ns_commands import VIEWER, Run, started
from ns_viewer import Look, look


def looked_at(config: Path, pose: np.ndarray | None = None) -> Look:
    """What a client of ``ns-viewer`` gets, which Ctrl-C then ends.

    Args:
        config: of a run.
        pose: camera-to-world (4, 4) in OpenGL axes; by default that of the first training photo.
    """
    viewers: list[Viewer] = []
    seen: list[Look] = []

    def opened(*args, **options) -> Viewer:
        viewers.append(Viewer(*args, **options))
        return viewers[-1]

    def between_looks(_: float) -> None:
        place = viewers[0].pipeline.datamanager.train_dataset.cameras.camera_to_worlds[0] if pose is None else pose[:3]
        seen.append(look(viewers[0], np.asarray(place, dtype=float)))
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_viewer, "ViewerState", opened)
        patch.setattr(run_viewer, "time", types.SimpleNamespace(sleep=between_looks))
        try:
            with pytest.raises(KeyboardInterrupt):
                started(run_viewer, "--load-config", config, *VIEWER)
        finally:
            for viewer in viewers:
                viewer.viser_server.stop()
    return seen[0]


def test_viewer_serves_its_page_and_what_the_model_draws_until_ctrl_c(run: Run, capture: Capture):
    looked_at(run.config, capture.poses[0]).check()
