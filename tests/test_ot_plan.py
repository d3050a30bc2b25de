"""Readings of a transport plan against the stored matrix; its life in the autograd graph; the memory it holds."""

import gc
import itertools
import weakref

import pytest
import torch
from conftest import assert_near, rand, scattered_mask
from literal_ot import (  # noqa: F401
    READINGS,
    algorithm_1,
    cost_matrix,
    domains,
    leaves,
    literal_batch,
    one_by_one,
    readings,
    set_rows,
)
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.autograd import gradcheck
from torch.profiler import ProfilerActivity, profile
from torch.utils.checkpoint import checkpoint

from meshkit.ot import TransportPlan, clear_workspace, sinkhorn, sinkhorn_from_cost, workspace

MASKS = {"mask_x": torch.tensor([[True] * 4, [True, False, True, True]])}


# Gradients of the readings


def some_columns(plan: TransportPlan) -> Tensor:
    """One of each row, but of the second none."""
    columns = torch.arange(plan.shape[1], device=plan.device) % plan.shape[2]
    columns[1] = -1
    return columns.expand(plan.shape[0], -1)


FURTHER = {
    "row_potential": lambda p, v, u: p.potentials[0].nan_to_num(neginf=0.0),
    "column_potential": lambda p, v, u: p.potentials[1],
    "residual": lambda p, v, u: p.residual,
    "topk": lambda p, v, u: p.topk(2)[0],
    "topk_columns": lambda p, v, u: p.topk(3, dim=1)[0],
    "T-topk": lambda p, v, u: p.T.topk(2)[0],
    "log_dense": lambda p, v, u: p.log_dense().nan_to_num(neginf=0.0),
    "log_at": lambda p, v, u: p.log_at(some_columns(p)).nan_to_num(neginf=0.0),
    "T-log_at": lambda p, v, u: p.T.log_at(some_columns(p.T)).nan_to_num(neginf=0.0),
}
ALL = {**{name: read for name, (read, _) in READINGS.items()}, **FURTHER}


@domains
@pytest.mark.parametrize("reading", ALL)
def test_gradcheck(reading, domain):
    def function(fx: Tensor, fy: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return ALL[reading](sinkhorn(fx, fy, eps=0.2, n_iters=3, domain=domain, **MASKS), v, u)

    assert gradcheck(function, leaves((2, 4, 3), (2, 3, 3), (2, 3, 2), (2, 4, 2)), fast_mode=True)


@domains
@pytest.mark.parametrize("reading", ["barycentric", "row_sums", "cost", "entropy", "topk", "row_potential"])
def test_gradcheck_unbalanced(reading, domain):
    def function(fx: Tensor, fy: Tensor, v: Tensor, u: Tensor) -> Tensor:
        plan = sinkhorn(fx, fy, eps=0.3, n_iters=3, reach=(0.4, 0.9), domain=domain, **MASKS)
        return ALL[reading](plan, v, u)

    assert gradcheck(function, leaves((2, 4, 3), (2, 3, 3), (2, 3, 2), (2, 4, 2)), fast_mode=True)


@domains
def test_residual_is_the_violation_of_both_marginals(domain):
    fx, fy = leaves((2, 7, 3), (2, 5, 3))
    for reach, powers in ((None, (1.0, 1.0)), (0.5, (0.5 / 0.7, 0.5 / 0.7))):
        plan = sinkhorn(fx, fy, eps=0.2, n_iters=2, reach=reach, domain=domain)
        dense = literal_batch([cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)], 0.2, 2, powers=powers)
        expected = (dense.sum(2) - 1 / 7).abs().sum(1) + (dense.sum(1) - 1 / 5).abs().sum(1)
        assert_near(plan.residual, expected, 1e-12)
        assert_near(plan.T.residual, expected, 1e-12)


# Indices


