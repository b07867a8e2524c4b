"""Configs of nerfstudio, and checkpoints of it and of gsplat's trainer, read without running
anything."""

import logging
import math
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from refusing import fails as refused

import pointsplat_ns as ps
from making import Bomb, normal_scene, same_bits
from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.checkpoints import read_checkpoint
from pointsplat_ns.scene.inert_yaml import Tagged, read_config
from pointsplat_ns.scene.reading import kind_of, read_scene, source_file


def fails(path, *fragments):
    text = refused(lambda: read_checkpoint(path), *fragments, error=SceneError)
    assert text.startswith(str(path)) and len(text) < len(str(path)) + 400


@pytest.mark.parametrize(
    "prefix", ["_model.gauss_params.", "_model.module.gauss_params.", "_model.", "_model.module."]
)
def test_parameters_come_back_to_the_bit(tmp_path, checkpoint_of, prefix):
    scene = normal_scene(6, 3)
    torch.save(checkpoint_of(scene, prefix=prefix), tmp_path / "step-000000001.ckpt")
    assert same_bits(scene, read_checkpoint(tmp_path / "step-000000001.ckpt"))


def test_colour_logits_of_degree_0_become_sh_of_the_same_colour(tmp_path, checkpoint_of):
    # Splatfacto seeds white and black points with infinite logits in float32.
    logits = torch.tensor([[0.0, math.inf, -math.inf], [2.0, -3.0, 88.0]])
    torch.save(checkpoint_of(normal_scene(2, 0).replace(features_dc=logits)), tmp_path / "a.ckpt")
    scene = read_scene(tmp_path / "a.ckpt")
    colours = 0.5 + SH_C0 * scene.features_dc
    # 2e-7: two roundings of float32 around values of at most 1
    assert torch.allclose(colours, torch.sigmoid(logits), atol=2e-7, rtol=0) and len(scene) == 2


def test_rows_without_meaning_are_dropped_counted_and_said(tmp_path, checkpoint_of, caplog):
    scene = normal_scene(5, 1)
    scene.means[3, 1] = math.nan
    scene.opacities[0] = math.inf
    torch.save(checkpoint_of(scene), tmp_path / "a.ckpt")
    with caplog.at_level(logging.WARNING, "pointsplat_ns"):
        found = read_scene(tmp_path / "a.ckpt")
    scene.opacities[0] = 30.0  # sigmoid(30) is 1 in float32
    assert same_bits(scene[[0, 1, 2, 4]], found)
    assert caplog.messages == [
        f"{tmp_path / 'a.ckpt'}: dropped 1 of 5 Gaussians with NaN or infinite values"
    ]


NUMPY_CORE = np.float64.__reduce__(np.float64(1))[0].__module__.split(".")[1]


def rewritten(path, change):
    """The file with the data of each entry as ``change`` makes it of name and data; what is in it
    then."""
    with zipfile.ZipFile(path) as archive:
        entries = {
            info.filename: change(info.filename, archive.read(info)) for info in archive.infolist()
        }
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return entries


@pytest.mark.parametrize("core", ["core", "_core"])
def test_a_checkpoint_written_with_either_numpy_loads(tmp_path, checkpoint_of, core):
    path = tmp_path / "a.ckpt"
    torch.save(checkpoint_of(normal_scene()), path)
    names = [f"cnumpy.{name}.multiarray\n".encode() for name in (NUMPY_CORE, core)]
    entries = rewritten(path, lambda _, data: data.replace(*names))
    assert any(names[1] + b"scalar" in data for data in entries.values())
    assert same_bits(normal_scene(), read_checkpoint(path))


@pytest.mark.parametrize(
    ("extra", "kind"),
    [
        (Bomb(), "print"),
        (np.array([1, "a"], dtype=object), "numpy"),
        (torch.zeros(5, 4).to_sparse(), "torch._utils._rebuild_sparse"),
    ],
)
def test_a_checkpoint_that_would_run_code_is_refused_and_runs_none(
    tmp_path, checkpoint_of, capsys, extra, kind
):
    torch.save({**checkpoint_of(normal_scene()), "extra": extra}, tmp_path / "a.ckpt")
    fails(tmp_path / "a.ckpt", f"holds an object of type {'' if kind == 'print' else kind}", kind)
    assert "never" not in capsys.readouterr().out


