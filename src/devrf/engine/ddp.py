"""Several processes learn one scene: each draws its share of the rays, all take the same step.

With one process everything here gives back what it is given.
"""

from __future__ import annotations

import signal
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, distributed

from devrf.errors import DevrfError


class ManualDDP(DDPStrategy):
    """Data parallelism for stages whose parameters come and go.

    torch's wrapper for distributed modules ties itself to the parameters that it finds first;
    here grids grow, and the frame that is learned is a slice of a buffer. So nothing is wrapped:
    the stage averages the gradients itself, with :func:`average_gradients`. A term that is a
    mean over what its rays have met (cycle, flow) becomes a mean of the processes' means.

    With a trainer of your own, ``Trainer(strategy=ManualDDP(), devices=4)``.
    """

    def __init__(self, process_group_backend: str | None = None) -> None:
        """Say how processes talk.

        Args:
            process_group_backend: None: ``nccl`` between GPUs, ``gloo`` between CPUs.
        """
        super().__init__(process_group_backend=process_group_backend)
        self._on_terminate: Any = signal.SIG_DFL

    def setup_environment(self) -> None:
        """Begin to talk with the other processes."""
        super().setup_environment()
        self._on_terminate = signal.getsignal(signal.SIGTERM)

    def on_train_start(self) -> None:
        """Answer SIGTERM as before the trainer ran.

        Lightning's own answer is to talk with the other processes at once, whatever they are
        doing; after that all may wait for one another for good.
        """
        if type(signal.getsignal(signal.SIGTERM)).__module__.startswith("lightning."):
            signal.signal(signal.SIGTERM, self._on_terminate)

    def configure_ddp(self) -> None:
        """Leave the stage as it is."""

    def barrier(self, name: str | None = None) -> None:
        """Wait for all processes; not where one writes a checkpoint, which concerns no other."""
        if name != "Trainer.save_checkpoint":
            super().barrier(name)


def rank() -> int:
    """The number of this process, from 0."""
    return distributed.get_rank() if _together() else 0


def world_size() -> int:
    """How many processes learn together."""
    return distributed.get_world_size() if _together() else 1


def _together() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def rays_per_rank(rays: int) -> int:
    """The rays of a batch that each process draws: rounded up, so that all draw as many."""
    return -(-rays // world_size())


def average_gradients(parameters: Iterable[Tensor]) -> None:
    """Replace each gradient by its mean over the processes.

    A parameter without a gradient counts as one whose gradient is zero, so that all processes
    exchange the same tensors whatever their rays have met.
    """
    size = world_size()
    if size == 1:
        return
    gradients = []
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
        gradients.append(parameter.grad)
    under_way = [distributed.all_reduce(gradient, async_op=True) for gradient in gradients]
    for work, gradient in zip(under_way, gradients, strict=True):
        assert work is not None
        work.wait()
        gradient.div_(size)


def average(values: Tensor) -> Tensor:
    """The mean over the processes of each number; all processes give the same shape."""
    size = world_size()
    if size == 1:
        return values
    means = values / size
    distributed.all_reduce(means)
    return means


@torch.no_grad()
def broadcast(tensors: Iterable[Tensor]) -> None:
    """Overwrite tensors, in place, with those of process 0."""
    if world_size() == 1:
        return
    for tensor in tensors:
        whole = tensor.detach().contiguous()
        # As bytes: not every backend knows every type.
        distributed.broadcast(whole.reshape(-1).view(torch.uint8), src=0)
        tensor.copy_(whole)


def assert_replicas_equal(tensors: Mapping[str, Tensor]) -> None:
    """See that all processes hold the same tensors, to the last bit.

    Raises:
        DevrfError: naming those that differ.
    """
    if world_size() == 1:
        return
    own = {name: _checksum(tensor) for name, tensor in tensors.items()}
    everyone: list[Any] = [None] * world_size()
    distributed.all_gather_object(everyone, own)
    known = sorted({name for other in everyone for name in other})
    differing = [n for n in known if any(other.get(n) != own.get(n) for other in everyone)]
    if differing:
        raise DevrfError(
            f"trainer: the processes have learned different fields ({', '.join(differing)}); give "
            "them devices of one kind, or use trainer=auto"
        )


def _checksum(tensor: Tensor) -> tuple[tuple[int, ...], int]:
    bits = tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
    return tuple(tensor.shape), zlib.crc32(bits.numpy().data)
