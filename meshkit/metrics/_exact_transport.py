"""Exact optimal transport between two uniform point sets on the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from meshkit.metrics._transport_bounds import DistanceTiles, conjugates, potentials, softmin, uniform

if TYPE_CHECKING:
    import numpy as np

_SUBSET = 1024  # most points that the first potentials come from
_SMALL = 200  # sets that need no potentials


def exact_plan(x: Tensor, y: Tensor, squared: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Rows, columns and masses of the entries of the best plan between ``x (N, 3)`` and ``y (M, 3)``."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    metric = "sqeuclidean" if squared else "euclidean"
    # Before the matrix is there, so that not both are in memory at a time.
    start = _starting_potentials(x, y, squared) if min(len(x), len(y)) > _SMALL else None
    cost = cdist(x.double().cpu().numpy(), y.double().cpu().numpy(), metric)
    if start is not None:
        cost -= start[0].double().cpu().numpy()[:, None]
        cost -= start[1].double().cpu().numpy()
    if len(x) == len(y):
        rows, columns = (torch.from_numpy(index).to(x.device) for index in linear_sum_assignment(cost))
        return rows, columns, x.new_full((len(x),), 1 / len(x))
    return _network_simplex(cost, x)


def _starting_potentials(x: Tensor, y: Tensor, squared: bool) -> tuple[Tensor, Tensor]:
    """Potentials near the best ones: those of a subset, carried over to all points. The order of points is spatial."""
    near_x, near_y = (points[:: max(4, -(-len(points) // _SUBSET))] for points in (x, y))
    tiles = DistanceTiles(near_x, near_y, squared, None)
    f, _ = potentials(tiles, uniform(near_x), uniform(near_y), n_iters=40, tol=1e-2)
    g = softmin(DistanceTiles(y, near_x, squared, tiles.eps), f)
    return conjugates(DistanceTiles(x, y, squared, tiles.eps), g)


def _network_simplex(cost: np.ndarray, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    import numpy as np

    try:
        import ot  # type: ignore[import-untyped]
    except ImportError as error:
        raise ImportError(
            "the exact earth mover's distance between sets of different size needs POT: pip install POT; or use "
            'method="sinkhorn"'
        ) from error
    shape = cost.shape
    plan, log = ot.emd(*(np.full(size, 1 / size) for size in shape), cost, numItermax=10**9, log=True)
    if log["warning"] is not None:
        raise RuntimeError(f"POT did not solve a transport problem of {shape[0]} x {shape[1]}: {log['warning']}")
    rows, columns = np.nonzero(plan)
    mass = torch.from_numpy(plan[rows, columns]).to(like)
    return torch.from_numpy(rows).to(like.device), torch.from_numpy(columns).to(like.device), mass