def test_damage_inside_a_whole_archive_is_said(tmp_path, checkpoint_of):
    path = tmp_path / "a.ckpt"
    torch.save(checkpoint_of(normal_scene()), path)
    rewritten(path, lambda name, data: data[:-20] if name.endswith("data.pkl") else data)
    fails(path, "truncated or not a checkpoint")


def test_a_compressed_archive_is_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.ckpt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(1_000_000))
    fails(tmp_path / "a.ckpt", "compressed archive")


OTHER_METHOD = {
    "step": 1,
    "pipeline": {f"_model.field.mlp.{i}.weight": torch.zeros(2) for i in range(6)},
}


@pytest.mark.parametrize(
    ("content", "found"),
    [
        *(
            (some, ["expected a checkpoint that Splatfacto, gsplat or 3DGS saved"])
            for some in (b"", b"hello", b"PK", bytes(5000), b"\x80\x02}q\x00.")
        ),
        (
            {"state_dict": {}, "epoch": 3},
            ["not a checkpoint of a scene", "found epoch, state_dict"],
        ),
        (
            OTHER_METHOD,
            [
                "another method",
                "_model.field.mlp.0.weight",
                "and 2 more",
                "_model.gauss_params.means",
            ],
        ),
    ],
)
def test_a_file_that_is_no_checkpoint_is_an_error_that_names_its_content(tmp_path, content, found):
    path = tmp_path / "a.ckpt"
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    fails(path, *found)


@pytest.mark.parametrize(
    ("name", "value", "fragment"),
    [
        *(
            (name, None, f"lacks the key '_model.gauss_params.{name}'")
            for name in ("scales", "quats", "opacities", "features_dc", "features_rest")
        ),
        ("quats", torch.zeros(4, 3), "quats has shape (4, 3); expected (5, 4)"),
        ("quats", [1.0], "is list"),
        ("quats", torch.zeros(1).expand(10**12, 4), "more than the file can hold"),
    ],
)
def test_a_parameter_that_is_missing_or_cannot_be_one_is_named(
    tmp_path, checkpoint_of, name, value, fragment
):
    content = checkpoint_of(normal_scene())
    state = {**content["pipeline"], "_model.gauss_params." + name: value}
    torch.save(
        {**content, "pipeline": {k: v for k, v in state.items() if v is not None}},
        tmp_path / "a.ckpt",
    )
    fails(tmp_path / "a.ckpt", fragment, name)


GOOD = normal_scene(4, 1)


