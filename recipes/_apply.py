"""Pose transfer between two mesh files with a run's weights."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import torch
from _data import IN_METRES, told
from _run import UserError
from torch import Tensor

from meshkit.batching import bounding_box_center, center
from meshkit.descriptors import intrinsic_descriptors
from meshkit.io import MeshFileError, load_mesh, save_mesh
from meshkit.models import GeneratorConfig, load_generator
from meshkit.models.pretrained import check_extent, extents, unusual_extent

FROM_1_TO_2 = ("humans", "animals", "smpl", "smal", "faust")
"""Kinds of --data whose bodies are about 1 to 2 long, in metres or units; meshes of folders may be of any size."""
SELDOM_LONGEST = {"humans": "y", "smpl": "y", "animals": "xz", "smal": "xz"}
"""Axes along which the bodies of a kind are longest in few poses; a person's arms may reach farther than it is tall."""


@torch.no_grad()
def apply(folder: Path, files: tuple[Path, Path], result: Path) -> None:
    """Give the first mesh file the pose of the second, with the weights of the run in ``folder``."""
    try:
        generator, model = load_generator(folder)
        kind = trained_on(folder)
        meshes = [load_mesh(path) for path in files]
        for path, (verts, _) in zip(files, meshes, strict=True):
            if kind in FROM_1_TO_2:
                other = shlex.join(["meshkit-transfer", *map(str, files), "--weights", str(folder)])
                check_extent(verts, str(path), advice=f"`{other}` guesses unit and axes")
            if model.architecture == "matching" and model.extractor == "setconv" and len(verts) < model.k:
                raise UserError(f"{path}: {len(verts)} vertices; this model looks at {model.k} neighbours")
        descriptors: list[Tensor] | list[None] = [None, None]
        if model.descriptors == "wks":
            descriptors = [describe(path, *mesh, model) for path, mesh in zip(files, meshes, strict=True)]
        for path, (verts, _) in zip(files, meshes, strict=True):
            warn(path, verts, kind)
        (identity, faces), (pose, _) = meshes
        known = {"identity_descriptors": descriptors[0], "pose_descriptors": descriptors[1], "identity_faces": faces}
        output = generator(center(identity[None]), center(pose[None]), **told(generator, known))
        # Training meshes are centred; the result goes to where the pose mesh stands.
        save_mesh(result, output.vertices[0] + bounding_box_center(pose[None])[0], faces)
    except (MeshFileError, ValueError) as error:
        raise UserError(str(error)) from None
    except OSError as error:
        raise UserError(f"cannot write {result}: {error.strerror}") from None
    print(f"{result}: {len(identity)} vertices of {files[0]} in the pose of {files[1]}")


def trained_on(folder: Path) -> str:
    """The word before the colon of the run's --data; empty if that is not known."""
    try:
        return str(json.loads((folder / "config.json").read_text())["data"]).partition(":")[0]
    except (KeyError, OSError, TypeError, ValueError):
        return ""


def warn(path: Path, verts: Tensor, kind: str) -> None:
    """Speak up where a mesh is unlike the bodies a model was trained on."""
    odd = unusual_extent(verts, kind)
    axis = "xyz"[int(extents(verts).argmax())]
    if kind in FROM_1_TO_2 and odd is not None:
        unit = " metres" if kind in IN_METRES else ""
        print(
            f"warning: {path} is {odd:.3g} long; these weights were trained on bodies of about 1 to 2{unit}",
            file=sys.stderr,
        )
    if axis in SELDOM_LONGEST.get(kind, ""):
        print(f"warning: {path} is longest along {axis}; expected z up, facing -y", file=sys.stderr)


def describe(path: Path, verts: Tensor, faces: Tensor, model: GeneratorConfig) -> Tensor:
    try:
        return intrinsic_descriptors(verts, faces, num_signatures=model.num_signatures, method="fast")[None]
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
