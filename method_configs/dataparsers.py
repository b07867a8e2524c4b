"""Dataparsers that this plugin adds to nerfstudio.

Apart from the methods: nerfstudio loads dataparsers while the modules that methods need are half imported.
"""

from __future__ import annotations

from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from pointsplat_ns.nerfstudio_plugin.registration import load_specification


def _replica() -> DataParserSpecification:
    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.third_party_warnings import quiet_nerfstudio

    quiet_nerfstudio()  # here, because nerfstudio loads dataparsers before what raises the warnings
    return DataParserSpecification(
        config=ReplicaDataParserConfig(),
        description="Posed RGB-D frames in the layout that NICE-SLAM gave to Replica.",
    )


replica = load_specification("replica-data", _replica)


def _scannetpp() -> DataParserSpecification:
    from pointsplat_ns.nerfstudio_plugin.scannetpp import SeededScanNetppDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.third_party_warnings import quiet_nerfstudio

    quiet_nerfstudio()
    return DataParserSpecification(
        config=SeededScanNetppDataParserConfig(),
        description="ScanNet++ without frames marked as bad, and with COLMAP's points to start from.",
    )


scannetpp = load_specification("scannetpp-seeded", _scannetpp)
