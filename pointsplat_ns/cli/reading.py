"""How options are read: counts and sizes as people write them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from pointsplat_ns.system.quantities import parse_count, parse_megabytes, parse_number


def _spec(metavar: str, parse: Callable[[str], Any]) -> PrimitiveConstructorSpec:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda value: isinstance(value, (int, float)) and not isinstance(value, bool),
        str_from_instance=lambda value: [f"{value:g}" if isinstance(value, float) else str(value)],
    )


def _share(text: str) -> float:
    return parse_number(text[:-1]) / 100 if text.endswith("%") else parse_number(text)


Share = Annotated[float, _spec("SHARE", _share)]
"""A share of the Gaussians, such as 0.1 or 10%."""

Megabytes = Annotated[float, _spec("MB", parse_megabytes)]
"""A size, in units of 10^6 bytes: 12, 12MB, 800kB or 1GB."""


def quantities() -> ConstructorRegistry:
    """A context in which tyro reads numbers as :func:`~pointsplat_ns.system.quantities.parse_number` does."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        return _RULES.get(info.type)

    return registry


def _float(text: str) -> float:
    return float(text) if text.lower().lstrip("+-") in ("nan", "inf") else parse_number(text)  # commands refuse them


_RULES = {int: _spec("INT", parse_count), float: _spec("FLOAT", _float)}
