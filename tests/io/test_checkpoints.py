"""Checkpoints of gsplat's trainer and of INRIA's 3D Gaussian Splatting, in the layouts that these programs save."""

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import normal_scene, same_bits
from pointsplat_ns.io.scene import kind_of, source_file

GOOD = normal_scene(4, 1)


def splats_of(scene):
    """What ``splats.state_dict()`` of gsplat's simple_trainer holds: a ParameterDict, opacities (N,), sh0 (N, 1, 3)."""
    values = {"means": scene.means, "scales": scene.scales, "quats": scene.quats, "opacities": scene.opacities[:, 0]}
    values |= {"sh0": scene.features_dc[:, None], "shN": scene.features_rest}
    return torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    ).state_dict()


def captured(scene, degree=None, number=np.float64, entries=12):
    """``GaussianModel.capture()`` of 3D Gaussian Splatting: parameters, statistics, the optimiser, and a number of
    numpy, which is also in the optimiser's learning rate."""
    values = [scene.means, scene.features_dc[:, None], scene.features_rest, scene.scales, scene.quats, scene.opacities]
    parameters = [torch.nn.Parameter(value.clone()) for value in values]
    extent = number(3.3)
    optimizer = torch.optim.Adam([{"params": [value], "lr": 1e-3} for value in parameters], lr=0.0, eps=1e-15)
    optimizer.param_groups[0]["lr"] = 1.6e-4 * extent
    for value in parameters:
        value.grad = torch.ones_like(value)
    state = optimizer.state_dict()
    n = len(scene)
    rest = [torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 1), state, extent]
    return (scene.sh_degree if degree is None else degree, *parameters, *rest)[:entries]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_checkpoint_of_gsplat_is_read_to_the_bit(tmp_path, degree):
    scene = normal_scene(7, degree)
    path = tmp_path / "ckpt_29999_rank0.pt"
    torch.save({"step": 29999, "splats": splats_of(scene), "pose_adjust": {"embeds.weight": torch.zeros(3, 9)}}, path)
    assert same_bits(ps.load(path), scene)
    assert kind_of(path) == ps.info(path).format == "checkpoint of gsplat, step 29999"


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


def test_a_name_under_which_gsplat_saves_2d_gaussians_too_is_warned_of(tmp_path, caplog):
    torch.save({"step": 29999, "splats": splats_of(GOOD)}, tmp_path / "ckpt_29999.pt")
    assert same_bits(ps.load(tmp_path / "ckpt_29999.pt"), GOOD)
    assert "read as 3D Gaussians; simple_trainer_2dgs.py saves 2D ones" in caplog.text


def test_parts_of_several_gpus_are_one_scene_whichever_is_named(tmp_path):
    scene = normal_scene(9, 2)
    for rank in range(3):
        part = {"step": 6999, "splats": splats_of(scene[rank::3])}
        torch.save(part, tmp_path / f"ckpt_6999_rank{rank}.pt")
    torch.save({"step": 29, "splats": splats_of(scene[:2])}, tmp_path / "ckpt_29_rank0.pt")
    paths = [tmp_path / f"ckpt_6999_rank{rank}.pt" for rank in range(3)]
    wanted = scene[[0, 3, 6, 1, 4, 7, 2, 5, 8]]
    assert all(same_bits(ps.load(path), wanted) for path in paths)
    assert source_file(paths[1]).bytes == ps.info(paths[0]).bytes == sum(path.stat().st_size for path in paths)
    assert source_file(paths[1]).sha256 == source_file(paths[0]).sha256
    assert len(ps.load(tmp_path / "ckpt_29_rank0.pt")) == 2
    paths[1].unlink()
    with pytest.raises(ps.SceneError, match="ckpt_6999_rank1.pt is missing"):
        ps.load(paths[2])


def test_parts_of_different_degrees_are_one_error(tmp_path):
    for rank, degree in enumerate((1, 3)):
        torch.save({"step": 1, "splats": splats_of(normal_scene(3, degree))}, tmp_path / f"ckpt_1_rank{rank}.pt")
    with pytest.raises(ps.SceneError, match="different SH degrees"):
        ps.load(tmp_path / "ckpt_1_rank0.pt")


