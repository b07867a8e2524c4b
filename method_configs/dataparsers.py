"""Dataparsers that this plugin adds to nerfstudio.

Apart from the methods: nerfstudio loads dataparsers while the modules that methods need are half
imported, and before what raises its warnings.
"""

from __future__ import annotations

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from pointsplat_ns.nerfstudio_plugin.registration import load_specification, quiet_nerfstudio

quiet_nerfstudio()


def _replica() -> DataParserSpecification:
    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig

    return DataParserSpecification(
        config=ReplicaDataParserConfig(),
        description="Posed RGB-D frames in the layout that NICE-SLAM gave to Replica.",
    )


def _scannetpp() -> DataParserSpecification:
    from pointsplat_ns.nerfstudio_plugin.scannetpp import SeededScanNetppDataParserConfig

    return DataParserSpecification(
        config=SeededScanNetppDataParserConfig(),
        description=(
            "ScanNet++ without frames marked as bad, and with COLMAP's points to start from."
        ),
    )


replica = load_specification("replica-data", _replica)
scannetpp = load_specification("scannetpp-seeded", _scannetpp)
