"""PointNet++-like convolutions over nearest neighbours, and the feature extractor made of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from meshkit._checks import check_channels, check_descriptors, check_dtype, check_features, check_whole, check_widths
from meshkit._repr import settings
from meshkit.batching import check_mask
from meshkit.neighbors import gather_vertices, knn
from meshkit.nn._edge_mlp import EPS, edge_mlp
from meshkit.scatter import segment_sum

__all__ = ["SetConv", "SetConvExtractor"]


class SetConv(nn.Module):
    r"""Convolution over the k nearest neighbours of each vertex.

    .. math:: y_i = \max_{j \in \mathrm{kNN}(i)} \phi_3\,\phi_2\,\phi_1\,[x_j,\; p_j - p_i], \qquad
              \phi_l(h) = \mathrm{LeakyReLU}_{0.1}(\mathrm{InstanceNorm}(W_l h))

    with statistics over all (vertex, neighbour) pairs of a sample. The relative positions carry no gradient, as in the
    released code, unless ``relative_gradient`` asks for it; the choice of neighbours never does.

    The evaluation is exact but not literal. The first linear map is split, :math:`W_1 [x_j, p_j - p_i] = (W_x x_j +
    W_p p_j) - W_p p_i`: N products instead of N k. The statistics of its result follow from the covariance of
    :math:`[x_j, p_j - p_i]`, so that the first norm is part of the map. The last norm and activation come after the
    maximum (a negative scale turns the sign of its row of :math:`W_3` first). What is left goes through blocks of
    vertices, and so does the hand-written gradient, which has no derivative of its own. Under autocast the products of
    the N k rows are in low precision, statistics and the rest in float32. torch.compile traces the layer as one graph.

    Args:
        in_features: channels of ``x``.
        out_features: channels of the result.
        slope: of the LeakyReLU, not negative.
        relative_gradient: ``p_j - p_i`` carries its gradient too, so that the one to the positions is whole.
        recompute: hold nothing of size N k between forward and backward, nor within them, at 1.7 times the matrix
            products; else one tensor ``(B, N k, out_features)`` is kept for the backward.

    Shape:
        ``x (B, N, C)``, ``positions (B, N, 3)``, ``neighbors (B, N, k)`` int64; the result is ``(B, N, out_features)``,
        0 at padded vertices.

    Raises:
        ValueError: negative slope, no channels, or shapes that do not fit.
        TypeError: no tensors, ``neighbors`` that are not int64, or ``x`` and the parameters in two dtypes.

    Reference:
        X-DualNet, "Network architecture" (pointnet++-like conv). Layer sizes as in the released code, which takes the
        layer from FLOT (Puy et al.).

    Example:
        >>> points = torch.randn(2, 50, 3)
        >>> SetConv(3, 16)(points, points, knn(points, 8)).shape
        torch.Size([2, 50, 16])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        slope: float = 0.1,
        recompute: bool = False,
        relative_gradient: bool = False,
    ) -> None:
        super().__init__()
        if not slope >= 0:
            raise ValueError(f"slope must not be negative (the maximum is taken before the activation), got {slope}")
        check_whole(in_features, "in_features")
        check_whole(out_features, "out_features")
        self.slope, self.in_features, self.out_features, self.recompute = slope, in_features, out_features, recompute
        self.relative_gradient = relative_gradient
        widths = [in_features + 3, out_features, out_features, out_features]
        self.linears = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in pairwise(widths))
        self.scales = nn.ParameterList(nn.Parameter(torch.ones(out_features)) for _ in self.linears)
        self.shifts = nn.ParameterList(nn.Parameter(torch.zeros(out_features)) for _ in self.linears)

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return f"{self.in_features}, {self.out_features}, {settings(self, 'slope', 'recompute', 'relative_gradient')}"

    def forward(
        self, x: Tensor, positions: Tensor, neighbors: Tensor | Neighborhoods, *, mask: Tensor | None = None
    ) -> Tensor:
        """Convolve ``x`` at ``positions`` over ``neighbors``; ``mask`` is ``(B, N)``, True = real vertex."""
        check_features(x)
        check_channels(x, self.in_features)
        check_dtype(x, self)
        if isinstance(neighbors, Neighborhoods):
            graph = neighbors
        else:
            _check_graph(x, positions, neighbors, mask)
            graph = neighborhoods(positions, neighbors, mask, gradient=self.relative_gradient)
        kind = x.device.type
        products = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else x.dtype
        with torch.autocast(kind, enabled=False):
            w1, w2, w3 = (cast(nn.Linear, linear).weight for linear in self.linears)
            u, v = self._first(x if graph.mask is None else x.masked_fill(~graph.mask[..., None], 0.0), w1, graph)
            sign = torch.where(self.scales[2] < 0, -1, 1).to(w3)
            best, mean, variance = edge_mlp(
                *(u, v, w2, self.scales[1], self.shifts[1], sign[:, None] * w3, graph.neighbors, graph.mask),
                slope=self.slope,
                recompute=self.recompute,
                dtype=products,
            )
            scale = sign * self.scales[2] * (variance + EPS).rsqrt()
            y = torch.addcmul((self.shifts[2] - scale * mean)[:, None], best, scale[:, None])
            y = nn.functional.leaky_relu(y, self.slope)
            return (y if graph.mask is None else y.masked_fill(~graph.mask[..., None], 0.0)).to(x.dtype)

    def _first(self, x: Tensor, weight: Tensor, graph: Neighborhoods) -> tuple[Tensor, Tensor]:
        """``u`` and ``v`` of the normalised first layer, u_j - v_i."""
        x, weight = x.to(graph.positions), weight.to(graph.positions)
        degree, rows = graph.degree[..., None], graph.rows[:, None, None]
        mean = (degree * x).sum(1, keepdim=True) / rows
        x = x - mean
        mixed = x.mT @ graph.offsets / rows
        covariance = torch.cat(
            [torch.cat([x.mT @ (degree * x) / rows, mixed], 2), torch.cat([mixed.mT, graph.covariance], 2)], 1
        )
        variance = ((weight @ covariance) * weight).sum(2).clamp_min(0)
        scale = self.scales[0] * (variance + EPS).rsqrt()
        folded = (scale[..., None] * weight).mT
        to_position = folded[:, self.in_features :]
        shift = self.shifts[0] - graph.mean @ to_position
        u = torch.baddbmm(shift, torch.cat([x, graph.positions], 2), folded)
        return u, graph.positions @ to_position


