"""The conditional blocks that generate vertices from the warped mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from meshkit._checks import check_widths
from meshkit._repr import settings
from meshkit.nn import ConditionalResBlock
from meshkit.norm import ElaIN

__all__ = ["PoseTransferStack"]


class PoseTransferStack(nn.Module):
    r"""Conditional residual blocks that turn the warped mesh into the output.

    ``3 -> w_0 -> block -> w_1 -> block -> ... -> 3``, then :math:`2 \tanh`: coordinates stay within two units of the
    centre, so meshes must be centred and scaled to metres (or any unit that keeps them in reach).

    Args:
        cond_features: channels of the condition (the identity's features).
        widths: channels of the residual blocks; the paper has 1024, 512, 256.
        norm: conditional norm of the blocks, see :class:`~meshkit.nn.ConditionalResBlock`.
        spectral: spectral normalisation in the blocks.
        residual: add the warped mesh to the output: the stack then learns a displacement.

    Raises:
        ValueError: no ``widths``, or a number of channels that is not a positive whole number.

    Shape:
        ``warped (B, N, 3)``, ``features (B, N, D)``, ``mask (B, N)``; the result is ``(B, N, 3)``.

    Reference:
        X-DualNet, appendix, table of the network architecture.

    Deviations:
        The paper's first convolution is 3 x 3 along the vertex order, which makes the result depend on an order that
        is random. Here every map is per vertex, so the stack is permutation-equivariant.
    """

    def __init__(
        self,
        cond_features: int,
        widths: Sequence[int],
        *,
        norm: Callable[[int, int], nn.Module] = ElaIN,
        spectral: bool = True,
        residual: bool = False,
    ) -> None:
        super().__init__()
        check_widths(widths)
        self.residual = residual
        self.lift = nn.Linear(3, widths[0])
        self.mix = nn.Linear(widths[0], widths[0])
        self.blocks = nn.ModuleList(ConditionalResBlock(w, cond_features, norm=norm, spectral=spectral) for w in widths)
        self.narrow = nn.ModuleList(nn.Linear(i, o) for i, o in zip(widths, [*widths[1:], 3], strict=True))

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "residual")

    def forward(self, warped: Tensor, features: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Generate vertices from the warped mesh under the identity's features."""
        # Nothing lies between the first two maps, so they are evaluated as one 3 -> w_0 map.
        weight = self.mix.weight @ self.lift.weight
        x = nn.functional.linear(warped, weight, self.mix(self.lift.bias))
        for block, narrow in zip(self.blocks, self.narrow, strict=True):
            x = block(x, features, mask=mask, cond_mask=mask, then=narrow)
        x = 2 * torch.tanh(x.float() if x.dtype in (torch.float16, torch.bfloat16) else x)
        return x + warped if self.residual else x
