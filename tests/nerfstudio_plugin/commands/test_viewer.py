"""``ns-viewer``, opened by a client."""

from __future__ import annotations

import types

import numpy as np
import pytest
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.viewer.viewer import Viewer

from captures import Capture
from ns_commands import Run, started
from ns_viewer import Look, look


def test_viewer_serves_its_page_and_what_the_model_draws_until_ctrl_c(run: Run, capture: Capture, monkeypatch):
    viewers: list[Viewer] = []
    seen: list[Look] = []

    def opened(*args, **options) -> Viewer:
        viewers.append(Viewer(*args, **options))
        return viewers[-1]

    def between_looks(_: float) -> None:
        seen.append(look(viewers[0], capture.poses[0]))
        raise KeyboardInterrupt

    monkeypatch.setattr(run_viewer, "ViewerState", opened)
    monkeypatch.setattr(run_viewer, "time", types.SimpleNamespace(sleep=between_looks))
    try:
        with pytest.raises(KeyboardInterrupt):
            started(run_viewer, "--load-config", run.config, "--viewer.websocket-host", "127.0.0.1")
    finally:
        for viewer in viewers:
            viewer.viser_server.stop()
    assert b"<html" in seen[0].page
    assert seen[0].picture.std() > 0.03, "a plain picture proves nothing"
    # JPEG at the quality of pictures that may be followed by better ones
    assert np.abs(seen[0].picture - seen[0].expected).mean() < 0.03
