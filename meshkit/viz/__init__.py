"""Pictures: a NumPy z-buffer renderer that works everywhere, figures made with it, animations and interactive pages."""

from meshkit.viz.animation import save_animation, turntable
from meshkit.viz.correspondence import correspondence_figure, position_colors, transfer_colors
from meshkit.viz.figures import contact_sheet, plot_curves
from meshkit.viz.heat_map import error_heat_map
from meshkit.viz.pyvista_renderer import render_pyvista
from meshkit.viz.rasterizer import error_colors, render
from meshkit.viz.viewer import save_html

__all__ = [
    "contact_sheet",
    "correspondence_figure",
    "error_colors",
    "error_heat_map",
    "plot_curves",
    "position_colors",
    "render",
    "render_pyvista",
    "save_animation",
    "save_html",
    "transfer_colors",
    "turntable",
]
