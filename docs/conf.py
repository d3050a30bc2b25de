"""How Sphinx builds the site. ``make docs`` runs the gallery; ``-D plot_gallery=0`` leaves it out."""

import os
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(Path(__file__).parent / "_ext"), str(ROOT)]
os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported
os.environ.setdefault("MPLBACKEND", "agg")

import meshkit  # noqa: E402

project = "meshkit"
author = "The meshkit authors"
copyright = "The meshkit authors, Apache-2.0"
version = release = meshkit.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "api_pages",
    "mathtext_svg",
]
exclude_patterns = ["_build", "README.md", "auto_examples/**/*.ipynb", "auto_examples/*.py"]
exclude_patterns += ["sg_execution_times.rst", "auto_examples/sg_execution_times.rst"]  # left by older builds

# Pages are GitHub's Markdown first: dollar math, ordinary links, headings with GitHub's anchors.
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
myst_update_mathjax = False
html_math_renderer = "mathtext_svg"
highlight_language = "none"  # blocks that name no language are output, not Python

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autosummary_generate = False  # api_pages writes the pages
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Shape", "Reference", "Deviations"]
napoleon_use_rtype = False
maximum_signature_line_length = 100
python_use_unqualified_type_names = True
add_module_names = False
# A reference to a name of meshkit must resolve. The build needs no network, so others' names stay plain text.
nitpicky = True
# Nor need types resolve that only appear in signatures.
nitpick_ignore_regex = [
    (r"py:.*", r"(?!meshkit\.).*"),
    (r"py:class", r"meshkit\.(\w+\.)?_\w+\..*"),
    (r"py:class", r"meshkit\.deform\.(correspondence\.Plan|dispatch\.Result)"),
    (r"py:class", r"meshkit\.(nn\.setconv\.Neighborhoods|ot\.sample\.SamplePlan)"),
]

sphinx_gallery_conf = {
    "examples_dirs": str(ROOT / "examples"),
    "gallery_dirs": "auto_examples",
    "filename_pattern": "plot_",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 1e9,  # run times differ from machine to machine
    "write_computation_times": False,  # a page that fetches scripts
    "capture_repr": ("_repr_html_",),  # the page to turn, the GIF
    "matplotlib_animations": False,
    "abort_on_example_error": True,
}

html_theme = "furo"
html_title = f"meshkit {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False


def outside_links(app, docname, source):
    """Turn links to files beside ``docs/``, which GitHub follows, into pages of the gallery or downloads."""
    if docname.startswith(("api/", "auto_examples/")):
        return
    text = re.sub(r"\]\(\.\./examples/(plot_\w+)\.py\)", r"](auto_examples/\1.rst)", source[0])
    source[0] = re.sub(r"\[([^\]\[]+)\]\((\.\./[^)#]+)\)", _download, text)


def _download(link):
    text, path = link[1].replace("`", ""), link[2]
    return f"{{download}}`{text} <{path}>`"


def setup(app):
    app.connect("source-read", outside_links)
