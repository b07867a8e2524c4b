"""LPIPS against torchmetrics' own, where its weights come from, and how it says that there are none."""

import hashlib
import math
import os
import re
import socket
import urllib.error
from dataclasses import replace
from io import BytesIO

import cachetools
import pytest
import torch

from making import SHARED_DATA
from making import noisy_pair as pair
from pointsplat_ns.metrics import ImageError, lpips
from pointsplat_ns.metrics.lpips import WEIGHTS_VARIABLE, LpipsUnavailable, ReportedLpips, empty_features, load_lpips

WEIGHTS = SHARED_DATA / "weights"
FILES = {"alex": "alexnet_features.pth", "vgg": "vgg16_features.pth"}
NETS = ["alex", "vgg"]


def random_backbone(net, seed=0):
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, empty in empty_features(net).state_dict().items():
        # He's initialisation keeps the activations of one size through all layers.
        spread = math.sqrt(2 / empty[0].numel()) if name.endswith("weight") else 0.1
        state[f"features.{name}"] = spread * torch.randn(empty.shape, generator=generator)
    return state


@pytest.fixture(scope="module")
def alex_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("backbone") / "mine.pth"
    torch.save({**random_backbone("alex"), "classifier.1.weight": torch.zeros(2)}, path)
    return path


@pytest.fixture
def alex(alex_file):
    return load_lpips("alex", alex_file)


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    """No variable, an empty hub cache, and a network that answers nothing."""
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    asked = []

    def refuse(request, *args, **kwargs):
        asked.append(request.full_url)
        raise urllib.error.URLError(OSError(-3, "Temporary failure in name resolution"))

    monkeypatch.setattr(torch.hub, "urlopen", refuse)
    return asked


# Values


@pytest.mark.parametrize("net", NETS)
@pytest.mark.parametrize("real", [False, True])
def test_lpips_is_torchmetrics(net, real, tmp_path):
    lpips = pytest.importorskip("torchmetrics.functional.image.lpips")
    if real:
        path = WEIGHTS / FILES[net]
        if not path.is_file():
            pytest.skip(f"{FILES[net]} is not at hand")
        state = torch.load(path, weights_only=True)
    else:
        state = random_backbone(net)
        path = tmp_path / "backbone.pth"
        torch.save(state, path)
    theirs = lpips._LPIPS(pretrained=True, net=net, pnet_rand=True).eval()
    for part in theirs.net.children():
        for index, layer in part.named_children():
            if hasattr(layer, "weight"):
                layer.weight.data, layer.bias.data = state[f"features.{index}.weight"], state[f"features.{index}.bias"]
    a, b = pair(2, 64, 80)
    expected = theirs(a.permute(0, 3, 1, 2), b.permute(0, 3, 1, 2), normalize=True).flatten()
    # 1e-5: float32 convolutions; the values are about 0.1
    assert torch.allclose(load_lpips(net, path)(a, b), expected, atol=1e-5, rtol=1e-5) and expected.min() > 1e-3


def test_the_gradient_is_finite_where_every_feature_is_zero(alex_file):
    state = torch.load(alex_file, weights_only=True)
    for index in (0, 3, 6, 8, 10):
        state[f"features.{index}.weight"] = -state[f"features.{index}.weight"].abs()
        state[f"features.{index}.bias"] = torch.zeros_like(state[f"features.{index}.bias"])
    torch.save(state, alex_file.parent / "dead.pth")
    dead = load_lpips("alex", alex_file.parent / "dead.pth")
    pred = torch.ones(40, 40, 3, requires_grad=True)  # bright: all first features are below zero, so cut off
    value = dead(pred, torch.zeros(40, 40, 3))
    value.backward()
    assert value.isfinite() and pred.grad.isfinite().all()


def test_value_and_gradient_in_float32_are_those_of_float64(alex):
    a, b = pair(40, 44, dtype=torch.float64)
    results = []
    for dtype in (torch.float64, torch.float32):
        pred = a.detach().clone().to(dtype).requires_grad_()
        value = alex(pred, b.to(dtype))
        value.backward()
        assert value.dtype == dtype
        results.append((value.item(), pred.grad.double()))
    assert results[1][0] == pytest.approx(results[0][0], rel=1e-4)  # five float32 layers
    difference = (results[1][1] - results[0][1]).norm() / results[0][1].norm()
    assert difference < 1e-3  # a ReLU that flips at rounding changes its gradient whole


@pytest.mark.parametrize("net", NETS)
def test_the_smallest_image_works_and_smaller_ones_are_refused(net, tmp_path):
    torch.save(random_backbone(net), tmp_path / "b.pth")
    model, least = load_lpips(net, tmp_path / "b.pth"), {"alex": 31, "vgg": 16}[net]
    assert model(*pair(least, least + 5)).isfinite()
    with pytest.raises(ImageError, match=f"images of {least} x {least - 1} pixels are too small for LPIPS with {net}"):
        model(*pair(least - 1, least))
    with pytest.raises(ImageError, match=r"pred has shape \(3, 40, 40\)"):
        model(torch.rand(3, 40, 40), torch.rand(3, 40, 40))


@pytest.fixture
def clock(monkeypatch):
    """Empty caches, and the time that failures are remembered by, in a list of one number."""
    now = [0.0]
    failures = cachetools.TTLCache(16, ttl=lpips._failures.ttl, timer=lambda: now[0])
    monkeypatch.setattr("pointsplat_ns.metrics.lpips._failures", failures)
    monkeypatch.setattr("pointsplat_ns.metrics.lpips._loaded", cachetools.LRUCache(4))
    return now


