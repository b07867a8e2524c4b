"""Which programs of splat-transform to compare with."""

from __future__ import annotations

from pointsplat_ns.tables.splat_transform import NAME, Reducer, SplatTransform


def peers_of(programs: tuple[str, ...]) -> tuple[list[Reducer], str]:
    """The modes of every program named, and why there are none.

    Args:
        programs: paths; none means what npx finds, which may be nothing.

    Raises:
        SystemExit: if a program that was named cannot be run.
    """
    if not programs:
        found = SplatTransform()
        return list(found.modes), found.missing
    modes: list[Reducer] = []
    for program in programs:
        found = SplatTransform(program)
        if found.missing:
            raise SystemExit(f"{NAME}: {found.missing}")
        modes += [mode for mode in found.modes if mode.label not in [known.label for known in modes]]
    return modes, ""
