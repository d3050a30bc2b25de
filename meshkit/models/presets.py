"""Sizes of the generators, and checkpoints that remember them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from meshkit.models.generator import PoseTransferGenerator

__all__ = ["GeneratorConfig", "load_generator", "xdualnet"]


@dataclass(frozen=True)
class GeneratorConfig:
    """Arguments of :class:`~meshkit.models.PoseTransferGenerator`, plus which descriptors feed it.

    The defaults are the paper's sizes.
    """

    extractor_widths: tuple[int, ...] = (32, 64, 128)
    """Channels of the feature extractor. Paper: 32, 64, 128."""
    k: int = 32
    """Neighbours in the extractor. Released code: 32."""
    widths: tuple[int, ...] = (1024, 512, 256)
    """Channels of the residual blocks. Paper: 1024, 512, 256."""
    eps: float = 0.03
    """Entropic regularisation of the matching. Paper: 0.03."""
    n_iters: int = 5
    """Sinkhorn iterations. Paper: 5."""
    spectral: bool = True
    """Spectral normalisation in the blocks. Released code: yes."""
    residual: bool = False
    """The blocks displace the warped mesh instead of generating all of it. Paper: no."""
    normalize_plan: bool = True
    """Warp with the row-normalised plan. Released code: yes. Paper: no."""
    condition: str = "auto"
    """What the blocks know of the identity: features, descriptors, or auto (descriptors where there are any). Paper:
    features."""
    rigid_radius: float | None = None
    """Radius of the rigid moving least squares that the warped mesh passes through, in metres. Paper: none."""
    match_size: bool = False
    """Scale the pose mesh to the identity's size before warping it, where there are descriptors. Paper: no."""
    descriptors: str = "none"
    """none: coordinates alone, the paper; wks: wave-kernel signatures and the size of the mesh besides."""
    num_signatures: int = 16
    """How many signatures, when there are any."""

    def build(self) -> PoseTransferGenerator:
        """The generator of this configuration, freshly initialised."""
        if self.descriptors not in ("none", "wks"):
            raise ValueError(f'descriptors must be "none" or "wks", got {self.descriptors!r}')
        arguments = asdict(self)
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
        descriptors="wks",
    ),
}


def xdualnet(preset: str = "paper") -> PoseTransferGenerator:
    """X-DualNet's generator (3D-CoreNet's as well: they differ in the training objective).

    Args:
        preset: ``"paper"`` (extractor 32/64/128 over 32 neighbours, blocks 1024/512/256) or ``"tiny"`` (16/32/32 over
            8 neighbours, blocks 256/128/64 that displace the warped mesh, intrinsic descriptors at the extractor's
            input and as the blocks' condition), which trains on a laptop's CPU.

    Example:
        >>> sum(p.numel() for p in xdualnet("tiny").parameters()) < 2_000_000
        True
    """
    if preset not in PRESETS:
        raise ValueError(f"preset must be one of {sorted(PRESETS)}, got {preset!r}")
    return PRESETS[preset].build()


def load_generator(folder: str | Path) -> tuple[PoseTransferGenerator, GeneratorConfig]:
    """Read ``model.safetensors`` and ``model.json`` from a run's folder.

    Raises:
        ValueError: a file is missing or damaged, or the weights do not fit the configuration.
    """
    from safetensors.torch import load_file

    folder = Path(folder)
    for name in ("model.json", "model.safetensors"):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} holds no {name}: give the folder of a finished or checkpointed run")
    config = GeneratorConfig.from_json((folder / "model.json").read_text())
    try:
        model = config.build()
        model.load_state_dict(load_file(folder / "model.safetensors"))
    except Exception as error:  # torch, safetensors and load_state_dict each raise their own kinds
        reason = str(error).splitlines()[0]
        raise ValueError(f"the weights in {folder} cannot be read into this model: {reason}") from error
    return model.eval(), config
