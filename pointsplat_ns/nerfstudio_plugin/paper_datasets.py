"""Recognises scenes of the datasets that the paper reports on."""

from __future__ import annotations

import re

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.runs import Run
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica


def paper_dataset(run: Run) -> str:
    """The dataset of the paper that a run, opened with its data, was trained on: "Replica" or "ScanNet++"; empty if it
    is another, or its data is gone."""
    parser, name = run.dataparser_class.rpartition(".")[2], run.data.name
    # The scenes of NICE-SLAM's Replica, which the paper follows; it does not say which three it tests on.
    if parser == "ReplicaDataParserConfig" and re.fullmatch(r"room[0-2]|office[0-4]", name):
        try:
            scene = load_replica(run.data, check_sizes=False)
        except DataError:
            return ""
        size = (scene.params.width, scene.params.height)
        # The rooms that this package makes may have the same names, but not this size and number.
        return "Replica" if size == (1200, 680) and len(scene) == 2000 else ""
    ours, theirs = "SeededScanNetppDataParserConfig", "ScanNetppDataParserConfig"
    if parser in (ours, theirs) and re.fullmatch(r"[0-9a-f]{10}", name) and (run.data / "dslr").is_dir():
        return "ScanNet++"
    return ""
