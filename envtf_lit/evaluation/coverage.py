"""What a log has seen: the cells of two dimensions that it visits, and its row that is nearest to another."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from envtf_lit.data.dataset import OfflineDataset
from envtf_lit.data.statistics import CONSTANT

ROWS = 256  # of the queries that are compared with all rows at a time


@dataclass(frozen=True, eq=False)
class Visits:
    """How often several logs were in each cell of a grid over two dimensions of the observation.

    Attributes:
        dimensions: the two, (x, y).
        x_edges, y_edges: (bins + 1,) of the cells.
        counts: (bins, bins) rows in each cell, x first, of each log by its name.
    """

    dimensions: tuple[int, int]
    x_edges: np.ndarray
    y_edges: np.ndarray
    counts: dict[str, np.ndarray]

    def share(self, name: str) -> float:
        """Share of the cells that any of the logs visits, which this one visits, in [0, 1]."""
        anywhere = np.any([count > 0 for count in self.counts.values()], axis=0)
        return float((self.counts[name] > 0).sum() / anywhere.sum())


def visits(logs: Mapping[str, OfflineDataset], dimensions: tuple[int, int], *, bins: int = 40) -> Visits:
    """Counts the rows of logs of one robot in the cells of a common grid.

    Args:
        logs: by name.
        dimensions: two of the observation.
        bins: cells along each of them, which together hold the whole range of all logs.
    """
    points = {name: np.asarray(log.observations)[:, dimensions] for name, log in logs.items()}
    everything = np.concatenate(list(points.values()))
    edges = [np.linspace(column.min(), column.max() + 1e-6, bins + 1) for column in everything.T]
    counts = {name: np.histogram2d(*found.T, bins=edges)[0] for name, found in points.items()}
    return Visits(dimensions, edges[0], edges[1], counts)


def nearest(queries: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest of the rows (N, D) to each query (Q, D): its index (Q,), and its distance (Q,).

    The distance is the root mean square of the differences, each in the standard deviation of its dimension over the
    rows; constant dimensions do not count.
    """
    spread = rows.astype(np.float64).std(0)
    live = spread > CONSTANT
    unit = np.sqrt(live.sum()) * spread[live]
    wanted, known = (torch.from_numpy(x[:, live] / unit) for x in (queries, rows))
    found = [torch.cdist(part, known).min(1) for part in wanted.split(ROWS)]
    distance, index = (torch.cat([getattr(part, name) for part in found]).numpy() for name in ("values", "indices"))
    return index, distance
