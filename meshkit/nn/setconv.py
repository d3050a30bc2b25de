"""PointNet++-like convolutions over nearest neighbours, and the feature extractor made of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from meshkit.neighbors import knn

__all__ = ["SetConv", "SetConvExtractor"]


class SetConv(nn.Module):
    r"""Convolution over the k nearest neighbours of each vertex.

    .. math:: y_i = \max_{j \in \mathrm{kNN}(i)} \phi_3\,\phi_2\,\phi_1\,[x_j,\; p_j - p_i], \qquad
              \phi_l(h) = \mathrm{LeakyReLU}_{0.1}(\mathrm{InstanceNorm}(W_l h))

    with statistics over all (vertex, neighbour) pairs of a sample. The first linear map is split,
    :math:`W_1 [x_j, p_j - p_i] = (W_x x_j + W_p p_j) - W_p p_i`: N products instead of N k. The relative positions
    carry no gradient.

    Args:
        in_features: channels of ``x``.
        out_features: channels of the result.
        slope: of the LeakyReLU.

    Shape:
        ``x (B, N, C)``, ``positions (B, N, 3)``, ``neighbors (B, N, k)`` int64; the result is ``(B, N, out_features)``.

    Reference:
        X-DualNet, "Network architecture" (pointnet++-like conv). Layer sizes as in the released code, which takes the
        layer from FLOT (Puy et al.).

    Example:
        >>> points = torch.randn(2, 50, 3)
        >>> SetConv(3, 16)(points, points, knn(points, 8)).shape
        torch.Size([2, 50, 16])
    """

    def __init__(self, in_features: int, out_features: int, *, slope: float = 0.1) -> None:
        super().__init__()
        self.slope, self.in_features, self.out_features = slope, in_features, out_features
        widths = [in_features + 3, out_features, out_features, out_features]
        self.linears = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in pairwise(widths))
        self.scales = nn.ParameterList(nn.Parameter(torch.ones(out_features)) for _ in self.linears)
        self.shifts = nn.ParameterList(nn.Parameter(torch.zeros(out_features)) for _ in self.linears)

    def forward(self, x: Tensor, positions: Tensor, neighbors: Tensor, *, mask: Tensor | None = None) -> Tensor:
        """Convolve ``x`` at ``positions`` over ``neighbors``; ``mask`` is ``(B, N)``, True = real vertex."""
        if mask is not None:
            x, positions = (t.masked_fill(~mask[..., None], 0.0) for t in (x, positions))
        to_features, to_position = self.linears[0].get_parameter("weight").split([self.in_features, 3], 1)
        offset = nn.functional.linear(positions.detach(), to_position)
        lifted = nn.functional.linear(x, to_features) + offset
        # One sample at a time: instance norm is then the native batch norm over rows, padding is cut off instead of
        # masked, and tensors of N k rows stay small enough for the cache.
        rows = [self._convolve(*sample) for sample in _samples(mask, lifted, offset, neighbors)]
        if mask is None:
            return torch.stack(rows)
        out = x.new_zeros(*mask.shape, self.out_features, dtype=rows[0].dtype)
        return out.masked_scatter(mask[..., None], torch.cat(rows))

    def _convolve(self, lifted: Tensor, offset: Tensor, neighbors: Tensor) -> Tensor:
        h = lifted.index_select(0, neighbors.flatten()).view(*neighbors.shape, -1) - offset[:, None]
        h = self._normalise(h.flatten(0, 1), 0)
        for layer in range(1, len(self.linears)):
            h = self._normalise(self.linears[layer](h), layer)
        return h.view(*neighbors.shape, -1).amax(1)

    def _normalise(self, h: Tensor, layer: int) -> Tensor:
        scale, shift = self.scales[layer], self.shifts[layer]
        h = nn.functional.batch_norm(h, None, None, scale, shift, training=True, momentum=0.0, eps=1e-5)
        return nn.functional.leaky_relu(h, self.slope, inplace=True)


def _samples(mask: Tensor | None, *tensors: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """The real rows of each sample. Padding may stand anywhere; neighbours are re-numbered to match."""
    for b, sample in enumerate(zip(*tensors, strict=True)):
        if mask is None:
            yield sample
        else:
            *values, neighbors = (t[mask[b]] for t in sample)
            yield *values, (mask[b].cumsum(0) - 1)[neighbors]


class SetConvExtractor(nn.Module):
    """Vertex features from positions (and optional descriptors): a stack of :class:`SetConv` over one kNN graph.

    Args:
        widths: channels of the convolutions; the paper has 32, 64, 128.
        k: neighbours of each vertex, itself included; the released code has 32.
        descriptors: number of descriptor channels appended to the coordinates at the input.

    Shape:
        ``positions (B, N, 3)``, ``descriptors (B, N, D)`` or ``None``, ``mask (B, N)``; result ``(B, N, widths[-1])``.

    Raises:
        ValueError: descriptors missing, unexpected or of the wrong shape; fewer than ``k`` vertices.

    Example:
        >>> SetConvExtractor((8, 16), k=4)(torch.randn(1, 30, 3)).shape
        torch.Size([1, 30, 16])
    """

    def __init__(self, widths: Sequence[int] = (32, 64, 128), *, k: int = 32, descriptors: int = 0) -> None:
        super().__init__()
        self.k, self.descriptors, self.out_features = k, descriptors, widths[-1]
        inputs = [3 + descriptors, *widths[:-1]]
        self.convs = nn.ModuleList(SetConv(i, o) for i, o in zip(inputs, widths, strict=True))

    def forward(self, positions: Tensor, *, descriptors: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Features of each vertex."""
        given = 0 if descriptors is None else descriptors.shape[-1]
        if given != self.descriptors:
            raise ValueError(
                f"this extractor takes {self.descriptors} descriptor channels, got {given}"
                + ("" if given else ": compute them with meshkit.descriptors.wave_kernel_signature")
            )
        if mask is not None:
            positions = positions.masked_fill(~mask[..., None], 0.0)
        neighbors = knn(positions, self.k, mask=mask)
        x = positions
        if descriptors is not None:
            if mask is not None:
                descriptors = descriptors.masked_fill(~mask[..., None], 0.0)
            x = torch.cat([positions, descriptors.to(positions.dtype)], 2)
        for conv in self.convs:
            x = conv(x, positions, neighbors, mask=mask)
        return x
