"""Equations as inline SVG, drawn by matplotlib: pages need no script, no font and no network to show them.

matplotlib's mathtext knows most of TeX's symbols but not all of its spellings; :func:`dialect` translates the rest. An
equation it cannot draw is a warning, and so fails a build with ``-W``.
"""

import html
import re
from functools import cache
from pathlib import Path

from docutils import nodes
from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import MathTextParser
from matplotlib.path import Path as Outline
from matplotlib.textpath import TextToPath
from sphinx.util import logging

EM = TextToPath.FONT_SCALE  # outlines come in hundredths of the font size
FONT = FontProperties(size=EM, math_fontfamily="cm")
SPELLINGS = [
    (r"\\[lr]Vert(?![a-zA-Z])", r"\\Vert "),
    (r"\\[Bb]igg?[lr]?\s*(?=[()\[\]/|\\])", ""),
    (r"\\operatorname\*", r"\\operatorname"),
    (r"\\textstyle", ""),
    (r"\\top(?![a-zA-Z])", r"{\\mathsf{T}}"),  # a relation there, with space around it
    (r"(\\mathrm\{\w\})\s*(\\log)", r"\1\\,\2"),
    (r"\\(le|ge|ne)(?![a-zA-Z])", r"\\\1q"),
    (r"\\neqq", r"\\neq"),
    (r"\\(mathbf|mathcal|mathrm)\s+(\w)", r"\\\1{\2}"),
    (r"\\sqrt\s*(\\[a-z]+|\w)(?![{[])", r"\\sqrt{\1}"),
    (r"\\(t?frac)\s*(\w)\s*(\w)", r"\\\1{\2}{\3}"),
    (r"\\(t?frac)\s*(\w)\s*(?=\{)", r"\\\1{\2}"),
    (r"\\left\|(.*?)\\right\|", r"|\1|"),
]


def dialect(tex: str, display: bool) -> str:
    """The same equation in mathtext's spelling."""
    for pattern, spelling in SPELLINGS:
        tex = re.sub(pattern, spelling, tex)
    if display:  # there, mathtext's \frac is TeX's \tfrac
        tex = tex.replace(r"\frac", r"\dfrac")
    return " ".join(tex.replace(r"\tfrac", r"\frac").split())


@cache
def svg(tex: str, display: bool) -> str:
    """An SVG element that stands on the line of the text and takes its colour and size."""
    text = f"${dialect(tex, display)}$"
    box = MathTextParser("path").parse(text, 72, FONT)
    verts, codes = TextToPath().get_text_path(FONT, text, ismath=True)
    letters = {Outline.MOVETO: "M", Outline.LINETO: "L", Outline.CURVE3: "Q", Outline.CURVE4: "C"}
    path = Outline(verts, codes)
    outline = "".join(
        "Z" if code == Outline.CLOSEPOLY else letters[code] + " ".join(f"{v:.1f}" for v in points)
        for points, code in path.iter_segments(simplify=False, curves=True)
    )
    margin = 4
    width, height, depth = box.width + 2 * margin, box.height + 2 * margin, box.depth + margin
    return (
        f'<svg class="equation" role="img" aria-label="{html.escape(tex, quote=True)}" '
        f'style="width:{width / EM:.3f}em;height:{height / EM:.3f}em;vertical-align:{-depth / EM:.3f}em" '
        f'viewBox="{-margin} {depth - height:.1f} {width:.1f} {height:.1f}">'
        f'<path transform="scale(1,-1)" fill="currentColor" d="{outline}"/></svg>'
    )


def write(translator, node, display: bool) -> None:
    tex = node.astext().strip()
    try:
        drawn = svg(tex, display)
    except ValueError as error:
        reason = str(error).strip().splitlines()[-1]
        logging.getLogger(__name__).warning("equation cannot be drawn: %s (%s)", tex, reason, location=node)
        drawn = f"<code>{html.escape(tex)}</code>"
    translator.body.append(f'<div class="equation">{drawn}</div>' if display else drawn)
    raise nodes.SkipNode


def setup(app):
    app.add_html_math_renderer(
        "mathtext_svg",
        inline_renderers=(lambda t, node: write(t, node, False), None),
        block_renderers=(lambda t, node: write(t, node, True), None),
    )
    return {"version": str(Path(__file__).stat().st_mtime_ns), "parallel_read_safe": True, "parallel_write_safe": True}
