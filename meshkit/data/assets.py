"""The bodies that come with meshkit, and their splits into training and test sides."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshkit.data.rigged import RiggedModel

__all__ = [
    "Split",
    "animal_families",
    "animal_split",
    "human_split",
    "load_animals",
    "load_humans",
    "load_shipped",
]

RESOLUTIONS = (1000, 2000, 3445, 6890)


def load_humans(num_verts: int = 1000) -> RiggedModel:
    """The shipped human body: 40 shape directions, 74 joints, 200 identities and 1000 poses.

    Metres, z up, facing -y, x towards the body's left, the origin at about half the height. Watertight, genus 0,
    outward oriented. Distilled from the CC0 MakeHuman data; see ``meshkit/data/assets/README.md``.

    Args:
        num_verts: resolution of the template: 1000, 2000, 3445 or 6890.

    Raises:
        ValueError: no template has that many vertices.

    Example:
        >>> load_humans(2000).template.shape
        torch.Size([2000, 3])
    """
    if num_verts not in RESOLUTIONS:
        raise ValueError(f"the shipped humans have {', '.join(map(str, RESOLUTIONS))} vertices, got {num_verts}")
    rig, n = _archive("humans_baked.npz"), num_verts

    def array(name: str) -> Tensor:
        return torch.from_numpy(rig[name].astype(np.float32))

    def indices(name: str) -> Tensor:
        return torch.from_numpy(rig[name].astype(np.int64))

    weights = torch.zeros(n, len(rig["joints"]), device="cpu").scatter_add_(1, indices(f"wi{n}"), array(f"ww{n}"))
    return RiggedModel(
        array(f"v{n}"),
        indices(f"f{n}"),
        array(f"dirs{n}"),
        array("joints"),
        array("joint_dirs"),
        weights,
        indices("parents"),
        identities=array("beta_samples"),
        poses=torch.from_numpy(_archive("poses_baked.npz")["rotvec"].astype(np.float32)),
    )


def load_animals() -> RiggedModel:
    """The shipped four-legged animals: 41 identities on one topology of 1962 vertices, 31 joints, 400 poses.

    Index i is animal i: its coefficients are row i of the identity matrix, over the differences from the mean animal. A
    row that mixes several is a blend. The last 16 animals are such blends already, of two animals of one family,
    named ``a*b:share of b``. Sizes vary: the rest bounding box has a diagonal of 1.5 to 2.1. Frame as for the humans:
    z up, facing -y, x towards the animal's left; closed, genus 0, outward oriented.

    Poses are frames of the animations of many species, on the common skeleton; ``pose_names`` says ``clip:frame``.
    Any animal can take any of them, as in the paper's pairs of animals, and some are odd on another species (a rearing
    hippopotamus).

    Derived from art of 0 A.D. by Wildfire Games (https://wildfiregames.com), licensed CC BY-SA 3.0: see
    ``meshkit/data/assets/LICENSE-animals.txt``. What is made from it must carry the same licence and credit.

    Deviations:
        Stored rotations have 16 bits; they are projected back to the nearest rotation.

    Example:
        >>> animals = load_animals()
        >>> animals.identity_names[2], animals(torch.tensor([2]), torch.tensor([7])).shape
        ('tiger', torch.Size([1, 1962, 3]))
    """
    rig = _archive("animals_baked.npz")
    # The file keeps the game's axes, y up and left-handed; exchanging y and z makes them ours.
    verts, joints = (torch.from_numpy(rig[name].astype(np.float32))[..., [0, 2, 1]] for name in ("v", "J"))
    turns = torch.from_numpy(rig["pose_rot"].astype(np.float64))[..., [0, 2, 1], :][..., [0, 2, 1]]
    u, _, vh = torch.linalg.svd(turns)  # orthogonal up to rounding and of determinant 1: u @ vh is the rotation
    mean, mean_joints = verts.mean(0), joints.mean(0)
    return RiggedModel(
        mean,
        torch.from_numpy(rig["f"].astype(np.int64)),
        verts - mean,
        mean_joints,
        joints - mean_joints,
        torch.from_numpy(rig["W"].astype(np.float32)),
        torch.from_numpy(rig["parents"].astype(np.int64)),
        identities=torch.eye(len(verts), device="cpu"),
        poses=(u @ vh).float(),
        identity_names=rig["names"].tolist(),
        pose_names=rig["pose_tag"].tolist(),
    )


def animal_families() -> dict[str, list[int]]:
    """Identity indices of the shipped animals by family; a blend belongs to the family of its parents.

    Example:
        >>> {family: len(members) for family, members in animal_families().items()}
        {'felidae': 6, 'canidae': 6, 'equidae': 7, 'bovidae': 10, 'cervid_giraffid_camelid': 5, 'large': 7}
    """
    families: dict[str, list[int]] = {}
    for index, family in enumerate(_archive("animals_baked.npz")["family"].tolist()):
        families.setdefault(family, []).append(index)
    return families


def load_shipped(name: str, num_verts: int | None = None) -> tuple[RiggedModel, Split]:
    """A shipped body and its split, by name.

    Args:
        name: ``"humans"`` or ``"animals"``.
        num_verts: resolution; 1000 (default), 2000, 3445 or 6890 for humans, 1962 for animals.

    Raises:
        ValueError: nothing has that name, or not at that resolution.

    Example:
        >>> animals, split = load_shipped("animals")
        >>> animals(split.test_identities[:1], split.test_poses[:1]).shape
        torch.Size([1, 1962, 3])
    """
    if name == "humans":
        return load_humans(1000 if num_verts is None else num_verts), human_split()
    if name == "animals":
        if num_verts not in (None, 1962):
            raise ValueError(f"the shipped animals have 1962 vertices, got {num_verts}")
        return load_animals(), animal_split()
    raise ValueError(f"the shipped bodies are 'humans' and 'animals', got {name!r}")


@dataclass(frozen=True)
class Split:
    """Disjoint identities and poses for training and testing, as indices into a model's tables.

    ``test_pairs`` ``(400, 4)`` lists fixed test pairs: identity and pose of the identity mesh, identity and pose of the
    pose mesh. Figures over its first n rows compare, whatever the system.
    """

    train_identities: Tensor
    test_identities: Tensor
    train_poses: Tensor
    test_poses: Tensor
    test_pairs: Tensor


def human_split() -> Split:
    """The one split of the shipped humans: 160 identities and 850 poses to train on, 40 and 150 unseen ones.

    Example:
        >>> split = human_split()
        >>> len(split.train_identities), len(split.test_identities), len(split.train_poses), len(split.test_poses)
        (160, 40, 850, 150)
    """
    return _split("humans")


def animal_split() -> Split:
    """The one split of the shipped animals: 29 animals and 340 poses to train on, 12 and 60 unseen ones.

    By family: cats and dogs and their kin are test animals, the other four families train. So no blend is separated
    from its parents, and the near-duplicates (horse, pony, horse_breed) are on one side; and no test animal lies as far
    from all others as the giraffe. Poses go by
    animation clip, so that no test pose is a neighbouring frame of a training pose.

    Example:
        >>> split = animal_split()
        >>> len(split.train_identities), len(split.test_identities), len(split.train_poses), len(split.test_poses)
        (29, 12, 340, 60)
    """
    return _split("animals")


def _split(name: str) -> Split:
    table = json.loads(_asset("splits.json").read_text())[name]

    def rows(name: str) -> Tensor:
        return torch.tensor(table[name], device="cpu")

    def others(count: int, taken: Tensor) -> Tensor:
        keep = torch.ones(count, dtype=torch.bool, device="cpu")
        keep[taken] = False
        return keep.nonzero()[:, 0]

    test_identities, test_poses = rows("test_identities"), rows("test_poses")
    return Split(
        others(table["identities"], test_identities),
        test_identities,
        others(table["poses"], test_poses),
        test_poses,
        rows("test_pairs"),
    )


def _asset(name: str) -> Any:
    return files("meshkit.data") / "assets" / name


@cache
def _archive(name: str) -> dict[str, np.ndarray]:
    with _asset(name).open("rb") as stream, np.load(stream) as archive:
        return dict(archive)
