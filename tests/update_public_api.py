"""Write tests/public_api.txt: every public name of the package, one ``module.name`` per line.

Run it after adding a public name (`.venv/bin/python tests/update_public_api.py`) and commit the result. A name that
disappears from the file also needs an entry under "Removed" in CHANGELOG.md.
"""

import importlib
import pkgutil
from pathlib import Path

import meshkit

API_FILE = Path(__file__).with_name("public_api.txt")


def public_modules() -> list[str]:
    """Names of all importable modules of the package whose path has no leading underscore."""
    walked = pkgutil.walk_packages(meshkit.__path__, prefix="meshkit.")
    return ["meshkit", *(m.name for m in walked if not any(part.startswith("_") for part in m.name.split(".")))]


def public_names() -> list[str]:
    """Sorted ``module.name`` of every ``__all__`` in the package."""
    modules = (importlib.import_module(name) for name in public_modules())
    return sorted(f"{module.__name__}.{name}" for module in modules for name in getattr(module, "__all__", ()))


if __name__ == "__main__":
    names = public_names()
    API_FILE.write_text("\n".join(names) + "\n")
    print(f"{API_FILE.name}: {len(names)} public names")
