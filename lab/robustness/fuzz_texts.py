"""Readers of JSON and other texts, apart from those of runs: camera paths, poses, results, what commands go on from.
COLMAP's binary files of poses are here as well."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

from fuzz_registry import Read, reader


@reader
def camera_path(folder: Path) -> Read:
    """Camera paths that nerfstudio's viewer saved."""
    from pointsplat_ns.viewing.saved_path import read_path

    path = folder / "a.json"

    def read(data: bytes) -> object:
        path.write_bytes(data)
        return read_path(path)

    return read


@reader
def camera_json(folder: Path) -> Read:
    """``cameras.json`` of 3DGS and ``transforms.json`` of nerfstudio, beside transforms into the frame of a scene."""
    from pointsplat_ns.io.camera_files import read_views

    path = folder / "a.json"
    rows = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": rows, "scale": 0.5}))

    def read(data: bytes) -> object:
        path.write_bytes(data)
        return read_views(path)

    return read


def _colmap(folder: Path, name: str) -> Read:
    """Reads a COLMAP model of one image once bytes are in one of its files."""
    from pointsplat_ns.io.camera_files import read_views

    files = {
        "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 8.0, 8.0, 4.0, 3.0),
        "images.bin": struct.pack("<QI7dI2sQ", 1, 1, 1.0, *6 * (0.0,), 1, b"a\0", 0),
        "cameras.txt": b"1 PINHOLE 8 6 8 8 4 3\n",
        "images.txt": b"1 1 0 0 0 0 0 0 1 a\n\n",
    }
    for file in files:
        if file.endswith(name[-4:]):
            (folder / file).write_bytes(files[file])

    def read(data: bytes) -> object:
        (folder / name).write_bytes(data)
        return read_views(folder)

    return read


@reader
def colmap_cameras(folder: Path) -> Read:
    """``cameras.bin`` of a COLMAP model."""
    return _colmap(folder, "cameras.bin")


@reader
def colmap_images(folder: Path) -> Read:
    """``images.bin`` of a COLMAP model."""
    return _colmap(folder, "images.bin")


@reader
def colmap_cameras_text(folder: Path) -> Read:
    """``cameras.txt`` of a COLMAP model."""
    return _colmap(folder, "cameras.txt")


@reader
def colmap_images_text(folder: Path) -> Read:
    """``images.txt`` of a COLMAP model."""
    return _colmap(folder, "images.txt")


def _replica(folder: Path, name: str) -> Read:
    """Reads a scene of one photo in the Replica layout once bytes are in the file of a name."""
    from PIL import Image

    from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica

    (folder / "results").mkdir()
    Image.new("RGB", (8, 6)).save(folder / "results" / "frame000000.png")
    camera = {"w": 8, "h": 6, "fx": 8, "fy": 8, "cx": 4, "cy": 3, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (folder / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")

    def read(data: bytes) -> object:
        (folder / name).write_bytes(data)
        scene = load_replica(folder)
        return scene, scene.params.principal_point()

    return read


@reader
def trajectory(folder: Path) -> Read:
    """``traj.txt`` of the Replica layout."""
    return _replica(folder, "traj.txt")


@reader
def intrinsics(folder: Path) -> Read:
    """``cam_params.json`` of the Replica layout."""
    return _replica(folder, "cam_params.json")


@reader
def held_out_list(folder: Path) -> Read:
    """The list of held-out frames."""
    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import read_eval_list

    path = folder / "list.txt"

    def read(data: bytes) -> object:
        path.write_bytes(data)
        return read_eval_list(path)

    return read


@reader
def evaluation(folder: Path) -> Read:
    """What ``ns-eval`` wrote, as ``pointsplat report`` prints it and shows it on a page."""
    from rich.console import Console

    from pointsplat_ns.nerfstudio_plugin.pointsplat import report

    path = folder / "a.json"

    def read(data: bytes) -> object:
        path.write_bytes(data)
        results = report.read_evaluation(path)
        for table in report.report_tables(results):
            Console(file=io.StringIO()).print(table)
        parts = [(report._reference(part), report._blocks(results, part)) for part in report._parts(results)]
        return report.write_report_page("a", report._settings(results), parts, report._note(results), folder / "a.html")

    return read


@reader
def points(folder: Path) -> Read:
    """The points of a sweep that is gone on with."""
    from pointsplat_ns.tradeoff.journal import POINTS, Journal

    def read(data: bytes) -> object:
        (folder / POINTS).write_bytes(data)
        return Journal(folder, {"file": "abc"})

    return read


@reader
def cells(folder: Path) -> Read:
    """The cells of tables that are gone on with, and the tables of them."""
    from pointsplat_ns.tables.cells import CELLS, CellJournal

    (folder / "room").mkdir()

    def read(data: bytes) -> object:
        (folder / "room" / CELLS).write_bytes(data)
        journal = CellJournal(folder, "room")
        journal.check({"file": "abc"})
        return journal

    return read


@reader
def flight(folder: Path) -> Read:
    """A scene that a sweep keeps for its page."""
    from pointsplat_ns.tradeoff.flights import read_flight_beside

    path, other = folder / "a.json", folder / "b.json"

    def read(data: bytes) -> object:
        path.write_bytes(data)
        other.write_bytes(data)
        return read_flight_beside(path, other)

    return read


@reader
def levels(folder: Path) -> Read:
    """The manifest of levels of detail, which says whether they are complete."""
    from pointsplat_ns.compression.level_folder import MANIFEST, check_folder

    def read(data: bytes) -> object:
        (folder / MANIFEST).write_bytes(data)
        return check_folder(folder, 2, force=False)

    return read


@reader
def record(folder: Path) -> Read:
    """The record of one of many scenes, and the description of all."""
    from pointsplat_ns.compression.scene_folder import _description
    from pointsplat_ns.compression.scene_task import SceneTask, _finished, known_result

    task = SceneTask("a", folder / "a.spz", folder / "a.ply")

    def read(data: bytes) -> object:
        for path in (task.record, folder / "all.json"):
            path.write_bytes(data)
        return known_result(task), _finished(task, "abc"), _description(folder / "all.json")

    return read
