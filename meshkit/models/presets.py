"""Sizes of the generators, and checkpoints that remember them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from meshkit.models.generator import PoseTransferGenerator
from meshkit.models.npt import NPT

__all__ = ["GeneratorConfig", "corenet3d", "load_generator", "npt", "xdualnet"]


@dataclass(frozen=True)
class GeneratorConfig:
    """Arguments of :class:`~meshkit.models.PoseTransferGenerator`, plus which descriptors feed it.

    The defaults are the paper's sizes. With ``architecture="npt_maxpool"`` or ``"npt_original"`` it describes an
    :class:`~meshkit.models.NPT`, which has no matching: of the other fields only ``extractor_widths`` counts then, as
    the encoder's channels.
    """

    architecture: Literal["matching", "npt_maxpool", "npt_original"] = "matching"
    """matching: X-DualNet and 3D-CoreNet; npt_maxpool, npt_original: NPT."""
    extractor: Literal["setconv", "pointwise"] = "setconv"
    """setconv: X-DualNet; pointwise: 3D-CoreNet."""
    extractor_widths: tuple[int, ...] = (32, 64, 128)
    """Channels of the feature extractor. Paper: 32, 64, 128. 3D-CoreNet: 64, 128, 256. NPT: 64, 128, 1024."""
    extractor_blocks: int = 4
    """Residual blocks of the pointwise extractor. 3D-CoreNet: 4."""
    k: int = 32
    """Neighbours in the extractor. Released code: 32."""
    widths: tuple[int, ...] = (1024, 512, 256)
    """Channels of the residual blocks. Paper: 1024, 512, 256."""
    eps: float = 0.03
    """Entropic regularisation of the matching. Paper: 0.03."""
    n_iters: int = 5
    """Sinkhorn iterations. Paper: 5."""
    norm: Literal["elain", "spadain"] = "elain"
    """Conditional norm of the blocks: elain, or spadain, with which the paper compares it."""
    spectral: bool = True
    """Spectral normalisation in the blocks. Released code: yes."""
    residual: bool = False
    """The blocks displace the warped mesh instead of generating all of it. Paper: no."""
    normalize_plan: bool = True
    """Warp with the row-normalised plan. Released code: yes. Paper: no."""
    condition: Literal["auto", "features", "descriptors"] = "auto"
    """What the blocks know of the identity: features, descriptors, or auto (descriptors where there are any). Paper:
    features."""
    rigid_radius: float | None = None
    """Radius of the rigid moving least squares that the warped mesh passes, in the meshes' unit. Paper: none."""
    poisson_weight: float | None = None
    """Weight of the positions in the Poisson deformation that it passes instead, of the same radius. Paper: none."""
    match_size: bool = False
    """Scale the pose mesh to the identity's size before warping it, where there are descriptors. Paper: no."""
    symmetry: bool = False
    """In evaluation, resolve exchanged limbs with the identity's mirror image (needs faces). Paper: no."""
    descriptors: Literal["none", "wks"] = "none"
    """none: coordinates alone, the paper; wks: wave-kernel signatures and the size of the mesh besides."""
    num_signatures: int = 16
    """How many signatures, when there are any."""
    released: bool = False
    """The released code to the letter, for its checkpoints: first convolution along the vertex order."""

    def build(self) -> PoseTransferGenerator | NPT:
        """The generator of this configuration, freshly initialised."""
        if self.architecture not in ("matching", "npt_maxpool", "npt_original"):
            raise ValueError(
                f'architecture must be "matching", "npt_maxpool" or "npt_original", got {self.architecture!r}'
            )
        if self.descriptors not in ("none", "wks"):
            raise ValueError(f'descriptors must be "none" or "wks", got {self.descriptors!r}')
        if self.architecture != "matching":
            if self.descriptors != "none":
                raise ValueError('NPT takes no descriptors: set descriptors="none"')
            return NPT(self.architecture.removeprefix("npt_"), encoder_widths=self.extractor_widths)
        return self._build_matching()

    def _build_matching(self) -> PoseTransferGenerator:
        arguments = asdict(self)
        del arguments["architecture"]
        if self.condition == "auto":
            arguments["condition"] = "features" if self.descriptors == "none" else "descriptors"
        signatures = arguments.pop("num_signatures")
        arguments["match_size"] = self.match_size and self.descriptors != "none"
        arguments["descriptors"] = signatures + 1 if self.descriptors == "wks" else 0
        return PoseTransferGenerator(**arguments)

    @classmethod
    def from_json(cls, text: str) -> GeneratorConfig:
        """The configuration in a JSON object; unknown names are an error that lists the known ones."""
        try:
            values: dict[str, Any] = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"the model configuration is not JSON: {error}") from error
        if not isinstance(values, dict):
            raise ValueError(f"the model configuration must be a JSON object, got {text.strip()[:40]!r}")
        unknown = sorted(set(values) - set(cls.__dataclass_fields__))
        if unknown:
            raise ValueError(
                f"unknown fields {unknown} in the model configuration; known: {list(cls.__dataclass_fields__)}"
            )
        arguments: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in values.items()}
        return cls(**arguments)


