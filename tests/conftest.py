"""What several test files share: reproducible numbers, padding at any place, and closeness in norm."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

GARBAGE = [1e20, math.nan]


def rand(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Normal deviates, the same in every run."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def scattered_mask(lengths: Sequence[int], size: int, seed: int = 0) -> Tensor:
    """``(B, size)`` mask with ``lengths[b]`` real rows at random places."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.zeros(len(lengths), size, dtype=torch.bool)
    for row, length in zip(mask, lengths, strict=True):
        row[torch.randperm(size, generator=generator)[:length]] = True
    return mask


def scatter(samples: Sequence[Tensor], mask: Tensor, fill: float) -> Tensor:
    """Batch ``(B, N, C)``: the rows of the samples, in their order, where ``mask`` is True; ``fill`` elsewhere."""
    padded = samples[0].new_full((*mask.shape, samples[0].shape[1]), fill)
    padded[mask] = torch.cat([sample.detach() for sample in samples])
    return padded


def assert_near(value: Tensor, expected: Tensor, tol: float, *, scale: float | None = None) -> None:
    """Largest difference within ``tol`` times the largest expected magnitude (or ``scale``)."""
    assert value.shape == expected.shape, f"{tuple(value.shape)} against {tuple(expected.shape)}"
    assert bool(torch.isfinite(value).all()), f"{int((~torch.isfinite(value)).sum())} of {value.numel()} are not finite"
    size = expected.abs().amax().item() if scale is None else scale
    error = (value - expected.to(value.dtype)).abs().amax().item()
    assert error <= tol * size, f"error {error:.2e} for values of size {size:.2e}, allowed {tol:.0e} of it"
