"""The feature extractor of 3D-CoreNet."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, normalize

from meshkit._checks import check_descriptors, check_dtype, check_whole, check_widths
from meshkit._repr import settings
from meshkit.batching import check_mask, check_verts
from meshkit.norm import instance_norm

__all__ = ["PointwiseExtractor"]


class PointwiseExtractor(nn.Module):
    r"""Vertex features that know the rest of the mesh through instance statistics alone.

    With :math:`\mathrm{N}` the instance norm (no scale, no shift) and :math:`\phi` a LeakyReLU,

    .. math:: h = \mathrm{N} W_3\, \phi\, \mathrm{N} W_2\, \phi\, \mathrm{N} W_1 v, \qquad x_0 = h / |h|, \qquad
              x_{l+1} = \rho_l(x_l + \mathrm{N} V_l\, \rho_l\, \mathrm{N} U_l x_l)

    with a PReLU :math:`\rho_l` that both activations of a block share. Every map is per vertex, so there is no
    neighbourhood: two vertices at one place have one feature, and the features do not depend on the connectivity.

    W, U and V have biases, as in the released layout, but the norm that follows takes them out again
    (:meth:`inert_parameters`).

    Args:
        widths: channels of the first maps; the released code has 64, 128, 256.
        blocks: number of residual blocks; the released code has 4.
        descriptors: number of descriptor channels appended to the coordinates at the input.
        slope: of the LeakyReLU.

    Shape:
        ``positions (B, N, 3)``, ``descriptors (B, N, D)`` or ``None``, ``mask (B, N)``; result ``(B, N, widths[-1])``.

    Raises:
        ValueError: meshes are not (B, N, 3), descriptors missing, unexpected or of another shape; no channels, or a
            negative number of blocks.
        TypeError: descriptors that are no tensor, or ``positions`` and the parameters in two dtypes.

    Reference:
        Song et al., "3D Pose Transfer with Correspondence Learning and Mesh Refinement" (3D-CoreNet); sizes, slopes
        and the normalised features from the released code.

    Example:
        >>> PointwiseExtractor((8, 16), blocks=1)(torch.randn(2, 30, 3)).shape
        torch.Size([2, 30, 16])
    """

    def __init__(
        self, widths: Sequence[int] = (64, 128, 256), *, blocks: int = 4, descriptors: int = 0, slope: float = 0.2
    ) -> None:
        super().__init__()
        check_widths(widths)
        check_whole(blocks, "blocks", least=0)
        check_whole(descriptors, "descriptors", least=0)
        if not slope >= 0:
            raise ValueError(f"slope must not be negative, got {slope}")
        self.descriptors, self.out_features, self.slope = descriptors, widths[-1], slope
        self.linears = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise([3 + descriptors, *widths]))
        self.blocks = nn.ModuleList(_ResidualBlock(widths[-1]) for _ in range(blocks))

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "descriptors", "slope")

    def forward(self, positions: Tensor, *, descriptors: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Features of each vertex."""
        check_verts(positions, name="positions")
        check_dtype(positions, self, name="positions")
        check_mask(mask, *positions.shape[:2])
        check_descriptors(descriptors, positions, self.descriptors)
        x = positions if descriptors is None else torch.cat([positions, descriptors.to(positions.dtype)], 2)
        if mask is not None:
            x = x.masked_fill(~mask[..., None], 0.0)
        for layer, lift in enumerate(self.linears):
            x = x if layer == 0 else leaky_relu(x, self.slope)
            x = instance_norm(lift(x), mask=mask)
        x = normalize(x, dim=2)
        for block in self.blocks:
            x = block(x, mask=mask)
        return x

    def inert_parameters(self) -> list[str]:
        """Names of the parameters that the layout holds and the result does not depend on."""
        return [name for name, _ in self.named_parameters() if name.endswith("bias")]


class _ResidualBlock(nn.Module):
    """Two normalised maps with a shared PReLU around the identity."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv_0, self.conv_1 = nn.Linear(features, features), nn.Linear(features, features)
        self.prelu = nn.PReLU()

    def forward(self, x: Tensor, *, mask: Tensor | None = None) -> Tensor:
        h = self.prelu(instance_norm(self.conv_0(x), mask=mask))
        return self.prelu(x + instance_norm(self.conv_1(h), mask=mask))
