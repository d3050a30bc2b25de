"""The set-convolution extractor as published: full distance matrix, argsort, concatenation, three 1 x 1 convolutions.

Slow and large on purpose. It is the oracle of the tests and the other side of the benchmark.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, instance_norm, leaky_relu

from meshkit.nn import SetConv, SetConvExtractor


def argsort_knn(points: Tensor, k: int) -> Tensor:
    """Neighbours ``(B, N, k)`` from the sorted rows of the distance matrix ``(B, N, N)``."""
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    return distances.argsort(2)[:, :, :k]


def gather(x: Tensor, nearest: Tensor) -> Tensor:
    return x[torch.arange(len(x))[:, None, None], nearest]


def setconv_literally(conv: SetConv, x: Tensor, positions: Tensor, nearest: Tensor) -> Tensor:
    """x (B, N, C), positions (B, N, 3), nearest (B, N, k): the layer, with the parameters of ``conv``."""
    relative = (gather(positions, nearest) - positions[:, :, None]).detach()
    h = torch.cat([gather(x, nearest), relative], 3).permute(0, 3, 1, 2)
    for linear, scale, shift in zip(conv.linears, conv.scales, conv.shifts, strict=True):
        assert isinstance(linear, nn.Linear)
        h = conv2d(h, linear.weight[:, :, None, None])
        h = instance_norm(h, weight=scale, bias=shift, eps=1e-5)  # over vertices and neighbours
        h = leaky_relu(h, conv.slope)
    return h.max(3).values.mT


def extractor_literally(extractor: SetConvExtractor, positions: Tensor, descriptors: Tensor | None = None) -> Tensor:
    nearest = argsort_knn(positions.detach(), extractor.k)
    x = positions if descriptors is None else torch.cat([positions, descriptors], 2)
    for conv in extractor.convs:
        assert isinstance(conv, SetConv)
        x = setconv_literally(conv, x, positions, nearest)
    return x
