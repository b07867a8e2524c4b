"""Counts, sizes and durations as text: 1e3, 10k, 1.5M, 1,000, 12kB, 1GB, 5 min 14 s."""

from __future__ import annotations

import math
import re
from decimal import Decimal


def parse_number(text: str) -> float:
    """A number, with k, M or G for thousands, millions or billions. Raises ValueError for any other
    text.

    Example:
        >>> parse_number("1e3"), parse_number("1.5M"), parse_number("1,000"), parse_number("0.3")
        (1000.0, 1500000.0, 1000.0, 0.3)
    """
    form = r"([+-]?(?:\d{1,3}(?:,\d{3})+|\d+)?(?:\.\d*)?(?:e[+-]?\d{1,3})?) ?([kmg]?)"
    found = re.fullmatch(form, text.strip(), re.IGNORECASE)
    if found is None or not re.match(r"[+-]?[\d.]*\d", found[1]):
        raise ValueError(
            f"{text!r} is not a number; expected one such as 0.5, 1000, 1,000, 1e3, 10k or 1.5M"
        )
    number = float(
        Decimal(found[1].replace(",", ""))
        * {"": 1, "k": 10**3, "m": 10**6, "g": 10**9}[found[2].lower()]
    )
    if math.isinf(number):
        raise ValueError(f"{text!r} is too large")
    return number


def parse_count(text: str) -> int:
    """A whole number, as :func:`parse_number` reads it. Raises ValueError for any other text.

    Example:
        >>> parse_count("10k"), parse_count("1.5M")
        (10000, 1500000)
    """
    number = parse_number(text)
    if number != int(number):
        raise ValueError(
            f"{text!r} is not a whole number; expected one such as 1000, 1,000, 1e3 or 10k"
        )
    return int(number)


def parse_megabytes(text: str) -> float:
    """A size in MB (10^6 bytes), also the default unit. Raises ValueError for any other text.

    Example:
        >>> [parse_megabytes(text) for text in ("12kb", "1GB", "12", "5000B")]
        [0.012, 1000.0, 12.0, 0.005]
    """
    text = text.strip()
    return parse_number(text[:-1]) / 1e6 if text.lower().endswith("b") else parse_number(text)


def counted(number: int, noun: str) -> str:
    """A count with its noun.

    Example:
        >>> counted(1, "size"), counted(2000, "point")
        ('1 size', '2,000 points')
    """
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def seconds_text(seconds: float) -> str:
    """A duration with its significant digits.

    Example:
        >>> [seconds_text(seconds) for seconds in (3.14, 31.4, 314, 3140, 7000)]
        ['3.1 s', '31 s', '5 min 14 s', '52 min', '1 h 57 min']
    """
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    if seconds < 600:
        return f"{round(seconds) // 60} min {round(seconds) % 60} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
