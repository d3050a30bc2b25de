"""PMD, the vertex-wise metric of the pose transfer papers."""

import torch
from torch import Tensor

from meshkit.batching import center, masked_mean
from meshkit.metrics._common import check_pair

__all__ = ["pmd"]


def pmd(pred: Tensor, target: Tensor, *, mask: Tensor | None = None, recenter: bool = True) -> Tensor:
    r"""Mean squared coordinate difference between corresponding vertices.

    .. math:: \mathrm{PMD}_b = \frac{1}{3 N_b} \sum_n \lVert (v'_{bn} - c_b) - v_{bn} \rVert_2^2

    where :math:`c_b` is the centre of the bounding box of the prediction. The target is used as it is: centre it
    (:func:`meshkit.batching.center`), as the evaluation data of the papers are, or pass ``recenter=False``.

    Args:
        pred: ``(B, N, 3)`` predicted positions v'.
        target: ``(B, N, 3)`` true positions v, in the same vertex order.
        mask: ``(B, N)`` bool, True = real vertex; None if all are real.
        recenter: subtract :math:`c_b`.

    Returns:
        ``(B,)``, in squared units of length; at least float32. Times 1e3, for metres, it compares with the papers'
        tables.

    Raises:
        ValueError: if shapes or dtypes do not fit, or a sample has no real vertex.

    Reference:
        X-DualNet, section "Evaluation metrics": "Pointwise Mesh Euclidean Distance".

    Deviations:
        The paper does not define PMD. This is the quantity that its released evaluation computes: squared in spite of
        the name, averaged over the three coordinates, and with only the prediction moved.

    Example:
        >>> target = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]]])
        >>> pmd(2 * target + 5, target)  # one of three coordinates is off by 1
        tensor([0.3333])
    """
    check_pair(pred, target, mask)
    pred = pred.to(torch.promote_types(pred.dtype, torch.float32))
    residual = (center(pred, mask) if recenter else pred) - target
    if mask is not None:
        # Before the square, so that padding gets no gradient even where it holds a NaN.
        residual = torch.where(mask[..., None], residual, 0)
    return masked_mean(residual.square().mean(2), mask)
