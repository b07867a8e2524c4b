"""Codebooks for SOG: a few numbers, or rows of SH coefficients, that represent many."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES

LEVELS = 256
"""Entries of a codebook of numbers."""


def codebook(values: Tensor) -> tuple[Tensor, Tensor]:
    """A codebook of 256 numbers for finite float32 values of any shape, by Lloyd's algorithm
    (1D k-means). Returns the codebook (256,), ascending, and the index of the nearest entry for
    each value, uint8, of the same shape."""
    flat = values.flatten()
    if not flat.numel():
        return torch.zeros(LEVELS, **FLOATS), torch.zeros(
            values.shape, dtype=torch.uint8, device="cpu"
        )
    book = _distinct(flat)
    if book is None:
        stride = -(-flat.numel() // (1 << 17))  # a sample is enough
        ordered = torch.cat([flat[::stride], flat.amin()[None], flat.amax()[None]])
        book = _spread(ordered)
        for _ in range(20):
            index = _nearest(book, ordered)
            count = torch.bincount(index, minlength=LEVELS)
            total = torch.zeros(LEVELS, **DOUBLES).index_add_(0, index, ordered.double())
            book = torch.where(count > 0, (total / count.clamp_min(1)).float(), book).sort().values
    return book, _nearest(book, flat).to(torch.uint8).reshape(values.shape)


def _distinct(values: Tensor) -> Tensor | None:
    """The distinct values, if there are at most 256, padded with the last one."""
    distinct = values[: 2 * LEVELS].unique()
    distinct = distinct if len(distinct) > LEVELS else values.unique()
    return (
        distinct[torch.arange(LEVELS, **INDICES).clamp_max(len(distinct) - 1)]
        if len(distinct) <= LEVELS
        else None
    )


def _spread(values: Tensor) -> Tensor:
    """256 numbers whose density is the cube root of the values' density, which minimises the mean
    squared error of many numbers (Panter and Dite 1951)."""
    low = float(values.amin())
    high = float(values.amax())
    bins = min(max(values.numel() // 16, 64), 4096)
    density = torch.histc(values, bins, low, high).double().pow(1 / 3)
    below = torch.cat([density.new_zeros(1), density.cumsum(0)])
    wanted = (torch.arange(LEVELS, **DOUBLES) + 0.5) / LEVELS * below[-1]
    bin_ = (torch.searchsorted(below, wanted) - 1).clamp(0, bins - 1)
    within = (wanted - below[bin_]) / density[bin_].clamp_min(1e-12)
    return (low + (high - low) * (bin_ + within) / bins).float()


def _nearest(book: Tensor, values: Tensor) -> Tensor:
    """Index of the nearest entry in an ascending codebook for each value."""
    return torch.bucketize(values, (book[1:] + book[:-1]) / 2)


def palette(
    rows: Tensor, size: int, weights: Tensor, progress: Callable[[float], None]
) -> tuple[Tensor, Tensor]:
    """A palette of rows for finite float32 rows (N, D), by hierarchical k-means.

    Rows are split into clusters. Each cluster gets a part of the palette in proportion to its
    squared error, and is split again. This takes a small part of the time of flat k-means with as
    many clusters. If there are no more distinct rows than entries, they are the palette.

    Args:
        rows: finite float32 rows (N, D).
        size: number of entries, a multiple of 64.
        weights: weight (N,) of each row's squared error, above 0.
        progress: called with the share done.

    Returns:
        The palette (P, D), P a multiple of 64, and the index (N,) of each row's entry.
    """
    n = len(rows)
    # clusters per level, and number of levels
    branches = 64
    deepest = 6
    if (found := _different(rows, size)) is not None:
        return found
    weights = weights.float()
    generator = torch.Generator().manual_seed(0)  # the same input gives the same bits
    book = rows.new_zeros(size, rows.shape[1])
    index = torch.empty(n, **INDICES)
    waiting = [(torch.arange(n, **INDICES), size, 0)]
    used = done = 0
    while waiting:
        members, k, depth = waiting.pop()
        part = rows[members]
        weight = weights[members]
        # fewer make splits slower and less accurate
        at_once = k <= branches or k * len(part) <= 1 << 22
        if not at_once and depth < deepest:
            sample = torch.randperm(len(part), generator=generator, device="cpu")[: 1 << 17]
            centres = _means(part[sample], weight[sample], branches, generator)
            of = _assign(part, centres)
            counts = torch.bincount(of, minlength=branches)
            groups = members[of.argsort(stable=True)].split(counts.tolist())
            error = weight.double() * (part - centres[of]).double().square().sum(dim=1)
            share = _apportion(
                counts, error.new_zeros(branches).index_add_(0, of, error), k
            ).tolist()
            waiting += [
                (group, own, depth + 1) for group, own in zip(groups, share, strict=True) if own
            ]
            continue
            # Rows that k-means cannot separate, for example if nearly all are equal, are cut into
            # pieces of equal size.
        if at_once:
            centres = _means(part, weight, k, generator)
            of = _assign(part, centres)
        else:
            of = _piece_of(part, k)
            centres = part.new_zeros(k, part.shape[1]).index_add_(0, of, part)
            centres /= torch.bincount(of, minlength=k)[:, None].clamp_min(1)
        index[members] = used + of
        book[used : used + len(centres)] = centres
        used = used + len(centres)
        done = done + len(members)
        progress(done / n)
    return book, index


def _piece_of(rows: Tensor, k: int) -> Tensor:
    """Piece of each row (N, D): ``k`` pieces of similar size along the column of largest
    variance."""
    order = rows[:, int(rows.var(dim=0).argmax())].argsort(stable=True)
    pieces = torch.empty(len(rows), **INDICES)
    pieces[order] = torch.arange(len(rows), **INDICES) * k // len(rows)
    return pieces


def _different(rows: Tensor, most: int) -> tuple[Tensor, Tensor] | None:
    """The distinct rows and the index of each row's, if there are at most ``most``; padded with
    zeros to a multiple of 64."""
    sums = rows.double() @ torch.linspace(1.0, 2.0, rows.shape[1], **DOUBLES).sqrt()
    if len(sums[: 2 * most].unique()) > most:
        return None
    ordered, order = sums.sort(stable=True)
    _, inverse, counts = ordered.unique_consecutive(return_inverse=True, return_counts=True)
    index = torch.empty_like(order).scatter_(0, order, inverse)
    book = rows[order[counts.cumsum(0) - counts]]
    if len(book) > most or not torch.equal(book[index], rows):
        return None
    filled = 64 * max(-(-len(book) // 64), 1)
    return torch.cat([book, book.new_zeros(filled - len(book), rows.shape[1])]), index


def _apportion(counts: Tensor, errors: Tensor, size: int) -> Tensor:
    """Distribute ``size`` entries in proportion to errors, float64: at least one per non-empty
    cluster, and no more than it has members."""
    errors = torch.where(errors.sum() > 0, errors, counts.double())
    share = torch.minimum((errors * size / errors.sum()).floor().long().clamp_min(1), counts)
    order = errors.argsort(descending=True, stable=True)
    while (left := size - int(share.sum())) != 0:
        can = order[(share[order] < counts[order]) if left > 0 else (share[order] > 1)][: abs(left)]
        if not len(can):
            break
        share[can] += 1 if left > 0 else -1
    return share


def _means(rows: Tensor, weights: Tensor, k: int, generator: torch.Generator) -> Tensor:
    """Centres (at most k, D) of weighted k-means over rows (N, D)."""
    if len(rows) <= k:
        return rows
    centres = rows[torch.multinomial(weights.double(), k, generator=generator)].clone()
    for _ in range(6):
        index = _assign(rows, centres)
        sums = weights.new_zeros(k).index_add_(0, index, weights)
        total = torch.zeros_like(centres).index_add_(0, index, rows * weights[:, None])
        filled = sums > 0
        centres[filled] = total[filled] / sums[filled, None]
    return centres


def _assign(rows: Tensor, centres: Tensor) -> Tensor:
    """Index (N,) of the nearest centre for each row."""
    half = 0.5 * centres.square().sum(dim=1)
    step = max((1 << 22) // len(centres), 1)  # 16 MB of distances at a time
    return torch.cat([(half - part @ centres.T).argmin(dim=1) for part in rows.split(step)])
