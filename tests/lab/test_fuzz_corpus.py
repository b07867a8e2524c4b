"""Files that fuzzing found to reach new branches: each is read, or refused by one typed error in
one line."""

import logging
from contextlib import suppress

import pytest

from lab.robustness.fuzz_readers import READERS
from lab.robustness.fuzzing import CORPUS, judge
from pointsplat_ns.errors import PointSplatError


@pytest.mark.parametrize("reader", sorted(READERS))
def test_each_file_of_the_corpus_is_read_or_refused_in_one_line(reader, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL, "pointsplat_ns")
    read = READERS[reader](tmp_path)
    files = [path.read_bytes() for path in sorted((CORPUS / reader).iterdir())]
    for data in files:  # imports what the memory of a reader is not to count
        with suppress(PointSplatError):
            read(data)
    assert files and {judge(read, data) for data in files} <= {"read", "refused"}