@pytest.fixture
def padded() -> TransportPlan:
    """Padding, a weight of zero, and blocks of rows."""
    a = rand(2, 30, seed=4).exp()
    a[0, 3] = 0
    masks = {"mask_x": scattered_mask([30, 21], 30), "mask_y": scattered_mask([20, 9], 20, seed=1)}
    a = a * masks["mask_x"]
    return sinkhorn(rand(2, 30, 5), rand(2, 20, 5, seed=1), a=a / a.sum(1, keepdim=True), eps=0.2, **masks)


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("dim", [1, 2])
def test_topk_and_argmax_equal_those_of_the_stored_matrix(dim, transposed, monkeypatch):
    set_rows(monkeypatch, 7)
    fx, fy = leaves((2, 30, 5), (2, 20, 5))
    plan = sinkhorn(fx, fy, eps=0.2)
    plan = plan.T if transposed else plan
    dense = plan.dense()
    masses, index = plan.topk(4, dim=dim)
    expected_masses, expected = dense.topk(4, dim=dim)
    if dim == 1:
        expected_masses, expected = expected_masses.mT, expected.mT
    assert torch.equal(index, expected) and index.dtype == torch.int64
    assert_near(masses, expected_masses, 1e-12)
    assert torch.equal(plan.argmax(dim), dense.argmax(dim))
    upstream = rand(*masses.shape, seed=3)
    truths = torch.autograd.grad(expected_masses, [fx, fy], upstream, retain_graph=True)
    for gradient, truth in zip(torch.autograd.grad(masses, [fx, fy], upstream), truths, strict=True):
        assert_near(gradient, truth, 1e-10)


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("dim", [1, 2])
def test_indices_of_a_padded_plan(padded, dim, transposed):
    plan = padded.T if transposed else padded
    dense = plan.dense() if dim == 2 else plan.dense().mT
    size = dense.shape[2]
    masses, index = plan.topk(size, dim=dim)
    expected = dense.sort(2, descending=True).values
    assert_near(masses, expected, 1e-12)
    assert_near(dense.gather(2, index)[masses > 0], masses[masses > 0], 1e-12)
    assert (index[masses == 0] == 0).all()
    assert torch.equal(plan.argmax(dim), index[..., 0])
    alive = dense.sum(2) > 0
    assert not alive.all() and torch.equal(plan.argmax(dim)[alive], dense.argmax(2)[alive])


def test_given_cost_reads_the_same():
    (cost,) = leaves((2, 9, 7))
    plan = sinkhorn_from_cost(cost, eps=0.3)
    dense = plan.dense()
    for dim in (1, 2):
        assert torch.equal(plan.argmax(dim), dense.argmax(dim))
    masses, index = plan.topk(3)
    assert_near(masses, dense.gather(2, index), 1e-13)
    upstream = rand(2, 9, 3)
    truths = torch.autograd.grad(dense.gather(2, index), cost, upstream, retain_graph=True)
    assert_near(torch.autograd.grad(masses, cost, upstream)[0], truths[0], 1e-11)


@pytest.mark.parametrize("transposed", [False, True])
def test_mutual_neighbours_by_brute_force(padded, transposed):
    plan = padded.T if transposed else padded
    dense = plan.dense()
    index, mutual = plan.mutual()
    assert 0 < mutual.sum() < mutual.numel()
    for s, i in itertools.product(range(2), range(dense.shape[1])):
        row = dense[s, i]
        if row.sum() == 0:
            assert not mutual[s, i]
            continue
        j = int(row.argmax())
        assert index[s, i] == j and mutual[s, i] == (dense[s, :, j].argmax() == i)


@pytest.mark.parametrize("transposed", [False, True])
def test_assignment_is_the_best_of_the_stored_matrix(padded, transposed):
    plan = padded.T if transposed else padded
    scores, matched = plan.log_dense(), plan.assign()
    assert matched.shape == scores.shape[:2] and matched.dtype == torch.int64
    for s in range(2):
        rows, columns = ((scores[s] > -torch.inf).any(dim).nonzero()[:, 0] for dim in (1, 0))
        r, c = linear_sum_assignment(scores[s][rows][:, columns].numpy(), maximize=True)
        expected = torch.full((scores.shape[1],), -1)
        expected[rows[r]] = columns[c]
        assert torch.equal(matched[s], expected)


def test_assignment_of_a_square_plan_is_the_cheapest():
    """At any eps and after any number of iterations: potentials add the same to every assignment."""
    fx, fy = rand(2, 15, 3), rand(2, 15, 3, seed=1)
    plan = sinkhorn(fx, fy, eps=0.5, n_iters=1)
    for s in range(2):
        expected = linear_sum_assignment(cost_matrix(fx[s], fy[s]).numpy())[1]
        assert torch.equal(plan.assign()[s], torch.from_numpy(expected))
        assert not torch.equal(plan.argmax()[s], torch.from_numpy(expected))


