"""Metrics over batches and over two processes against one mean over all samples."""

import ast
import subprocess
import sys
from datetime import timedelta

import pytest
import torch
import torch.distributed as dist
from conftest import rand

from meshkit import metrics

PRED = torch.arange(5 * 6.0).view(5, 2, 3).square()
FACES = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.mark.parametrize(
    ("metric", "function", "options"),
    [
        (metrics.PMD, metrics.pmd, {"recenter": False}),
        (metrics.ChamferDistance, metrics.chamfer_distance, {"squared": False}),
        (metrics.EarthMoversDistance, metrics.earth_movers_distance, {"squared": True}),
        (metrics.EdgeRatio, metrics.edge_ratio, {"faces": FACES}),
        (metrics.VolumeChange, metrics.volume_change, {"faces": FACES}),
    ],
)
def test_batches_of_any_size_give_the_mean_over_samples(metric, function, options):
    pred, target = rand(7, 4, 3), rand(7, 4, 3, seed=1)
    accumulated = metric(**options)
    for batch in ([0, 1, 2], [3], [4, 5, 6]):
        accumulated.update(pred[batch], target[batch])
    expected = function(pred, target, **options).mean()
    torch.testing.assert_close(accumulated.compute(), expected)
    torch.testing.assert_close(accumulated.compute(), expected)  # asking changes nothing
    accumulated.reset()
    assert accumulated.compute().isnan()
    of_batch = accumulated(pred[:2], target[:2])
    torch.testing.assert_close(of_batch, function(pred[:2], target[:2], **options).mean())
    torch.testing.assert_close(accumulated.compute(), of_batch)


def test_metrics_of_other_arguments():
    verts = rand(2, 4, 3)
    rate = metrics.SelfIntersectionRate()
    rate.update(verts, FACES)
    torch.testing.assert_close(rate.compute(), metrics.self_intersection_rate(verts, FACES).mean())
    error = metrics.CorrespondenceError(distance="euclidean")
    matches, truth = torch.tensor([[0, 1], [2, 3]]), torch.tensor([[1, 1], [3, 3]])
    error.update(matches, verts, truth, mask=torch.tensor([[True, False], [True, True]]))
    expected = (verts[0, 0] - verts[0, 1]).norm() / 2 + (verts[1, 2] - verts[1, 3]).norm() / 4
    torch.testing.assert_close(error.compute(), expected)


def test_options_are_checked_where_they_are_given():
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'squared': options of pmd are pred, target"):
        metrics.PMD(squared=False)
    metrics.MeanMetric(lambda pred, **options: pred, anything=1)
    metrics.MeanMetric(max)  # has no signature


def test_printed_metric():
    metric = metrics.EdgeRatio(faces=FACES, min_length=0.1)
    metric.update(rand(3, 4, 3), rand(3, 4, 3, seed=1))
    assert repr(metric) == "EdgeRatio(faces=tensor(4, 3), min_length=0.1): 3 samples"
    assert repr(metrics.MeanMetric(metrics.pmd)) == "MeanMetric(pmd): 0 samples"


def test_options_of_a_call_come_first():
    metric = metrics.ChamferDistance(squared=False)
    metric.update(torch.zeros(1, 1, 3), torch.full((1, 1, 3), 2.0), squared=True)
    assert metric.compute().item() == 24


def test_curves_are_averaged_pointwise():
    thresholds = torch.tensor([0.0, 0.5, 1.0])
    metric = metrics.MeanMetric(metrics.correspondence_curve, thresholds=thresholds)
    errors = torch.rand(5, 6, generator=torch.Generator().manual_seed(0))
    metric.update(errors[:4])
    metric.update(errors[4:])
    torch.testing.assert_close(metric.compute().float(), metrics.correspondence_curve(errors, thresholds).mean(0))


def test_no_graph_and_no_digits_are_kept():
    metric = metrics.MeanMetric(lambda x: x)
    metric.update(torch.full((1,), 2.0**24, requires_grad=True))
    for _ in range(4):
        metric.update(torch.ones(1))  # in float32 2^24 + 1 is 2^24
    assert not metric.compute().requires_grad
    assert metric.compute().item() == (2**24 + 4) / 5


WORKER = """
import sys
sys.path[:0] = {path!r}
import test_metrics_accumulate
print(test_metrics_accumulate.measure_as(1, {rendezvous!r}))
"""


def measure_as(rank: int, rendezvous: str) -> list:
    """What each of two processes computes from its own, unequal share of the samples."""
    wait = timedelta(seconds=60)
    dist.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=2, timeout=wait)
    try:
        pred = PRED[:1] if rank == 0 else PRED[1:]
        pmd = metrics.PMD(recenter=False)
        pmd.update(pred, torch.zeros_like(pred))
        # Rank 0 has no samples for these, and does not know their shape.
        curves, values, nothing = (metrics.MeanMetric(lambda x: x) for _ in range(3))
        if rank == 1:
            curves.update(torch.tensor([[1.0, 2, 3], [3, 4, 5]]))
            values.update(torch.tensor([4.0, 8.0]))
        twice = [pmd.compute().item(), pmd.compute().item()]
        return [*twice, curves.compute().tolist(), values.compute().tolist(), bool(nothing.compute().isnan())]
    finally:
        dist.destroy_process_group()


@pytest.mark.skipif(not dist.is_gloo_available(), reason="torch is built without gloo")
def test_two_processes_give_the_mean_over_all_samples(tmp_path):
    rendezvous = str(tmp_path / "rendezvous")
    command = [sys.executable, "-c", WORKER.format(path=sys.path, rendezvous=rendezvous)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as worker:
        results = [measure_as(0, rendezvous)]
        out, err = worker.communicate(timeout=60)
    assert worker.returncode == 0, err
    results.append(ast.literal_eval(out))
    expected = metrics.pmd(PRED, torch.zeros_like(PRED), recenter=False).mean().item()
    for first, second, curves, values, nothing in results:
        assert first == second == pytest.approx(expected, rel=1e-6)
        assert curves == [2, 3, 4] and values == 6 and nothing is True
