"""The methods ``pointsplat-paper`` and ``pointsplat-authors``: ``pointsplat`` with published
settings.

Sources: the paper (A. T. Tran and J. Košecká, "PointSplat: Efficient Geometry-Driven Pruning and
Transformer Refinement for 3D Gaussian Splatting", arXiv 2604.09903), and the code that its authors
released (github.com/anhthuan1999/pointsplat). What neither says is as in ``pointsplat``.
"""

from __future__ import annotations

import dataclasses

from pointsplat_ns.nerfstudio_plugin.pointsplat.config import (
    REFINER_RATES,
    PointSplatTrainerConfig,
    adam,
    pointsplat_config,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipelineConfig
from pointsplat_ns.scene.runs import METHOD_NAMES


def paper_config() -> PointSplatTrainerConfig:
    """The method ``pointsplat-paper``. Sections, equations and tables are the paper's; "details" is
    the paragraph "Implementation details" of section 4."""
    rates = dict.fromkeys(REFINER_RATES, 1e-5)  # details
    config = _preset(
        "paper", _paper_model(), rates, eps=1e-8
    )  # torch's default: the paper names none
    config.max_num_iterations = 10_000  # details
    # details: "dropped by 10 at iteration 6,000"
    config.schedule = "step"
    config.drop_at = 0.6
    config.global_norm = None  # the paper names no limit of gradients
    return config


def _paper_model() -> PointSplatModelConfig:
    return PointSplatModelConfig(
        by="paper",  # eq. 3
        opacity_weight=0.3,  # details: lambda_alpha, for all datasets
        keep="30%",  # Table 1: 0.5, 0.3 and 0.1, each with a network of its own
        size="full",  # details: five stages of 2, 2, 2, 4 and 2 blocks
        encoder="dual",  # eq. 4 to 6
        use_appearance=True,  # Table 4, model V
        use_position=True,  # Table 4, model V
        raw_inputs=True,  # eq. 4: attributes are concatenated as they are
        norm="batch",  # details: "batch normalization"
        stem="conv",  # section 3.3: Point Transformer V3, which begins with a convolution
        means_reach=1.0,  # eq. 8 has no limit; the tanh of the released code allows one unit cube
        train_encoder=True,  # details: "the proposed network is trained"
        pixel_loss="l1",  # details: L = L_1 + lambda_LPIPS L_LPIPS
        lpips_weight=0.1,  # details: lambda_LPIPS
        lpips_net="vgg",  # the released code: the paper names no network
    )


def authors_config() -> PointSplatTrainerConfig:
    """The method ``pointsplat-authors``: what differs from the paper in the released code, the part
    of which is named first. The rest is as in :func:`paper_config`."""
    model = dataclasses.replace(
        _paper_model(),
        by="authors",  # score: z-scores of opacity logits and of a product of log-scales
        enc_depths=(2, 2, 2, 6, 2),  # backbone: its default, which nothing sets
        stem="linear",  # backbone: Linear, BatchNorm, GELU
        # encoder: log-scales in the unit cube, opacity logits, SH coefficients as they are
        raw_inputs=True,
        means_reach=1.0,  # heads: tanh of the residual of means, in unit cubes
        train_encoder=False,  # optimiser: it has the backbone and the heads alone
    )
    rates = dict.fromkeys(REFINER_RATES, 3e-5) | dict.fromkeys(
        ("means", "scales", "quats"), 1e-5
    )  # optimiser
    rates["features_rest"] = 1e-6
    config = _preset("authors", model, rates, eps=1e-15)  # optimiser: Adam's eps
    config.max_num_iterations = 10_000  # the paper's
    # schedule named "cosine": MultiStep, a tenth at 7,000
    config.schedule = "step"
    config.drop_at = 0.7
    config.global_norm = 2.0  # training: one norm of all gradients
    return config


def _preset(
    name: str, model: PointSplatModelConfig, rates: dict[str, float], eps: float
) -> PointSplatTrainerConfig:
    config = pointsplat_config()
    config.method_name = f"{METHOD_NAMES.refiner}-{name}"
    config.optimizers = adam(rates, eps)
    config.rate_factor = 1.0
    scenes = ScenesDataManagerConfig(
        supervision="photos",  # section 4, Datasets: images of the scenes
        # section 4, Datasets: "two random images per scene"; the released code: 1 on Replica
        images_per_step=2,
    )
    config.pipeline = PointSplatPipelineConfig(datamanager=scenes, model=model)
    return config