def test_shape_dtype_and_transposition():
    plan = sinkhorn(rand(2, 4, 3, dtype=torch.float32), rand(2, 6, 3, dtype=torch.float32))
    assert plan.shape == (2, 4, 6) and plan.T.shape == (2, 6, 4)
    assert plan.dtype == torch.float32 and plan.device == torch.device("cpu")
    assert torch.equal(plan.T.dense(), plan.dense().mT) and torch.equal(plan.T.T.dense(), plan.dense())
    assert (plan @ rand(2, 6, 2)).dtype == torch.float32
    assert plan.n_iters == plan.T.n_iters == [5, 5]


def test_barycentric_is_a_convex_combination_and_reproduces_constants():
    plan = sinkhorn(rand(1, 9, 3), rand(1, 7, 3, seed=1))
    values = rand(1, 7, 2, seed=2)
    warped = plan.barycentric(values)
    assert (warped <= values.amax(1, keepdim=True)).all() and (warped >= values.amin(1, keepdim=True)).all()
    assert_near(plan.barycentric(torch.full_like(values, 3)), torch.full((1, 9, 2), 3.0), 1e-14)


# The autograd graph


def literal_loss(fx: Tensor, fy: Tensor, v: Tensor) -> Tensor:
    dense = literal_batch([cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)], 0.2, 3)
    return ((dense @ v).square().sum() + 5 * (dense.sum(1, keepdim=True) ** 2 @ v).sum()) * 10


def loss_of(plan: TransportPlan, v: Tensor) -> Tensor:
    return ((plan @ v).square().sum() + 5 * (plan.marginals()[1][:, None] ** 2 @ v).sum()) * 10


def options(domain: str) -> dict:
    return {"eps": 0.2, "n_iters": 3, "domain": domain}


@pytest.fixture
def pooled(monkeypatch):
    """Every stored kernel comes from the pool of used buffers."""
    clear_workspace()
    monkeypatch.setattr(workspace, "_SMALL", 0)
    yield
    clear_workspace()


@domains
@pytest.mark.parametrize("store", ["keep", "stream"])
def test_two_forwards_before_one_backward(domain, store, pooled):
    """A second plan must not take over memory that the first one's backward still reads."""
    pairs = [leaves((1, 9, 4), (1, 7, 4), (1, 7, 2), seed=10 * i) for i in range(3)]
    sinkhorn(*pairs[0][:2], store=store, **options(domain)).dense()  # leaves its buffer behind
    losses = [loss_of(sinkhorn(x, y, store=store, **options(domain)), v) for x, y, v in pairs]
    inputs = [leaf for pair in pairs for leaf in pair]
    truths = torch.autograd.grad(sum(literal_loss(*pair) for pair in pairs), inputs)
    for gradient, truth in zip(torch.autograd.grad(sum(losses), inputs), truths, strict=True):
        assert_near(gradient, truth, 1e-11)


@domains
def test_buffers_are_used_again_only_when_free(domain, pooled):
    fx, fy = rand(1, 9, 4), rand(1, 7, 4, seed=1)

    def address(plan: TransportPlan) -> int:
        return plan._samples[0].kernel.tiles.stored.data_ptr()

    first = sinkhorn(fx, fy, store="keep", **options(domain))
    second = sinkhorn(fx, fy, store="keep", **options(domain))
    assert address(first) != address(second)
    free = address(first)
    del first
    assert address(sinkhorn(fx, fy, store="keep", **options(domain))) == free
    assert workspace._free
    clear_workspace()
    assert not workspace._free


def test_the_pool_is_bounded(pooled, monkeypatch):
    monkeypatch.setattr(workspace, "_LIMIT", 3 * 9 * 7 * 8)
    plans = [sinkhorn(rand(1, 9, 4), rand(1, 7, 4), store="keep") for _ in range(5)]
    del plans
    assert len(workspace._free) == 3


def test_a_buffer_may_come_back_while_another_is_lent(pooled):
    """A finalizer runs wherever the cyclic collector does, in the middle of lending as well."""
    plan = sinkhorn(rand(1, 9, 4), rand(1, 7, 4), store="keep")
    with workspace._lock:
        del plan  # would wait for ever if it took the lock
    clear_workspace()
    assert not workspace._free and not workspace._returned


