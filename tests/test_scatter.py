"""Segment reductions against loops, on every backend that is installed."""

import importlib.util
import sys

import pytest
import torch
from conftest import assert_near, rand
from torch import Tensor
from torch.autograd import gradcheck

from meshkit import scatter
from meshkit.scatter import segment_max, segment_mean, segment_min, segment_softmax, segment_sum, set_backend

REDUCTIONS = {
    segment_sum: lambda rows: rows.sum(0),
    segment_mean: lambda rows: rows.mean(0),
    segment_max: lambda rows: rows.amax(0),
    segment_min: lambda rows: rows.amin(0),
}
EVERY = [*REDUCTIONS, segment_softmax]
every = pytest.mark.parametrize("function", EVERY, ids=lambda f: f.__name__)
INDEX = torch.tensor([3, 0, 3, 3, 5, 0, 1, 5])  # segments 2, 4 and 6 of 7 are empty
installed = importlib.util.find_spec("torch_scatter") is not None
without_torch_scatter = pytest.mark.skipif(not installed, reason="torch-scatter is not installed: make scatter")


@pytest.fixture(params=["torch", pytest.param("torch_scatter", marks=without_torch_scatter)])
def backend(request):
    with set_backend(request.param):
        yield request.param


@pytest.mark.parametrize("function", REDUCTIONS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3)])
def test_reductions_equal_a_loop(function, shape, backend):
    src = rand(8, *shape)
    value = function(src, INDEX, 7)
    assert value.shape == (7, *shape)
    for segment in range(7):
        rows = src[segment == INDEX]
        expected = REDUCTIONS[function](rows) if len(rows) else torch.zeros(shape, dtype=src.dtype)
        torch.testing.assert_close(value[segment], expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_softmax_equals_a_loop(shape, backend):
    src = 30 * rand(8, *shape)
    value = segment_softmax(src, INDEX, 7)
    for segment in range(7):
        rows = segment == INDEX
        torch.testing.assert_close(value[rows], src[rows].softmax(0), rtol=1e-13, atol=1e-14)


@every
def test_gradcheck(function, backend):
    assert gradcheck(lambda src: function(src, INDEX, 7), rand(8, 2).requires_grad_())


@every
def test_second_derivative(function):
    assert torch.autograd.gradgradcheck(lambda src: function(src, INDEX, 7), rand(8, 2).requires_grad_())


@every
def test_torch_scatter_gives_the_same(function):
    """Parity of the backends, value and gradient."""
    pytest.importorskip("torch_scatter", reason="torch-scatter is not installed: make scatter")
    src, index = rand(500, 4, dtype=torch.float32).requires_grad_(), torch.randint(60, (500,))
    results = []
    for name in ("torch", "torch_scatter"):
        with set_backend(name):
            value = function(src, index, 70)
        results.append((value, torch.autograd.grad(value, src, rand(*value.shape, seed=1, dtype=torch.float32))[0]))
    for native, other in zip(*results, strict=True):
        assert_near(native, other, 1e-6)


def test_equal_maxima_share_the_gradient():
    src = torch.tensor([2.0, 1.0, 2.0]).requires_grad_()
    (gradient,) = torch.autograd.grad(segment_max(src, torch.zeros(3, dtype=torch.int64), 1).sum(), src)
    assert gradient.tolist() == [0.5, 0, 0.5]


@every
def test_no_rows(function, backend):
    value = function(torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), 4)
    assert value.shape == ((0, 3) if function is segment_softmax else (4, 3))
    assert not value.any()


def test_half_precision_accumulates_in_float32(backend):
    """In bfloat16, 256 + 1 is 256."""
    ones, index = torch.ones(1000, dtype=torch.bfloat16), torch.zeros(1000, dtype=torch.int64)
    assert segment_sum(ones, index, 1).item() == 1000 and segment_sum(ones, index, 1).dtype == torch.bfloat16
    assert segment_mean(ones, index, 1).item() == 1
    assert_near(segment_softmax(ones, index, 1).float(), torch.full((1000,), 1e-3), 4e-3)


def test_softmax_of_large_and_of_infinite_values():
    index = torch.tensor([0, 0, 1, 1])
    value = segment_softmax(torch.tensor([1e4, 1e4 - 1, -torch.inf, 3.0]), index, 2)
    assert_near(value, torch.tensor([1 / (1 + 1 / torch.e), 1 / (1 + torch.e), 0.0, 1.0]), 1e-4)


@every
def test_compiles_into_one_graph(function):
    src = rand(8, 2)
    compiled = torch.compile(lambda src: function(src, INDEX, 7), fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(src), function(src, INDEX, 7))


@pytest.mark.parametrize(
    ("src", "index", "num", "message"),
    [
        (
            torch.ones(3, dtype=torch.int64),
            torch.zeros(3, dtype=torch.int64),
            1,
            "src must be floating point, got .*int64",
        ),
        (torch.ones(3), torch.zeros(3), 1, "index must be an int64 vector .* got torch.float32"),
        (torch.ones(3), torch.zeros(3, dtype=torch.int32), 1, "got torch.int32"),
        (torch.ones(3, 2), torch.zeros(3, 2, dtype=torch.int64), 1, r"row of src \(3, 2\), got torch.int64 \(3, 2\)"),
        (torch.ones(3), torch.zeros(4, dtype=torch.int64), 1, "one entry per row"),
        (torch.tensor(1.0), torch.zeros(1, dtype=torch.int64), 1, "one entry per row"),
        (torch.ones(2), torch.tensor([0, 3]), 3, r"index must lie in \[0, 3\), got a range of \[0, 3\]"),
        (torch.ones(2), torch.tensor([-1, 1]), 3, r"leave padding \(-1\) out"),
        (torch.ones(2), torch.tensor([0, 1]), -1, "num_segments must not be negative, got -1"),
    ],
)
@every
def test_errors(function, src: Tensor, index, num, message):
    with pytest.raises(ValueError, match=message):
        function(src, index, num)


# The switch


def test_backend_for_good_and_within_a_block(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch_scatter", object())
    assert scatter._backend == "torch"
    with pytest.raises(KeyError), set_backend("torch_scatter"):
        assert scatter._backend == "torch_scatter"
        raise KeyError
    assert scatter._backend == "torch"
    set_backend("torch_scatter")
    assert scatter._backend == "torch_scatter"
    set_backend("torch")
    assert scatter._backend == "torch"


def test_backend_errors(monkeypatch):
    with pytest.raises(ValueError, match=r"backend must be .* got 'cuda'"):
        set_backend("cuda")
    monkeypatch.setitem(sys.modules, "torch_scatter", None)  # makes the import fail
    with pytest.raises(ValueError, match=r"torch-scatter cannot be imported .*: build it with `make scatter`"):
        set_backend("torch_scatter")
    assert scatter._backend == "torch"
