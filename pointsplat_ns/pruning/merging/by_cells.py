"""Merging of scenes that are larger than memory: cell by cell, with files in between.

1. Parts of a space-filling curve with equal numbers of Gaussians are the **cells**; each has a
   file (``cells.py``).
2. Thinned scenes give views, visibility weights and colour axes: the overview. Views and weights
   are those of merging in memory.
3. A round finds pairs in each cell. The cheapest of all cells are merged: one price limit applies
   to all cells, and the count is exact.
4. In each cell, members are regrouped, and their rows are written.

Finished steps stay on disk, and a killed command resumes from them. Several processes may share the
cells, or the workers of a cluster, which see the same disk.
"""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError, PointSplatError
from pointsplat_ns.geometry.neighbours import other_neighbours
from pointsplat_ns.pruning.merging.cells import Cells, Scratch, divided
from pointsplat_ns.pruning.merging.groups import Groups, scene_maker
from pointsplat_ns.pruning.merging.pair_cost import pair_costs
from pointsplat_ns.pruning.merging.pairs import Round, cheapest_pairs, replace_pairs
from pointsplat_ns.pruning.merging.regrouping import regrouped
from pointsplat_ns.pruning.merging.rounds import merge, most_pairs
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import Participants, State, initial_state, principal_axes
from pointsplat_ns.pruning.merging.visibility import (
    blurs_that_count,
    drawn_step,
    views_to_weigh,
    visibility_of,
)
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import PlyRows, header_bytes, ply_bytes, row_table
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.cluster import Cluster, LostWorkError
from pointsplat_ns.system.files import replacing
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.system.threads import one_thread_each
from pointsplat_ns.system.workers import Workers
from pointsplat_ns.view_sampling.content import content_size, enlarged, thinning
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.settings import current_settings
from pointsplat_ns.view_sampling.traces import factors_of, traces_around


@torch.no_grad()
def merge_file(
    rows: PlyRows,
    count_of: Callable[[int], int],
    output: Path,
    most: int,
    scratch: Scratch,
    views: Callable[[Gaussians], Views | None] = lambda sample: None,
    sampler: Callable[..., Sampler] = Sampler,
    progress: Progress = silent,
    settings: MergeSettings = MERGING,
    jobs: int = 1,
    cluster: Cluster | None = None,
) -> tuple[int, int]:
    """Merge the Gaussians of a file, cell by cell, and write the result.

    Args:
        rows: the Gaussians. Those that cannot be drawn are dropped.
        count_of: maps the number N of the others to the number after merging, in 1..N.
        output: the PLY to write.
        most: approximate maximum number of Gaussians in a cell.
        scratch: folder of finished steps.
        views: maps every n-th Gaussian to known views, or None for sampled ones.
        sampler: maps Gaussians of the scene, each of which ``stands_for`` several, to the sampler
            of their views.
        progress: called with the current task and its share done.
        settings: the tuned numbers.
        jobs: number of processes that share the cells. The result is exact to the bit for any
            number.
        cluster: works on the cells in place of processes, if given; ``scratch`` is then an absolute
            path that its workers see.

    Returns:
        The numbers of Gaussians before and after.

    Raises:
        SceneError: if a file cannot be read or written, or no Gaussian can be drawn.
        BudgetError: from ``count_of``, or if there are more cells than Gaussians after merging.
        PointSplatError: if processes are killed, or workers die of one cell time and again.
    """
    cells = divided(rows, most, scratch, functools.partial(progress, "dividing into cells"))
    k = count_of(cells.count)
    if k < len(cells):
        raise BudgetError(
            f"cannot merge {len(cells)} parts of a scene into {k} Gaussians; expected "
            f"{len(cells)} or more"
        )

    def look() -> dict[str, Tensor]:
        report = functools.partial(progress, "sampling views")
        report(0.0)
        step = thinning(rows.count, current_settings().sampled_count)
        some = enlarged(rows.pick(range(0, rows.count, step)), step)  # cover as much as all
        with one_thread_each():
            seen = views_to_weigh(
                cells.starts(k)[-1], views(some) or sampler(some, stands_for=step), settings
            )
            return vars(overview_of(cells, k, *seen, settings, report))

    scratch.make("overview", look)
    work = _Work(cells, k, sampler, settings)
    with Workers(work, jobs, cluster, scratch.description) as workers:

        def each(what: str, *step: float) -> None:
            """Run a step on every cell."""
            progress(what, 0.0)
            tasks = [(cell, *step) for cell in range(len(cells))]
            try:
                for done, _ in enumerate(workers.results(tasks), 1):
                    progress(what, done / len(cells))
            except LostWorkError as error:
                (cell, *_), reason = next(iter(error.reasons.items()))
                raise PointSplatError(
                    f"{output}: {what}, part {cell + 1} of {len(cells)}: {reason}; run the same "
                    "command to resume"
                ) from error

        rounds = 0
        left = -1
        while left != k:
            if not scratch.has(_chosen(rounds)):
                each(f"merging, round {rounds + 1}", rounds)
            left = int(
                scratch.tensors(_chosen(rounds), functools.partial(work.choose, rounds))["left"]
            )
            rounds += 1
        changes = torch.cat([scratch.known(_sizes(cell))["changes"] for cell in range(len(cells))])
        each("finishing", rounds, float(changes.mean()))
    with (
        replacing(output, ply_bytes(k, rows.sh_degree, rows.traits)) as part,
        part.open("wb") as stream,
    ):
        stream.write(header_bytes(k, rows.sh_degree, rows.traits))
        for cell in range(len(cells)):
            with _finished(scratch, cell).open("rb") as finished:
                shutil.copyfileobj(finished, stream, 1 << 20)
    return cells.count, k