def test_products_with_tracked_values_take_one_sweep(monkeypatch):
    fx, fy, v = rand(1, 9, 4), rand(1, 7, 4, seed=1), rand(1, 7, 2, seed=2).requires_grad_()
    plan = sinkhorn(fx, fy)
    sweeps = []
    tiles = plan._samples[0].kernel.tiles
    monkeypatch.setattr(tiles, "apply", lambda *args: sweeps.append(1) or type(tiles).apply(tiles, *args))
    assert_near(plan @ v, plan.dense() @ v, 1e-13)
    assert len(sweeps) == 2  # the product, and the row sums that dense asks for


@domains
def test_backward_twice(domain):
    fx, fy, v = leaves((2, 9, 4), (2, 7, 4), (2, 7, 2))
    loss = loss_of(sinkhorn(fx, fy, **options(domain)), v)
    truths = torch.autograd.grad(literal_loss(fx, fy, v), [fx, fy, v])
    for _ in range(3):
        for gradient, truth in zip(torch.autograd.grad(loss, [fx, fy, v], retain_graph=True), truths, strict=True):
            assert_near(gradient, truth, 1e-11)


@domains
@pytest.mark.parametrize("order", list(itertools.permutations(["v", "fx", "fy"])))
def test_gradients_asked_for_one_at_a_time(order, domain):
    """A pass that asks for the values alone must leave nothing behind for the next one."""
    given = dict(zip(["fx", "fy", "v"], leaves((2, 9, 4), (2, 7, 4), (2, 7, 2)), strict=True))
    plan = sinkhorn(given["fx"], given["fy"], **options(domain))
    loss = loss_of(plan, given["v"])
    expected = literal_loss(**given)
    for name in order:
        (truth,) = torch.autograd.grad(expected, given[name], retain_graph=True)
        assert_near(torch.autograd.grad(loss, given[name], retain_graph=True)[0], truth, 1e-11)


@domains
def test_part_of_the_readings_in_each_backward(domain):
    """Losses of one plan differentiated one after the other, and only the first with respect to values."""
    fx, fy, v = leaves((2, 9, 4), (2, 7, 4), (2, 7, 2))
    plan = sinkhorn(fx, fy, **options(domain))
    dense = literal_batch([cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)], 0.2, 3)
    losses = [(plan @ v).square().sum(), plan.T.row_sums().square().sum(), plan.entropy().sum()]
    expected = [(dense @ v).square().sum(), dense.sum(1).square().sum(), -(dense * dense.log()).sum()]
    torch.autograd.grad(losses[0], v, retain_graph=True)
    for loss, literal in zip(losses, expected, strict=True):
        truths = torch.autograd.grad(literal, [fx, fy], retain_graph=True)
        for gradient, truth in zip(torch.autograd.grad(loss, [fx, fy], retain_graph=True), truths, strict=True):
            assert_near(gradient, truth, 1e-11)


@domains
def test_several_backward_passes_accumulate(domain):
    fx, fy, v = leaves((2, 9, 4), (2, 7, 4), (2, 7, 2))
    plan = sinkhorn(fx, fy, **options(domain))
    (plan @ v).square().sum().backward(retain_graph=True)
    plan.entropy().sum().backward()
    dense = literal_batch([cost_matrix(x, y) for x, y in zip(fx, fy, strict=True)], 0.2, 3)
    truths = torch.autograd.grad((dense @ v).square().sum() - (dense * dense.log()).sum(), [fx, fy, v])
    for leaf, truth in zip((fx, fy, v), truths, strict=True):
        assert_near(leaf.grad, truth, 1e-11)


@domains
@pytest.mark.parametrize("use_reentrant", [False, True])
def test_checkpointing(domain, use_reentrant):
    fx, fy, v = leaves((2, 9, 4), (2, 7, 4), (2, 7, 2))

    def function(x: Tensor, y: Tensor, values: Tensor) -> Tensor:
        return loss_of(sinkhorn(x, y, **options(domain)), values)

    checkpoint(function, fx, fy, v, use_reentrant=use_reentrant).backward()
    truths = torch.autograd.grad(literal_loss(fx, fy, v), [fx, fy, v])
    for leaf, truth in zip((fx, fy, v), truths, strict=True):
        assert_near(leaf.grad, truth, 1e-11)


