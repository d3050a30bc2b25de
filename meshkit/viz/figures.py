"""Finished pictures for reports: rows of rendered meshes with titles, and training curves."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshkit.io import atomic_write
from meshkit.viz._mesh import as_array
from meshkit.viz.rasterizer import error_colors

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["contact_sheet", "plot_curves"]

_INK = (38, 42, 48)
_GREY = (104, 110, 118)
_PALETTE = ("#3b6ea8", "#d1603d", "#4f9d69", "#8b6bb1", "#c29a2b", "#5b6770", "#b0507a", "#3a9ca6")

Picture = NDArray[np.uint8]


def contact_sheet(
    rows: Sequence[Sequence[Picture | None]],
    *,
    column_titles: Sequence[str],
    row_titles: Sequence[str] | None = None,
    captions: Sequence[Sequence[str]] | None = None,
    colorbar: tuple[float, float, str] | None = None,
) -> "Image":
    """Set rendered pictures in a grid with titles.

    Args:
        rows: rows of (H, W, 3) uint8 pictures of one size, as :func:`meshkit.viz.render` returns them; ``None`` leaves
            a cell empty.
        column_titles: one title per column, above the first row.
        row_titles: one title per row, turned upright on the left.
        captions: one line under each picture, in the shape of ``rows``.
        colorbar: lowest value, highest value and label of the colours of :func:`meshkit.viz.error_colors`, drawn on
            the right.

    Returns:
        The sheet, a Pillow image; ``sheet.save("sheet.png")`` writes it.

    Raises:
        ValueError: no pictures, rows, titles or captions of unequal number, or pictures of another size or type.

    Example:
        >>> white = np.full((60, 80, 3), 255, dtype=np.uint8)
        >>> sheet = contact_sheet([[white, None]], column_titles=["identity", "pose"])
        >>> sheet.mode, sheet.width > 160
        ('RGB', True)
    """
    from PIL import Image

    height, width = _check_grid(rows, column_titles, row_titles, captions)
    text = max(11, round(0.055 * min(height, width)))
    gap = max(6, round(0.035 * min(height, width)))
    caption_height = round(1.9 * text) if captions else 0
    left = gap + (round(1.9 * text) if row_titles else 0)
    top = gap + round(2.0 * text)
    right = gap + (6 * text if colorbar else 0)
    step_x, step_y = width + gap, height + caption_height + gap
    size = (left + len(column_titles) * step_x - gap + right, top + len(rows) * step_y)
    sheet = Image.new("RGB", size, "white")

    for j, title in enumerate(column_titles):
        _paste_text(sheet, title, (left + j * step_x + width // 2, gap + text // 2), text, width, bold=True)
    for i, row in enumerate(rows):
        y = top + i * step_y
        if row_titles:
            _paste_text(sheet, row_titles[i], (gap + text // 2, y + height // 2), text, height, bold=True, upright=True)
        for j, picture in enumerate(row):
            x = left + j * step_x
            if picture is not None:
                sheet.paste(Image.fromarray(picture), (x, y))
            if captions:
                center = (x + width // 2, y + height + caption_height // 2)
                _paste_text(sheet, captions[i][j], center, round(0.88 * text), width, color=_GREY)
    if colorbar:
        grid_height = len(rows) * step_y - gap
        bar = (size[0] - right, top, text, round(min(grid_height, max(1.6 * height, 0.5 * grid_height))))
        _paste_colorbar(sheet, colorbar, (bar[0], top + (grid_height - bar[3]) // 2, bar[2], bar[3]), text)
    return sheet


def plot_curves(
    path: str | os.PathLike[str],
    series: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    xlabel: str,
    ylabel: str,
    logy: bool = False,
) -> None:
    """Write a line plot of named curves as a PNG file.

    Args:
        path: the file to write; its folder is made if missing.
        series: name of each curve and its x and y values, equally many. Values that are not finite leave a gap.
        xlabel: title of the horizontal axis, with its unit.
        ylabel: title of the vertical axis, with its unit.
        logy: logarithmic vertical axis, if any value is above 0.

    Raises:
        ValueError: no curve, another suffix than ``.png``, or a curve without a finite point or with
            unequal numbers of x and y values.

    Example:
        >>> import tempfile, pathlib
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "loss.png"
        >>> plot_curves(file, {"training": ([0, 1, 2], [1.0, 0.5, 0.3])}, xlabel="step", ylabel="loss")
        >>> file.exists()
        True
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"curves are written as .png, got {Path(path).name!r}")
    if not series:
        raise ValueError("nothing to plot: series is empty")
    curves = {}
    for name, pair in series.items():
        if not isinstance(pair, Sequence | np.ndarray) or len(pair) != 2:
            raise ValueError(f"curve {name!r} must be (x values, y values), got {type(pair).__name__}")
        curves[name] = as_array(pair[0]), as_array(pair[1])
    for name, (x, y) in curves.items():
        if x.ndim != 1 or x.shape != y.shape or not (np.isfinite(x) & np.isfinite(y)).any():
            raise ValueError(
                f"curve {name!r} needs as many x as y values and a finite point, got shapes {x.shape} and {y.shape}"
            )
    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    for number, (name, (x, y)) in enumerate(curves.items()):
        color, marker = _PALETTE[number % len(_PALETTE)], "o" if len(x) <= 25 else None
        axes.plot(x, y, label=name, color=color, linewidth=1.6, marker=marker, markersize=3.5)
    if logy and any((y > 0).any() for _, y in curves.values()):
        axes.set_yscale("log", nonpositive="mask")
        low, high = axes.get_ylim()
        if high < 100 * low:  # few decades: plain numbers, in between as well
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
            axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.grid(True, which="major", color="#dfe3e8", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if len(curves) > 1:
        axes.legend(frameon=False)
    with atomic_write(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def paste_title(sheet: "Image", text: str, center: tuple[int, int], size: int, room: int) -> None:
    """Write a bold title around ``center``, smaller when it would be wider than ``room`` pixels."""
    _paste_text(sheet, text, center, size, room, bold=True)


def _check_grid(
    rows: Sequence[Sequence[Picture | None]],
    column_titles: Sequence[str],
    row_titles: Sequence[str] | None,
    captions: Sequence[Sequence[str]] | None,
) -> tuple[int, int]:
    pictures = [picture for row in rows for picture in row if picture is not None]
    if not pictures:
        raise ValueError("a contact sheet needs a picture, got none")
    if any(len(row) != len(column_titles) for row in rows):
        raise ValueError(f"{len(column_titles)} column titles for rows of {[len(row) for row in rows]} pictures")
    if row_titles is not None and len(row_titles) != len(rows):
        raise ValueError(f"{len(row_titles)} row titles for {len(rows)} rows")
    if captions is not None and [len(line) for line in captions] != [len(row) for row in rows]:
        raise ValueError("captions must have one line for every picture, in the shape of rows")
    if any(p.dtype != np.uint8 or p.ndim != 3 or p.shape[2] != 3 or p.shape != pictures[0].shape for p in pictures):
        kinds = sorted({f"{p.dtype} {p.shape}" for p in pictures})
        raise ValueError(f"pictures must be uint8 (H, W, 3) of one size, got {', '.join(kinds)}")
    return pictures[0].shape[0], pictures[0].shape[1]


def _font(size: int, bold: bool) -> Any:
    from matplotlib import font_manager
    from PIL import ImageFont

    properties = font_manager.FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    return ImageFont.truetype(font_manager.findfont(properties), size)


def _paste_text(
    sheet: "Image",
    text: str,
    center: tuple[int, int],
    size: int,
    room: int,
    *,
    color: tuple[int, int, int] = _INK,
    bold: bool = False,
    upright: bool = False,
) -> None:
    """Write one line around ``center``, in smaller type when it would be longer than ``room`` pixels."""
    from PIL import Image, ImageDraw

    font = _font(size, bold)
    if font.getlength(text) > room:
        font = _font(max(7, int(size * room / font.getlength(text))), bold)
    ascent, descent = font.getmetrics()
    line = Image.new("L", (int(font.getlength(text)) + 2, ascent + descent), 0)
    ImageDraw.Draw(line).text((1, 0), text, fill=255, font=font)
    if upright:
        line = line.rotate(90, expand=True)
    sheet.paste(color, (center[0] - line.width // 2, center[1] - line.height // 2), line)


def _paste_colorbar(
    sheet: "Image", colorbar: tuple[float, float, str], box: tuple[int, int, int, int], size: int
) -> None:
    from PIL import Image, ImageDraw

    low, high, label = colorbar
    x, y, width, height = box
    ramp = np.rint(error_colors(np.linspace(1, 0, height), vmax=1) * 255).astype(np.uint8)
    sheet.paste(Image.fromarray(np.repeat(ramp[:, None], width, axis=1)), (x, y))
    draw = ImageDraw.Draw(sheet)
    tick_font = _font(round(0.88 * size), bold=False)
    for fraction in (0.0, 0.5, 1.0):
        tick_y = y + round((1 - fraction) * (height - 1))
        draw.line((x + width, tick_y, x + width + size // 3, tick_y), fill=_GREY)
        tick = (x + width + size // 2, tick_y)
        draw.text(tick, f"{low + fraction * (high - low):.3g}", fill=_GREY, font=tick_font, anchor="lm")
    _paste_text(sheet, label, (x + width + round(4.4 * size), y + height // 2), size, height, upright=True)
