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

    def __call__(self, batch: PairBatch) -> tuple[dict[str, Tensor], Tensor]:
        """Losses and the gradient's norm. Gradients are written, not added to what was there."""
        for field in fields(batch):
            value = getattr(batch, field.name)
            if value is not None:
                getattr(self.batch, field.name).copy_(value)
        self.graph.replay()
        return self.results