def _check_graph(x: Tensor, positions: Tensor, neighbors: Tensor, mask: Tensor | None) -> None:
    """Name what does not fit ``x (B, N, C)``; indices out of range are left to the lookup."""
    check_features(positions, name="positions", layout="(B, N, 3)")
    check_channels(positions, 3, name="positions")
    check_features(neighbors, name="neighbors", layout="(B, N, k)")
    if neighbors.dtype != torch.int64:
        raise TypeError(f"neighbors must be int64 indices, as meshkit.neighbors.knn gives them, got {neighbors.dtype}")
    if not x.shape[:2] == positions.shape[:2] == neighbors.shape[:2]:
        raise ValueError(
            f"x, positions and neighbors must agree in B and N, got {tuple(x.shape)}, {tuple(positions.shape)} and "
            f"{tuple(neighbors.shape)}"
        )
    check_mask(mask, *x.shape[:2])


class Neighborhoods(NamedTuple):
    """A kNN graph and the moments of its relative positions d = p_j - p_i."""

    positions: Tensor  # (B, N, 3), about their mean; at least float32
    neighbors: Tensor  # (B, N, k)
    mask: Tensor | None
    rows: Tensor  # (B,), number of (vertex, neighbour) pairs
    degree: Tensor  # (B, N), in how many neighbourhoods each vertex is
    offsets: Tensor  # (B, N, 3), sum over these of d, less the mean of d each
    mean: Tensor  # (B, 1, 3), of d
    covariance: Tensor  # (B, 3, 3), of d


def neighborhoods(
    positions: Tensor, neighbors: Tensor, mask: Tensor | None, *, gradient: bool = False
) -> Neighborhoods:
    """What :class:`SetConv` needs to know of its graph."""
    positions = positions if gradient else positions.detach()
    with torch.autocast(positions.device.type, enabled=False):
        return _neighborhoods(positions.to(torch.promote_types(positions.dtype, torch.float32)), neighbors, mask)


