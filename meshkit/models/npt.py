"""Neural Pose Transfer (NPT)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from meshkit._checks import check_widths
from meshkit._repr import settings
from meshkit.batching import check_mask, check_verts
from meshkit.models.output import GeneratorOutput
from meshkit.nn import ConditionalResBlock
from meshkit.norm import SPAdaIN, instance_norm

__all__ = ["NPT"]


class NPT(nn.Module):
    r"""Generator G without correspondence: the pose is a feature, the identity's coordinates are the condition.

    With :math:`e` the encoder (three maps per vertex, each with instance norm and ReLU),

    .. math:: G(A, B)_i = S([E_i, A_i]; A)_i, \qquad E_i = \max_j e(B)_j \;\text{(maxpool)} \quad\text{or}\quad
              E_i = e(B)_i \;\text{(original)}

    where S is three residual blocks whose SPAdaIN takes scale and shift from the coordinates :math:`A_i`, with maps
    between them, and :math:`2 \tanh` at the end.

    The original variant pairs vertex i of one mesh with vertex i of the other, whatever they are, so it needs meshes
    of equal vertex counts, and its result depends on the order of either. The max-pool variant, which the authors
    recommend for meshes of different sizes, has neither limit; its first block does not normalise, since the pooled
    feature is the same at every vertex.

    Args:
        variant: ``"maxpool"`` or ``"original"``.
        encoder_widths: channels of the encoder; the released code has 64, 128, 1024. With w the last of them plus 3,
            the residual blocks have w, w/2 and w/4 channels.

    Shape:
        ``identity (B, N, 3)``, ``pose (B, M, 3)``, masks ``(B, N)`` and ``(B, M)``.

    Raises:
        ValueError: unknown variant; meshes are not (B, V, 3); batches differ; vertex counts or masks differ in the
            original variant; descriptors are given.

    Reference:
        Wang et al., "Neural Pose Transfer by Spatially Adaptive Instance Normalization" (CVPR 2020); the max-pool
        variant from the released code.

    Example:
        >>> net = NPT(encoder_widths=(8, 16))
        >>> net(torch.randn(1, 30, 3), torch.randn(1, 40, 3)).vertices.shape
        torch.Size([1, 30, 3])
    """

    def __init__(self, variant: str = "maxpool", *, encoder_widths: Sequence[int] = (64, 128, 1024)) -> None:
        super().__init__()
        if variant not in ("maxpool", "original"):
            raise ValueError(f'variant must be "maxpool" or "original", got {variant!r}')
        check_widths(encoder_widths, "encoder_widths")
        self.variant = variant
        self.encoder = _PoseEncoder(encoder_widths)
        self.decoder = _Decoder(encoder_widths[-1], bare_start=variant == "maxpool")
        self._initialize()

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "variant")

    # Not reset_parameters: it draws what a fresh network's parts leave to it, and leaves the rest as it is.
    def _initialize(self) -> None:
        """Xavier initialisation, with a last layer small enough that training starts from a mesh near the centre."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_normal_(module.weight)
        nn.init.normal_(self.decoder.narrow[-1].get_parameter("weight"), std=1e-3)
        nn.init.zeros_(self.decoder.narrow[-1].get_parameter("bias"))

    def fit_descriptors(self, descriptors: Tensor, *, mask: Tensor | None = None) -> None:
        """Refuse: there are no descriptors to standardise."""
        _refuse(descriptors)

    def encode(self, verts: Tensor, *, mask: Tensor | None = None, descriptors: Tensor | None = None) -> Tensor:
        """Pose features ``(B, V, D)`` of a mesh; the max-pool variant has the same at each vertex."""
        check_verts(verts)
        check_mask(mask, *verts.shape[:2])
        _refuse(descriptors)
        features = self.encoder(verts, mask=mask)
        if self.variant == "original":
            return features
        if mask is not None:
            features = features.masked_fill(~mask[..., None], 0.0)  # the lowest value a ReLU gives
        return features.amax(1, keepdim=True).expand_as(features)

    def forward(
        self,
        identity: Tensor,
        pose: Tensor,
        *,
        identity_mask: Tensor | None = None,
        pose_mask: Tensor | None = None,
        identity_descriptors: Tensor | None = None,
        pose_descriptors: Tensor | None = None,
        identity_features: Tensor | None = None,
        pose_features: Tensor | None = None,
    ) -> GeneratorOutput:
        """Give the identity mesh the pose of the pose mesh.

        The arguments are those of every generator. Features of the identity, which :meth:`encode` gives, are not used;
        descriptors are refused. The output has neither a warped mesh nor a plan.
        """
        check_verts(identity, name="identity")
        check_mask(identity_mask, *identity.shape[:2], name="identity_mask")
        if len(identity) != len(pose):
            raise ValueError(f"identity and pose batches differ: {tuple(identity.shape)} and {tuple(pose.shape)}")
        if self.variant == "original" and identity.shape != pose.shape:
            raise ValueError(
                'variant="original" pairs vertices by their index and needs equal vertex counts, got '
                f'{identity.shape[1]} and {pose.shape[1]}: use variant="maxpool"'
            )
        if self.variant == "original" and not _same_mask(identity_mask, pose_mask):
            raise ValueError(
                'variant="original" pairs vertices by their index and needs equal masks: use variant="maxpool"'
            )
        _refuse(identity_descriptors, pose_descriptors)
        features = self.encode(pose, mask=pose_mask) if pose_features is None else pose_features
        if self.variant == "maxpool":
            features = features[:, :1]
        vertices = self.decoder(features, identity, mask=identity_mask)
        return GeneratorOutput(vertices, None, None)

    def inert_parameters(self) -> list[str]:
        """Names of the parameters that the layout holds and the result does not depend on.

        They are biases whose sum with everything before them an instance norm takes the mean from.
        """
        inert = [name for name, _ in self.named_parameters() if name.startswith("encoder") and name.endswith("bias")]
        last = len(self.decoder.blocks) - 1
        for i, block in enumerate(self.decoder.blocks):
            if not isinstance(block.norm_0, _Modulation):
                inert.append(f"decoder.narrow.{i - 1}.bias" if i else "decoder.mix.bias")
                inert.append(f"decoder.blocks.{i}.conv_0.bias")
            if i < last:
                inert += [f"decoder.blocks.{i}.conv_1.bias", f"decoder.blocks.{i}.shortcut_bias"]
        return inert


