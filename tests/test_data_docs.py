"""The page on data: what can run without licensed files runs as printed, and what it lists is all there is."""

import re
from pathlib import Path

import meshkit.data
from meshkit.data import RELEASED_SPLITS, animal_split, human_split, load_animals, load_humans

PAGE = Path(__file__).parents[1] / "docs" / "data.md"


def test_the_page_runs(capsys):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 1
    exec(compile(blocks[0], PAGE.name, "exec"), {})
    assert capsys.readouterr().out.count("torch.Size([4, 1962, 3])") == 9


def test_the_blocks_that_need_files_are_python_and_use_what_there_is():
    blocks = re.findall(r"^```python no-run\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 2
    for block in blocks:
        compile(block, PAGE.name, "exec")
        (names,) = re.findall(r"from meshkit.data import (.*)", block)
        assert all(hasattr(meshkit.data, name) for name in names.split(", "))


def test_the_page_states_the_numbers_of_the_data():
    text = PAGE.read_text()
    humans, animals = load_humans(), load_animals()
    for count in (len(humans.identities), len(humans.poses), len(animals.identities), len(animals.poses)):
        assert str(count) in text
    for split in (human_split(), animal_split()):
        people, poses = (split.train_identities, split.test_identities), (split.train_poses, split.test_poses)
        assert "{} / {}".format(*map(len, people)) in text and "{} / {}".format(*map(len, poses)) in text
    assert all(f"`{name}`" in text for name in RELEASED_SPLITS)
    assert "Wildfire Games" in text and "creativecommons.org/licenses/by-sa/3.0" in text
