"""Pictures and pages of transfers."""

import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from meshkit.batching import center
from meshkit.io import atomic_write
from meshkit.io.report import counted
from meshkit.transfer.report import TransferResult
from meshkit.viz import contact_sheet, render, save_html

__all__ = ["save_page", "save_picture"]

_TITLES = ("identity", "pose", "result")


def save_picture(
    path: str | os.PathLike[str],
    results: Sequence[TransferResult],
    *,
    size: int = 400,
    report: str | os.PathLike[str] | None = None,
) -> None:
    """Write identity, pose and result side by side, a row for each result and at one scale in each row.

    Args:
        path: the picture to write.
        results: one or more.
        size: of each cell, in pixels.
        report: file in which the warnings can be read, for the captions that count them.

    Raises:
        ValueError: no results.
    """
    if not results:
        raise ValueError("there are no results to draw")
    rows, captions = [], []
    for result in results:
        views = _upright(result)
        everything = torch.cat([verts for verts, _ in views])
        bounds = torch.stack([everything.amin(0), everything.amax(0)])
        rows.append([render(verts, faces, bounds=bounds, size=(size, size)) for verts, faces in views])
        count = len(result.report.doubts)
        warned = counted(count, "warning") + (f": see {Path(report).name}" if report is not None else "")
        names = [Path(mesh.name).name for mesh in (result.report.identity, result.report.pose)]
        captions.append([*names, warned if count else ""])
    with atomic_write(path) as temporary:
        contact_sheet(rows, column_titles=_TITLES, captions=captions).save(temporary)


def save_page(path: str | os.PathLike[str], result: TransferResult) -> None:
    """Write a page in which identity, pose and result can be turned; it needs no network.

    Args:
        path: the HTML file to write.
        result: of one transfer.
    """
    report = result.report
    meshes = dict(zip(_TITLES, _upright(result), strict=True))
    headlines = "; ".join(doubt.headline for doubt in report.doubts if not doubt.follows)
    if count := sum(doubt.follows for doubt in report.doubts):
        headlines += f"; {count} more"
    notes = [Path(report.identity.name).name, Path(report.pose.name).name, headlines or report.weights]
    save_html(path, meshes, title="Pose transfer", notes=notes)


def _upright(result: TransferResult) -> list[tuple[Tensor, Tensor]]:
    return [(center(verts[None].cpu())[0], faces.cpu()) for verts, faces in result.views]
