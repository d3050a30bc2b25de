"""Descriptors of many meshes, on as many processes as asked for."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from torch import Tensor

from meshkit.descriptors import intrinsic_descriptors

__all__ = ["signatures"]


def signatures(
    verts: Iterable[Tensor], faces: Iterable[Tensor], *, num_signatures: int, num_eigenpairs: int, workers: int
) -> Generator[np.ndarray | ValueError, None, None]:
    """Intrinsic descriptors ``(V, num_signatures + 1)`` of each mesh in turn, by the fast method.

    A mesh that has none yields the reason: the caller knows which mesh it was, a process's batch does not. To be closed
    when left early: until then processes work on, and the number of threads is not the caller's.
    """
    compute = partial(_signature, num_signatures=num_signatures, num_eigenpairs=num_eigenpairs)
    if workers <= 1:
        with _one_thread_here():
            yield from map(compute, verts, faces)
        return
    # Spawned processes do not inherit the threads of this one, which forked ones would find half alive.
    context = multiprocessing.get_context("spawn")
    arrays = ((mesh.numpy() for mesh in side) for side in (verts, faces))
    with _one_thread_each(), ProcessPoolExecutor(workers, mp_context=context) as executor:
        yield from executor.map(compute, *arrays, chunksize=8)


def _signature(
    verts: Tensor | np.ndarray, faces: Tensor | np.ndarray, *, num_signatures: int, num_eigenpairs: int
) -> np.ndarray | ValueError:
    points, triangles = (x if isinstance(x, Tensor) else torch.from_numpy(x) for x in (verts, faces))
    try:
        result = intrinsic_descriptors(
            points, triangles, num_signatures=num_signatures, num_eigenpairs=num_eigenpairs, method="fast"
        )
    except (ValueError, RuntimeError) as error:  # the latter from an eigensolver that does not converge
        return ValueError(str(error))
    # NumPy arrays cross process borders by value; tensors would go through shared memory handles.
    return result.numpy()


@contextmanager
def _one_thread_here() -> Iterator[None]:
    """Small matrices gain nothing from threads, and lose much where other processes share the cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started here run their linear algebra on one thread; several each would fight for the cores."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
