"""Codebooks for SOG: few numbers, or few rows of SH coefficients, that stand for many."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

LEVELS = 256
"""Entries of a codebook of numbers."""

MAX_COLORS = 65_536
"""Entries, at most, of a palette of SH; an index has 16 bits."""

GROUP = 1024
"""Gaussians per entry of a palette where there are few, and entries that palettes are multiples of."""

_SAMPLE = 1 << 17
"""Numbers that a codebook is made from, and rows that the first split of a palette is made from."""

_STEPS_1D, _STEPS = 20, 6
_BLOCK = 1 << 22  # distances computed at once, 16 MB


def codebook(values: Tensor) -> tuple[Tensor, Tensor]:
    """256 numbers that stand for many, by Lloyd's algorithm (k-means in one dimension).

    Args:
        values: float32 of any shape, finite.

    Returns:
        The codebook (256,), ascending, and the index of the nearest entry for each value, uint8 of the same shape.
    """
    flat = values.flatten()
    if not flat.numel():
        return torch.zeros(LEVELS), torch.zeros(values.shape, dtype=torch.uint8)
    ordered = flat[:: -(-flat.numel() // _SAMPLE)].sort().values
    ordered = torch.cat([flat.amin()[None], ordered, flat.amax()[None]])
    # Half by rank, half by value, so that neither the many nor the extremes go without.
    ranks = torch.linspace(0, len(ordered) - 1, LEVELS // 2).round().long()
    book = torch.cat([ordered[ranks], torch.linspace(float(ordered[0]), float(ordered[-1]), LEVELS // 2)])
    book = book.sort().values
    for _ in range(_STEPS_1D):
        index = _nearest(book, ordered)
        count = torch.bincount(index, minlength=LEVELS)
        total = torch.zeros(LEVELS, dtype=torch.float64).index_add_(0, index, ordered.double())
        book = torch.where(count > 0, (total / count.clamp_min(1)).float(), book).sort().values
    book[0], book[-1] = ordered[0], ordered[-1]
    return book, _nearest(book, flat).to(torch.uint8).reshape(values.shape)


def _nearest(book: Tensor, values: Tensor) -> Tensor:
    """Index in an ascending codebook of the entry nearest to each value."""
    return torch.bucketize(values, (book[1:] + book[:-1]) / 2)


def palette_size(count: int) -> int:
    """Entries of the palette for so many Gaussians: a power of two of thousands, at most as many as an index reaches."""
    size = GROUP
    while 2 * size <= min(count, MAX_COLORS):
        size *= 2
    return size


def palette(rows: Tensor, progress: Callable[[float], None]) -> tuple[Tensor, Tensor]:
    """Rows that stand for many, by k-means in two levels: rows are split into clusters, and each cluster into its share
    of the palette. That takes a fraction of the time of k-means with as many clusters at once.

    Args:
        rows: (N, D) float32, finite.
        progress: called with the share done.

    Returns:
        The palette (P, D), P a multiple of 64, and the index (N,) of the entry for each row.
    """
    n, size = len(rows), palette_size(len(rows))
    if n <= size:
        return torch.cat([rows, rows.new_zeros(size - n, rows.shape[1])]), torch.arange(n)
    generator = torch.Generator().manual_seed(0)  # the same input gives the same bits
    first = max(int(size**0.5), 1)
    sample = rows[torch.randperm(n, generator=generator)[:_SAMPLE]]
    coarse = _assign(rows, _means(sample, first, generator))
    order = coarse.argsort(stable=True)
    counts = torch.bincount(coarse, minlength=first)
    share = _apportion(counts, size)
    book, index = rows.new_zeros(size, rows.shape[1]), torch.empty(n, dtype=torch.int64)
    start = used = 0
    for count, k in zip(counts.tolist(), share.tolist(), strict=True):
        members = order[start : start + count]
        if count:
            centres = _means(rows[members], k, generator)
            index[members] = used + _assign(rows[members], centres)
            book[used : used + len(centres)] = centres
        start, used = start + count, used + k
        progress(start / n)
    return book, index


def _apportion(counts: Tensor, size: int) -> Tensor:
    """``size`` entries shared out in proportion to counts: at least one where there are members, none more than them."""
    share = torch.minimum((counts.double() * size / counts.sum()).floor().long().clamp_min(1), counts)
    order = counts.argsort(descending=True, stable=True)
    while (left := size - int(share.sum())) != 0:
        can = order[(share[order] < counts[order]) if left > 0 else (share[order] > 1)][: abs(left)]
        if not len(can):
            break
        share[can] += 1 if left > 0 else -1
    return share


def _means(rows: Tensor, k: int, generator: torch.Generator) -> Tensor:
    """Centres (at most k, D) of k-means over rows (N, D)."""
    if len(rows) <= k:
        return rows
    centres = rows[torch.randperm(len(rows), generator=generator)[:k]].clone()
    for _ in range(_STEPS):
        index = _assign(rows, centres)
        count = torch.bincount(index, minlength=k)
        total = torch.zeros_like(centres).index_add_(0, index, rows)
        filled = count > 0
        centres[filled] = total[filled] / count[filled, None]
    return centres


def _assign(rows: Tensor, centres: Tensor) -> Tensor:
    """Index (N,) of the centre nearest to each row."""
    half = 0.5 * centres.square().sum(dim=1)
    step = max(_BLOCK // len(centres), 1)
    return torch.cat([(half - part @ centres.T).argmin(dim=1) for part in rows.split(step)])
