"""Counts and sizes are read as people write them, by every command."""

import pytest

from pointsplat_ns import cli
from pointsplat_ns.cli import main


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        ("prune a.ply --fine-tune 1k", "fine_tune", 1000),
        ("make-feedback a.ply --updates 1e3", "updates", 1000),
        ("make-refiner --steps 1,000", "steps", 1000),
        ("compact a.ply --target-mb 12kb", "target_mb", 0.012),
        ("compact a.ply --target-mb 12", "target_mb", 12.0),
        ("tradeoff a.ply --target-mb 1GB", "target_mb", 1000.0),
        ("compact a.ply --html-limit 800kB", "html_limit", 0.8),
        ("compact a.ply --seconds 1.5k", "seconds", 1500.0),
        ("demo --keep 20%", "keep", 0.2),
        ("tables a.ply -o t --keeps 50% 0.1", "keeps", (0.5, 0.1)),
        ("view a.ply --port 8k", "port", 8000),
    ],
)
def test_an_option_understands_a_number_as_people_write_it(words, name, value, monkeypatch):
    called, real = {}, cli._command

    def watched(command):
        function = real(command)

        def instead(**options):
            called.update(options)

        instead.__signature__, instead.__wrapped__ = __import__("inspect").signature(function), function
        instead.__annotations__, instead.__doc__ = function.__annotations__, function.__doc__
        return instead

    monkeypatch.setattr(cli, "_command", watched)
    main(words.split())
    assert called[name] == value


def test_what_is_no_number_is_refused_with_those_that_are(capsys):
    with pytest.raises(SystemExit) as end:
        main(["prune", "a.ply", "--fine-tune", "1.5"])
    assert end.value.code == 2 and "is no whole number" in " ".join(capsys.readouterr().err.split())
