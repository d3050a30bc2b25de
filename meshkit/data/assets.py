"""The bodies that come with meshkit."""

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

__all__ = ["Split", "human_split", "load_humans"]

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

    weights = torch.zeros(n, len(rig["joints"])).scatter_add_(1, indices(f"wi{n}"), array(f"ww{n}"))
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
    table = json.loads(_asset("splits.json").read_text())["humans"]
    test_identities, test_poses = torch.tensor(table["test_identities"]), torch.tensor(table["test_poses"])

    def others(count: int, taken: Tensor) -> Tensor:
        keep = torch.ones(count, dtype=torch.bool)
        keep[taken] = False
        return keep.nonzero()[:, 0]

    return Split(
        others(table["identities"], test_identities),
        test_identities,
        others(table["poses"], test_poses),
        test_poses,
        torch.tensor(table["test_pairs"]),
    )


def _asset(name: str) -> Any:
    return files("meshkit.data") / "assets" / name


@cache
def _archive(name: str) -> dict[str, np.ndarray]:
    with _asset(name).open("rb") as stream, np.load(stream) as archive:
        return dict(archive)
