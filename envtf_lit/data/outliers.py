"""Values so far from all others of their column that they alone would set its scale."""

from collections.abc import Iterator

import numpy as np

from envtf_lit.data.columns import Column, column_blocks
from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.findings import Finding

FAR = 1e3  # spreads from the median
SAMPLE = 10_000  # rows that median and spread are taken from, evenly over all
SHARES = (50, 90, 99)  # percent of the rows whose range is the spread: the first that is not zero
COLUMNS = ("observations", "actions", "rewards", "next_observations")


def wild_values(dataset: OfflineDataset) -> Iterator[Finding]:
    """A warning for each dimension with values further from its median than `FAR` interquartile ranges.

    Means and standard deviations, by which everything is scaled, would be of those values: of 10,000 rows one at a
    million times the spread makes the standard deviation 10,000 times what it is without. Dimensions that hardly vary
    have no interquartile range; the range of 90 or 99 percent of the rows stands in for it, and at last the median's
    magnitude.
    """
    for name in COLUMNS:
        column = getattr(dataset, name)
        middle, spread = _middle_and_spread(column)
        for dimension, (row, count) in sorted(_far(column, middle, spread).items()):
            value = float(np.asarray(column[row : row + 1]).reshape(1, -1)[0, dimension])
            yield _finding(dataset, name, dimension, row, value, count, middle[dimension], spread[dimension])


def _finding(
    dataset: OfflineDataset, name: str, dimension: int, row: int, value: float, count: int, middle: float, spread: float
) -> Finding:
    episode = int(np.searchsorted(dataset.episode_starts, row, "right")) - 1
    begin, end = dataset.episode_starts[episode], dataset.episode_ends[episode]
    where = "" if name == "rewards" else f" in dimension {dimension}"
    others = "" if count == 1 else f" ({count} rows are as far)"
    what = f"{name!r} is {value:.4g}{where} at row {row}, {abs(value - middle) / spread:.2g} times the spread away from"
    fix = f"mend the value, or drop episode {episode} (rows {begin} to {end - 1}): else it sets the scale of all others"
    return Finding("warning", f"{what} the median {middle:.4g}{others}", fix)


def _middle_and_spread(column: Column) -> tuple[np.ndarray, np.ndarray]:
    """Median and spread, each (D,) float64, of a sample of the rows (N, D) or (N,)."""
    step = -(-len(column) // SAMPLE)
    parts = [np.asarray(column[block])[-block.start % step :: step] for block in column_blocks(column)]
    sample = np.concatenate(parts).astype(np.float64)
    sample = sample.reshape(len(sample), -1)
    middle = np.median(sample, axis=0)
    spread = np.zeros_like(middle)
    for share in SHARES:
        low, high = np.percentile(sample, [50 - share / 2, 50 + share / 2], axis=0)
        spread = np.where(spread > 0, spread, high - low)
    return middle, np.where(spread > 0, spread, np.abs(middle))


def _far(column: Column, middle: np.ndarray, spread: np.ndarray) -> dict[int, tuple[int, int]]:
    """By dimension the first row that is far from the median, and how many are."""
    found: dict[int, tuple[int, int]] = {}
    for block in column_blocks(column):
        part = np.asarray(column[block])
        far = (np.abs(part.reshape(len(part), -1) - middle) > FAR * spread) & (spread > 0)
        for dimension in np.flatnonzero(far.any(axis=0)).tolist():
            row, count = found.get(dimension, (block.start + int(far[:, dimension].argmax()), 0))
            found[dimension] = row, count + int(far[:, dimension].sum())
    return found