PRESETS = {
    "paper": GeneratorConfig(),
    "tiny": GeneratorConfig(
        extractor_widths=(16, 32, 32),
        k=8,
        widths=(256, 128, 64),
        residual=True,
        rigid_radius=0.25,
        match_size=True,
        symmetry=True,
        descriptors="wks",
    ),
}
_POISSON = replace(PRESETS["tiny"], rigid_radius=0.15, poisson_weight=0.2)
PRESETS["small"] = replace(_POISSON, extractor_widths=(32, 64, 64), k=16)
_CORENET3D = {
    "paper": GeneratorConfig(extractor="pointwise", extractor_widths=(64, 128, 256)),
    "tiny": replace(PRESETS["tiny"], extractor="pointwise", extractor_widths=(16, 32, 64), extractor_blocks=2),
    "small": replace(_POISSON, extractor="pointwise", extractor_widths=(32, 64, 128)),
}
_NPT = {"paper": (64, 128, 1024), "tiny": (32, 64, 253), "small": (32, 64, 253)}


def xdualnet(preset: str = "paper", *, released: bool = False) -> PoseTransferGenerator:
    """X-DualNet's generator.

    Args:
        preset: ``"paper"`` (extractor 32/64/128 over 32 neighbours, blocks 1024/512/256), ``"tiny"`` (16/32/32 over 8
            neighbours, blocks 256/128/64 that displace the warped mesh, intrinsic descriptors at the extractor's input
            and as the blocks' condition), which trains on a laptop's CPU, or ``"small"``, that with an extractor
            32/64/64 over 16 neighbours and Poisson deformation of the warped mesh.
        released: the released code's first convolution, of kernel 3 along the vertex order, and its matching. The
            model is then not permutation-equivariant.

    Example:
        >>> sum(p.numel() for p in xdualnet("tiny").parameters()) < 2_000_000
        True
    """
    return replace(_pick(PRESETS, preset), released=released)._build_matching()


def corenet3d(preset: str = "paper", *, released: bool = False) -> PoseTransferGenerator:
    """3D-CoreNet's generator: X-DualNet's, but with a pointwise extractor and two maps before the matching.

    Args:
        preset: ``"paper"`` (extractor 64/128/256 with 4 residual blocks, blocks 1024/512/256), ``"tiny"`` (16/32/64
            with 2, the rest as ``xdualnet("tiny")``) or ``"small"`` (32/64/128 with 4, the rest likewise).
        released: as in :func:`xdualnet`.

    Example:
        >>> sum(p.numel() for p in corenet3d("tiny").parameters()) < 2_000_000
        True
    """
    return replace(_pick(_CORENET3D, preset), released=released)._build_matching()


def npt(variant: str = "maxpool", *, preset: str = "paper") -> NPT:
    """Neural Pose Transfer, the baseline without correspondence.

    Args:
        variant: ``"maxpool"``, or ``"original"`` for meshes of equal vertex counts.
        preset: ``"paper"`` (encoder 64/128/1024, blocks 1027/513/256, which is also the released layout), or ``"tiny"``
            and ``"small"``, which are one (32/64/253, blocks 256/128/64).

    Example:
        >>> sum(p.numel() for p in npt(preset="tiny").parameters()) < 500_000
        True
    """
    if variant in _NPT:
        raise ValueError(f'{variant!r} is a preset, not a variant: npt(preset="{variant}")')
    return NPT(variant, encoder_widths=_pick(_NPT, preset))


def _pick(presets: dict[str, Any], name: str) -> Any:
    if name not in presets:
        raise ValueError(f"preset must be one of {sorted(presets)}, got {name!r}")
    return presets[name]


def load_generator(folder: str | Path) -> tuple[PoseTransferGenerator | NPT, GeneratorConfig]:
    """Read ``model.safetensors`` and ``model.json`` from a run's folder.

    Raises:
        ValueError: a file is missing or damaged, or the weights do not fit the configuration.
    """
    from safetensors.torch import load_file

    folder = Path(folder)
    for name in ("model.json", "model.safetensors"):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} holds no {name}: give the folder of a finished or checkpointed run")
    try:
        config = GeneratorConfig.from_json((folder / "model.json").read_text())
    except ValueError as error:
        raise ValueError(f"{folder / 'model.json'}: {error}") from error
    try:
        with torch.device("cpu"):  # read there whatever the default device
            model = config.build()
        model.load_state_dict(load_file(folder / "model.safetensors"))
    except Exception as error:  # torch, safetensors and load_state_dict each raise their own kinds
        reason = (str(error).splitlines() or [repr(error)])[0]
        raise ValueError(f"the weights in {folder} cannot be read into this model: {reason}") from error
    return model.eval(), config
