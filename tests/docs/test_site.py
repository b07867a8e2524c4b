"""The documentation is a site without a broken link, which needs nothing from elsewhere."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pointsplat_ns as ps
from documented import ROOT

pytestmark = pytest.mark.xdist_group("site")  # one process builds it for all tests of this file

NEEDED = ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` does: any warning is an error."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"needs {', '.join(missing)}: pip install -e .[docs]")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_public_name_is_in_the_reference_with_its_example(site):
    page = (site / "reference" / "api.html").read_text("utf-8")
    for name in ps.__all__:
        assert f'id="{ps._HOME[name]}.{name}"' in page
    assert page.count("Examples:</span>") >= len(ps.__all__)
    assert ":func:" not in page and ":class:" not in page


def test_links_of_pages_from_elsewhere_lead_to_pages_of_the_site(site):
    assert 'href="../benchmarks.html"' in (site / "project" / "contributing.html").read_text("utf-8")
    assert 'href="project/refiner.html"' in (site / "refining.html").read_text("utf-8")


def test_nothing_is_fetched_from_elsewhere(site):
    for page in site.rglob("*.html"):
        text = page.read_text("utf-8")
        assert not re.findall(r'<(?:script|img|link rel="stylesheet"|iframe)[^>]+(?:src|href)="(?:https?:)?//', text)


def test_pictures_are_small():
    for picture in (ROOT / "docs").rglob("*.[jp][pn]g"):
        assert picture.stat().st_size < 200_000, picture
