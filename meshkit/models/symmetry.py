"""Left or right: which of two mirrored matchings each vertex should follow."""

from __future__ import annotations

import torch
from torch import Tensor

from meshkit.topology import unique_edges

__all__ = ["mirror_labels"]

_UNITS = 1000  # of an integer capacity, per mean edge length
_LARGEST = (1 << 31) - 1
_WHOLE = 0.75  # share of the volume that must be left


def mirror_labels(
    verts: Tensor,
    faces: Tensor,
    targets: Tensor,
    mirrored: Tensor,
    partner: Tensor,
    *,
    slack: float = 1.5,
    tie: float = 0.5,
) -> Tensor:
    r"""Choose for each vertex of a symmetric body between its match and that of its mirror image, by a minimum cut.

    A body's left and right look alike, so a learned matching may send a left calf to the right calf of the pose mesh
    while the thigh is matched well; nothing in a reconstruction loss objects. But the leg is torn at the knee then.
    With :math:`t_i^0` the matched position of vertex i, :math:`t_i^1` that of its mirror image, and :math:`\sigma(i)`
    its partner on the other side, the labels :math:`x_i \in \{0, 1\}` minimise

    .. math:: \sum_{ij \in E} \max\bigl(0, \lVert t_i^{x_i} - t_j^{x_j} \rVert - s \lVert v_i - v_j \rVert\bigr)
              + \tau h \sum_i [x_i \ne x_{\sigma(i)}]

    with h the mean edge length: edges may not stretch, and both sides change places together, so that they cannot fold
    onto one. The opposite labels give the mirror image, which is no less whole; of the two, that of the larger signed
    volume (of the body's own sign) has its outside out. Labels that cost the mesh a quarter of its volume have folded
    it all the same, and are not taken.

    Args:
        verts: ``(N, 3)`` the body.
        faces: ``(F, 3)`` its faces, consistently oriented.
        targets: ``(N, 3)`` matched position of each vertex, of a soft matching such as ``plan.barycentric(...)``:
            single best matches jump from vertex to vertex, which tears every edge.
        mirrored: ``(N, 3)`` matched position of each vertex's mirror image.
        partner: ``(N,)`` int64, :math:`\sigma`; need not be an involution.
        slack: s, the stretch that costs nothing.
        tie: :math:`\tau`.

    Returns:
        ``(N,)`` bool, True where the mirrored match is the better one.

    Raises:
        ValueError: shapes do not fit, positions are not finite, or ``faces`` or ``partner`` point to no vertex.

    Reference:
        Kolmogorov and Zabih, "What energy functions can be minimized via graph cuts?", 2004. Not part of the X-DualNet
        paper, whose failure on symmetric limbs it mends. The energy is no cut's where a tear is mended by different
        labels: see :func:`least_labels`.

    Example:
        >>> from meshkit.models import mirror_labels
        >>> verts = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [-1, 0, -1], [1, 0, -1], [0, 1, 0]])
        >>> faces = torch.tensor([[0, 4, 2], [1, 3, 4], [0, 2, 4], [1, 4, 3]])  # two shins that share a hip
        >>> swapped = verts[[0, 1, 3, 2, 4]]  # the feet have changed places
        >>> mirror_labels(verts, faces, swapped, swapped[[1, 0, 3, 2, 4]], torch.tensor([1, 0, 3, 2, 4])).tolist()
        [False, False, True, True, False]
    """
    num = len(verts)
    if verts.shape != (num, 3) or targets.shape != verts.shape or mirrored.shape != verts.shape:
        raise ValueError(
            "verts, targets and mirrored must all be (N, 3), got "
            f"{tuple(verts.shape)}, {tuple(targets.shape)} and {tuple(mirrored.shape)}"
        )
    if partner.shape != (num,):
        raise ValueError(f"partner must be ({num},), got {tuple(partner.shape)}")
    device = verts.device
    for name, points in (("verts", verts), ("targets", targets), ("mirrored", mirrored)):
        if not bool(points.isfinite().all()):
            raise ValueError(f"{name} must be finite")
    for name, index, low in (("faces", faces, -1), ("partner", partner, 0)):  # faces may be padded with -1
        if index.numel() and not low <= int(index.min()) <= int(index.max()) < num:
            raise ValueError(f"{name} must be in [0, {num}), got {int(index.min())} to {int(index.max())}")
    verts, targets, mirrored = (t.detach().double().cpu() for t in (verts, targets, mirrored))
    faces, partner = faces.cpu(), partner.cpu()
    i, j = unique_edges(faces).T
    rest = (verts[i] - verts[j]).norm(dim=1)
    if len(i) == 0 or not float(rest.mean()) > 0:
        return torch.zeros(num, dtype=torch.bool, device=device)
    positions, length, every = (targets, mirrored), rest.mean(), torch.arange(num, device="cpu")
    tails, heads = torch.cat([i, every]), torch.cat([j, partner])
    costs = torch.empty(2, 2, len(tails), dtype=torch.float64, device="cpu")  # of the two labels of each pair
    for a in (0, 1):
        for b in (0, 1):
            stretch = ((positions[a][i] - positions[b][j]).norm(dim=1) - slack * rest).clamp_min(0) / length
            costs[a, b] = torch.cat([stretch, stretch.new_full((num,), tie * float(a != b))])
    labels = least_labels(tails, heads, costs, num)
    none = torch.zeros_like(labels)
    volume, opposite, before, swapped = (
        _volume(torch.where(x[:, None], mirrored, targets), faces) for x in (labels, ~labels, none, ~none)
    )
    if _volume(verts, faces) < 0:  # faces that look inwards
        volume, opposite, before, swapped = -volume, -opposite, -before, -swapped
    if opposite > volume:
        labels, volume = ~labels, opposite
    return (none if volume < _WHOLE * max(before, swapped) else labels).to(device)