def test_appearance_optimisation_of_gsplat_is_refused_by_name(tmp_path):
    splats = splats_of(normal_scene(4, 1))
    del splats["sh0"], splats["shN"]
    splats |= {"features": torch.zeros(4, 32), "colors": torch.zeros(4, 3)}
    torch.save({"step": 1, "splats": splats, "app_module": {"a": torch.zeros(2)}}, tmp_path / "a.pt")
    with pytest.raises(ps.SceneError, match=r"appearance optimisation \(--app_opt\).*--save_ply"):
        ps.load(tmp_path / "a.pt")


@pytest.mark.parametrize("number", [float, np.float32, np.float64])
def test_a_checkpoint_of_3dgs_is_read_to_the_bit_whatever_numpy_wrote(tmp_path, number):
    scene = normal_scene(7, 3)
    path = tmp_path / "chkpnt30000.pth"
    torch.save((captured(scene, number=number), 30000), path)
    assert same_bits(ps.load(path), scene)
    assert kind_of(path) == "checkpoint of 3DGS, step 30000"


def test_bands_of_sh_that_the_training_did_not_draw_yet_are_left_out(tmp_path):
    scene = normal_scene(5, 3)
    torch.save((captured(scene, degree=1), 1500), tmp_path / "a.pth")
    assert same_bits(ps.load(tmp_path / "a.pth"), scene.replace(features_rest=scene.features_rest[:, :3]))


def test_2d_gaussians_and_degree_4_are_read_as_in_plys(tmp_path, caplog):
    scene = normal_scene(5, 3)
    flat = list(captured(scene))
    flat[4] = torch.nn.Parameter(scene.scales[:, :2].clone())
    torch.save((tuple(flat), 30000), tmp_path / "a.pth")
    found = ps.load(tmp_path / "a.pth")
    assert torch.equal(found.scales[:, :2], scene.scales[:, :2]) and bool((found.scales[:, 2] == -87).all())
    splats = splats_of(scene) | {"shN": torch.cat([scene.features_rest, torch.ones(5, 9, 3)], dim=1)}
    torch.save({"step": 1, "splats": splats}, tmp_path / "b.pt")
    assert same_bits(ps.load(tmp_path / "b.pt"), scene)
    assert "2D Gaussians" in caplog.text and "SH degree 4, read up to degree 3" in caplog.text


class Bomb:
    def __reduce__(self):
        return (print, ("this must never be printed",))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"step": 1, "splats": {**splats_of(GOOD), "extra": Bomb()}}, "holds an object of type print"),
        (((*captured(GOOD)[:-1], Bomb()), 1), "holds an object of type print"),
        ((captured(GOOD, entries=11), 1), "a tuple of 11 entries"),
        (((*captured(GOOD), 1, 2), 1), "a tuple of 14 entries"),
        ((captured(GOOD, degree=9), 1), "the active SH degree first"),
        ((captured(GOOD, degree=torch.zeros(4)), 1), "the active SH degree first"),
        (((1, *[torch.zeros(4, 5)] * 6, *captured(GOOD)[7:]), 1), "means has shape (4, 5)"),
        (((1, *["text"] * 6, *captured(GOOD)[7:]), 1), "'means' is str"),
        ({"splats": {}}, "lacks the key 'means'"),
        ({"splats": {**splats_of(GOOD), "sh0": None}}, "lacks the key 'sh0'"),
        ({"splats": {**splats_of(GOOD), "shN": torch.zeros(1).expand(10**12, 15, 3)}}, "more than the file can hold"),
        ({"splats": {**splats_of(GOOD), "opacities": torch.zeros(4, 1, 1)}}, "opacities has shape (4, 1, 1)"),
        ({"splats": {**splats_of(GOOD), "quats": torch.zeros(4, 4, dtype=torch.int32)}}, "torch.int32"),
        ({"splats": {**splats_of(GOOD), "scales": torch.zeros(3, 3)}}, "scales has shape (3, 3)"),
        ({"splats": {**splats_of(GOOD), "shN": torch.zeros(4, 5, 3)}}, "5 coefficients a channel"),
        (((), ()), "a tuple of 0 entries"),
    ],
    ids=range(16),
)
def test_a_checkpoint_that_cannot_be_one_is_refused_in_one_line(tmp_path, capsys, content, said):
    path = tmp_path / "a.pt"
    torch.save(content, path)
    with pytest.raises(ps.SceneError) as caught:
        ps.load(path)
    assert said in str(caught.value) and str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    assert "never" not in capsys.readouterr().out
