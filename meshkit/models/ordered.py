"""The pose-transfer stack of the released code, which looks along the vertex order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from meshkit.models.stack import PoseTransferStack
from meshkit.norm import ElaIN

__all__ = ["OrderedPoseTransferStack"]


class OrderedPoseTransferStack(PoseTransferStack):
    r""":class:`~meshkit.models.PoseTransferStack` whose first map is a convolution of kernel 3 along the vertex order.

    .. math:: x_n = W_{-1} v_{n-1} + W_0 v_n + W_1 v_{n+1} + b

    with zeros before the first and after the last real vertex. The neighbours in the order of a mesh file, or in the
    random order that the released code trains on, are no neighbours on the surface, and the result depends on the
    order. On the shipped bodies (1000 and 6890 vertices, ``xdualnet(released=True)`` with random weights, seed 0),
    permuting the identity's vertices and permuting the result back changes it by 1.1 times its own norm; the default
    ``xdualnet()`` changes by 2e-5, which is rounding in float32.

    Args:
        cond_features: channels of the condition (the identity's features).
        widths: channels of the residual blocks.
        norm: conditional norm of the blocks.
        spectral: spectral normalisation in the blocks.
        residual: add the warped mesh to the output.

    Shape:
        ``warped (B, N, 3)``, ``features (B, N, D)``, ``mask (B, N)``; the result is ``(B, N, 3)``. Under a mask, the
        order is that of the real vertices.

    Reference:
        X-DualNet, appendix, table of the network architecture (Conv1d 3 x 3), and the released code.

    Example:
        >>> OrderedPoseTransferStack(8, (32, 16))(torch.randn(1, 20, 3), torch.randn(1, 20, 8)).shape
        torch.Size([1, 20, 3])
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
        super().__init__(cond_features, widths, norm=norm, spectral=spectral)
        self.add_warped = residual
        self.lift = nn.Linear(9, widths[0])  # columns: previous, own, next

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return f"residual={self.add_warped}"

    def forward(self, warped: Tensor, features: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Generate vertices from the warped mesh under the identity's features."""
        result = super().forward(_window(warped, mask), features, mask=mask)
        return result + warped if self.add_warped else result


def _window(x: Tensor, mask: Tensor | None) -> Tensor:
    """Each row with the one before and the one after it: ``(B, N, C)`` to ``(B, N, 3 C)``."""
    if mask is None:
        return torch.cat([pad(x, (0, 0, 1, 0))[:, :-1], x, pad(x, (0, 0, 0, 1))[:, 1:]], 2)
    # The real rows move to the front, in their order, with zeros after them; then back.
    order = (~mask).to(torch.uint8).argsort(stable=True, dim=1)[..., None]
    front = x.masked_fill(~mask[..., None], 0.0).take_along_dim(order, 1)
    return _window(front, None).take_along_dim(order.argsort(1), 1)
