"""Pictures: a NumPy z-buffer renderer that works everywhere, contact sheets and curves."""

from meshkit.viz.figures import contact_sheet, plot_curves
from meshkit.viz.rasterizer import error_colors, render

__all__ = ["contact_sheet", "error_colors", "plot_curves", "render"]
