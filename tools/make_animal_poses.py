"""Make the poses of the shipped animals again from 0 A.D.'s animations, and compare them with the shipped ones.

Needs the game's data, 1.4 GB: on Debian or Ubuntu

    apt-get download 0ad-data && dpkg-deb -x 0ad-data_*.deb 0ad
    python tools/make_animal_poses.py 0ad/usr/share/games/0ad/mods/public/public.zip

Every frame of the four-legged animals' animations is carried over to the common skeleton of 31 joints: a joint takes
the change of the game's bone that stands for it, from rest to the frame, relative to its parent's. Of the frames in
which the animal stands or leaps more or less upright, farthest-point sampling takes 400. The shapes, and the whole
shipped file, come from make_animals.

The art is by Wildfire Games, CC BY-SA 3.0; see meshkit/data/assets/LICENSE-animals.txt.
"""

import argparse
import fnmatch
import zipfile
from importlib.resources import files

import numpy as np
from zero_ad import ANIMATIONS, SUFFIX, read_animation, read_mesh

POSES = 400

# Per rig: a mesh that has it, its animations, and the game's bones that stand for joints: six from pelvis to head; four
# down each leg, front left, hind left, front right, hind right; three of the tail, if it has one.
RIGS: dict[str, tuple[str, list[str], list[list[int]], list[int] | None]] = {
    "old": (
        "animal_lion",
        ["lion_*", "donkey_*"],
        [[1, 2, 3, 4, 5, 6], [8, 9, 10, 11], [17, 18, 19, 20], [13, 14, 15, 16], [21, 22, 23, 24]],
        [25, 26, 26],
    ),
    "tiger": (
        "tiger",
        ["feline_*"],
        [[0, 5, 7, 8, 9, 1], [14, 15, 15, 16], [23, 24, 25, 26], [10, 11, 11, 12], [19, 20, 21, 22]],
        [27, 29, 32],
    ),
    "wolf": (
        "wolf",
        ["wolf_*"],
        [[0, 5, 6, 7, 8, 10], [14, 15, 15, 16], [24, 25, 26, 27], [19, 20, 20, 21], [28, 29, 30, 31]],
        [1, 2, 4],
    ),
    "fox": (
        "fox",
        ["fox_*"],
        [[1, 2, 3, 4, 5, 6], [13, 14, 14, 15], [23, 24, 25, 26], [18, 19, 19, 20], [27, 28, 29, 30]],
        [31, 32, 34],
    ),
    "wolfhound": (
        "wolfhound",
        ["wolfhound_*"],
        [[0, 1, 2, 3, 4, 6], [17, 18, 18, 19], [32, 33, 34, 35], [22, 23, 23, 24], [36, 37, 38, 39]],
        [27, 29, 31],
    ),
    "mastiff": (
        "mastiff_no_spikes",
        ["mastiff_*"],
        [[0, 1, 2, 3, 4, 6], [19, 20, 20, 21], [34, 35, 36, 37], [24, 25, 25, 26], [38, 39, 40, 41]],
        [29, 31, 33],
    ),
    "horse": (
        "horse",
        ["horse_[aginptwd]*", "pony_*"],
        [[1, 2, 3, 4, 6, 7], [13, 14, 15, 16], [26, 27, 28, 29], [19, 20, 21, 22], [32, 33, 34, 35]],
        [37, 41, 44],
    ),
    "bovid": (
        "bull_a",
        ["bovidae_*"],
        [[1, 2, 3, 3, 8, 9], [4, 5, 6, 7], [19, 20, 21, 22], [14, 15, 16, 17], [27, 28, 29, 30]],
        [24, 25, 26],
    ),
    "goat": (
        "goat_male",
        ["goat_*"],
        [[15, 14, 1, 2, 2, 3], [10, 11, 12, 13], [20, 21, 22, 23], [5, 6, 7, 8], [16, 17, 18, 19]],
        [24, 24, 24],
    ),
    "deer": (
        "deer_mesh",
        ["deer_*"],
        [[1, 2, 3, 4, 5, 6], [9, 10, 11, 12], [19, 20, 21, 22], [14, 15, 16, 17], [23, 24, 25, 26]],
        [27, 28, 28],
    ),
    "giraffe": (
        "giraffe_adult",
        ["giraffe_adult_*"],
        [[0, 11, 13, 24, 26, 27], [20, 21, 22, 23], [2, 3, 4, 5], [15, 16, 17, 18], [7, 8, 9, 10]],
        [28, 29, 30],
    ),
    "camel": (
        "camel",
        ["camel_*"],
        [[1, 2, 4, 5, 7, 9], [22, 23, 24, 25], [40, 42, 43, 44], [16, 17, 18, 19], [33, 35, 36, 37]],
        [28, 30, 31],
    ),
    "hippo": (
        "fauna_hippopotamus",
        ["hippopotamus_*"],
        [[7, 8, 10, 11, 11, 12], [40, 41, 42, 43], [33, 34, 35, 36], [44, 45, 46, 47], [28, 29, 30, 31]],
        None,
    ),
    "rhino": (
        "rhino",
        ["rhino_*"],
        [[0, 1, 2, 3, 3, 4], [7, 8, 9, 10], [18, 18, 19, 20], [11, 12, 13, 14], [21, 21, 22, 23]],
        [16, 17, 17],
    ),
    "bear": (
        "bear",
        ["bear_*"],
        [[1, 2, 4, 5, 6, 7], [21, 22, 22, 23], [38, 40, 41, 43], [16, 17, 17, 18], [32, 34, 35, 37]],
        None,
    ),
    "zebra": (
        "zebra",
        ["zebra_*"],
        [[2, 1, 1, 28, 29, 30], [24, 25, 26, 27], [3, 4, 5, 6], [33, 34, 35, 36], [14, 15, 16, 17]],
        [11, 12, 13],
    ),
}


