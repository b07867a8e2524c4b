"""Where each setting of the paper's tables is stated: in the paper (arXiv 2604.09903), in the
released code (github.com/anhthuan1999/pointsplat), or nowhere that we know of."""

from __future__ import annotations

from dataclasses import dataclass

UNKNOWN = "unknown"
"""The source of what neither the paper nor the released code states."""


@dataclass(frozen=True)
class Setting:
    """A setting of the paper's tables."""

    name: str
    value: str
    source: str
    """Section of the paper, files of the released code, or both."""


RELEASED = "released code"

SETTINGS = (
    Setting("dense scenes", "nerfstudio's Splatfacto", "paper, Implementation details"),
    Setting("their training", "15,000 steps, SH degree 3, full size", f"{RELEASED}, README.md"),
    Setting(
        "held-out photos",
        "10 %",
        f"paper, Datasets; {RELEASED}, README.md (`--eval_mode fraction`)",
    ),
    Setting("test scenes", "5 of ScanNet++, 3 of Replica", "paper, Datasets"),
    Setting("their names", UNKNOWN, "neither; `configs/dataset/*.gin` name folders only"),
    Setting(
        "scenes of the networks, ScanNet++",
        "others than the test scenes",
        f"{RELEASED}, `configs/dataset/pp.gin`",
    ),
    Setting(
        "scenes of the networks, Replica",
        "the test scenes themselves; other photos are held out",
        f"{RELEASED}, `configs/dataset/replica.gin`, `dataset/GS.py` (`eval_lists.txt`)",
    ),
    Setting("training of a network", "10,000 steps, rate 1e-5", "paper, Implementation details"),
    Setting(
        "the same as released",
        "ScanNet++: 10,000 steps, 1e-5 to 3e-5; Replica: 30,000 steps, 5e-5",
        f"{RELEASED}, `configs/train/defaultpp.gin`, `configs/train/default.gin`",
    ),
    Setting("its hours on a GPU", UNKNOWN, "neither; no step was measured here on a GPU"),
    Setting(
        "LPIPS of the tables",
        "VGG",
        f"{RELEASED}, `utils/metrics.py`; the paper does not say",
    ),
    Setting("LPIPS of the loss", "VGG", f"{RELEASED}, `utils/loss_utils.py`"),
    Setting("selection of the row SplatFormer", UNKNOWN, "neither; at random here"),
    Setting("fine-tuning of the baselines", UNKNOWN, "neither; here as their authors' programs"),
    Setting(
        "LightGaussian's",
        "5,000 steps, rates of 3DGS, a twentieth less every 400 steps, no densification",
        "github.com/VITA-Group/LightGaussian, `scripts/run_prune_finetune.sh`, `prune_finetune.py`",
    ),
    Setting(
        "PUP-3DGS's",
        "80 % pruned, 5,000 steps, half of the rest pruned, 5,000 steps; rates of 3DGS, no "
        "densification; scores from pictures of a quarter of the width",
        "github.com/j-alex-hanson/gaussian-splatting-pup, `scripts/full_pruning_pipeline.sh`",
    ),
    Setting("scenes of Table 2 and Figure 4", UNKNOWN, "neither"),
    Setting("dataset of Table 4", "ScanNet++", "its rows I and V are those of Table 3"),
)


def lines() -> list[list[str]]:
    """Cells of a table of all settings: setting, value, source."""
    return [[setting.name, setting.value, setting.source] for setting in SETTINGS]
