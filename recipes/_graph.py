"""A training step recorded as a CUDA graph."""

from __future__ import annotations

import copy
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from meshkit.data import PairBatch


class GraphedStep:
    """Forward and backward pass recorded once as a CUDA graph, and replayed for each batch.

    A step of a small network is some ten thousand short kernels, which take longer to launch than to run.
    """

    def __init__(self, trainer: Any, batch: PairBatch, s: int) -> None:
        self.batch = copy.deepcopy(batch)
        dice = torch.cuda.get_rng_state()
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        state = copy.deepcopy(trainer.system.state_dict())
        with torch.cuda.stream(stream):  # what is set up at first use must not be part of the graph
            for _ in range(3):
                trainer.optimizer.zero_grad()
                trainer.backward(self.batch, s)
        torch.cuda.current_stream().wait_stream(stream)
        trainer.system.load_state_dict(state)  # spectral normalisation moved on
        trainer.optimizer.zero_grad()
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.results = trainer.backward(self.batch, s)
        self.gradients = [(p, p.grad) for p in trainer.system.parameters()]
        torch.cuda.set_rng_state(dice)  # the first replay draws what an eager step would have

    def __call__(self, batch: PairBatch) -> tuple[dict[str, Tensor], Tensor]:
        """Losses and the gradient's norm. Gradients are written, not added to what was there."""
        for field in fields(batch):
            value, place = getattr(batch, field.name), getattr(self.batch, field.name)
            if value is not None:
                place.copy_(value)
        self.graph.replay()
        for parameter, gradient in self.gradients:  # an eager step in between has let go of them
            parameter.grad = gradient
        return self.results
