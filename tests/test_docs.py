"""The documentation site builds without a warning, lists every public name and no other, and its code runs."""

import importlib
import inspect
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from update_public_api import public_names

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TOP_LEVEL = {"py:class", "py:function", "py:data", "py:exception"}
# Pages whose code tests of their own run.
ELSEWHERE = {"arap.md", "consistency.md", "data.md", "io_viz.md", "losses.md", "metrics.md", "transfer.md"}


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


PROSE = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
PAGES = [page.name for page in sorted(DOCS.glob("*.md")) if blocks(page) and page.name not in ELSEWHERE]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site, from a copy of the sources, so that nothing is written beside them."""
    for needed in ("sphinx", "furo", "myst_parser", "sphinx_gallery"):
        pytest.importorskip(needed)
    folder = tmp_path_factory.mktemp("site")
    source = folder / "source"
    built = shutil.ignore_patterns("_build", "auto_examples", "api", "sg_execution_times.rst", "__pycache__")
    # Copies, not links: those need a privilege on Windows.
    for name in ("docs", "examples", "meshkit", "recipes", "tests", "benchmarks"):
        shutil.copytree(ROOT / name, source / name, ignore=built)
    for name in ("README.md", "CITATION.cff"):
        shutil.copy(ROOT / name, source)
    html = folder / "html"
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-D", "plot_gallery=0"]
    command += ["-d", str(folder / "doctrees"), str(source / "docs"), str(html)]
    run = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    assert run.returncode == 0, run.stderr
    return html


@pytest.fixture(scope="module")
def inventory(site: Path) -> dict[str, dict[str, tuple[str, str]]]:
    """Documented objects: kind -> name -> page and anchor."""
    from sphinx.util.inventory import InventoryFile

    with (site / "objects.inv").open("rb") as stream:
        loaded = InventoryFile.load(stream, "", lambda base, uri: uri)
    return {kind: {name: (item[2], item[3]) for name, item in of.items()} for kind, of in loaded.items()}


def test_every_public_name_is_documented_and_no_other(inventory) -> None:
    documented = {name for kind in TOP_LEVEL for name in inventory.get(kind, {})}
    public = set(public_names()) - {"meshkit.__version__"}
    # Constants have no home of their own: the same object, listed by two modules, is documented once.
    values = {name: resolve(name) for name in public}
    shown = [id(values[name]) for name in documented & public]
    missing = {name for name in public - documented if id(values[name]) not in shown}
    assert not missing
    assert not documented - public


def test_every_public_name_has_a_docstring_of_its_own() -> None:
    values = {name: resolve(name) for name in public_names()}
    own = {n: vars(v).get("__doc__") if inspect.isclass(v) else v.__doc__ for n, v in values.items() if callable(v)}
    bare = [name for name, text in own.items() if not text]
    assert not bare


def test_every_component_has_a_page_and_a_reference(site: Path) -> None:
    import meshkit

    files = Path(meshkit.__file__).parent.iterdir()
    components = {p.stem for p in files if p.suffix == ".py" or (p / "__init__.py").exists()}
    components = {c for c in components if not c.startswith("_")}
    assert {p.stem for p in (site / "api").glob("meshkit.*.html")} == {f"meshkit.{c}" for c in components}
    pages = "".join(p.read_text() for p in DOCS.glob("*.md"))
    assert not [c for c in components if f"`meshkit.{c}`" not in pages]


def test_equations_are_drawn_and_nothing_is_fetched(site: Path) -> None:
    page = (site / "optimal_transport.html").read_text()
    assert page.count('<svg class="equation"') > 20
    for file in site.rglob("*.html"):
        fetched = re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:)?//', file.read_text())
        assert not fetched, file.name


def test_links_between_pages_hold() -> None:
    """Links of the Markdown, to files and to headings, as GitHub follows them."""
    targets = [(page.name, *link) for page in DOCS.glob("*.md") for link in links(page.read_text())]
    assert len(targets) > 60
    for page, path, anchor in targets:
        file = DOCS / (path or page)
        assert file.exists(), f"{page}: {path}"
        assert not anchor or anchor in headings(file.read_text()), f"{page}: {path}#{anchor}"


def test_what_counts_as_a_link_and_a_heading() -> None:
    text = "[a](b.md#c) ![d](e.png) [f](#g) <https://h.i> [j](https://k.l) $x[0](1)$\n```\nm[n](o)\n```\n`p[q](r)`\n"
    assert links(text) == [("b.md", "c"), ("e.png", ""), ("", "g")]
    assert headings("# Of `N x M`, *measured*\n## Two\n```\n# no heading\n```\n") == {"of-n-x-m-measured", "two"}


def prose(text: str) -> str:
    """Without blocks of code."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def links(text: str) -> list[tuple[str, str]]:
    """File and anchor of each link to this repository."""
    text = re.sub(r"`[^`\n]+`\]", "]", prose(text))  # code as the text of a link
    text = re.sub(r"(\$\$?).*?\1|`[^`\n]+`", "", text, flags=re.DOTALL)
    return re.findall(r"\]\((?!https?://)([^)#\s]*)#?([^)\s]*)\)", text)


