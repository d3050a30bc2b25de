"""One page per public module, written from its ``__all__`` before the build reads its sources.

A name is documented where users import it from, ``meshkit.norm.ElaIN``; autodoc files it under the module that defines
it as well. What only a submodule lists follows at the end of the page.
"""

import importlib
import inspect
import pkgutil
from pathlib import Path
from textwrap import indent
from typing import NamedTuple

from sphinx.pycode import ModuleAnalyzer

import meshkit


class Entry(NamedTuple):
    """A public name, and the text below it that autodoc does not find by itself."""

    path: str
    directive: str
    text: str = ""


def modules(package) -> list[str]:
    """Public modules directly below a package."""
    found = pkgutil.iter_modules(package.__path__, package.__name__ + ".")
    return sorted(m.name for m in found if not m.name.rpartition(".")[2].startswith("_"))


def entry(module: str, name: str) -> Entry:
    value = getattr(importlib.import_module(module), name)
    if inspect.isclass(value):
        kind = "autoexception" if issubclass(value, Exception) else "autoclass"
    else:
        kind = "autofunction" if inspect.isroutine(value) else "autodata"
    return Entry(f"{module}.{name}", kind, comment(module, name) if kind == "autodata" else "")


def comment(module: str, name: str) -> str:
    """The string below a constant that a package lists and one of its modules defines; autodoc reads the package's."""
    package = importlib.import_module(module)
    for inner in modules(package) if hasattr(package, "__path__") else []:
        lines = ModuleAnalyzer.for_module(inner)
        lines.analyze()
        if found := lines.attr_docs.get(("", name)):
            return "\n".join(found).strip()
    return ""


def entries(component: str) -> tuple[list[Entry], list[Entry]]:
    """Names of a component, and those that only its submodules list."""
    module = importlib.import_module(component)
    own = [entry(component, name) for name in module.__all__]
    inner = []
    for name in modules(module) if hasattr(module, "__path__") else []:
        listed = getattr(importlib.import_module(name), "__all__", ())
        names = [n for n in listed if n not in module.__all__]
        inner += [entry(name, n) for n in names]
    return own, inner


def page(component: str) -> str:
    own, inner = entries(component)
    lines = [component, "=" * len(component), "", f".. automodule:: {component}", "   :no-members:", ""]
    lines += [f".. currentmodule:: {component}", ""]
    lines += [".. autosummary::", "   :nosignatures:", "", *(f"   {e.path.rpartition('.')[2]}" for e in own), ""]
    for title, group in (("", own), ("In its submodules", inner)):
        if title and group:
            lines += [title, "-" * len(title), ""]
        for e in group:
            members = ["   :members:"] if e.directive in ("autoclass", "autoexception") else []
            lines += [f".. {e.directive}:: {e.path}", *members, ""]
            lines += [indent(e.text, "   "), ""] if e.text else []
    return "\n".join(lines)


def write_pages(app) -> None:
    folder = Path(app.srcdir) / "api"
    folder.mkdir(exist_ok=True)
    components = modules(meshkit)
    index = ["API reference", "=============", "", "Every public name, from the docstrings.", ""]
    index += [".. toctree::", "   :maxdepth: 1", "", *(f"   {name}" for name in components), ""]
    pages = {name: page(name) for name in components} | {"index": "\n".join(index)}
    for name, text in pages.items():
        file = folder / f"{name}.rst"
        if not file.exists() or file.read_text() != text:  # an untouched file is not read again
            file.write_text(text)
    for file in folder.glob("*.rst"):
        if file.stem not in pages:
            file.unlink()


def skip_members(app, what, name, obj, skip, options):
    """Fields of named tuples, which say only "Alias for field number", and what only printing a module calls."""
    return True if name == "extra_repr" or isinstance(obj, type(inspect.getattr_static(Entry, "path"))) else None


def setup(app):
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-skip-member", skip_members)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
