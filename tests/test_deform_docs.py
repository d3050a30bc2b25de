"""The Python block of the page on ARAP runs as printed, and its pictures are there."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "arap.md"


def test_the_page_runs() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, PAGE.name, "exec"), names)
    assert names["info"].converged and names["target"].grad.isfinite().all()
    for picture in re.findall(r"\]\((images/.*?)\)", PAGE.read_text()):
        assert 0 < (PAGE.parent / picture).stat().st_size < 300_000