class Touches:
    """Makes a file when it is unpickled as usual."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def splats_of(scene):
    """What ``splats.state_dict()`` of gsplat's simple_trainer holds: a ParameterDict, opacities
    (N,), sh0 (N, 1, 3)."""
    values = {
        "means": scene.means,
        "scales": scene.scales,
        "quats": scene.quats,
        "opacities": scene.opacities[:, 0],
    }
    values |= {"sh0": scene.features_dc[:, None], "shN": scene.features_rest}
    return torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    ).state_dict()


@pytest.mark.parametrize("degree", [0, 3])
def test_a_checkpoint_of_gsplat_is_read_to_the_bit(tmp_path, degree):
    scene = normal_scene(7, degree)
    path = tmp_path / "ckpt_29999_rank0.pt"
    torch.save(
        {
            "step": 29999,
            "splats": splats_of(scene),
            "pose_adjust": {"embeds.weight": torch.zeros(3, 9)},
        },
        path,
    )
    assert same_bits(read_scene(path), scene) and kind_of(path) == "checkpoint"


@pytest.mark.parametrize(
    "settings",
    ["antialiased: true\n", "antialiased: false\n", "nested:\n  antialiased: true\n", None],
)
def test_settings_of_a_gsplat_training_tell_whether_it_is_antialiased(tmp_path, settings):
    path = tmp_path / "results" / "ckpts" / "ckpt_29999_rank0.pt"
    path.parent.mkdir(parents=True)
    torch.save({"step": 29999, "splats": splats_of(GOOD)}, path)
    if settings is not None:
        config = tmp_path / "results" / "cfg.yml"
        config.write_text(
            f"absgrad: false\n{settings}strategy: !!python/object:gsplat.strategy.DefaultStrategy "
            f"{{}}\n"
        )
    assert read_scene(path).antialiased == (settings == "antialiased: true\n")


def test_parts_of_a_training_on_several_gpus_are_joined(tmp_path, caplog):
    whole = normal_scene(12, 1)
    for rank in range(3):  # gsplat gives every third point to each of three
        part = {"step": 9, "splats": splats_of(whole[rank::3])}
        torch.save(part, tmp_path / f"ckpt_9_rank{rank}.pt")
    torch.save({"step": 8, "splats": splats_of(GOOD)}, tmp_path / "ckpt_8_rank0.pt")
    joined = ps.Gaussians.cat([whole[rank::3] for rank in range(3)])
    sources = set()
    for rank in range(3):
        path = tmp_path / f"ckpt_9_rank{rank}.pt"
        with caplog.at_level(logging.INFO):
            assert same_bits(read_scene(path), joined)
        assert f"{path}: one of 3 parts of a training on several GPUs" in caplog.text
        source = source_file(path)
        assert source.name == path.name and source.bytes > 2 * path.stat().st_size
        sources.add(source.sha256)
    assert len(sources) == 1
    assert same_bits(read_scene(tmp_path / "ckpt_8_rank0.pt"), GOOD)


@pytest.mark.parametrize(("there", "missing"), [((1,), 0), ((0, 2), 1), ((0, 1, 3), 2)])
def test_a_part_of_a_training_whose_others_are_missing_is_no_scene(tmp_path, there, missing):
    for rank in there:
        torch.save({"step": 9, "splats": splats_of(GOOD)}, tmp_path / f"ckpt_9_rank{rank}.pt")
    for rank in there:
        fails(
            tmp_path / f"ckpt_9_rank{rank}.pt",
            f"parts of a training on several GPUs; expected all of them beside it; "
            f"ckpt_9_rank{missing}.pt is missing",
        )


def test_parts_of_different_sh_degrees_are_no_scene(tmp_path):
    for rank in range(2):
        part = {"step": 9, "splats": splats_of(normal_scene(3, rank))}
        torch.save(part, tmp_path / f"ckpt_9_rank{rank}.pt")
    fails(tmp_path / "ckpt_9_rank0.pt", "SH of degrees [0, 1]")


def saved_by_inria(scene, scales=None, scale_of_rates=4.5):
    """What 3DGS saves as ``chkpnt30000.pth``: its model as a tuple, and the step."""
    parameters = {
        "xyz": scene.means,
        "f_dc": scene.features_dc[:, None],
        "f_rest": scene.features_rest,
        "scaling": scene.scales if scales is None else scales,
        "rotation": scene.quats,
        "opacity": scene.opacities,
    }
    held = {name: torch.nn.Parameter(value.clone()) for name, value in parameters.items()}
    groups = [{"params": [value], "lr": 0.1, "name": name} for name, value in held.items()]
    optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    for value in held.values():
        value.grad = torch.ones_like(value)
    optimizer.step()
    before = [value.detach().clone() for value in parameters.values()]
    for value, old in zip(held.values(), before, strict=True):
        value.data = old
    n = len(scene)
    statistics = torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 1)
    degree = scene.sh_degree
    return (degree, *held.values(), *statistics, optimizer.state_dict(), scale_of_rates), 30_000


@pytest.mark.parametrize("scale", [4.5, np.float32(4.5), np.float64(4.5)], ids=repr)
@pytest.mark.parametrize("degree", [0, 3])
def test_a_checkpoint_of_3dgs_is_read_to_the_bit(tmp_path, degree, scale):
    scene = normal_scene(7, degree)
    path = tmp_path / "chkpnt30000.pth"
    torch.save(saved_by_inria(scene, scale_of_rates=scale), path)
    assert same_bits(read_scene(path), scene) and kind_of(path) == "checkpoint"


def test_discs_in_a_checkpoint_of_2dgs_are_flat(tmp_path):
    path = tmp_path / "chkpnt7.pth"
    torch.save(saved_by_inria(GOOD, GOOD.scales[:, :2]), path)
    found = read_scene(path)
    assert torch.equal(found.scales[:, :2], GOOD.scales[:, :2])
    assert float(found.stds[:, 2].max()) < 1e-30


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda model: (*model[:2], {"a": torch.zeros(1)}, *model[2:]), "of a moving scene"),
        (lambda model: (*model, torch.zeros(4, 1), torch.zeros(4, 1), None), "of a moving scene"),
        (lambda model: model[:9], "a checkpoint of 9 entries; expected 12"),
        (lambda model: (model[0], None, *model[2:]), "lacks the key 'means'"),
        (lambda model: (*model[:2], model[2][:, 0, :2], *model[3:]), "features_dc has shape"),
    ],
    ids=range(5),
)
def test_a_checkpoint_of_a_relative_of_3dgs_is_refused_by_what_it_is(tmp_path, change, said):
    model, step = saved_by_inria(GOOD)
    torch.save((change(model), step), tmp_path / "chkpnt7.pth")
    fails(tmp_path / "chkpnt7.pth", said)


@pytest.mark.parametrize("key", ["trbf_center", "motion", "omega", "velocities"])
def test_a_checkpoint_of_a_moving_scene_is_refused(tmp_path, key):
    torch.save({"step": 1, "splats": {**splats_of(GOOD), key: torch.zeros(4)}}, tmp_path / "a.pt")
    fails(tmp_path / "a.pt", "a moving scene", f"{key!r}", "one moment")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sh0": None}, "lacks the key 'sh0'"),
        ({"opacities": torch.zeros(4, 1, 1)}, "opacities has shape (4, 1, 1)"),
        ({"shN": torch.zeros(4, 5, 3)}, "5 coefficients a channel"),
    ],
    ids=range(3),
)
def test_a_checkpoint_of_gsplat_that_cannot_be_one_is_refused(tmp_path, changes, said):
    torch.save({"step": 1, "splats": {**splats_of(GOOD), **changes}}, tmp_path / "a.pt")
    fails(tmp_path / "a.pt", said)


@pytest.mark.parametrize("where", ["beside", "inside", "in place of a tensor", "in place of all"])
@pytest.mark.parametrize("zipped", [True, False], ids=["archive", "legacy"])
def test_a_checkpoint_of_gsplat_that_would_run_code_is_refused_and_runs_none(
    tmp_path, where, zipped
):
    """Told apart by a file that the code in it would make; torch itself, told to trust it, does."""
    mark = tmp_path / "mark"
    bomb = Touches(mark)
    splats = splats_of(GOOD)
    contents = {
        "beside": {"step": 1, "splats": splats, "pose_adjust": bomb},
        "inside": {"step": 1, "splats": {**splats, "extra": bomb}},
        "in place of a tensor": {"step": 1, "splats": {**splats, "sh0": bomb}},
        "in place of all": bomb,
    }
    path = tmp_path / "ckpt_29999_rank0.pt"
    torch.save(contents[where], path, _use_new_zipfile_serialization=zipped)
    fails(path, "holds an object of type")
    assert not mark.exists()
    torch.load(path, weights_only=False)
    assert mark.exists()


@pytest.mark.parametrize("zipped", [True, False], ids=["archive", "legacy"])
def test_a_tensor_of_gsplat_that_lies_outside_its_storage_is_refused(tmp_path, zipped):
    """Sizes of tensors are in the pickle: what lies behind the values of the file is never read."""
    path = tmp_path / "a.pt"
    content = {"step": 1, "splats": splats_of(GOOD)}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    small = b"K\x00K\x04K\x03\x86"  # means (4, 3) from 0, as pickled
    large = b"K\x00K\xffK\x03\x86"
    if zipped:
        entries = rewritten(path, lambda _, data: data.replace(small, large, 1))
        assert any(large in data for data in entries.values())
    else:
        assert small in path.read_bytes()
        path.write_bytes(path.read_bytes().replace(small, large, 1))
    fails(path, "truncated or not a checkpoint")


def read(tmp_path, text):
    (tmp_path / "config.yml").write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_config(tmp_path / "config.yml")


def test_python_tags_become_inert_values(tmp_path):
    root = read(
        tmp_path,
        """!!python/object:some.where.Config
