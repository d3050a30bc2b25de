"""Which way a batch is taken: as a whole where its tensors are, or mesh by mesh on the CPU."""

from collections.abc import Callable
from typing import TypeVar

from meshkit.deform.mesh_by_mesh import MeshByMesh
from meshkit.deform.whole_batch import WholeBatch

__all__ = ["Kind", "dispatch"]

Kind = type[WholeBatch] | type[MeshByMesh]
Result = TypeVar("Result")


def dispatch(whole: bool, work: Callable[[Kind], Result | None]) -> Result:
    """Do the work with one of the kinds of problem.

    The whole batch tests its values on the device, all at once. Where a test fails, the other way says which and how,
    or copes.
    """
    result = work(WholeBatch) if whole else None
    if result is None:
        result = work(MeshByMesh)
    assert result is not None
    return result
