"""glTF with Gaussians: what is written, read back; and what other programs may write."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from gltfs import KHR, Builder, glb_of, taken_apart
from refusing import fails

import pointsplat_ns as ps
from making import cloud, normal_scene
from pointsplat_ns.cli.scene_options import output_beside
from pointsplat_ns.geometry.harmonics import basis_rows
from pointsplat_ns.geometry.transforms import direction_of, rotation_matrices
from pointsplat_ns.scene.discovery import find_scenes
from pointsplat_ns.scene.reading import kind_of, source_file

CASES = Path(__file__).parent / "cases"
SCENE = cloud(40, 3, 3)


def loaded(tmp_path, built: Builder, name: str = "a.glb") -> ps.Gaussians:
    (tmp_path / name).write_bytes(built.gltf() if name.endswith(".gltf") else built.glb())
    return ps.load(tmp_path / name)


def covariances(scene: ps.Gaussians) -> torch.Tensor:
    axes = rotation_matrices(scene.quats.double()) * scene.scales.double().exp()[:, None]
    return axes @ axes.mT


def colours(scene: ps.Gaussians, directions: torch.Tensor) -> torch.Tensor:
    """SH of a scene (N, 3, M) in directions (M, 3)."""
    basis = torch.stack(basis_rows(directions.T, scene.sh_degree))
    return torch.einsum("km,nkc->ncm", basis, scene.sh.double())


DIRECTIONS = torch.nn.functional.normalize(
    torch.randn(50, 3, generator=torch.Generator().manual_seed(5)).double(), dim=1
)


def same_after(
    got: ps.Gaussians, scene: ps.Gaussians, linear: torch.Tensor, moved: torch.Tensor
) -> None:
    """A scene is another one after a transform."""
    wanted = scene.means.double() @ linear.T + moved
    at = torch.tensor(got.offset or (0.0, 0.0, 0.0)).double()
    torch.testing.assert_close(got.means.double() + at, wanted, rtol=1e-6, atol=1e-6)
    spread = linear @ covariances(scene) @ linear.T
    torch.testing.assert_close(covariances(got), spread, rtol=1e-4, atol=1e-7)
    left, _, right = torch.linalg.svd(linear)
    rotation = left @ right
    torch.testing.assert_close(
        colours(got, DIRECTIONS), colours(scene, DIRECTIONS @ rotation), rtol=1e-4, atol=1e-4
    )
    torch.testing.assert_close(got.alphas, scene.alphas, rtol=0, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_a_scene_comes_back_to_the_last_bits_of_its_activations(tmp_path, suffix, degree):
    scene = cloud(300, 7, degree)
    ps.save(scene, tmp_path / f"a{suffix}")
    back = ps.load(tmp_path / f"a{suffix}")
    assert kind_of(tmp_path / f"a{suffix}") == "glTF"
    for name in ("means", "features_dc", "features_rest"):
        assert torch.equal(getattr(back, name), getattr(scene, name)), name
    unit = scene.quats / scene.quats.norm(dim=1, keepdim=True)
    torch.testing.assert_close(back.quats, unit, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.scales, scene.scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.alphas, scene.alphas, rtol=0, atol=1e-6)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z", None])
@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".spz.glb"])
def test_traits_come_back_and_viewers_see_y_up(tmp_path, suffix, up):
    scene = SCENE.replace(up=up, antialiased=True, offset=(451000.0, -5412000.5, 300.25))
    ps.save(scene, tmp_path / f"a{suffix}")
    back = ps.load(tmp_path / f"a{suffix}")
    assert back.traits == scene.traits
    torch.testing.assert_close(back.means, scene.means, rtol=0, atol=3e-4)
    if suffix == ".gltf":
        return
    content, _ = taken_apart((tmp_path / f"a{suffix}").read_bytes())
    matrix = np.array(content["nodes"][0].get("matrix", np.eye(4).ravel())).reshape(4, 4).T
    assert np.linalg.det(matrix) == 1 and not matrix[:3, 3].any()
    if up is not None:
        assert (matrix[:3, :3] @ direction_of(up).numpy()).tolist() == [0, 1, 0]


@pytest.mark.parametrize("suffix", [".glb", ".spz.glb"])
def test_a_direction_along_no_axis_comes_back_and_viewers_see_it_up(tmp_path, suffix):
    up = (0.123, 0.456, -0.789)
    scene = SCENE.replace(up=up)
    ps.save(scene, tmp_path / f"a{suffix}")
    back = ps.load(tmp_path / f"a{suffix}")
    assert back.up == up
    torch.testing.assert_close(back.means, scene.means, rtol=0, atol=3e-4)
    content, _ = taken_apart((tmp_path / f"a{suffix}").read_bytes())
    matrix = np.array(content["nodes"][0]["matrix"]).reshape(4, 4).T
    assert matrix[:3, :3] @ direction_of(up).numpy() == pytest.approx([0, 1, 0], abs=1e-12)


def test_another_program_sees_the_scene_turned_to_y_up(tmp_path):
    """What is written with the traits left out is read as by others."""
    scene = SCENE.replace(up="-z")
    ps.save(scene, tmp_path / "a.gltf")
    text = (tmp_path / "a.gltf").read_text()
    (tmp_path / "a.gltf").write_text(text.replace('"pointsplat_ns":', '"others":'))
    back = ps.load(tmp_path / "a.gltf")
    assert back.up == "y"
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
    same_after(back, scene, turn, torch.zeros(3))


def test_a_file_says_what_the_extension_asks_for(tmp_path):
    scene = cloud(50, 2, 2).replace(up="y")
    ps.save(scene, tmp_path / "a.glb")
    content, binary = taken_apart((tmp_path / "a.glb").read_bytes())
    assert content["extensionsUsed"] == [KHR] and "extensionsRequired" not in content
    (primitive,) = content["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    names = ["ROTATION", "SCALE", "OPACITY"]
    names += [f"SH_DEGREE_{d}_COEF_{i}" for d in range(3) for i in range(2 * d + 1)]
    assert {*primitive["attributes"]} == {"POSITION", "COLOR_0", *(f"{KHR}:{n}" for n in names)}

    def values(name: str, dtype: str = "<f4") -> np.ndarray:
        accessor = content["accessors"][primitive["attributes"][name]]
        view = content["bufferViews"][accessor["bufferView"]]
        assert accessor["count"] == 50 and view["byteOffset"] % 4 == 0
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, dtype, 50 * width, view["byteOffset"]).reshape(50, width)

    position = content["accessors"][primitive["attributes"]["POSITION"]]
    assert np.array_equal(values("POSITION"), scene.means)
    assert position["min"] == values("POSITION").min(axis=0).tolist()
    assert position["max"] == values("POSITION").max(axis=0).tolist()
    assert np.allclose(values(f"{KHR}:SCALE"), scene.stds, rtol=1e-6)
    assert np.allclose(values(f"{KHR}:OPACITY")[:, 0], scene.alphas, atol=1e-6)
    turns = values(f"{KHR}:ROTATION")
    assert np.allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-6)
    assert np.array_equal(values(f"{KHR}:SH_DEGREE_2_COEF_4"), scene.features_rest[:, 7])
    shown = np.clip(0.5 + 0.2820947917738781 * scene.features_dc.numpy(), 0, 1)
    colour = content["accessors"][primitive["attributes"]["COLOR_0"]]
    assert colour["componentType"] == 5121 and colour["normalized"] is True
    linear = values("COLOR_0", "u1")[:, :3] / 255
    assert np.abs(linear - shown**2.2).max() < 0.01, "colours of points are linear"
    assert (
        np.abs(values("COLOR_0", "u1")[:, 3] / 255 - scene.alphas.numpy()).max() < 0.5 / 255 + 1e-6
    )


def test_a_glb_with_spz_names_its_extensions_and_is_told_apart(tmp_path):
    scene = SCENE.replace(up="-y")
    ps.save(scene, tmp_path / "a.spz.glb")
    ps.save(scene, tmp_path / "a.spz")
    content, binary = taken_apart((tmp_path / "a.spz.glb").read_bytes())
    packing = f"{KHR}_compression_spz_2"
    assert content["extensionsRequired"] == content["extensionsUsed"] == [KHR, packing]
    (primitive,) = content["meshes"][0]["primitives"]
    extension = primitive["extensions"][KHR]
    assert extension["kernel"] == "ellipse" and extension["extensions"][packing] == {
        "bufferView": 0
    }
    assert binary[:2] == b"\x1f\x8b"
    (tmp_path / "a.spz.glb").rename(tmp_path / "b.glb")
    assert kind_of(tmp_path / "b.glb") == "glTF with SPZ"
    back = ps.load(tmp_path / "b.glb")
    step = torch.tensor(1 / 4096)
    assert (back.means - scene.means).abs().max() <= step
    assert (back.scales - scene.scales).abs().max() <= 1 / 32 + 1e-6
    assert back.up == "-y"


def test_an_empty_scene_comes_back(tmp_path):
    for suffix in (".glb", ".gltf", ".spz.glb"):
        ps.save(ps.Gaussians.empty(2).replace(up="z"), tmp_path / f"a{suffix}")
        back = ps.load(tmp_path / f"a{suffix}")
        assert (len(back), back.sh_degree, back.up) == (0, 2, "z")


def test_a_scene_without_a_declared_up_axis_is_said_to_be_taken_as_y_up(tmp_path, caplog):
    ps.save(SCENE, tmp_path / "a.glb")
    assert "a.glb: glTF is y up" in caplog.text and "--up y" in caplog.text
    caplog.clear()
    ps.save(SCENE.replace(up="z"), tmp_path / "b.glb")
    ps.save(SCENE, tmp_path / "b.ply")
    assert not caplog.messages


def test_transforms_of_nested_nodes_are_applied(tmp_path):
    half = math.sqrt(0.5)
    built = glb_of(SCENE, rotation=[half, 0, 0, half], translation=[1, 2, 3], scale=[2, 2, 2])
    columns = [0, 3, 0, 0, -3, 0, 0, 0, 0, 0, 3, 0, 10, 20, 30, 1]
    built.node(matrix=columns, children=[0])
    built.content.update(scene=0, scenes=[{"nodes": [1]}])
    back = loaded(tmp_path, built)
    about_x = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()
    outer = torch.tensor([[0.0, -3, 0], [3, 0, 0], [0, 0, 3]]).double()
    at = outer @ torch.tensor([1.0, 2, 3]).double() + torch.tensor([10.0, 20, 30])
    same_after(back, SCENE, outer @ about_x * 2, at)
    assert back.up == "y"


@pytest.mark.parametrize("scale", [[1, 2, 0.25], [-1, 1, 1], [-2, -2, -2], [1, -3, 2]])
def test_other_scales_along_each_axis_and_mirrors_are_exact(tmp_path, scale):
    half = math.sqrt(0.5)
    back = loaded(tmp_path, glb_of(SCENE, rotation=[0, half, 0, half], scale=scale))
    about_y = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).double()
    linear = about_y * torch.tensor(scale).double()
    same_after(back, SCENE, linear, torch.zeros(3))


def test_flat_gaussians_and_those_that_cannot_be_drawn_pass_a_stretch(tmp_path, caplog):
    scene = cloud(3, 1, 0)
    scene.scales[0, 1] = -math.inf
    scene.scales[1, 0] = math.nan
    back = loaded(tmp_path, glb_of(scene, scale=[1, 2, 3]))
    assert len(back) == 2 and "dropped 1 of 3" in caplog.text
    assert float(back.scales[0].min()) < -80


def test_far_from_the_origin_positions_keep_their_digits(tmp_path):
    back = loaded(tmp_path, glb_of(SCENE, translation=[4.5e6, 1.25, -3e6]))
    assert back.offset is not None
    same_after(back, SCENE, torch.eye(3).double(), torch.tensor([4.5e6, 1.25, -3e6]).double())


def test_all_primitives_and_nodes_are_joined_and_other_geometry_is_named(tmp_path, caplog):
    built = Builder()
    low, high = cloud(5, 1, 1), cloud(7, 2, 3)
    points = {"attributes": {"POSITION": built.accessor(np.zeros((4, 3), "<f4"))}}
    two = built.mesh(built.splats(low), points, built.splats(high))
    built.node(mesh=two)
    built.node(mesh=two, translation=[100, 0, 0])
    built.node(mesh=built.mesh(points))
    built.node(name="a camera")
    back = loaded(tmp_path, built)
    assert len(back) == 2 * (5 + 7) and back.sh_degree == 3
    means = torch.cat([low.means, high.means])
    wanted = torch.cat([means, means + torch.tensor([100.0, 0, 0])])
    torch.testing.assert_close(back.means, wanted, rtol=0, atol=1e-5)
    assert torch.equal(back.features_rest[:5, :3], low.features_rest)
    assert not back.features_rest[:5, 3:].any()
    assert "3 primitives without Gaussians are ignored" in caplog.text


def test_only_nodes_of_the_scene_are_read(tmp_path):
    built = glb_of(SCENE)
    built.node(mesh=0, translation=[9, 9, 9])
    built.content["scenes"] = [{"nodes": [1]}, {"nodes": [0]}]
    built.content["scene"] = 1
    back = loaded(tmp_path, built)
    assert len(back) == len(SCENE) and torch.equal(back.means, SCENE.means)


def test_buffers_are_read_from_data_uris_and_from_files_beside(tmp_path):
    built = glb_of(SCENE)
    whole = loaded(tmp_path, built)
    assert torch.equal(loaded(tmp_path, built, "a.gltf").means, whole.means)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "the data.bin").write_bytes(built.data)
    (tmp_path / "b.gltf").write_bytes(built.gltf("parts/the%20data.bin"))
    assert torch.equal(ps.load(tmp_path / "b.gltf").features_rest, whole.features_rest)
    size = sum(
        path.stat().st_size for path in (tmp_path / "b.gltf", tmp_path / "parts/the data.bin")
    )
    assert source_file(tmp_path / "b.gltf")[:2] == ("b.gltf", size)


def test_integers_strides_and_sparse_values_are_read(tmp_path):
    built = Builder()
    n = len(SCENE)
    spread = np.zeros((n, 10), "<f4")
    spread[:, 2:5] = SCENE.means
    view = built.view(spread.tobytes(), byteStride=40)
    means = built.accessor(SCENE.means.numpy(), bufferView=view, byteOffset=8)
    alphas = built.accessor((255 * SCENE.alphas.numpy()).round().astype("u1"), normalized=True)
    unit = SCENE.quats / SCENE.quats.norm(dim=1, keepdim=True)
    turns = (32767 * unit[:, [1, 2, 3, 0]].numpy()).round().astype("<i2")
    sparse = {
        "count": 2,
        "indices": {
            "bufferView": built.view(np.array([3, 9], "<u2").tobytes()),
            "componentType": 5123,
        },
        "values": {"bufferView": built.view(np.full((2, 3), 1.5, "<f4").tobytes())},
    }
    dc = built.accessor(np.zeros((n, 3), "<f4"), sparse=sparse)
    primitive = built.splats(
        SCENE,
        POSITION=means,
        OPACITY=alphas,
        ROTATION=built.accessor(turns, normalized=True),
        SH_DEGREE_0_COEF_0=dc,
    )
    built.node(mesh=built.mesh(primitive))
    back = loaded(tmp_path, built)
    assert torch.equal(back.means, SCENE.means)
    assert (back.alphas - SCENE.alphas).abs().max() < 0.51 / 255
    torch.testing.assert_close(
        rotation_matrices(back.quats), rotation_matrices(unit), rtol=0, atol=1e-3
    )
    wanted = torch.zeros(n, 3)
    wanted[[3, 9]] = 1.5
    assert torch.equal(back.features_dc, wanted)


def test_colours_of_points_stand_in_for_missing_attributes(tmp_path):
    built = Builder()
    rows = np.random.default_rng(1).integers(0, 256, (len(SCENE), 4)).astype("u1")
    colour = built.accessor(rows, normalized=True)
    primitive = built.splats(SCENE, OPACITY=None, SH_DEGREE_0_COEF_0=None, COLOR_0=colour)
    built.node(mesh=built.mesh(primitive))
    back = loaded(tmp_path, built)
    shown = 0.5 + 0.2820947917738781 * back.features_dc
    assert np.abs(shown.numpy() - rows[:, :3] / 255).max() < 1e-6
    assert np.abs(back.alphas.numpy() - rows[:, 3] / 255).max() < 1e-6


def test_linear_colours_become_srgb(tmp_path, caplog):
    built = glb_of(cloud(20, 4, 1))
    (primitive,) = built.content["meshes"][0]["primitives"]
    primitive["extensions"][KHR]["colorSpace"] = "lin_rec709_display"
    back = loaded(tmp_path, built)
    linear = colours(cloud(20, 4, 0), DIRECTIONS[:1])[..., 0].numpy() + 0.5
    shown = colours(back.replace(features_rest=back.features_rest[:, :0]), DIRECTIONS[:1])
    kept = linear > 0.01
    assert np.abs((shown[..., 0].numpy() + 0.5)[kept] ** 2.4 - linear[kept]).max() < 0.1
    assert "linear colours" in caplog.text


def changed(change) -> Builder:
    built = glb_of(SCENE)
    change(built.content)
    return built


def extension_of(content: dict) -> dict:
    return content["meshes"][0]["primitives"][0]["extensions"][KHR]


def attributes_of(content: dict) -> dict:
    return content["meshes"][0]["primitives"][0]["attributes"]


REFUSED = {
    "shears": lambda c: c["nodes"][0].update(
        matrix=[1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    ),
    "scaled to nothing": lambda c: c["nodes"][0].update(scale=[1, 0, 1]),
    "expected finite numbers": lambda c: c["nodes"][0].update(scale=[1, math.nan, 1]),
    "whose last row": lambda c: c["nodes"][0].update(matrix=[1] * 16),
    "expected 16 numbers": lambda c: c["nodes"][0].update(matrix=[1] * 15),
    "two parents": lambda c: c["nodes"].append({"children": [0, 0]}),
    "nodes 7 is missing": lambda c: c.update(scenes=[{"nodes": [7]}]),
    "nested too deeply": lambda c: c["nodes"].extend({"children": [k]} for k in range(300)),
    "no geometry and no Gaussians": lambda c: c["nodes"][0].pop("mesh"),
    "1 other primitives and no Gaussians": lambda c: c["meshes"][0]["primitives"][0].pop(
        "extensions"
    ),
    "kernel 'cube'": lambda c: extension_of(c).update(kernel="cube"),
    "with XYZ_packing are not read": lambda c: extension_of(c).update(
        extensions={"XYZ_packing": {}}
    ),
    "EXT_meshopt_compression, which is not read": lambda c: c["bufferViews"][0].update(
        extensions={"EXT_meshopt_compression": {}}
    ),
    "EXT_mesh_gpu_instancing": lambda c: c["nodes"][0].update(
        extensions={"EXT_mesh_gpu_instancing": {}}
    ),
    f"lacks '{KHR}:SCALE'": lambda c: attributes_of(c).pop(f"{KHR}:SCALE"),
    f"SH without {KHR}:SH_DEGREE_2_COEF_3": lambda c: attributes_of(c).pop(
        f"{KHR}:SH_DEGREE_2_COEF_3"
    ),
    "of 39 Gaussians, expected 40": lambda c: c["accessors"][1].update(count=39),
    "truncated; an accessor of 10000000000": lambda c: c["accessors"][0].update(count=10**10),
    "accessor 0 has no data": lambda c: c["accessors"][0].pop("bufferView"),
    "expected a whole number from 1": lambda c: c["accessors"][0].update(count=0),
    "is of type 'VEC2', expected VEC3": lambda c: c["accessors"][0].update(type="VEC2"),
    "numbers of type 5130": lambda c: c["accessors"][0].update(componentType=5130),
    "truncated; buffer view 0 ends": lambda c: c["bufferViews"][0].update(byteLength=10**12),
    "a stride of 4 bytes": lambda c: c["bufferViews"][0].update(byteStride=4),
    "glTF of version '3.0'": lambda c: c["asset"].update(version="3.0"),
    "names no asset": lambda c: c.pop("asset"),
    "accessors is a dict": lambda c: c.update(accessors={}),
}


@pytest.mark.parametrize("said", REFUSED)
def test_what_is_damaged_or_not_read_is_refused_in_one_line(tmp_path, said):
    (tmp_path / "a.glb").write_bytes(changed(REFUSED[said]).glb())
    text = fails(lambda: ps.load(tmp_path / "a.glb"), said, error=ps.SceneError)
    assert text.startswith(str(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    "uri",
    ["../a.bin", "/etc/passwd", "https://host/a.bin", "a\\b.bin", "%2e%2e/a.bin", "file:a", 7],
)
def test_buffers_outside_of_the_folder_and_on_the_network_are_refused(tmp_path, uri):
    (tmp_path / "a.bin").write_bytes(glb_of(SCENE).data)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.gltf").write_bytes(glb_of(SCENE).gltf(uri))
    fails(lambda: ps.load(tmp_path / "in" / "a.gltf"), "expected one in its own folder")


def test_data_uris_and_files_that_are_short_are_refused(tmp_path):
    path = tmp_path / "a.gltf"
    for uri, said in (
        ("data:application/octet-stream,abc", "not base64"),
        ("data:;base64,abc!", "buffer 0"),
        ("data:;base64,abcd", "truncated; buffer 0 has 3 bytes"),
        ("missing.bin", "missing.bin: cannot be read"),
    ):
        path.write_bytes(glb_of(SCENE).gltf(uri))
        fails(lambda: ps.load(path), said, error=ps.SceneError)


def test_a_mesh_among_scenes_is_passed_over(tmp_path, caplog):
    (tmp_path / "mesh.glb").write_bytes(
        changed(lambda c: c["meshes"][0]["primitives"][0].pop("extensions")).glb()
    )
    (tmp_path / "room.glb").write_bytes(glb_of(SCENE).glb())
    ps.save(normal_scene(5, 0), tmp_path / "small.spz.glb")
    assert [*find_scenes(tmp_path)] == ["room", "small"]
    assert "mesh.glb: no Gaussians in it" in caplog.text


def test_what_splat_transform_writes_is_read_right():
    """It takes a PLY to have -y up, and turns it about z."""
    room = ps.example_room()[::600]
    back = ps.load(CASES / "splat_transform.glb")
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    order = torch.cdist(back.means.double(), room.means.double() @ half_turn).argmin(dim=1)
    assert sorted(order.tolist()) == list(range(len(room)))
    same_after(back, room[order], half_turn, torch.zeros(3))
    assert back.up == "y"


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".spz.glb"])
def test_a_budget_in_bytes_is_kept(tmp_path, suffix):
    room = ps.example_room()[::20]
    keep = f"0.06MB{suffix}"
    small = ps.prune(room, keep=keep, by="coverage")
    ps.save(small, tmp_path / f"a{suffix}")
    size = (tmp_path / f"a{suffix}").stat().st_size
    assert 0.9 * 60_000 < size <= 60_000


@pytest.mark.parametrize("name", ["room.glb", "room.spz.glb", "room.gltf"])
def test_results_are_beside_a_scene_in_its_format(tmp_path, name):
    ps.save(cloud(9), tmp_path / name)
    assert output_beside(tmp_path / name, "pruned").name == name.replace("room", "room_pruned")
