"""Running recipes as their users do: as scripts, or their ``main`` in this process."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[1]
RECIPES = ROOT / "recipes"


def recipe_module(name: str) -> ModuleType:
    """A module of the recipes' folder, which is no package: scripts import their neighbours by bare names."""
    sys.path.insert(0, str(RECIPES))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(RECIPES))


def command(recipe: str, *arguments: Any) -> list[str]:
    return [sys.executable, str(RECIPES / f"{recipe}.py"), *map(str, arguments)]


def environment() -> dict[str, str]:
    return os.environ | {"OMP_NUM_THREADS": "1"}


def launch(recipe: str, *arguments: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(recipe, *arguments),
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def read_log(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def read_json(file: Path) -> dict[str, Any]:
    return json.loads(file.read_text())
