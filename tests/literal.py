"""Literal transcriptions of the pose-transfer stack: channels first, one convolution per equation, nothing shared.

They are what the package's composed evaluation must equal (tests) and what it is measured against (benchmarks).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu
from torch.nn.utils.parametrizations import spectral_norm


class LiteralElaIN(nn.Module):
    """ElaIN of the released code on ``x (B, C, N)`` and ``cond (B, D, N)``."""

    def __init__(self, num_features: int, cond_features: int) -> None:
        super().__init__()
        self.shared = nn.Conv1d(cond_features, num_features, 1)
        self.gamma = nn.Conv1d(num_features, num_features, 1)
        self.beta = nn.Conv1d(num_features, num_features, 1)
        self.weight = nn.Conv1d(2 * num_features, num_features, 1)

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        h = self.shared(cond)
        mean, std = x.mean(2, keepdim=True), (x.var(2, keepdim=True) + 1e-5).sqrt()
        w = self.weight(torch.cat([h.mean(2, keepdim=True), x.mean(2, keepdim=True)], 1))
        gamma = w * self.gamma(h) + (1 - w) * std
        beta = w * self.beta(h) + (1 - w) * mean
        return (1 + gamma) * ((x - mean) / std) + beta


class LiteralBlock(nn.Module):
    """Residual block of the released code: three ElaINs, three convolutions under spectral normalisation."""

    def __init__(self, num_features: int, cond_features: int, *, spectral: bool = True) -> None:
        super().__init__()
        wrap = spectral_norm if spectral else nn.Identity()
        self.norm_0, self.norm_1, self.norm_s = (LiteralElaIN(num_features, cond_features) for _ in range(3))
        self.conv_0, self.conv_1 = (wrap(nn.Conv1d(num_features, num_features, 1)) for _ in range(2))
        self.conv_s = wrap(nn.Conv1d(num_features, num_features, 1, bias=False))

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        shortcut = self.conv_s(leaky_relu(self.norm_s(x, cond), 0.2))
        x = self.conv_0(leaky_relu(self.norm_0(x, cond), 0.2))
        return self.conv_1(leaky_relu(self.norm_1(x, cond), 0.2)) + shortcut


class LiteralStack(nn.Module):
    """The pose-transfer stack, ``warped (B, N, 3)`` and ``cond (B, N, D)`` to ``(B, N, 3)``."""

    def __init__(self, cond_features: int, widths: Sequence[int], *, spectral: bool = True) -> None:
        super().__init__()
        self.lift = nn.Conv1d(3, widths[0], 1)
        self.mix = nn.Conv1d(widths[0], widths[0], 1)
        self.blocks = nn.ModuleList(LiteralBlock(w, cond_features, spectral=spectral) for w in widths)
        self.narrow = nn.ModuleList(nn.Conv1d(i, o, 1) for i, o in zip(widths, [*widths[1:], 3], strict=True))

    def forward(self, warped: Tensor, cond: Tensor) -> Tensor:
        x, cond = self.mix(self.lift(warped.mT)), cond.mT
        for block, narrow in zip(self.blocks, self.narrow, strict=True):
            x = narrow(block(x, cond))
        return 2 * torch.tanh(x).mT

    def load(self, state: dict[str, Tensor]) -> LiteralStack:
        """Take the parameters of a composed stack, whose linear maps are matrices without the kernel dimension."""
        own = self.state_dict()
        self.load_state_dict({name: value.reshape(own[name].shape) for name, value in state.items()})
        return self