_target: &id001 !!python/name:some.where.Class ''
again: *id001
path: !!python/object/apply:pathlib.PosixPath [/, data, scene]
newer: !!python/object/apply:pathlib._local.PosixPath [data]
windows: !!python/object/apply:pathlib.WindowsPath ['C:\\', data]
here: !!python/object/apply:pathlib.PosixPath []
size: !!python/tuple [1, 2.5, null]
enum: !!python/object/apply:some.where.Enum [value]
inner: !!python/object:some.where.Inner {a: 1.0e-15}
other: !something {b: true}
""",
    )
    assert root.tag == "some.where.Config"
    assert root.fields == {
        "_target": Tagged("some.where.Class", None),
        "again": Tagged("some.where.Class", None),
        "path": Path("/data/scene"),
        "newer": Path("data"),
        "windows": Path("C:/data"),
        "here": Path("."),
        "size": (1, 2.5, None),
        "enum": Tagged("some.where.Enum", ["value"]),
        "inner": Tagged("some.where.Inner", {"a": 1e-15}),
        "other": Tagged("!something", {"b": True}),
    }


def test_a_hostile_file_runs_nothing(tmp_path):
    mark = tmp_path / "mark"
    root = read(
        tmp_path,
        f"""!!python/object:a.B
a: !!python/object/apply:os.system ['touch {mark}']
b: !!python/object/apply:subprocess.check_call [[touch, {mark}]]
c: !!python/object/new:subprocess.Popen [[touch, {mark}]]
d: !!python/object/apply:builtins.open ['{mark}', w]
e: !!python/module:antigravity ''
f: !!python/name:this.s ''
g: !!python/object/apply:pathlib.Path [[nested]]
""",
    )
    assert not mark.exists() and "antigravity" not in sys.modules and "this" not in sys.modules
    assert root.fields["a"] == Tagged("os.system", [f"touch {mark}"])
    assert all(isinstance(value, Tagged) for value in root.fields.values())


def nested(first, line, depth, *last):
    """A configuration in which each line holds the one before it, several times."""
    lines = [line.format(i=i, before=i - 1) for i in range(1, depth)]
    return "\n".join(["!!python/object:a.B", f"x0: &x0 {first}", *lines, *last])


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        # As a key a tuple is hashed, and a name is made to text: both would take the time and
        # memory of all values.
        (
            nested("[a]", "x{i}: &x{i} [*x{before}, *x{before}]", 20, "? *x19", ": 1"),
            "more than 65536 values",
        ),
        (
            nested(
                "[a]", "x{i}: &x{i} !!python/tuple [*x{before}, *x{before}]", 20, "? *x19", ": 1"
            ),
            "65536 values",
        ),
        ("!!python/object:a.B\nmethod_name: &x [*x]", "contains itself"),
        (
            nested("{k: v}", "x{i}: &x{i} {{<<: [*x{before}, *x{before}]}}", 4),
            "merge keys are not supported at line 3",
        ),
        (b"\xff\xfe\xff", "not a nerfstudio config.yml"),
        ("a: 1", "expected a saved trainer configuration"),
        ("!!python/object:a.B {? [1, 2] : 3}", "unhashable"),
        ("[" * 1500, "not a nerfstudio config.yml"),
        ("a" * (1 << 20) + "a", "1048577 bytes"),
    ],
)
def test_what_is_no_configuration_is_said(tmp_path, text, fragment):
    said = refused(lambda: read(tmp_path, text), fragment, error=SceneError)
    assert said.startswith(str(tmp_path / "config.yml"))