def headings(text: str) -> set[str]:
    """Anchors of the headings."""
    titles = re.findall(r"^#+ (.+)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_tests_that_pages_name_exist() -> None:
    """A claim names the test that holds it as `tests/test_norm.py::test_gradcheck`."""
    pattern = re.compile(r"tests/(test_\w+\.py)::(\w+)")
    named = [(page.name, *ref) for page in DOCS.glob("*.md") for ref in pattern.findall(page.read_text())]
    assert len(named) > 20
    for page, file, name in named:
        assert f"def {name}(" in (ROOT / "tests" / file).read_text(), f"{page}: {file}::{name}"


def test_every_benchmark_is_on_its_page_and_no_other() -> None:
    listed = set(re.findall(r"^\| `.*?benchmarks/(\w+\.py)", (DOCS / "benchmarks.md").read_text(), re.MULTILINE))
    assert listed == {p.name for p in (ROOT / "benchmarks").glob("*.py") if not p.name.startswith("_")}


def test_files_that_pages_name_exist() -> None:
    pattern = re.compile(r"(?:python|`)\s*((?:benchmarks|recipes|examples|tools|tests)/[\w/]+\.py)")
    named = [(page.name, file) for page in DOCS.glob("*.md") for file in pattern.findall(page.read_text())]
    assert len(named) > 40
    assert not [(page, file) for page, file in named if not (ROOT / file).exists()]


# Options of pip and torchrun.
FOREIGN = {"--no-build-isolation", "--nnodes", "--nproc-per-node", "--max-restarts"}
FOREIGN |= {"--rdzv-backend", "--rdzv-endpoint"}


def test_options_that_pages_name_exist() -> None:
    """Those of the command, tools and benchmarks, which spell them out, and of recipes, whose options are fields."""
    from meshkit._transfer_command import parser

    files = [file for name in ("recipes", "tools", "benchmarks") for file in (ROOT / name).glob("*.py")]
    text = "\n".join(file.read_text() for file in [*files, ROOT / "meshkit" / "models" / "presets.py"])
    known = FOREIGN | set(re.findall(r'"(--[a-z][\w-]*)', text))
    known |= set(re.findall(r"--[a-z][\w-]*", parser().format_help()))
    for field in re.findall(r"^    (\w+): ", text, re.MULTILINE):
        known |= {f"--{of}{field.replace('_', '-')}" for of in ("", "no-", "model.", "model.no-")}
    pattern = re.compile(r"(?<![\w-])--[a-z][\w.-]*\w")
    named = [(page.name, flag) for page in PROSE for flag in pattern.findall(page.read_text())]
    assert len(named) > 100
    assert not [(page, flag) for page, flag in named if flag not in known]


def test_readings_of_a_plan_that_its_page_names_exist() -> None:
    from meshkit.ot import TransportPlan

    named = re.findall(r"`plan\.(\w+)", (DOCS / "optimal_transport.md").read_text())
    assert len(named) > 12 and all(hasattr(TransportPlan, name) for name in named)


def test_blocks_that_do_not_run_are_python_and_use_what_there_is() -> None:
    found = 0
    for page in PROSE:
        for block in re.findall(r"^```python no-run\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            compile(block, page.name, "exec")
            for module, names in re.findall(r"^from (meshkit[\w.]*) import (.*)$", block, re.MULTILINE):
                assert all(hasattr(importlib.import_module(module), name) for name in names.split(", ")), block
                found += 1
    assert found >= 3


def test_clean_removes_what_a_build_leaves() -> None:
    ignored = [line.strip("/") for line in (ROOT / ".gitignore").read_text().split() if line.startswith("docs/")]
    recipe = (ROOT / "Makefile").read_text().split("\nclean:")[1].split("\n\n")[0].split()
    assert ignored and not set(ignored) - set(recipe)


@pytest.mark.parametrize("name", PAGES)
def test_page_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "page"}
    for number, block in enumerate(blocks(DOCS / name)):
        exec(compile(block, f"block {number} of {name}", "exec"), names)


def resolve(path: str) -> object:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)
