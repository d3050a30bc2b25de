"""Make the shipped animals, ``animals_baked.npz``, again from the art of the game 0 A.D.

Needs the game's data, 0ad-data 0.0.26 (a download of 1.4 GB, 3.3 GB unpacked), and pymeshlab. On Debian or Ubuntu:

    pip install -e ".[remesh]"
    apt-get download 0ad-data && dpkg-deb -x 0ad-data_*.deb 0ad
    python tools/make_animals.py --art 0ad --output animals_baked.npz

The template is the game's lioness, made symmetric and subdivided once: 1962 vertices. It is carried over to 25 animals
(see animal_registration); where a carried shape crosses itself, it is smoothed. Sixteen blends of two animals of one
family follow, and every shape is given a size within 15 % of a common one. The poses come from make_animal_poses. The
file holds, in the game's left-handed axes (x to the animal's left, y up, z backwards):

``v`` (41, 1962, 3), ``f`` (3920, 3), ``names`` (41,), ``family`` (41,)
    shapes at rest, with the pelvis at the origin; a blend is named ``first*second:share of the second``.
``J`` (41, 31, 3), ``parents`` (31,), ``joint_names`` (31,), ``W`` (1962, 31)
    joints of each shape, the tree they form, and the skinning weights.
``pose_rot`` (400, 31, 3, 3), ``pose_tag`` (400,)
    local rotations of the joints, and the game's clip and frame that each pose comes from.

It takes one to two minutes on one core. At the end the arrays are compared with those of the shipped file: all are
equal but ``v`` and, through the size of the shapes, ``J``. Closest points jump, so that the registration amplifies
rounding: a template larger by 1e-12 moves single vertices by up to 3 % of an animal's size, as other versions of the
libraries do. Most of that is along the surface; vertices lie within 1 mm of the shipped ones on average.

The art is by Wildfire Games, CC BY-SA 3.0; see meshkit/data/assets/LICENSE-animals.txt.
"""

import argparse
import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
from animal_registration import Template, make_template, mirror_map, register, smooth_crossings, subdivide, symmetric
from animal_skeleton import FAMILIES, NAMES, PARENTS, SEGMENTS, find_joints, load_animal
from make_animal_poses import POSES, all_frames, choose

from meshkit.io import atomic_write

TEMPLATE = "animal_lioness"
WITHOUT_BACK_PULL = ("wolfhound",)  # its ears would be drawn out to the length of a hare's
SHAPES = 41
DIAGONAL = 1.8  # of the bounding box, in metres, before the size is varied


def lioness_template(archive: zipfile.ZipFile) -> Template:
    """The symmetric lioness, subdivided and rigged."""
    verts, faces, bones = load_animal(archive, TEMPLATE)
    joints = find_joints(verts, bones, FAMILIES["felidae"][TEMPLATE])
    return make_template(*subdivide(symmetric(verts, mirror_map(verts)), faces), joints)


def registered(archive: zipfile.ZipFile, template: Template) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (25, V, 3) and joints (25, J, 3) of the animals, pelvis at the origin and all of one size."""
    shapes, skeletons = [], []
    for name, rig in (pair for family in FAMILIES.values() for pair in family.items()):
        verts, faces, bones = load_animal(archive, name)
        joints = find_joints(verts, bones, rig)
        fitted, error = register(template, verts, faces, joints, back=0.0 if name in WITHOUT_BACK_PULL else 0.35)
        shape = smooth_crossings(fitted, template.faces)
        moved = np.linalg.norm(shape - fitted, axis=1).max() / np.linalg.norm(np.ptp(shape, axis=0))
        print(f"{name:20s} {100 * error:.2f} % of its height off the surface; smoothing moved {100 * moved:.1f} %")
        scale = DIAGONAL / np.linalg.norm(np.ptp(shape, axis=0))
        shapes.append(scale * (shape - joints[0]))
        skeletons.append(scale * (joints - joints[0]))
    return np.stack(shapes), np.stack(skeletons)


def add_blends(shapes: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str], list[str]]:
    """All 41 vertices, joints, names and families: blends within families after the animals, sizes varied."""
    names = [name for family in FAMILIES.values() for name in family]
    families = [family for family, members in FAMILIES.items() for _ in members]
    rng = np.random.default_rng(0)
    all_shapes, all_joints = list(shapes), list(joints)
    while len(all_shapes) < SHAPES:
        family = list(FAMILIES)[rng.integers(len(FAMILIES))]
        a, b = rng.choice([names.index(name) for name in FAMILIES[family]], 2, replace=False)
        share = rng.uniform(0.3, 0.7)
        all_shapes.append((1 - share) * shapes[a] + share * shapes[b])
        all_joints.append((1 - share) * joints[a] + share * joints[b])
        names.append(f"{names[a]}*{names[b]}:{share:.2f}")
        families.append(family)
    sizes = rng.uniform(0.85, 1.15, SHAPES)[:, None, None]
    return sizes * np.stack(all_shapes), sizes * np.stack(all_joints), names, families


def joint_weights(template: Template) -> np.ndarray:
    """Weights (V, J): a segment turns with the joint it starts from."""
    weights = np.zeros((len(template.verts), len(NAMES)))
    for k, (start, _) in enumerate(SEGMENTS):
        weights[:, start] += template.weights[:, k]
    return weights


def compare(arrays: dict[str, np.ndarray]) -> None:
    """Print how each array differs from that of the shipped file."""
    with (files("meshkit.data") / "assets" / "animals_baked.npz").open("rb") as stream, np.load(stream) as archive:
        shipped = dict(archive)
    for key in sorted(arrays.keys() | shipped.keys()):
        if key not in arrays or key not in shipped:
            print(f"{key}: only in {'the new' if key in arrays else 'the shipped'} file")
            continue
        new, old = arrays[key], shipped[key]
        if new.shape != old.shape or new.dtype != old.dtype:
            print(f"{key}: {new.shape} {new.dtype}, shipped {old.shape} {old.dtype}")
        elif np.array_equal(new, old):
            print(f"{key}: equal")
        elif new.dtype.kind == "f":
            off = np.abs(new.astype(np.float64) - old)
            print(f"{key}: {(off > 0).mean():.1%} of the numbers differ, mean {off.mean():.1e}, most {off.max():.1e}")
        else:
            print(f"{key}: {(new != old).sum()} of {new.size} entries differ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--art", type=Path, required=True, help="folder in which 0ad-data 0.0.26 was unpacked")
    parser.add_argument("--output", type=Path, required=True, help="the .npz file to write")
    args = parser.parse_args()
    found = sorted(args.art.rglob("mods/public/public.zip"))
    if not found:
        parser.error(f"no mods/public/public.zip below {args.art}: unpack 0ad-data there")
    with zipfile.ZipFile(found[0]) as archive:
        template = lioness_template(archive)
        shapes, joints, names, families = add_blends(*registered(archive, template))
        poses, tags = all_frames(archive, PARENTS)
    chosen = choose(poses, POSES)
    arrays = {
        "v": shapes.astype(np.float16),
        "f": template.faces.astype(np.uint16),
        "J": joints.astype(np.float32),
        "W": joint_weights(template).astype(np.float16),
        "names": np.array(names),
        "family": np.array(families),
        "parents": np.array(PARENTS),
        "joint_names": np.array(NAMES),
        "pose_rot": poses[chosen].astype(np.float16),
        "pose_tag": np.array([tags[k] for k in chosen]),
    }
    with atomic_write(args.output) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    compare(arrays)


if __name__ == "__main__":
    main()
