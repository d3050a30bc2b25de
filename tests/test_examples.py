"""Every tutorial runs without a display and leaves pictures; those cheap enough run whole and keep their promise."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("plot_*.py"))
WHOLE = {"plot_04_correspondence"}  # the others' loops, `steps = N` and `poses = N`, are cut short, pictures are coarse

RUN = """
import re, runpy, sys
import matplotlib.pyplot as plt
from pathlib import Path

script, steps = Path(sys.argv[1]), sys.argv[2]
code = script.read_text()
if steps:
    code = re.sub(r"\\b(steps|poses) = \\d+$", rf"\\1 = {steps}", code, flags=re.MULTILINE)
    code = code.replace("supersample=3", "supersample=1")
sys.argv = [str(script)]
exec(compile(code, str(script), "exec"), {"__name__": "__main__", "__file__": str(script)})
for number in plt.get_fignums():
    figure = plt.figure(number)
    figure.canvas.draw()
    pixels = memoryview(figure.canvas.buffer_rgba()).tobytes()
    assert len(set(pixels)) > 8, f"figure {number} is blank"
print("figures", len(plt.get_fignums()))
"""


def run(script: Path, steps: str = "") -> str:
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment = {**os.environ, **threads, "MPLBACKEND": "Agg", "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", RUN, str(script), steps]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr[-3000:]
    figures = re.search(r"^figures (\d+)$", result.stdout, re.MULTILINE)
    assert figures is not None and int(figures[1]) >= 1
    return result.stdout


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 5


@pytest.mark.parametrize("script", [path for path in EXAMPLES if path.stem not in WHOLE], ids=lambda path: path.stem)
def test_it_runs(script: Path) -> None:
    run(script, steps="3")


def test_left_and_right_are_told_apart() -> None:
    printed = run(ROOT / "examples" / "plot_04_correspondence.py")
    right = {
        name: int(share) for name, share in re.findall(r"^(.*): mean error .*, (\d+) % within", printed, re.MULTILINE)
    }
    assert right["signatures"] < 50 < 70 < right["signatures and place"] < right["signatures and cut"]
