"""LPIPS against its formula, where its weights come from, and how it says that there are none."""

import hashlib
import math
import socket
import urllib.error
from io import BytesIO
from pathlib import Path
from unittest import mock

import pytest
import torch
import torchmetrics
from torch.nn import functional

from making import noisy_pair as pair
from pointsplat_ns.metrics import ImageError, lpips
from pointsplat_ns.metrics.lpips import (
    WEIGHTS_VARIABLE,
    Lpips,
    LpipsUnavailable,
    ReportedLpips,
    load_lpips,
)

NETS = ["alex", "vgg"]
LINEAR = Path(torchmetrics.__file__).parent / "functional/image/lpips_models"


def random_backbone(net, seed=0):
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, empty in Lpips(net).network.state_dict().items():
        if not name.startswith("net."):
            continue
        # He's initialisation keeps the activations of one size through all layers.
        spread = math.sqrt(2 / empty[0].numel()) if name.endswith("weight") else 0.1
        state[f"features.{name.split('.', 2)[2]}"] = spread * torch.randn(
            empty.shape, generator=generator
        )
    return state


@pytest.fixture(scope="module")
def alex_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("backbone") / "alexnet_features.pth"
    torch.save({**random_backbone("alex"), "classifier.1.weight": torch.zeros(2)}, path)
    return path


@pytest.fixture
def alex(alex_file):
    return Lpips("alex").load(alex_file)


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


def files_below(folder):
    return [path for path in folder.rglob("*") if path.is_file()]


def by_formula(state, linear, net, a, b):
    """LPIPS of images (B, H, W, 3) by its publication, in float64: distances of unit-length
    features of five ReLUs."""
    ends = {
        "alex": ((0, 3, 6, 8, 10), (0, 3, 6, 8, 10)),
        "vgg": ((0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), (2, 7, 14, 21, 28)),
    }
    convolutions, compared = ends[net]
    stride, padding = {"alex": ({0: 4}, {0: 2, 3: 2}), "vgg": ({}, {})}[net]
    shift = torch.tensor([-0.030, -0.088, -0.188]).double()
    spread = torch.tensor([0.458, 0.448, 0.450]).double()
    total = 0.0
    maps = [((2 * x.double() - 1 - shift) / spread).permute(0, 3, 1, 2) for x in (a, b)]
    for index in convolutions:
        weight, bias = (state[f"features.{index}.{name}"].double() for name in ("weight", "bias"))
        if index in {"alex": (3, 6), "vgg": (5, 10, 17, 24)}[net]:
            maps = [functional.max_pool2d(x, 3 if net == "alex" else 2, 2) for x in maps]
        maps = [
            functional.conv2d(x, weight, bias, stride.get(index, 1), padding.get(index, 1)).relu()
            for x in maps
        ]
        if index in compared:
            first, second = (x / (x.square().sum(1, keepdim=True) + 1e-8).sqrt() for x in maps)
            weight = linear[f"lin{compared.index(index)}.model.1.weight"].double()
            total = total + ((first - second).square() * weight).sum(1).mean((1, 2))
    return total


@pytest.mark.parametrize("net", NETS)
def test_lpips_is_that_of_its_publication_and_draws_no_random_number(net, tmp_path):
    state = random_backbone(net)
    path = tmp_path / "backbone.pth"
    torch.save(state, path)
    a, b = pair(2, 64, 80)
    linear = torch.load(LINEAR / f"{net}.pth", map_location="cpu", weights_only=True)
    expected = by_formula(state, linear, net, a, b)
    before = torch.get_rng_state()
    model = Lpips(net).load(path)
    # 1e-5: float32 convolutions; the values are about 0.1
    assert (
        torch.allclose(model(a, b).double(), expected, atol=1e-5, rtol=1e-5)
        and expected.min() > 1e-3
    )
    assert torch.equal(torch.get_rng_state(), before) and not any(
        p.requires_grad for p in model.parameters()
    )


def test_the_gradient_is_finite_where_every_feature_is_zero(alex_file):
    state = torch.load(alex_file, weights_only=True)
    for index in (0, 3, 6, 8, 10):
        state[f"features.{index}.weight"] = -state[f"features.{index}.weight"].abs()
        state[f"features.{index}.bias"] = torch.zeros_like(state[f"features.{index}.bias"])
    torch.save(state, alex_file.parent / "dead.pth")
    dead = Lpips("alex").load(alex_file.parent / "dead.pth")
    pred = torch.ones(
        40, 40, 3, requires_grad=True
    )  # bright: all first features are below zero, so cut off
    value = dead(pred, torch.zeros(40, 40, 3))
    value.backward()
    assert value.isfinite() and pred.grad.isfinite().all()


@pytest.mark.parametrize("net", NETS)
def test_the_smallest_image_works_and_smaller_ones_are_refused(net, tmp_path):
    torch.save(random_backbone(net), tmp_path / "b.pth")
    model = Lpips(net).load(tmp_path / "b.pth")
    least = {"alex": 31, "vgg": 16}[net]
    assert model(*pair(least, least + 5)).isfinite()
    with pytest.raises(
        ImageError,
        match=f"images of {least} x {least - 1} pixels are too small for LPIPS with {net}",
    ):
        model(*pair(least - 1, least))


