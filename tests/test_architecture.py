"""The shape of the package: who imports whom, what an import costs, which names are public, what is shipped."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest
from update_public_api import API_FILE, public_modules, public_names

PACKAGE = Path(__file__).parents[1] / "meshkit"

# component -> components of meshkit that it may import, at any depth of its code.
FOUNDATION = {
    "_checks",
    "_compile",
    "_connectivity",
    "_names",
    "_numerics",
    "_repr",
    "batching",
    "scatter",
    "topology",
    "neighbors",
}
MAY_IMPORT: dict[str, set[str]] = {
    "_checks": set(),
    "_compile": set(),
    "_connectivity": {"_compile", "_numerics", "topology"},
    "_names": set(),
    "_numerics": set(),
    "_repr": set(),
    "batching": set(),
    "scatter": set(),
    "topology": {"batching", "scatter"},
    "neighbors": {"_numerics", "batching", "scatter"},
    "descriptors": FOUNDATION,
    "ot": FOUNDATION,
    "norm": FOUNDATION,
    "nn": FOUNDATION | {"norm"},
    "deform": FOUNDATION,
    "losses": FOUNDATION | {"ot", "deform"},
    "metrics": FOUNDATION | {"ot"},
    "consistency": FOUNDATION | {"ot", "losses", "deform"},
    "models": FOUNDATION
    | {"nn", "norm", "ot", "deform", "descriptors", "io"},  # io: checkpoints are written atomically
    "io": FOUNDATION,
    "viz": {"io"},
    "data": FOUNDATION | {"io", "descriptors"},
}
MAY_IMPORT["_transfer_command"] = {"_names", "transfer"}  # the latter inside functions: options need no PyTorch
MAY_IMPORT["transfer"] = set(MAY_IMPORT)

# Third-party packages importable at module level; everything else is imported inside the function that needs it.
WITH_NUMPY = {"data", "io", "viz", "transfer"}
# Kernels cannot be written without their language; these files are imported where the kernels are used.
KERNEL_FILES = {"ot/_triton_tiles.py": {"triton"}}
TORCH_ONLY = sorted(set(MAY_IMPORT) - WITH_NUMPY)
HEAVY = [
    "scipy",
    "igl",
    "trimesh",
    "pymeshlab",
    "pyvista",
    "lightning",
    "lightning_fabric",
    "matplotlib",
    "PIL",
    "triton",
    "tyro",
]


def component(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def sources() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def imported_names(node: ast.stmt, path: Path) -> list[str]:
    """Absolute dotted names that an import statement binds or reads; [] for any other statement."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = node.module or ""
    if node.level:
        package = ("meshkit", *path.relative_to(PACKAGE).parent.parts)
        base = ".".join(filter(None, (*package[: len(package) - node.level + 1], base)))
    return [f"{base}.{alias.name}" for alias in node.names]