@domains
@pytest.mark.parametrize("reading", ALL)
def test_second_derivative_is_refused(reading, domain):
    """A gradient penalty must not train on a silently wrong number."""
    fx, fy, v, u = leaves((2, 5, 3), (2, 4, 3), (2, 4, 2), (2, 5, 2))
    value = ALL[reading](sinkhorn(fx, fy, **options(domain)), v, u)
    with pytest.raises(RuntimeError, match="sinkhorn has no second derivatives"):
        torch.autograd.grad(value.square().sum(), fx, create_graph=True)


@domains
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
@pytest.mark.parametrize("changed", [0, 1])
def test_features_changed_in_place_are_noticed_or_harmless(changed, cost, domain):
    leaf = leaves((1, 6, 3), (1, 5, 3))
    features = [f * 1.0 for f in leaf]
    loss = sinkhorn(*features, cost=cost, **options(domain)).entropy().sum()
    truth = torch.autograd.grad(loss, leaf, retain_graph=True)
    with torch.no_grad():
        features[changed].mul_(2)
    try:
        gradients = torch.autograd.grad(loss, leaf)
    except RuntimeError as error:
        assert "modified by an inplace operation" in str(error)
        return
    for gradient, expected in zip(gradients, truth, strict=True):
        assert_near(gradient, expected, 1e-13)