class _PoseEncoder(nn.Module):
    """Maps per vertex, each with instance norm and ReLU."""

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise([3, *widths]))

    def forward(self, x: Tensor, *, mask: Tensor | None = None) -> Tensor:
        if mask is not None:
            x = x.masked_fill(~mask[..., None], 0.0)
        for lift in self.linears:
            x = instance_norm(lift(x), mask=mask).relu()
        return x


class _Decoder(nn.Module):
    """From pose features, one per vertex or one per mesh, and the identity's coordinates to vertices."""

    def __init__(self, features: int, *, bare_start: bool) -> None:
        super().__init__()
        self.features = features
        width = features + 3
        widths = [width, width // 2, width // 4]
        norms = [_Modulation if bare_start else SPAdaIN, SPAdaIN, SPAdaIN]
        self.mix = nn.Linear(width, width)
        self.blocks = nn.ModuleList(_Block(w, 3, norm=norm) for w, norm in zip(widths, norms, strict=True))
        self.narrow = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise([*widths, 3]))

    def forward(self, features: Tensor, identity: Tensor, *, mask: Tensor | None = None) -> Tensor:
        if mask is not None:
            identity = identity.masked_fill(~mask[..., None], 0.0)
        from_features, from_identity = self.mix.weight.split([self.features, 3], 1)
        x = linear(features, from_features, self.mix.bias) + linear(identity, from_identity)
        for block, narrow in zip(self.blocks, self.narrow, strict=True):
            x = block(x, identity, mask=mask, then=narrow)
        x = 2 * torch.tanh(x.float() if x.dtype in (torch.float16, torch.bfloat16) else x)
        return x if mask is None else x.masked_fill(~mask[..., None], 0.0)


class _Block(ConditionalResBlock):
    """Block with ReLU, without spectral norm, and with a bias on the shortcut."""

    def __init__(self, num_features: int, cond_features: int, *, norm: type[nn.Module]) -> None:
        super().__init__(num_features, cond_features, norm=norm, slope=0.0, spectral=False)
        self.shortcut_bias = nn.Parameter(torch.zeros(num_features))

    def forward(
        self,
        x: Tensor,
        cond: Tensor,
        *,
        mask: Tensor | None = None,
        cond_mask: Tensor | None = None,
        then: nn.Linear | None = None,
    ) -> Tensor:
        bias = self.shortcut_bias if then is None else linear(self.shortcut_bias, then.weight)
        return super().forward(x, cond, mask=mask, cond_mask=cond_mask, then=then) + bias


class _Modulation(SPAdaIN):
    """SPAdaIN without its instance norm: statistics that change nothing."""

    def statistics(self, x: Tensor, *, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        mean = x.new_zeros(len(x), 1, x.shape[2], dtype=torch.promote_types(x.dtype, torch.float32))
        return mean, torch.ones_like(mean)


def _same_mask(first: Tensor | None, second: Tensor | None) -> bool:
    """Whether two masks mark the same vertices; no mask marks all."""
    if first is None or second is None:
        return all(mask is None or bool(mask.all()) for mask in (first, second))
    return torch.equal(first, second)


def _refuse(*descriptors: Tensor | None) -> None:
    if any(d is not None for d in descriptors):
        raise ValueError("NPT takes no descriptors: its condition is the identity's coordinates")