def test_a_report_has_the_value_or_the_reason_why_there_is_none(alex_file, alex, clock, monkeypatch):
    lpips = ReportedLpips("alex")
    assert lpips(*pair(40, 40)) is None and "alex backbone cannot be downloaded" in lpips.reason
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(alex_file))
    lpips = ReportedLpips("alex")
    assert torch.equal(lpips(*pair(40, 40)), alex(*pair(40, 40))) and lpips.reason is None
    assert lpips(*pair(20, 40)) is None and "40 x 20 pixels are too small" in lpips.reason


# Where the weights come from


@pytest.mark.parametrize(
    ("place", "named"),
    [
        ("folder/alexnet_features.pth", "folder"),
        ("folder/alexnet-owt-7be5be79.pth", "folder"),
        ("any.pth", "any.pth"),
        ("hub/checkpoints/alexnet-owt-7be5be79.pth", None),
    ],
)
def test_weights_are_found_by_the_variable_or_in_the_hub_cache(
    alex_file, alex, tmp_path, monkeypatch, nowhere, place, named
):
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    os.symlink(alex_file, tmp_path / place)
    if named:
        monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / named))
    assert torch.equal(load_lpips("alex").features[0].weight, alex.features[0].weight) and not nowhere
    wrong = "any.pth: not the weights of LPIPS's vgg backbone; .*has shape" if named == "any.pth" else "cannot be downl"
    with pytest.raises(LpipsUnavailable, match=wrong):
        load_lpips("vgg")


def files_below(folder):
    return [path for path in folder.rglob("*") if path.is_file()]


def test_without_a_network_the_reason_is_one_line_and_no_file_is_left(tmp_path, nowhere):
    with pytest.raises(LpipsUnavailable) as caught:
        load_lpips("alex")
    text = str(caught.value)
    assert "alex backbone cannot be downloaded ([Errno -3] Temporary failure in name resolution)" in text
    assert f"set {WEIGHTS_VARIABLE} to a folder with alexnet_features.pth" in text and "\n" not in text
    assert nowhere == ["https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"] and not files_below(tmp_path)


class Answer(BytesIO):
    """What a proxy might send in place of the weights."""

    def info(self):
        return self

    def getheaders(self, name):
        return []


class Cut(Answer):
    def read(self, size=-1):
        raise TimeoutError("timed out")


@pytest.mark.parametrize(
    ("answer", "message"),
    [(Answer(b"<html>log in first</html>"), "cannot be downloaded .invalid hash value"), (Cut(), "timed out")],
)
def test_a_wrong_or_cut_download_leaves_no_file_and_restores_the_timeout(tmp_path, monkeypatch, answer, message):
    monkeypatch.setattr(torch.hub, "urlopen", lambda *args, **kwargs: answer)
    with pytest.raises(LpipsUnavailable, match=message):
        load_lpips("alex")
    assert not files_below(tmp_path) and socket.getdefaulttimeout() is None


def test_a_download_is_kept_only_with_all_digits_of_its_sha_256(alex_file, tmp_path, monkeypatch):
    """Eight of them, as in its name, can be had by trying."""
    data = alex_file.read_bytes()
    right = hashlib.sha256(data).hexdigest()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub home"))
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    for digest in (right[:-1] + "0123456789abcdef"[int(right[-1], 16) ^ 1], right):
        monkeypatch.setattr(torch.hub, "urlopen", lambda *args, **kwargs: Answer(data))
        monkeypatch.setitem(lpips._BACKBONES, "alex", replace(lpips._BACKBONES["alex"], digest=digest))
        if digest == right:
            load_lpips("alex")
        else:
            with pytest.raises(LpipsUnavailable, match="invalid hash value"):
                load_lpips("alex")
            assert not files_below(tmp_path / "hub home")


def test_the_digests_are_those_that_the_names_of_the_files_begin():
    for backbone in lpips._BACKBONES.values():
        assert re.fullmatch("[0-9a-f]{64}", backbone.digest)
        assert backbone.files[-1].endswith(f"-{backbone.digest[:8]}.pth")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PK garbage", "truncated or not a state dict"),
        (b"", "truncated or not a state dict"),
        ([torch.zeros(1)], "holds a list; expected a state dict"),
        ({"net.0.weight": torch.zeros(1)}, r"lacks 'features.0.weight' \(found net.0.weight\)"),
        ({"features.0.weight": torch.zeros(64, 3, 3, 3)}, r"has shape \(64, 3, 3, 3\), expected \(64, 3, 11, 11\)"),
    ],
)
def test_files_that_are_no_backbone_are_said(tmp_path, content, message):
    path = tmp_path / "bad.pth"
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    with pytest.raises(LpipsUnavailable, match=message) as caught:
        load_lpips("alex", path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_file_or_folder_that_is_named_alone_is_tried(alex_file, tmp_path, monkeypatch, nowhere):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(alex_file))
    with pytest.raises(LpipsUnavailable, match=r"none\.pth: no such file"):
        load_lpips("alex", tmp_path / "none.pth")
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "gone"))
    with pytest.raises(LpipsUnavailable, match=f"gone: no such file or folder, though {WEIGHTS_VARIABLE} names it"):
        load_lpips()
    assert not nowhere


def test_an_unknown_network_is_said():
    with pytest.raises(LpipsUnavailable, match="no LPIPS network is called 'squeeze'; expected one of alex, vgg"):
        load_lpips("squeeze")
