"""Data parallelism: several processes draw their shares of a batch and take the same step.

The functions that average are for several processes; with one, the others change nothing.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from lightning import Trainer
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from torch import Tensor, distributed

from devrf.errors import DevrfError, expect

# A grid of so many values or more exchanges only the points that were reached, if these are at
# most a share of all: finding and gathering them costs time, too.
LARGE = 2**18
MOST_REACHED = 0.5


class ManualDDP(DDPStrategy):
    """Data parallelism for stages whose parameters are replaced during training.

    ``DistributedDataParallel`` registers the parameters it finds at the beginning, but grids grow,
    and the frame that is learned is a slice of a buffer. So the module is not wrapped; the stage
    averages gradients itself, with :func:`average_gradients`. A loss term that is a mean over a
    subset of the rays (cycle, flow) becomes a mean of the processes' means.

    With a trainer of your own: ``Trainer(strategy=ManualDDP(), devices=4)``.
    """

    def __init__(self, process_group_backend: str | None = None) -> None:
        """Choose the backend of torch.distributed.

        Args:
            process_group_backend: None: ``nccl`` between GPUs, ``gloo`` between CPUs.
        """
        super().__init__(process_group_backend=process_group_backend)
        self._on_terminate: Any = signal.SIG_DFL

    def setup_environment(self) -> None:
        """Connect to the other processes, and note the present handler of SIGTERM."""
        super().setup_environment()
        self._on_terminate = signal.getsignal(signal.SIGTERM)

    def on_train_start(self) -> None:
        """Replace Lightning's handler of SIGTERM by the one that was there before.

        Lightning's handler communicates with the other processes at once, whatever they are doing;
        that can deadlock.
        """
        if type(signal.getsignal(signal.SIGTERM)).__module__.startswith("lightning."):
            signal.signal(signal.SIGTERM, self._on_terminate)

    def configure_ddp(self) -> None:
        """Do not wrap the stage."""

    def barrier(self, name: str | None = None) -> None:
        """Wait for all processes; except where a single one writes a checkpoint."""
        if name != "Trainer.save_checkpoint":
            super().barrier(name)


def check_strategy(trainer: Trainer) -> None:
    """Check that a trainer has one device, or several processes by :class:`ManualDDP`.

    Raises:
        DevrfError: it has another strategy.
    """
    if isinstance(trainer.strategy, ManualDDP):
        return
    ddp = "trainer=ddp (the strategy devrf.engine.ddp.ManualDDP)"
    if trainer.world_size > 1:
        raise DevrfError(f"trainer.devices: {trainer.world_size} processes need {ddp}")
    name = type(trainer.strategy).__name__
    alone = isinstance(trainer.strategy, SingleDeviceStrategy)
    expect(alone, "trainer.strategy", f"none, or {ddp}", name)


def world_size() -> int:
    """The number of processes."""
    begun = distributed.is_available() and distributed.is_initialized()
    return distributed.get_world_size() if begun else 1


def average_gradients(parameters: Iterable[Tensor]) -> None:
    """Replace each gradient by its mean over the processes, of which there are several.

    A missing gradient counts as zero, so that all processes exchange the same tensors whichever
    parameters their rays have reached. Of a large grid (X, Y, Z, C) only the points are exchanged
    that a ray of any process has reached, unless these are most of them.
    """
    size = world_size()
    dense: list[Tensor] = []
    grids: list[Tensor] = []
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        large = parameter.ndim == 4 and parameter.numel() >= LARGE
        if large and not parameter.grad.is_contiguous():
            parameter.grad = parameter.grad.contiguous()
        (grids if large else dense).append(parameter.grad)
    reached: list[tuple[Tensor, Tensor]] = []
    for gradient, points in zip(grids, _reached_points(grids), strict=True):
        rows = gradient.view(-1, gradient.shape[-1])
        if len(points) > MOST_REACHED * len(rows):
            dense.append(gradient)
        elif len(points):
            reached.append((rows, points))
    parts = [rows.index_select(0, points) for rows, points in reached]
    exchanged = [*dense, *parts]
    pending = [distributed.all_reduce(tensor, async_op=True) for tensor in exchanged]
    for work, tensor in zip(pending, exchanged, strict=True):
        assert work is not None
        work.wait()
        tensor.div_(size)
    for (rows, points), part in zip(reached, parts, strict=True):
        rows.index_copy_(0, points, part)


def _reached_points(gradients: Sequence[Tensor]) -> list[Tensor]:
    """For each (X, Y, Z, C) the points, counted along the grid, at which any process has values."""
    if not gradients:
        return []
    reached_here = [(gradient != 0).any(dim=-1).view(-1) for gradient in gradients]
    anywhere = torch.cat(reached_here).to(torch.uint8)
    distributed.all_reduce(anywhere, distributed.ReduceOp.MAX)
    parts = torch.split(anywhere, [len(reached) for reached in reached_here])
    return [part.nonzero()[:, 0] for part in parts]


def largest(values: Sequence[int], device: torch.device) -> list[int]:
    """For each value, as many in each process, the largest of all; waits for the others."""
    if world_size() == 1:
        return list(values)
    maxima = torch.tensor(values, dtype=torch.int64, device=device)
    distributed.all_reduce(maxima, distributed.ReduceOp.MAX)
    return [int(value) for value in maxima.tolist()]


def average(values: Tensor) -> Tensor:
    """Means of ``values`` over several processes, all of which pass the same shape."""
    means = values / world_size()
    distributed.all_reduce(means)
    return means


@torch.no_grad()
def broadcast(tensors: Iterable[Tensor]) -> None:
    """Overwrite tensors in place with those of process 0."""
    if world_size() == 1:
        return
    for tensor in tensors:
        dense = tensor.detach().contiguous()
        # As bytes: not every backend supports every type.
        distributed.broadcast(dense.reshape(-1).view(torch.uint8), src=0)
        tensor.copy_(dense)
