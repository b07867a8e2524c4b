"""Methods that this plugin adds to nerfstudio."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from pointsplat_ns.nerfstudio_plugin.registration import errors_in_one_line, load_specification


def _splatfacto_cpu() -> MethodSpecification:
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config
    from pointsplat_ns.scene.checkpoints import allow_splatfacto_checkpoints

    allow_splatfacto_checkpoints()
    errors_in_one_line()
    return MethodSpecification(
        config=splatfacto_cpu_config(),
        description=(
            "Splatfacto with a rasterizer in plain torch: trains on a CPU, and on CUDA where "
            "there is one."
        ),
    )


splatfacto_cpu = load_specification("splatfacto-cpu", _splatfacto_cpu)


def _pointsplat() -> MethodSpecification:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config

    return MethodSpecification(
        config=pointsplat_config(),
        description=(
            "Prunes trained Splatfacto scenes and repairs them with one network trained across "
            "scenes."
        ),
    )


pointsplat = load_specification("pointsplat", _pointsplat)


def _pointsplat_paper() -> MethodSpecification:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.presets import paper_config

    return MethodSpecification(
        config=paper_config(),
        description="pointsplat with the settings of the PointSplat paper; needs a GPU.",
    )


pointsplat_paper = load_specification("pointsplat-paper", _pointsplat_paper)


def _pointsplat_authors() -> MethodSpecification:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.presets import authors_config

    return MethodSpecification(
        config=authors_config(),
        description=(
            "pointsplat with the settings of the code that the paper's authors released; needs a "
            "GPU."
        ),
    )


pointsplat_authors = load_specification("pointsplat-authors", _pointsplat_authors)
