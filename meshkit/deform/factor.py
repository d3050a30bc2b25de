"""The linear solves of the as-rigid-as-possible iterations for one set of handles."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from meshkit.deform.conjugate_gradients import diagonal_solver
from meshkit.deform.rest import ARAPRest
from meshkit.deform.sparse import csr_of_scipy

__all__ = ["SOLVERS", "ARAPFactor"]

SOLVERS = ("auto", "splu", "qdldl", "cholespy", "pcg", "dense")


class ARAPFactor:
    """Factor of the block of the free vertices of a rest shape's Laplacian; serves any handle positions.

    Args:
        rest: operators of the rest shape.
        handles: (H,) indices of the vertices whose positions are given; may be empty where `soft_weights` hold
            every component.
        soft_weights: (V,) weights, at least 0, of the soft targets; 0 where there is none.
        solver: "splu" (scipy), "qdldl" or "cholespy" (if installed), or "pcg": conjugate gradients with the diagonal
            as preconditioner, which keeps no factor and so suits meshes too large for one. "auto" and "dense", which
            concern whole batches, are "splu" here.

    Attributes:
        free: (V - H,) indices of the other vertices.
        handles: (H,) indices of the handles.

    Raises:
        ValueError: an unknown solver; handles out of range or repeated; soft weights of another shape, negative or
            not finite; a component that neither a handle nor a soft weight holds.
        ImportError: the package of the solver is missing.

    Example:
        >>> from meshkit.deform import ARAPTopology
        >>> topology = ARAPTopology(torch.tensor([[0, 1, 2]]), 3)
        >>> rest = ARAPRest(topology, torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
        >>> ARAPFactor(rest, torch.tensor([0])).free.tolist()
        [1, 2]
    """

    def __init__(
        self, rest: ARAPRest, handles: Tensor, *, soft_weights: Tensor | None = None, solver: str = "auto"
    ) -> None:
        import numpy as np
        from scipy import sparse

        check_choice("solver", solver, SOLVERS)
        size = rest.topology.num_verts
        self.rest, self.handles = rest, handles.detach().cpu().long()
        _check_handles(self.handles, size)
        if soft_weights is not None:
            _check_soft(soft_weights, size)
        # weights of the energy over m, as the operators are
        self.soft = None if soft_weights is None else soft_weights.detach().cpu().double() / rest.topology.multiplicity
        _check_held(rest, self.handles, self.soft)
        is_free = np.ones(size, dtype=bool)
        is_free[self.handles.numpy()] = False
        self.stiffness = rest.laplacian
        if self.soft is not None:
            self.stiffness = (rest.laplacian + sparse.diags_array(self.soft.numpy())).tocsr()
        self.free = torch.from_numpy(np.flatnonzero(is_free))
        self.solve: Callable[[Any], Any] = _empty
        if len(self.free):
            self.solve = _MAKERS[solver](_block(self.stiffness, is_free))


def check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raise ValueError unless the value is a known one."""
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}; got {value!r}")


def _check_handles(handles: Tensor, size: int) -> None:
    if handles.numel() and (int(handles.max()) >= size or int(handles.min()) < 0):
        raise ValueError(
            f"handles must lie in [0, {size}), got a range of [{int(handles.min())}, {int(handles.max())}]"
        )
    repeated = len(handles) - len(handles.unique())
    if repeated:
        raise ValueError(f"{repeated} handles repeat an earlier one of the same mesh; list each vertex once")


def _check_soft(weights: Tensor, size: int) -> None:
    if weights.shape != (size,):
        raise ValueError(f"soft_weights must have shape ({size},), got {tuple(weights.shape)}")
    if not bool(((weights >= 0) & weights.isfinite()).all()):
        low, high = float(weights.min()), float(weights.max())
        raise ValueError(f"soft_weights must be finite and at least 0, got a range of [{low}, {high}]")