def module_level(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements run when the module is imported: function bodies and ``if TYPE_CHECKING`` blocks left out."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from module_level(node.orelse)
            continue
        yield node
        for field in ("body", "orelse", "finalbody"):
            yield from module_level(getattr(node, field, []))
        for handler in getattr(node, "handlers", []):
            yield from module_level(handler.body)


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_import_direction(path: Path) -> None:
    owner, tree = component(path), ast.parse(path.read_text())
    assert owner in MAY_IMPORT, f"{owner} is new: give it a row in MAY_IMPORT"
    for node in ast.walk(tree):
        for name in imported_names(node, path) if isinstance(node, ast.stmt) else []:
            parts = name.split(".")
            if parts[0] == "meshkit" and parts[1:] and parts[1] not in {owner, "__version__"}:
                allowed = MAY_IMPORT[owner]
                where = f"{path.name}:{node.lineno}"
                assert parts[1] in allowed, f"{where}: {owner} may import {sorted(allowed)}, not {name}"
    third_party = {"torch", "numpy"} if owner in WITH_NUMPY else {"torch"}
    third_party |= KERNEL_FILES.get(path.relative_to(PACKAGE).as_posix(), set())
    for node in module_level(tree.body):
        for name in imported_names(node, path):
            root = name.split(".")[0]
            assert root in third_party | {"meshkit"} | sys.stdlib_module_names, (
                f"{path.name}:{node.lineno}: import {root} inside the function that needs it"
            )


def test_import_names_are_resolved() -> None:
    """The checker itself: relative imports, functions, and type-checking blocks are understood."""
    path = PACKAGE / "norm" / "elain.py"
    tree = ast.parse("from ..ot import plan\nfrom .stats import mean\nfrom .. import nn\nimport scipy.sparse\n")
    assert [n for s in tree.body for n in imported_names(s, path)] == [
        "meshkit.ot.plan",
        "meshkit.norm.stats.mean",
        "meshkit.nn",
        "scipy.sparse",
    ]
    code = "def f():\n import a\nif TYPE_CHECKING:\n import b\ntry:\n import c\nexcept ImportError:\n import d\n"
    found = [n for s in module_level(ast.parse(code).body) for n in imported_names(s, path)]
    assert found == ["c", "d"]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("__init__.py")), ids=lambda p: str(p.parent.name))
def test_init_files_only_re_export(path: Path) -> None:
    docstring, *rest = ast.parse(path.read_text()).body
    assert isinstance(docstring, ast.Expr), f"{path} needs a docstring"
    assigned = []
    for node in rest:
        assert isinstance(node, ast.Import | ast.ImportFrom | ast.Assign), f"{path}:{node.lineno}: only re-exports here"
        if isinstance(node, ast.Assign):
            assigned += [ast.unparse(target) for target in node.targets]
    assert "__all__" in assigned
    assert set(assigned) <= {"__all__", "__version__"}


def test_components_import_nothing_heavy() -> None:
    """Each torch-only component leaves numerical, drawing and training packages out of ``sys.modules``."""
    names = [n for n in TORCH_ONLY if (PACKAGE / f"{n}.py").exists() or (PACKAGE / n / "__init__.py").exists()]
    assert names
    code = (
        "import importlib, sys\n"
        f"for name in {names}:\n"
        "    importlib.import_module('meshkit.' + name)\n"
        f"    loaded = [m for m in {HEAVY} if m in sys.modules]\n"
        "    if loaded: sys.exit(f'meshkit.{name} imports {loaded}')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert done.returncode == 0, done.stderr


def test_every_public_module_lists_names_that_exist() -> None:
    for name in public_modules():
        module = importlib.import_module(name)
        assert "__all__" in vars(module), f"{name} does not say what of it is public: give it an __all__"
        listed = module.__all__
        assert [n for n in listed if not hasattr(module, n)] == []
        assert len(set(listed)) == len(listed), f"{name}.__all__ repeats a name"


def test_public_api_is_the_committed_one() -> None:
    committed, actual = set(API_FILE.read_text().split()), set(public_names())
    assert actual - committed == set(), "new public names: run tests/update_public_api.py and commit the file"
    assert committed - actual == set(), (
        "public names are gone: restore them, or record the removal in CHANGELOG.md and run tests/update_public_api.py"
    )


def test_assets_are_in_the_package_with_their_licences() -> None:
    folder = resources.files("meshkit") / "data" / "assets"
    notes = (folder / "README.md").read_text()
    archives = {asset.name: asset for asset in folder.iterdir() if asset.name.endswith(".npz")}
    assert {"humans_baked.npz", "poses_baked.npz"} <= archives.keys()
    for name, asset in archives.items():
        assert asset.read_bytes()[:2] == b"PK"  # a zip archive, not a pointer to one
        assert name in notes, f"assets/README.md says nothing of the source and licence of {name}"


def test_typed_marker_and_version() -> None:
    version = importlib.import_module("meshkit").__version__
    assert (PACKAGE / "py.typed").is_file()
    assert f"version: {version}\n" in (PACKAGE.parent / "CITATION.cff").read_text()
