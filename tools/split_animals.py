"""Draw the split of the shipped animals and store it in meshkit/data/assets/splits.json.

Test animals are two whole families; test poses are whole animation clips, 60 poses together; the 400 test pairs are
drawn from them, two different animals in two different poses each. Always gives the same split.

    python tools/split_animals.py
"""

import json
import random
from importlib.resources import files

import numpy as np

from meshkit.io import atomic_write

TEST_FAMILIES = ("felidae", "canidae")
TEST_POSES = 60
PAIRS = 400


def main() -> None:
    assets = files("meshkit.data") / "assets"
    with (assets / "animals_baked.npz").open("rb") as stream, np.load(stream) as rig:
        families, tags = rig["family"].tolist(), rig["pose_tag"].tolist()
    draw = random.Random(0)
    clips: dict[str, list[int]] = {}
    for index, tag in enumerate(tags):
        clips.setdefault(tag.split(":")[0], []).append(index)
    names, test_poses = sorted(clips), []
    draw.shuffle(names)
    for name in names:
        if len(test_poses) + len(clips[name]) <= TEST_POSES:
            test_poses += clips[name]
    animals = [i for i, family in enumerate(families) if family in TEST_FAMILIES]
    pairs = []
    for _ in range(PAIRS):
        (who_a, who_b), (how_a, how_b) = draw.sample(animals, 2), draw.sample(sorted(test_poses), 2)
        pairs.append([who_a, how_a, who_b, how_b])
    path = str(assets / "splits.json")
    with open(path) as stream:
        table = json.load(stream)
    table["animals"] = {
        "identities": len(families),
        "poses": len(tags),
        "test_identities": animals,
        "test_poses": sorted(test_poses),
        "test_pairs": pairs,
    }
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(table) + "\n", encoding="utf-8")
    print(f"{len(animals)} of {len(families)} animals and {len(test_poses)} of {len(tags)} poses to test on")


if __name__ == "__main__":
    main()
