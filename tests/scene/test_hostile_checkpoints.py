"""Checkpoints of some hundred bytes that ask for any amount of memory: one line, and no memory."""

import io
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

from hostile import Called, archive_of, pickled
from making import normal_scene, same_bits
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainer, StoppableTrainerConfig
from pointsplat_ns.scene import checkpoint_pickles
from pointsplat_ns.scene.checkpoint_pickles import need_bounded
from pointsplat_ns.scene.checkpoints import load_checkpoint, read_checkpoint

MANY = 4_000_000_000

HOSTILE = {
    "builtins.bytearray": Called("builtins.bytearray", MANY),
    "torch.storage.UntypedStorage": Called("torch.storage.UntypedStorage", MANY),
    "a call of torch FloatStorage": Called("torch.FloatStorage", MANY),
    "a numpy type 'V2000000000'": Called(
        "numpy._core.multiarray.scalar", Called("numpy.dtype", f"V{MANY // 2}", False, True), b""
    ),
    "a numpy type 'U1000000000'": Called(
        "numpy.core.multiarray.scalar", Called("numpy.dtype", f"U{MANY // 4}", False, True), b""
    ),
    "torch.Tensor": Called("torch.Tensor", MANY),
    "torch.nn.parameter.Parameter": Called("torch.nn.parameter.Parameter", Called("torch.Tensor")),
    "a key that is neither a number nor text": {(1, 2): 3},
}
"""What an error names, and a value whose pickle asks for it."""

EMPTY_LISTS = b"\x80\x02(" + b"]" * checkpoint_pickles.MOST_PICKLED + b"l."
MANY_CALLS = b"\x80\x02ccollections\nOrderedDict\nq\x00](" + b"h\x00)R" * 100_001 + b"e."
BYTES_OF_PROTOCOL_5 = b"\x80\x05\x96" + MANY.to_bytes(8, "little") + b"."


def refused(path: Path, fragment: str) -> None:
    with pytest.raises(SceneError) as raised:
        read_checkpoint(path)
    text = str(raised.value)
    assert fragment in text and text.startswith(str(path)) and len(text) < len(str(path)) + 300


@pytest.mark.parametrize("archived", [True, False])
@pytest.mark.parametrize("fragment", HOSTILE)
def test_what_it_asks_for_is_named_and_torch_does_not_load_it(
    fragment, archived, tmp_path, monkeypatch
):
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("torch loads it"))
    data = pickled({"pipeline": HOSTILE[fragment]})
    before = b"".join(map(pickled, (0x1950A86A20F9469CFC6C, 1001, {})))
    path = tmp_path / "a.ckpt"
    path.write_bytes(archive_of(data) if archived else before + data + pickled([]))
    refused(path, fragment)


@pytest.mark.parametrize(
    ("data", "fragment"),
    [
        (EMPTY_LISTS, "bytes of data.pkl"),
        (MANY_CALLS, "more than 100,000 objects"),
        (pickled([1, 2])[:-1], "pickle exhausted before seeing STOP"),
        (b"\x80\x02\x85.", "a damaged pickle"),
        (b"\x80\x02e.", "a damaged pickle"),
        (BYTES_OF_PROTOCOL_5, "truncated or not a checkpoint"),
        (b"\x80\x02X\xff\xff\xff\x7fa.", "truncated or not a checkpoint"),
    ],
)
def test_other_pickles_that_no_trainer_writes_are_refused(data, fragment, tmp_path):
    path = tmp_path / "a.ckpt"
    path.write_bytes(archive_of(data))
    refused(path, fragment)


def saved(value: object, **options) -> bytes:
    stream = io.BytesIO()
    torch.save(value, stream, **options)
    return stream.getvalue()


@pytest.mark.parametrize("archived", [True, False])
@pytest.mark.parametrize("number", ["numel", "size", "offset"])
def test_sizes_of_tensors_fit_into_their_storage_and_storages_into_the_file(
    number, archived, tmp_path
):
    """torch makes the storage of a file by torch before 1.6 as large as its pickle says, and
    enlarges one that is too small for its view."""
    data = saved({"pipeline": torch.zeros(77)[3:]}, _use_new_zipfile_serialization=archived)
    before = {"numel": b"K\x4d", "size": b"K\x4a\x85", "offset": b"K\x03K"}[number]
    many = b"J" + (1_900_000_000).to_bytes(4, "little")
    after = {"numel": many, "size": many + b"\x85", "offset": many + b"K"}[number]
    assert data.count(before) == 1
    path = tmp_path / "a.ckpt"
    path.write_bytes(data)
    need_bounded(path)
    data = data.replace(before, after)
    if archived:  # torch aligns what follows, and Python writes another archive
        start = data.index(b"\x80\x02")
        data = archive_of(data[start : data.index(b".PK", start) + 1])
    path.write_bytes(data)
    refused(path, "more than the file can hold" if number == "numel" else "more than its storage")


