"""The Node packages of the viewers, and Chromium, which one of them carries."""

from __future__ import annotations

import functools
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.files import one_line

FOLDER = Path(__file__).parent
MODULES = FOLDER / "node_modules"
CHROMIUM = "@sparticuz/chromium"
"""A package with a headless Chromium for Linux on x86_64, compressed."""
SPLAT_TRANSFORM = "@playcanvas/splat-transform"

SECONDS = 240
"""Time limit of an installation: half a minute on an idle machine."""

_UNPACK = """
const { createReadStream, createWriteStream } = require('fs');
const { pipeline } = require('stream/promises');
const [, source, target] = process.argv;
const brotli = require('zlib').createBrotliDecompress();
pipeline(createReadStream(source), brotli, createWriteStream(target));
"""

_FONTS = """<?xml version="1.0"?>
<!DOCTYPE fontconfig SYSTEM "fonts.dtd">
<fontconfig>
  <dir>{folder}/fonts</dir>
  <dir>/usr/share/fonts</dir>
  <cachedir>{folder}/fonts_cache</cachedir>
</fontconfig>
"""


class Missing(PointSplatError):
    """A program that is needed is not on this machine and cannot be installed."""


@dataclass(frozen=True)
class Chromium:
    """A headless Chromium and the driver that selenium starts."""

    program: str
    driver: str
    environment: dict[str, str] = field(default_factory=dict)
    """Variables for its own libraries and fonts; empty for a Chromium of the system."""


def modules() -> Path:
    """The folder of the packages that ``package-lock.json`` pins, installed if they are not there.
    Raises Missing with the reason if they cannot be installed."""
    found, reason = _installed()
    if found is None:
        raise Missing(reason)
    return found


@functools.cache
def _installed() -> tuple[Path | None, str]:
    """The folder of packages; or none and the reason, so that a process tries once."""
    lock = (FOLDER / "package-lock.json").read_bytes()
    stamp = FOLDER / "node_modules" / ".installed-lock.json"
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        return None, "Node with npm is not on the path"
    with _alone():
        if stamp.is_file() and stamp.read_bytes() == lock:
            return stamp.parent, ""
        args = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline"]
        args += ["--fetch-retries=1", "--fetch-timeout=60000", "--loglevel=error"]
        try:
            done = subprocess.run(
                args, cwd=FOLDER, capture_output=True, text=True, errors="replace", timeout=SECONDS
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return None, f"npm ci did not end: {one_line(error)}"
        if done.returncode:
            return None, f"npm ci failed: {' '.join(done.stderr.split())[-200:]}"
        stamp.write_bytes(lock)
    return stamp.parent, ""


@contextmanager
def _alone() -> Iterator[None]:
    """Waits while another process installs or unpacks, where files can be locked."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with open(FOLDER / ".lock", "w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def version_of(package: str) -> str:
    """The version of a package that the lock pins."""
    lock = json.loads((FOLDER / "package-lock.json").read_text("utf-8"))
    return lock["packages"][f"node_modules/{package}"]["version"]


def splat_transform() -> list[str]:
    """The command of splat-transform. Raises Missing."""
    return ["node", str(modules() / SPLAT_TRANSFORM / "bin" / "cli.mjs")]


@functools.cache
def chromium() -> Chromium:
    """The Chromium of this machine; without one, that of the packages, with the driver of PyPI's
    chromedriver-py. Raises Missing if there is neither."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    program = next(filter(None, map(shutil.which, names)), None)
    driver = shutil.which("chromedriver")
    if program and driver:
        return Chromium(program, driver)
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise Missing("no Chromium with chromedriver on the path; a package has it for Linux alone")
    try:
        from chromedriver_py import binary_path
    except ImportError as error:
        raise Missing("neither Chromium with chromedriver nor chromedriver-py is there") from error
    folder = _unpacked(modules() / CHROMIUM / "bin")
    libraries = os.pathsep.join(
        filter(None, (str(folder / "lib"), os.environ.get("LD_LIBRARY_PATH")))
    )
    environment = {"LD_LIBRARY_PATH": libraries, "FONTCONFIG_FILE": str(folder / "fonts.conf")}
    return Chromium(str(folder / "chromium"), binary_path, environment)


@contextmanager
def browser(arguments: Iterable[str]) -> Iterator[Any]:
    """A browser of its own with these arguments, driven by selenium and closed at the end. Raises
    Missing if there is no Chromium."""
    from selenium import webdriver

    found = chromium()
    options = webdriver.ChromeOptions()
    options.binary_location = found.program
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for argument in arguments:
        options.add_argument(argument)
    service = webdriver.ChromeService(found.driver, env={**os.environ, **found.environment})
    driver = webdriver.Chrome(options=options, service=service)
    try:
        yield driver
    finally:
        driver.quit()


def _unpacked(packed: Path) -> Path:
    """The folder with the program, its libraries and fonts, unpacked from a package's."""
    folder = MODULES / ".chromium"
    with _alone():
        if not (folder / "done").is_file():
            folder.mkdir(exist_ok=True)
            _decompress(packed / "chromium.br", folder / "chromium")
            (folder / "chromium").chmod(0o755)
            for name in ("al2023", "swiftshader", "fonts"):
                archive = folder / f"{name}.tar"
                _decompress(packed / f"{name}.tar.br", archive)
                shutil.unpack_archive(archive, folder)
                archive.unlink()
            (folder / "fonts.conf").write_text(_FONTS.format(folder=folder), "utf-8")
            (folder / "done").touch()
    return folder


def _decompress(source: Path, target: Path) -> None:
    """Undo brotli, which Node has and Python's library has not."""
    done = subprocess.run(
        ["node", "-e", _UNPACK, "--", str(source), str(target)],
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )
    if done.returncode:
        raise Missing(f"{source.name} cannot be unpacked: {' '.join(done.stderr.split())[-200:]}")