def test_a_report_has_the_value_or_the_reason_why_there_is_none(alex_file, alex, nowhere, tmp_path):
    lpips = ReportedLpips()
    for _ in range(2):  # a download that failed is not tried again
        assert (
            lpips(*pair(40, 40)) is None
            and f"set {WEIGHTS_VARIABLE} to a folder with alexnet" in lpips.reason
        )
    assert (
        "alex backbone cannot be downloaded (<urlopen error [Errno -3] Temporary failure in"
        in lpips.reason
    )
    assert nowhere == [
        "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
    ] and not files_below(tmp_path)
    found = tmp_path / "hub/checkpoints/alexnet-owt-7be5be79.pth"
    found.parent.mkdir(parents=True, exist_ok=True)
    found.symlink_to(alex_file)  # but looked for again
    lpips = ReportedLpips()
    assert (
        torch.equal(lpips(*pair(40, 40)), alex(*pair(40, 40)))
        and lpips.reason is None
        and len(nowhere) == 1
    )
    assert lpips(*pair(20, 40)) is None and "40 x 20 pixels are too small" in lpips.reason


def test_weights_are_found_by_the_variable(alex_file, alex, monkeypatch, nowhere):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(alex_file.parent))
    first = "network.net.slice1.0.weight"
    assert (
        torch.equal(load_lpips("alex").state_dict()[first], alex.state_dict()[first])
        and not nowhere
    )
    with pytest.raises(LpipsUnavailable, match="vgg backbone cannot be downl"):
        load_lpips("vgg")


@pytest.mark.parametrize(
    ("net", "name"), [("alex", "alexnet-owt-7be5be79.pth"), ("vgg", "vgg16-397923af.pth")]
)
def test_weights_are_found_in_the_cache_of_torch_hub(net, name, tmp_path, nowhere):
    """Under the names that torchvision gives its downloads, which other programs left there."""
    state = random_backbone(net)
    cached = tmp_path / "hub" / "checkpoints" / name
    cached.parent.mkdir(parents=True)
    torch.save(state, cached)
    found = load_lpips(net).state_dict()["network.net.slice1.0.weight"]
    assert torch.equal(found, state["features.0.weight"])
    assert nowhere == []


def test_weights_that_the_variable_names_come_before_those_of_the_hub(
    alex_file, alex, tmp_path, monkeypatch, nowhere
):
    cached = tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    cached.parent.mkdir(parents=True)
    other = {name: value + 1 for name, value in random_backbone("alex").items()}
    torch.save(other, cached)
    first = "network.net.slice1.0.weight"
    assert torch.equal(load_lpips("alex").state_dict()[first], other["features.0.weight"])
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(alex_file.parent))
    assert torch.equal(load_lpips("alex").state_dict()[first], alex.state_dict()[first])
    assert nowhere == []


class Answer(BytesIO):
    """What a proxy might send in place of the weights."""

    def info(self):
        return self

    def getheaders(self, name):
        return []


def test_a_download_that_is_cut_leaves_no_file_and_restores_the_timeout(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "urlopen", lambda *args, **kwargs: Answer())
    monkeypatch.setattr(Answer, "read", mock.Mock(side_effect=TimeoutError("timed out")))
    with pytest.raises(LpipsUnavailable, match="timed out"):
        load_lpips("alex")
    assert not files_below(tmp_path) and socket.getdefaulttimeout() is None


def test_a_download_is_kept_only_with_all_digits_of_its_sha_256(alex_file, tmp_path, monkeypatch):
    """Eight of them, as in its name, can be had by trying."""
    data = alex_file.read_bytes()
    right = hashlib.sha256(data).hexdigest()
    monkeypatch.setattr(torch.hub, "urlopen", lambda *args, **kwargs: Answer(data))
    wrong = right[:-1] + "0123456789abcdef"[int(right[-1], 16) ^ 1]
    monkeypatch.setitem(lpips._BACKBONES, "alex", lpips._BACKBONES["alex"]._replace(digest=wrong))
    with pytest.raises(LpipsUnavailable, match="invalid hash value"):
        load_lpips("alex")
    assert not files_below(tmp_path)
    monkeypatch.setitem(lpips._BACKBONES, "alex", lpips._BACKBONES["alex"]._replace(digest=right))
    load_lpips("alex")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PK garbage", "alex backbone .UnpicklingError"),
        (b"", "EOFError"),
        ([torch.zeros(1)], "TypeError: list indices"),
        ({"net.0.weight": torch.zeros(1)}, "KeyError: 'features.0.weight'"),
        ({"features.0.weight": 3}, "AttributeError: 'int' object"),
        (None, r"size mismatch for net.slice1.0.weight: .*64, 3, 3, 3"),
    ],
)
def test_files_that_are_no_backbone_are_said(alex_file, tmp_path, content, message):
    path = tmp_path / "bad.pth"
    if content is None:
        content = torch.load(alex_file) | {"features.0.weight": torch.zeros(64, 3, 3, 3)}
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    with pytest.raises(LpipsUnavailable, match=message) as caught:
        Lpips("alex").load(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_folder_that_is_named_and_not_there_is_said(tmp_path, monkeypatch, nowhere):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "gone"))
    with pytest.raises(
        LpipsUnavailable, match=f"gone: no such folder; {WEIGHTS_VARIABLE} names it"
    ):
        load_lpips()
    with pytest.raises(
        LpipsUnavailable, match="no LPIPS network is called 'squeeze'; expected one of alex, vgg"
    ):
        load_lpips("squeeze")
    assert not nowhere