def least_labels(tails: Tensor, heads: Tensor, costs: Tensor, num: int) -> Tensor:
    """Labels ``(N,)`` bool of low ``sum costs[x_tail, x_head, edge]``: those of a spanning tree, bettered by a cut.

    Where a matching is torn, the edge wants its ends to differ, which no cut can express. A maximum spanning tree of
    what edges gain by equal or by different labels says which ends should differ; relative to its labels all but the
    weak edges want equal ones.
    """
    wish = costs[0, 0] + costs[1, 1] - costs[0, 1] - costs[1, 0]  # positive: to differ
    start = spanning_labels(tails, heads, wish, num)
    first, second = start[tails].long(), start[heads].long()
    edge = torch.arange(len(tails), device="cpu")
    (same_0, other), (swapped, same_1) = ([costs[first ^ a, second ^ b, edge] for b in (0, 1)] for a in (0, 1))
    surplus = (same_0 + same_1 - other - swapped).clamp_min(0) / 2
    other, swapped = other + surplus, swapped + surplus
    # same_0 + (swapped - same_0) y_i + (same_1 - swapped) y_j + (other + swapped - same_0 - same_1) (1 - y_i) y_j
    linear = costs.new_zeros(num).index_add_(0, tails, swapped - same_0)
    linear.index_add_(0, heads, same_1 - swapped)
    return start ^ minimum_cut(tails, heads, (other + swapped - same_0 - same_1).clamp_min(0), linear)


def spanning_labels(tails: Tensor, heads: Tensor, wish: Tensor, num: int) -> Tensor:
    """Labels ``(N,)`` bool that grant the wishes along a maximum spanning tree; a wish above 0 is to differ."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

    proper = tails != heads
    low, high = torch.minimum(tails, heads)[proper], torch.maximum(tails, heads)[proper]
    pairs, inverse = torch.unique(low * num + high, return_inverse=True)
    total = wish.new_zeros(len(pairs)).index_add_(0, inverse, wish[proper])
    strength = total.abs()
    length = strength.amax() + 1 - strength if len(total) else strength  # positive, the least for the strongest
    places = (pairs // num).numpy(), (pairs % num).numpy()
    tree = minimum_spanning_tree(coo_array((length.numpy(), places), shape=(num, num)).tocsr())
    differ = dict(zip(pairs.tolist(), (total > 0).tolist(), strict=True))
    labels = [False] * num
    _, component = connected_components(tree, directed=False)
    for root in torch.from_numpy(component).unique().tolist():
        order, before = breadth_first_order(tree, int((component == root).argmax()), directed=False)
        for vertex in order[1:].tolist():
            parent = int(before[vertex])
            labels[vertex] = labels[parent] ^ differ[min(parent, vertex) * num + max(parent, vertex)]
    return torch.tensor(labels, device="cpu")


def minimum_cut(tails: Tensor, heads: Tensor, capacities: Tensor, cost_of_1: Tensor) -> Tensor:
    """Labels ``(N,)`` bool that minimise ``sum capacity (1 - x_tail) x_head + sum cost_of_1 x``, to rounding."""
    import numpy as np
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    num = len(cost_of_1)
    source, sink, every = num, num + 1, torch.arange(num, device="cpu")
    # On the sink's side lies label 1: its cost is paid on the edge from the source, that of 0 on the edge to the sink.
    rows = torch.cat([tails, tails.new_full((num,), source), every])
    columns = torch.cat([heads, every, heads.new_full((num,), sink)])
    weights = torch.cat([capacities, cost_of_1.clamp_min(0), (-cost_of_1).clamp_min(0)])
    whole = (_UNITS * weights).round().clamp_max(_LARGEST // 8)
    graph = coo_array((whole.numpy(), (rows.numpy(), columns.numpy())), shape=(num + 2, num + 2)).tocsr()
    graph.data = np.minimum(graph.data, _LARGEST // 8)
    graph = csr_array(graph.astype(np.int32))
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    labels = torch.ones(num + 2, dtype=torch.bool, device="cpu")
    labels[torch.from_numpy(breadth_first_order(residual, source, return_predecessors=False).astype(np.int64))] = False
    return labels[:num]


def _volume(verts: Tensor, faces: Tensor) -> float:
    """Six times the signed volume, about the mean."""
    a, b, c = (verts - verts.mean(0))[faces[(faces >= 0).all(1)]].unbind(1)
    return float((torch.linalg.cross(a, b) * c).sum())