def _neighborhoods(positions: Tensor, neighbors: Tensor, mask: Tensor | None) -> Neighborhoods:
    batch, num, k = neighbors.shape
    if mask is None:
        real = positions.new_ones(batch, num, 1)
    else:
        real = mask[..., None].to(positions)
        positions = positions.masked_fill(~mask[..., None], 0.0)
    count = real.sum(1, keepdim=True).clamp_min(1)
    positions = (positions - positions.sum(1, keepdim=True) / count) * real
    rows = k * count
    relative = (gather_vertices(positions, neighbors) - positions[:, :, None]) * real[..., None]
    mean = relative.sum((1, 2))[:, None] / rows
    flat = relative.flatten(1, 2)
    covariance = flat.mT @ flat / rows - mean.mT @ mean
    start = num * torch.arange(batch, device=neighbors.device)[:, None, None]
    ones = real[..., None].expand(-1, -1, k, 1)
    sums = segment_sum(torch.cat([relative, ones], 3).view(-1, 4), (neighbors + start).flatten(), batch * num)
    offsets, degree = sums.view(batch, num, 4).split([3, 1], 2)
    offsets = offsets - degree * mean
    return Neighborhoods(positions, neighbors, mask, rows[:, 0, 0], degree[..., 0], offsets, mean, covariance)


class SetConvExtractor(nn.Module):
    """Vertex features from positions (and optional descriptors): a stack of :class:`SetConv` over one kNN graph.

    Args:
        widths: channels of the convolutions; the paper has 32, 64, 128.
        k: neighbours of each vertex, itself included; the released code has 32.
        descriptors: number of descriptor channels appended to the coordinates at the input.
        recompute: as in :class:`SetConv`.
        relative_gradient: likewise.

    Shape:
        ``positions (B, N, 3)``, ``descriptors (B, N, D)`` or ``None``, ``mask (B, N)``; result ``(B, N, widths[-1])``.

    Raises:
        ValueError: no widths, or numbers of channels or neighbours that are no positive whole numbers; descriptors
            missing, unexpected or of the wrong shape; fewer than ``k`` vertices.
        TypeError: no tensors, or ``positions`` and the parameters in two dtypes.

    Example:
        >>> SetConvExtractor((8, 16), k=4)(torch.randn(1, 30, 3)).shape
        torch.Size([1, 30, 16])
    """

    def __init__(
        self,
        widths: Sequence[int] = (32, 64, 128),
        *,
        k: int = 32,
        descriptors: int = 0,
        recompute: bool = False,
        relative_gradient: bool = False,
    ) -> None:
        super().__init__()
        check_widths(widths)
        check_whole(k, "k")
        check_whole(descriptors, "descriptors", least=0)
        self.k, self.descriptors, self.out_features = k, descriptors, widths[-1]
        inputs = [3 + descriptors, *widths[:-1]]
        options = {"recompute": recompute, "relative_gradient": relative_gradient}
        self.relative_gradient = relative_gradient
        self.convs = nn.ModuleList(SetConv(i, o, **options) for i, o in zip(inputs, widths, strict=True))

    def extra_repr(self) -> str:
        """Options in the printed module."""
        return settings(self, "k", "descriptors", "relative_gradient")

    def forward(self, positions: Tensor, *, descriptors: Tensor | None = None, mask: Tensor | None = None) -> Tensor:
        """Features of each vertex."""
        check_features(positions, name="positions", layout="(B, N, 3)")
        if positions.shape[2] != 3:
            hint = (
                "transpose them with positions.mT" if positions.shape[1] == 3 else "further channels go to descriptors"
            )
            raise ValueError(f"positions must have shape (B, N, 3), got {tuple(positions.shape)}; {hint}")
        check_dtype(positions, self, name="positions")
        check_mask(mask, *positions.shape[:2])
        check_descriptors(descriptors, positions, self.descriptors)
        if mask is not None:
            positions = positions.masked_fill(~mask[..., None], 0.0)
        neighbors = knn(positions.detach(), self.k, mask=mask)
        graph = neighborhoods(positions, neighbors, mask, gradient=self.relative_gradient)
        x = positions
        if descriptors is not None:
            if mask is not None:
                descriptors = descriptors.masked_fill(~mask[..., None], 0.0)
            x = torch.cat([positions, descriptors.to(positions.dtype)], 2)
        for conv in self.convs:
            x = conv(x, positions, graph, mask=mask)
        return x