def _check_held(rest: ARAPRest, handles: Tensor, soft: Tensor | None) -> None:
    sizes = torch.bincount(rest.components)
    loose = torch.ones(len(sizes), dtype=torch.bool, device="cpu")
    loose[rest.components[handles]] = False
    if soft is not None:
        loose[rest.components[soft > 0]] = False
    if not len(handles) and soft is None:
        raise ValueError("the mesh has no handle; give it at least one, or soft targets")
    isolated = int((loose & (sizes == 1)).sum())
    if isolated:
        raise ValueError(
            f"{isolated} vertices are in no face of positive area and are no handles, so nothing determines them; "
            "remove them, mask them out, or make them handles"
        )
    if loose.any():
        welded = _pieces_after_welding(rest)
        advice = "give each component at least one handle"
        if welded < len(sizes):
            advice = (
                f"the mesh is in {len(sizes)} pieces, which are {welded} once vertices at equal positions are merged: "
                "verts, inverse = torch.unique(verts, dim=0, return_inverse=True); faces = inverse[faces]"
            )
        raise ValueError(f"{int(loose.sum())} connected components have no handle, so nothing holds them; {advice}")


def _pieces_after_welding(rest: ARAPRest) -> int:
    import numpy as np
    from scipy import sparse

    _, place = np.unique(rest.verts.numpy(), axis=0, return_inverse=True)
    labels, place = rest.components.numpy(), place.ravel()
    # Pieces and places as one bipartite graph.
    count, pieces = len(labels), int(labels.max()) + 1
    shape = (pieces + count, pieces + count)
    graph = sparse.csr_array((np.ones(count), (labels, pieces + place)), shape=shape)
    return len(np.unique(sparse.csgraph.connected_components(graph, directed=False)[1][:pieces]))


def _block(matrix: Any, keep: Any) -> Any:
    """Rows and columns of a symmetric CSR matrix, as CSC."""
    import numpy as np
    from scipy import sparse

    number = np.cumsum(keep, dtype=np.int32) - 1
    row = np.repeat(np.arange(len(keep)), np.diff(matrix.indptr))
    inside = keep[row] & keep[matrix.indices]
    counts = np.bincount(row[inside], minlength=len(keep))[keep]
    indptr = np.append(0, counts.cumsum()).astype(np.int32)
    return sparse.csc_array((matrix.data[inside], number[matrix.indices[inside]], indptr), shape=(len(counts),) * 2)


def _empty(right: Any) -> Any:
    return right


def _splu(matrix: Any) -> Callable[[Any], Any]:
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve


def _qdldl(matrix: Any) -> Callable[[Any], Any]:
    import numpy as np
    from scipy import sparse

    qdldl = _optional("qdldl")
    factor = qdldl.Solver(sparse.csc_matrix(matrix))
    return lambda right: np.stack([factor.solve(np.ascontiguousarray(column)) for column in right.T], 1)


def _cholespy(matrix: Any) -> Callable[[Any], Any]:
    import numpy as np

    cholespy = _optional("cholespy")
    entries = matrix.tocoo()  # cholespy would change a CSC matrix in place
    rows, cols = entries.row.astype(np.int32), entries.col.astype(np.int32)
    factor = cholespy.CholeskySolverD(matrix.shape[0], rows, cols, entries.data, cholespy.MatrixType.COO)

    def solve(right: Any) -> Any:
        result = np.empty(right.shape)
        factor.solve(np.ascontiguousarray(right), result)
        return result

    return solve


def _pcg(matrix: Any) -> Callable[[Any], Any]:
    inverse = torch.from_numpy(1 / matrix.diagonal()[:, None])
    solve = diagonal_solver(csr_of_scipy(matrix.tocsr()), inverse)
    return lambda right: solve(torch.from_numpy(right)).numpy()


def _optional(package: str) -> Any:
    from importlib import import_module

    try:
        return import_module(package)
    except ImportError as error:
        raise ImportError(
            f'solver="{package}" needs the package {package}: pip install "meshkit-torch[solvers]"'
        ) from error


_MAKERS = {"auto": _splu, "dense": _splu, "splu": _splu, "qdldl": _qdldl, "cholespy": _cholespy, "pcg": _pcg}