@domains
@pytest.mark.parametrize("cost", ["cosine", "sqeuclidean", "dot"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_plan_is_of_the_features_it_was_given(cost, dtype, domain):
    """An optimiser step, or a buffer filled anew, must not move a plan that is still read."""
    features = [rand(1, 6, 3, dtype=dtype), rand(1, 5, 3, seed=1, dtype=dtype)]
    plan, fresh = (sinkhorn(*features, cost=cost, store="stream", **options(domain)) for _ in range(2))
    before = plan.dense().clone()
    for f in features:
        f.fill_(1.0)
    for dense in (plan.dense(), fresh.dense()):
        assert_near(dense, before, 1e-6)


@domains
@readings
def test_reading_without_gradient_does_not_cut_the_graph(reading, domain):
    """What a reading leaves for the next one to use must not be a constant, nor the other way round."""
    fx, fy, v, u = leaves((2, 6, 3), (2, 5, 3), (2, 5, 2), (2, 6, 2))
    read = READINGS[reading][0]
    upstream = rand(*read(sinkhorn(fx, fy, **options(domain)), v, u).shape, seed=3)
    expected = torch.autograd.grad((read(sinkhorn(fx, fy, **options(domain)), v, u) * upstream).sum(), [fx, fy])
    for other in ("matmul", "row_sums", "cost"):
        plan = sinkhorn(fx, fy, **options(domain))
        with torch.no_grad():
            assert not READINGS[other][0](plan, v, u).requires_grad
        value = read(plan, v, u)
        for gradient, truth in zip(torch.autograd.grad((value * upstream).sum(), [fx, fy]), expected, strict=True):
            assert_near(gradient, truth, 1e-12)
        with torch.no_grad():
            again = read(plan, v, u)
        assert not again.requires_grad
        assert_near(again, value.detach(), 1e-13)


@domains
def test_plan_made_without_gradient_is_a_constant(domain):
    fx, fy, v = leaves((2, 6, 3), (2, 5, 3), (2, 5, 2))
    with torch.no_grad():
        plan = sinkhorn(fx, fy, **options(domain))
    assert not plan.dense().requires_grad and not plan.row_sums().requires_grad
    (gradient,) = torch.autograd.grad((plan @ v).sum(), v)
    assert_near(gradient, plan.marginals()[1][..., None].expand(2, 5, 2), 1e-13)


@domains
def test_constant_plan_serves_many_training_steps(domain):
    """Readings of learned values must not leave their graph in the plan."""
    plan = sinkhorn(rand(2, 6, 3), rand(2, 5, 3, seed=1), **options(domain))
    v, u = leaves((2, 5, 2), (2, 6, 2))
    dense = plan.dense()
    for reading in [*READINGS, *READINGS]:
        read, literal = READINGS[reading]
        value = read(plan, v, u)
        if value.requires_grad:
            gradients = torch.autograd.grad(value.square().sum(), [v, u], materialize_grads=True)
            truths = torch.autograd.grad(literal(dense, dense, v, u).square().sum(), [v, u], materialize_grads=True)
            for gradient, truth in zip(gradients, truths, strict=True):
                assert_near(gradient, truth, 1e-12, scale=1.0)


@domains
def test_values_read_once_leave_the_features_graph_usable(domain):
    fx, fy, v = leaves((1, 6, 3), (1, 5, 3), (1, 5, 2))
    plan = sinkhorn(fx, fy, **options(domain))
    torch.autograd.grad(plan.barycentric(v).sum(), v)  # frees what this reading kept
    plan.entropy().sum().backward()
    dense = algorithm_1(cost_matrix(fx[0], fy[0]), 0.2, 3)
    assert_near(fx.grad, torch.autograd.grad(-(dense * dense.log()).sum(), fx)[0], 1e-11)


@domains
@pytest.mark.parametrize("store", ["keep", "stream"])
def test_inference_leaves_training_usable(domain, store, pooled):
    """Memory first used in inference mode is used again by the plan that is trained."""
    fx, fy, v = leaves((1, 9, 4), (1, 7, 4), (1, 7, 2))
    with torch.inference_mode():
        inferred = loss_of(sinkhorn(fx, fy, store=store, **options(domain)), v)
    loss = loss_of(sinkhorn(fx, fy, store=store, **options(domain)), v)
    assert_near(inferred.clone(), loss.detach(), 1e-13)
    truths = torch.autograd.grad(literal_loss(fx, fy, v), [fx, fy, v])
    for gradient, truth in zip(torch.autograd.grad(loss, [fx, fy, v]), truths, strict=True):
        assert_near(gradient, truth, 1e-11)


# Memory


@pytest.fixture
def no_gc():
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@domains
@pytest.mark.parametrize("backward", [False, True])
def test_memory_is_freed_without_the_cyclic_collector(domain, backward, no_gc):
    fx, fy, v, u = leaves((1, 6, 3), (1, 5, 3), (1, 5, 2), (1, 6, 2))
    plan = sinkhorn(fx, fy, store="keep", **options(domain))
    tiles = weakref.ref(plan._samples[0].kernel.tiles)
    values = [read(plan, v, u) for read in ALL.values()]
    plan.argmax(), plan.mutual(), plan.assign()
    loss = sum(value.sum() for value in values)
    if backward:
        loss.backward()
    assert tiles() is not None
    del plan, values, loss
    assert tiles() is None


STREAMED = {
    **{name: read for name, read in ALL.items() if "dense" not in name},
    "argmax": lambda p, v, u: p.argmax(1),
    "mutual": lambda p, v, u: p.mutual()[0],
    "T-mutual": lambda p, v, u: p.T.mutual()[0],
}


@pytest.mark.parametrize(("name", "domain"), list(zip(STREAMED, itertools.cycle(["kernel", "log"]))))
def test_streaming_never_holds_the_matrix(name, domain, monkeypatch):
    """Not in one tensor, nor in many: the most memory held at any time, forward and backward."""
    set_rows(monkeypatch, 50)
    size = 600
    fx, fy, v, u = (rand(1, size, d, seed=s, dtype=torch.float32).requires_grad_() for s, d in enumerate((4, 4, 2, 2)))
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        value = STREAMED[name](sinkhorn(fx, fy, eps=0.05, n_iters=3, store="stream", domain=domain), v, u)
        if value.requires_grad:
            value.sum().backward()
    events = [e for e in recorded.profiler.kineto_results.events() if e.name() == "[memory]"]
    assert events
    held = itertools.accumulate(e.nbytes() for e in sorted(events, key=lambda e: e.start_ns()))
    assert max(held) < 0.6 * 4 * size**2


# Surroundings


@domains
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_autocast_keeps_float32(domain, dtype):
    fx, fy = (f.to(dtype).requires_grad_() for f in (rand(1, 80, 8), rand(1, 70, 8, seed=1)))
    v, u = rand(1, 70, 2, seed=2), rand(1, 80, 2, seed=3)
    exact = [f.detach().double().requires_grad_() for f in (fx, fy)]
    for name in ("matmul", "T-barycentric", "entropy", "topk", "dense", "column_potential"):
        read = ALL[name]
        with torch.autocast("cpu", torch.bfloat16):
            value = read(sinkhorn(fx, fy, domain=domain), v.float(), u.float())
        truth = read(sinkhorn(*exact, domain=domain), v, u)
        assert value.dtype == torch.float32, name
        # bfloat16 inside would move the logits by 2^-9 / eps: 7 %.
        assert_near(value, truth.float(), 2e-4)
        # PyTorch advises against backward passes under autocast; the streamed ones stand it.
        with torch.autocast("cpu", torch.bfloat16, enabled=name != "dense"):
            gradients = torch.autograd.grad(value.square().sum(), [fx, fy])
        for gradient, expected in zip(gradients, torch.autograd.grad(truth.square().sum(), exact), strict=True):
            assert gradient.dtype == dtype
            assert_near(gradient.float(), expected.float(), 1e-3 if dtype == torch.float32 else 1e-2)


def test_compiled_function_gives_the_same():
    def function(fx: Tensor, fy: Tensor, v: Tensor) -> Tensor:
        return sinkhorn(fx * 2, fy, n_iters=2).barycentric(v).square()

    inputs = leaves((1, 9, 4), (1, 7, 4), (1, 7, 2))
    torch._dynamo.reset()
    compiled = torch.compile(function, backend="aot_eager")
    value, expected = compiled(*inputs), function(*inputs)
    assert_near(value, expected, 1e-13)
    truths = torch.autograd.grad(expected.sum(), inputs)
    for gradient, truth in zip(torch.autograd.grad(value.sum(), inputs), truths, strict=True):
        assert_near(gradient, truth, 1e-12)


# Errors


@pytest.mark.parametrize("shape", [(6, 3), (2, 4, 3), (1, 6, 3)])
def test_values_of_another_shape(shape):
    plan = sinkhorn(rand(2, 4, 3), rand(2, 6, 3, seed=1))
    for method in (plan.barycentric, plan.__matmul__):
        with pytest.raises(ValueError, match=r"\(B, M\) = \(2, 6\), got"):
            method(torch.ones(shape, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"\(B, M\) = \(2, 4\), got \(2, 6, 1\)"):
        plan.T @ torch.ones(2, 6, 1)


@pytest.mark.parametrize("transposed", [False, True])
def test_log_at_reads_single_entries(transposed, padded):
    """Also of rows and columns in the padding or without weight, whose logarithm is -inf."""
    plan = padded.T if transposed else padded
    batch, rows, number = plan.shape
    columns = torch.randint(-1, number, (batch, rows), generator=torch.Generator().manual_seed(3))
    expected = plan.log_dense().gather(2, columns.clamp_min(0)[..., None])[..., 0].masked_fill(columns < 0, -torch.inf)
    found = plan.log_at(columns)
    assert torch.equal(found.isneginf(), expected.isneginf()) and 0 < int(found.isneginf().sum()) < found.numel()
    assert_near(found.exp(), expected.exp(), 1e-15)
    assert_near(found.nan_to_num(neginf=0.0), expected.nan_to_num(neginf=0.0), 1e-12)


@pytest.mark.parametrize("options", [{}, {"mask_y": torch.tensor([[True] * 5 + [False]] * 2)}], ids=["", "mask"])
@pytest.mark.parametrize("column", [6, 7])
def test_log_at_refuses_columns_that_are_not_there(column, options):
    plan = sinkhorn(rand(2, 4, 3), rand(2, 6, 3, seed=1), **options)
    with pytest.raises(IndexError):
        plan.log_at(torch.full((2, 4), column))


@pytest.mark.parametrize("columns", [torch.zeros(2, 5, dtype=torch.int64), torch.zeros(2, 4)])
def test_log_at_errors(columns):
    plan = sinkhorn(rand(2, 4, 3), rand(2, 6, 3, seed=1))
    with pytest.raises(ValueError, match=r"columns must be integers of shape \(B, N\) = \(2, 4\), got torch\.\w+ of"):
        plan.log_at(columns)


@pytest.mark.parametrize(
    ("k", "dim", "message"),
    [
        (1, 0, r"dim must be 1 .* or 2 .* got 0"),
        (1, -3, "dim must be .* got -3"),
        (0, 2, "k must be between 1 and 6, the number of candidates, got 0"),
        (7, 2, "k must be between 1 and 6, .* got 7"),
        (5, 1, "k must be between 1 and 4, .* got 5"),
    ],
)
def test_topk_errors(k, dim, message):
    plan = sinkhorn(rand(2, 4, 3), rand(2, 6, 3, seed=1))
    with pytest.raises(ValueError, match=message):
        plan.topk(k, dim=dim)
    if k == 1:
        with pytest.raises(ValueError, match=message):
            plan.argmax(dim)
