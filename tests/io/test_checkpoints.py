"""Checkpoints of gsplat's trainer, as it saves them."""

import pytest
import torch
from refusing import fails

import pointsplat_ns as ps
from making import Bomb, normal_scene, same_bits
from pointsplat_ns.io.scene import kind_of

GOOD = normal_scene(4, 1)


def splats_of(scene):
    """What ``splats.state_dict()`` of gsplat's simple_trainer holds: a ParameterDict, opacities (N,), sh0 (N, 1, 3)."""
    values = {"means": scene.means, "scales": scene.scales, "quats": scene.quats, "opacities": scene.opacities[:, 0]}
    values |= {"sh0": scene.features_dc[:, None], "shN": scene.features_rest}
    return torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    ).state_dict()


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_checkpoint_of_gsplat_is_read_to_the_bit(tmp_path, degree):
    scene = normal_scene(7, degree)
    path = tmp_path / "ckpt_29999_rank0.pt"
    torch.save({"step": 29999, "splats": splats_of(scene), "pose_adjust": {"embeds.weight": torch.zeros(3, 9)}}, path)
    assert same_bits(ps.load(path), scene)
    assert kind_of(path) == ps.info(path).format == "checkpoint"


@pytest.mark.parametrize(
    "settings", ["antialiased: true\n", "antialiased: false\n", "nested:\n  antialiased: true\n", None]
)
def test_settings_of_a_gsplat_training_tell_whether_it_is_antialiased(tmp_path, settings):
    path = tmp_path / "results" / "ckpts" / "ckpt_29999_rank0.pt"
    path.parent.mkdir(parents=True)
    torch.save({"step": 29999, "splats": splats_of(GOOD)}, path)
    if settings is not None:
        config = tmp_path / "results" / "cfg.yml"
        config.write_text(f"absgrad: false\n{settings}strategy: !!python/object:gsplat.strategy.DefaultStrategy {{}}\n")
    assert ps.load(path).antialiased == (settings == "antialiased: true\n")


def test_a_part_of_a_training_on_several_gpus_is_refused(tmp_path):
    for rank in (0, 1):
        torch.save({"step": 9, "splats": splats_of(GOOD)}, tmp_path / f"ckpt_9_rank{rank}.pt")
    torch.save({"step": 8, "splats": splats_of(GOOD)}, tmp_path / "ckpt_8_rank0.pt")
    for rank in (0, 1):
        with pytest.raises(ps.SceneError, match="a part of a training on several GPUs.*--save_ply"):
            ps.load(tmp_path / f"ckpt_9_rank{rank}.pt")
    assert same_bits(ps.load(tmp_path / "ckpt_8_rank0.pt"), GOOD)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"step": 1, "splats": {**splats_of(GOOD), "extra": Bomb()}}, "holds an object of type print"),
        ({"splats": {}}, "lacks the key 'means'"),
        ({"splats": {**splats_of(GOOD), "sh0": None}}, "lacks the key 'sh0'"),
        ({"splats": {**splats_of(GOOD), "shN": torch.zeros(1).expand(10**12, 15, 3)}}, "more than the file can hold"),
        ({"splats": {**splats_of(GOOD), "opacities": torch.zeros(4, 1, 1)}}, "opacities has shape (4, 1, 1)"),
        ({"splats": {**splats_of(GOOD), "quats": torch.zeros(4, 4, dtype=torch.int32)}}, "torch.int32"),
        ({"splats": {**splats_of(GOOD), "scales": torch.zeros(3, 3)}}, "scales has shape (3, 3)"),
        ({"splats": {**splats_of(GOOD), "shN": torch.zeros(4, 5, 3)}}, "5 coefficients a channel"),
    ],
    ids=range(8),
)
def test_a_checkpoint_that_cannot_be_one_is_refused_in_one_line(tmp_path, capsys, content, said):
    path = tmp_path / "a.pt"
    torch.save(content, path)
    assert fails(lambda: ps.load(path), said, error=ps.SceneError).startswith(str(path))
    assert "never" not in capsys.readouterr().out