@dataclass(frozen=True, eq=False)
class Overview:
    """Data of the whole scene that all cells need."""

    centre: Tensor  # [3] float64, of the content
    size: Tensor  # scalar float64, diagonal of the content, scene units
    # [m] float32, visibility weights of every ``step``-th member of all cells, along the curve
    weights: Tensor
    blurs: Tensor  # [m] float32, their blurs, in units of the squared size; 0 for none
    step: Tensor  # scalar int64
    middle: Tensor  # [3 (d+1)^2] as of principal_axes
    axes: Tensor  # [3 (d+1)^2, C]


def overview_of(
    cells: Cells,
    k: int,
    views: Views | None,
    traced: bool,
    settings: MergeSettings,
    report: Callable[[float], None],
) -> Overview:
    """The overview of cells that become ``k`` Gaussians, with views of :func:`views_to_weigh`, and
    whether trace factors apply. Every n-th member of all cells is drawn, because a sample of the
    file would have holes that show hidden Gaussians."""
    *starts, count = cells.starts(k)
    step = drawn_step(count, settings)
    parts = []
    traces = []
    for cell, start in enumerate(starts):
        scene, members = cells.members(cell, k)
        here = slice(-start % step, None, step)
        parts.append(scene[members[here]])
        if traced:
            traces.append(torch.stack(traces_around(scene, members))[:, here])
        report(0.5 * len(parts) / len(cells))
    scene = enlarged(Gaussians.cat(parts), step)
    participants = Participants(scene, torch.arange(len(scene), **INDICES), *content_size(scene))
    weights, blurs = visibility_of(
        participants, views, settings, lambda share: report(0.5 + 0.5 * share)
    )
    blurs = blurs_that_count(participants, blurs)
    if traced:
        weights *= factors_of(*torch.cat(traces, dim=1))
    size = torch.tensor(participants.size, **DOUBLES)
    every = torch.tensor(step, **INDICES)
    middle, axes = principal_axes(scene, participants.members)
    return Overview(
        centre=participants.centre,
        size=size,
        weights=weights,
        blurs=torch.zeros_like(weights) if blurs is None else blurs,
        step=every,
        middle=middle,
        axes=axes,
    )