def stand_ins(archive: zipfile.ZipFile, rig: str, joints: int) -> tuple[list[int | None], np.ndarray]:
    """The game's bone for each joint (None: the joint follows its parent), and the bones' rotations at rest."""
    name, _, (spine, *legs), tail = RIGS[rig]
    mesh = read_mesh(archive, name)
    # Some rigs call left what lies at negative x.
    if mesh.bones[legs[0], 0].mean() < mesh.bones[legs[2], 0].mean():
        legs = [*legs[2:], *legs[:2]]
    bones: list[int | None] = [None] * joints
    bones[:6] = spine
    bones[7:10] = tail or [None] * 3
    for k, leg in enumerate(legs):
        bones[11 + 5 * k : 15 + 5 * k] = leg
    return bones, mesh.turns


def all_frames(archive: zipfile.ZipFile, parents: list[int]) -> tuple[np.ndarray, list[str]]:
    """Local rotations (frames, J, 3, 3) on the common skeleton, and clip and number of each frame."""
    poses, tags = [], []
    clips = {path[len(ANIMATIONS) :]: path for path in archive.namelist() if path.startswith(ANIMATIONS)}
    for rig, (_, patterns, _, _) in RIGS.items():
        bones, rest = stand_ins(archive, rig, len(parents))
        for pattern in patterns:
            for clip in sorted(fnmatch.filter(clips, pattern + SUFFIX)):
                turns = read_animation(archive, clips[clip])
                if turns.shape[1] != len(rest):
                    continue  # made for another skeleton
                world = np.tile(np.eye(3), (len(turns), len(parents), 1, 1))
                for j, bone in enumerate(bones):
                    if bone is not None:
                        world[:, j] = turns[:, bone] @ rest[bone].T
                    elif parents[j] >= 0:
                        world[:, j] = world[:, parents[j]]
                local = world.copy()
                local[:, 1:] = world[:, parents[1:]].swapaxes(-1, -2) @ world[:, 1:]
                poses.append(local)
                tags += [f"{clip[: -len(SUFFIX)]}:{frame}" for frame in range(len(turns))]
    return np.concatenate(poses), tags


def choose(poses: np.ndarray, count: int) -> list[int]:
    """Frames far from each other, among those that lean by less than 50 degrees and bend no joint by 110 or more."""
    lean = np.degrees(np.arccos(np.clip(poses[:, 0, 1, 1], -1, 1)))
    bend = np.degrees(np.arccos(np.clip((np.trace(poses, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))
    usable = np.flatnonzero((lean < 50) & (bend.max(1) < 110))
    features = poses[usable] - np.eye(3)
    features[:, 7:11] *= 0.3  # tails count for less
    features = features.reshape(len(usable), -1)
    chosen = [int(np.random.default_rng(0).integers(len(usable)))]
    distance = ((features - features[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, ((features - features[chosen[-1]]) ** 2).sum(1))
    return usable[chosen].tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", help="public.zip of 0 A.D. 0.0.26")
    parser.add_argument("--out", help="write pose_rot and pose_tag to this .npz")
    args = parser.parse_args()
    with (files("meshkit.data") / "assets" / "animals_baked.npz").open("rb") as stream, np.load(stream) as shipped:
        parents, known, known_tags = shipped["parents"].tolist(), shipped["pose_rot"], shipped["pose_tag"].tolist()
    with zipfile.ZipFile(args.archive) as archive:
        poses, tags = all_frames(archive, parents)
    chosen = choose(poses, POSES)
    turns, names = poses[chosen].astype(np.float16), [tags[k] for k in chosen]
    same = sum(a == b for a, b in zip(names, known_tags, strict=True))
    print(f"{len(poses)} frames; {same} of {POSES} poses are the shipped frames, in their order")
    place = {tag: k for k, tag in enumerate(tags)}
    again = np.stack([poses[place[tag]] for tag in known_tags if tag in place])
    stored = np.stack([turn for turn, tag in zip(known, known_tags, strict=True) if tag in place])
    print(f"largest difference of a stored rotation: {np.abs(again - stored).max():.1e} ({len(stored)} poses compared)")
    if args.out:
        np.savez_compressed(args.out, pose_rot=turns, pose_tag=np.array(names))


if __name__ == "__main__":
    main()