def test_an_archive_that_two_readers_read_differently_is_refused(tmp_path):
    """Python's moves the directory along with bytes before the archive; torch's does not."""
    harmless = archive_of(pickled({"pipeline": {}}))
    path = tmp_path / "a.ckpt"
    path.write_bytes(harmless)
    need_bounded(path)
    path.write_bytes(harmless[:40] + harmless)
    refused(path, "an ambiguous archive")
    twice = io.BytesIO(harmless)
    with zipfile.ZipFile(twice, "a") as archive:
        archive.writestr("ARCHIVE/DATA.PKL", pickled(1))
    path.write_bytes(twice.getvalue())
    refused(path, "an ambiguous archive")


@pytest.mark.parametrize("archived", [True, False])
def test_what_trainers_write_is_loaded(archived, tmp_path, checkpoint_of):
    """Splatfacto's is; so are a model's parameters, as INRIA saves them, and all types of numbers
    that torch had before it wrote archives."""
    scene = normal_scene(6, 3)
    path = tmp_path / "a.ckpt"
    path.write_bytes(saved(checkpoint_of(scene), _use_new_zipfile_serialization=archived))
    assert same_bits(scene, read_checkpoint(path))
    types = (torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
    types += (torch.float16, torch.bfloat16, torch.float32, torch.float64)
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.ones(2))])
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, [1, 2])
    value = {
        "inria": (3, torch.nn.Parameter(torch.arange(6.0).view(2, 3)), optimizer.state_dict()),
        "schedule": schedule.state_dict(),
        "module": torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2)).state_dict(),
        "types": [torch.ones(3, dtype=each) for each in types],
        "views": [
            torch.zeros(4, 4)[1:, ::2],
            torch.zeros(0, 3),
            torch.zeros(()),
            torch.zeros(5).expand(7, 5),
        ],
        "plain": [None, True, 1.5, -3, 2**70, "text", (1, (2, ()))],
    }
    path.write_bytes(saved(value, _use_new_zipfile_serialization=archived))
    found = load_checkpoint(path)
    assert torch.equal(found["inria"][1], value["inria"][1])
    assert all(map(torch.equal, found["types"], value["types"]))
    assert found["plain"] == value["plain"] and found["schedule"] == value["schedule"]


@pytest.mark.parametrize("way", ["load_checkpoint", "load_dir"])
def test_a_training_does_not_resume_from_one(way, tmp_path, monkeypatch):
    path = tmp_path / "step-000000009.ckpt"
    path.write_bytes(archive_of(pickled(Called("builtins.bytearray", MANY))))
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("torch loads it"))
    trainer = StoppableTrainer.__new__(StoppableTrainer)
    trainer.config = StoppableTrainerConfig(**{way: path if way == "load_checkpoint" else tmp_path})
    with pytest.raises(SceneError, match="builtins.bytearray"):
        trainer._load_checkpoint()


LIMITED = """
import resource, sys
import torch
from pointsplat_ns.cli import main
import pointsplat_ns.cli.info, pointsplat_ns.cli.convert, pointsplat_ns.scene.reading, psutil
import pointsplat_ns.tools.scene_info, pointsplat_ns.pipeline.run, PIL.Image, scipy.spatial
size = psutil.Process().memory_info().vms
resource.setrlimit(resource.RLIMIT_AS, (size + 300_000_000, -1))
main(sys.argv[1:])
"""


@pytest.mark.parametrize("fragment", ["builtins.bytearray", "a numpy type 'V2000000000'"])
def test_a_command_takes_less_than_300_mb_beyond_its_imports(fragment, tmp_path):
    path = tmp_path / "a.ckpt"
    path.write_bytes(archive_of(pickled(HOSTILE[fragment])))
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, "info", str(path)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and fragment in done.stderr
