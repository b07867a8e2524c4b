"""Recognises scenes of the datasets that the paper reports on."""

from __future__ import annotations

import re

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.runs import Run
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica

REPLICA_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")
"""The scenes of NICE-SLAM's Replica, which the paper follows; it does not say which three it tests on."""

SCANNETPP_PARSERS = ("ScanNetppDataParserConfig", "SeededScanNetppDataParserConfig")
"""nerfstudio's and ours."""


def paper_dataset(run: Run) -> str:
    """The dataset of the paper that a run was trained on: "Replica" or "ScanNet++"; empty if it is another, or its data
    is gone.

    Args:
        run: opened with its data.
    """
    parser, name = run.dataparser_class.rpartition(".")[2], run.data.name
    if parser == "ReplicaDataParserConfig" and name in REPLICA_SCENES:
        try:
            scene = load_replica(run.data, check_sizes=False)
        except DataError:
            return ""
        size = (scene.params.width, scene.params.height)
        # The rooms that this package makes may have the same names, but not this size and number.
        return "Replica" if size == (1200, 680) and len(scene) == 2000 else ""
    if parser in SCANNETPP_PARSERS and re.fullmatch(r"[0-9a-f]{10}", name) and (run.data / "dslr").is_dir():
        return "ScanNet++"
    return ""
