"""The page on files and pictures runs as printed, its pictures are there, and the tool behind them runs."""

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "io_viz.md"


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) >= 4
    names: dict[str, object] = {}
    for number, block in enumerate(blocks):
        exec(compile(block, f"block {number} of {PAGE.name}", "exec"), names)
    printed = re.search(r"^```\n(mesh .*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert printed is not None and printed[1] in capsys.readouterr().out
    assert {p.name for p in tmp_path.iterdir()} >= {"body.ply", "views.png", "error.png", "turn.gif", "compare.html"}


def test_its_pictures_are_small_and_there() -> None:
    pictures = [PAGE.parent / name for name in re.findall(r"\]\((images/.*?)\)", PAGE.read_text())]
    assert len(pictures) == 5
    assert sum(picture.stat().st_size for picture in pictures) < 2**20


def test_its_pictures_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["draw_carry.py", str(tmp_path)])
    runpy.run_path(str(ROOT / "tools" / "draw_carry.py"))
    assert {p.name for p in tmp_path.iterdir()} == {"simplify_carry.png", "turntable.gif", "correspondence.html"}
    error = re.search(r"carried to 6890 vertices: mean error (.*) mm", capsys.readouterr().out)
    assert error is not None and float(error[1]) < 2