@dataclass(frozen=True, eq=False)
class _Work:
    """The work on a cell. Called with the cell, the number of earlier rounds and, for the finish,
    the size change."""

    cells: Cells
    k: int
    sampler: Callable[..., Sampler]
    settings: MergeSettings

    @functools.cached_property
    def overview(self) -> Overview:
        """Read by each process, because it is too large to be sent with each step."""
        return Overview(**self.cells.scratch.known("overview"))

    def __call__(self, step: tuple[Any, ...]) -> None:
        cell, rounds, *size_change = step
        scratch = self.cells.scratch
        if not size_change:
            scratch.make(_round(rounds, cell), functools.partial(self.pairs, rounds, cell))
            scratch.drop(_round(rounds - 2, cell))
        elif not (path := _finished(scratch, cell)).is_file():
            with replacing(path) as part:
                self.write(rounds, cell, size_change[0], part)

    def pairs(self, number: int, cell: int) -> dict[str, Tensor]:
        """State of a cell after ``number`` rounds, the ``group`` (n,) of each participant in it,
        and the pairs that may be merged next."""
        with one_thread_each():
            state, group = self.state(number, cell)
            near = other_neighbours(state.means.double(), self.settings.neighbours)
            costs = pair_costs(state, near, self.settings)
            first, second, prices = cheapest_pairs(near, costs, self.settings.matching_passes)
        pairs = {"firsts": first.int(), "seconds": second.int(), "prices": prices}
        return {**vars(state), "group": group.int(), **pairs}

    def choose(self, number: int) -> dict[str, Tensor]:
        """For each cell, by its number, a mask (E,) of the pairs that are the cheapest of all
        cells; and the number of Gaussians ``left`` after merging them."""
        left = 0
        prices = []
        for cell in range(len(self.cells)):
            found = self.cells.scratch.known(_round(number, cell))
            left += len(found["means"])
            prices.append(found["prices"])
        chosen = lowest(prices, min(left - self.k, most_pairs(left, self.settings)))
        merged = sum(int(part.sum()) for part in chosen)
        if merged == 0 and left > self.k:
            raise RuntimeError(f"a round found no pair among {left} Gaussians")  # would never end
        return {
            **{f"{cell}": part for cell, part in enumerate(chosen)},
            "left": torch.tensor(left - merged, **INDICES),
        }

    def state(self, number: int, cell: int) -> tuple[State, Tensor]:
        """State of a cell after ``number`` rounds, and the group (n,) of each participant in it."""
        scratch = self.cells.scratch
        overview = self.overview
        if number == 0:
            participants = self.participants(cell)
            scratch.make(_sizes(cell), functools.partial(self.size_changes, cell, participants))
            weights = overview.weights[self.drawn(cell)]
            state = initial_state(participants, weights, (overview.middle, overview.axes))
            return state, torch.arange(len(state), **INDICES)
        before = scratch.known(_round(number - 1, cell))
        chosen = scratch.known(_chosen(number - 1))[f"{cell}"]
        first, second = (before[name][chosen].long() for name in ("firsts", "seconds"))
        earlier = State(**{field.name: before[field.name] for field in fields(State)})
        after, merged = replace_pairs(earlier, first, second, self.settings)
        return after, merged.place[before["group"]].long()

    def participants(self, cell: int) -> Participants:
        """The participants of a cell, along the curve."""
        overview = self.overview
        blurs = overview.blurs[self.drawn(cell)] if bool(overview.blurs.any()) else None
        return Participants(
            *self.cells.members(cell, self.k), overview.centre, float(overview.size), blurs
        )

    def drawn(self, cell: int) -> Tensor:
        """For each participant of a cell, (n,), its place in the overview."""
        first, last = self.cells.starts(self.k)[cell : cell + 2]
        return torch.arange(first, last, **INDICES) // self.overview.step

    def size_changes(self, cell: int, participants: Participants) -> dict[str, Tensor]:
        """Size changes of the parts in this cell, of four parts evenly spread over all cells.

        In five scenes, with parts of an eighth of a scene, their mean factor differs from that of
        the whole by 0.02 at most. A thinned scene needs smaller factors than the whole.
        """
        changes = []
        parts = 4
        size = 1 << 18
        for number in range(parts):
            found, place = divmod((number + 0.5) * len(self.cells) / parts, 1)
            if found == cell:
                start = max(0, int(place * len(participants)) - size // 2)
                part = participants.scene[participants.members[start : start + size]]
                few = max(1, len(part) * self.k // self.cells.count)
                changes.append(
                    merge(part, few, views=self.sampler(part), settings=self.settings).size_change
                )
        return {"changes": torch.tensor(changes, **FLOATS)}

    def write(self, rounds: int, cell: int, size_change: float, path: Path) -> None:
        """Regroup the members of a cell after the rounds, and write the rows of its groups."""
        with one_thread_each():
            state, group = self.state(rounds, cell)
            participants = self.participants(cell)
            groups = Groups.of(
                participants, state, [Round(group, torch.ones(len(group), **FLOATS))]
            )
            del state
            if groups.any_merged:
                groups = regrouped(participants, groups, self.settings)
            row_table(scene_maker(participants, groups, self.settings)[1](size_change)).tofile(path)


def lowest(parts: list[Tensor], most: int) -> list[Tensor]:
    """Masks of the ``most`` lowest numbers of all parts, float32 and at least 0; of equal numbers,
    the first. They are counted by the upper half of their bits, then by the lower half, which have
    the order of the numbers: sorting all of them would take five times their memory."""
    bits = [part.view(torch.int32) for part in parts]
    limit = 0
    rest = most
    for shift, values in ((16, 1 << 15), (0, 1 << 16)):
        counts = torch.zeros(values, **INDICES)
        for part in bits:
            within = part if shift else part[part >> 16 == limit >> 16]
            counts += torch.bincount((within >> shift) & 0xFFFF, minlength=values)
        sums = counts.cumsum(0)
        digit = min(int(torch.searchsorted(sums, rest)), values - 1)  # the last if there are fewer
        rest -= int(sums[digit] - counts[digit])
        limit |= digit << shift
    chosen = []
    for part in bits:
        equal = part == limit
        first = equal & (equal.cumsum(0) <= rest)
        rest -= int(first.sum())
        chosen.append((part < limit) | first)
    return chosen


def _round(number: int, cell: int) -> str:
    return f"round_{number}_{cell:04d}"


def _chosen(number: int) -> str:
    return f"chosen_{number}"


def _sizes(cell: int) -> str:
    return f"sizes_{cell:04d}"


def _finished(scratch: Scratch, cell: int) -> Path:
    return scratch.folder / f"finished_{cell:04d}.rows"
