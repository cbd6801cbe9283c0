"""Data parallelism: what two processes exchange, by hand."""

from __future__ import annotations

import multiprocessing
import socket
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import distributed

from devrf.callbacks import PeriodicCheckpoint
from devrf.engine import ddp
from devrf.engine.ddp import (
    average,
    average_gradients,
    broadcast,
    largest,
    world_size,
)
from devrf.errors import DevrfError
from devrf.methods.devrf.canonical_stage import CanonicalStage


def conversation(number: int, port: int, answer: Connection) -> None:
    """Send what the functions under test return in process ``number`` of two."""
    torch.set_num_threads(1)
    address = f"tcp://127.0.0.1:{port}"
    distributed.init_process_group("gloo", init_method=address, rank=number, world_size=2)
    found: dict[str, Any] = {"size": world_size()}

    # Process 0 has no gradient of the second parameter, neither process one of the third.
    parameters = [torch.zeros(2), torch.zeros(3, 1), torch.zeros(1)]
    parameters[0].grad = torch.tensor([1.0, 4.0]) * (number + 1)
    if number == 1:
        parameters[1].grad = torch.tensor([[2.0], [0.0], [-8.0]])
    average_gradients(parameters)
    found["gradients"] = [p.grad.flatten().tolist() for p in parameters]

    # Grids of three points, of which rays reach few, all, and none.
    ddp.LARGE = 6
    few, most = torch.zeros(3, 1, 1, 2), torch.zeros(1, 3, 1, 2)
    few.grad = torch.tensor([[0.0, 0.0], [0.0, 2.0], [0.0, 0.0]]).view_as(few) * number
    most.grad = torch.full_like(most, 1.0 + number)
    kept = few.grad
    unreached = torch.zeros(3, 1, 1, 2)
    average_gradients([few, most, unreached])
    assert few.grad is kept
    found["grids"] = [few.grad.flatten().tolist(), most.grad.flatten().tolist()]
    found["grids"].append(unreached.grad.flatten().tolist())

    here = torch.device("cpu")
    found["largest"] = largest([number, 5 - number, True], here)
    saving = PeriodicCheckpoint()
    if number == 1:
        saving.ask_to_stop()
    # The other one's request, and rank 0's file.
    found["agreed"] = saving._agreed(number == 0, here)
    found["means"] = average(torch.tensor([[3.0 * number, 1.0]])).tolist()

    mask = torch.tensor([number == 0, number == 1, True])
    crossed = torch.arange(6.0).view(2, 3).t() + number  # not contiguous
    scalar = torch.tensor(5 + number)
    broadcast([mask, crossed, scalar])
    found["first"] = [mask.tolist(), crossed.tolist(), int(scalar)]

    answer.send(found)
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def found() -> list[dict[str, Any]]:
    """What each of two processes sends."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # Forked, which saves the imports.
    fork = multiprocessing.get_context("fork")
    pipes = [fork.Pipe(duplex=False) for _ in range(2)]
    processes = [
        fork.Process(target=conversation, args=(k, port, pipes[k][1]), daemon=True)
        for k in range(2)
    ]
    for process in processes:
        process.start()
    try:
        for here, _ in pipes:
            assert here.poll(60), "no answer"
        return [here.recv() for here, _ in pipes]
    finally:
        for process in processes:
            process.join(10)
            process.kill()


def test_two_processes(found):
    for each in found:
        assert each["size"] == 2
        # Means; a missing gradient counts as zero.
        assert each["gradients"] == [[1.5, 6.0], [1.0, 0.0, -4.0], [0.0]]
        assert each["grids"] == [[0, 0, 0, 1, 0, 0], [1.5] * 6, [0] * 6]
        assert each["largest"] == [1, 5, 1]
        assert each["agreed"] == (True, True)
        assert each["means"] == [[1.5, 1.0]]
        # The tensors of process 0, of any type and layout.
        assert each["first"] == [[True, False, True], [[0, 3], [1, 4], [2, 5]], 5]


def test_one_process_changes_nothing():
    parameter = torch.zeros(2, requires_grad=True)
    assert world_size() == 1
    assert largest([3, True], torch.device("cpu")) == [3, 1]
    broadcast([parameter])


def test_each_process_and_step_draws_pixels_of_its_own(canonical, datamodule, trainer, monkeypatch):
    drawn = {}
    for number, iteration, seed in [(0, 0, 0), (1, 0, 0), (0, 10, 0), (0, 0, 1), (0, 0, 0)]:
        torch.manual_seed(seed)
        stage = canonical()
        monkeypatch.setattr(CanonicalStage, "global_rank", number)
        stage.position.iterations_done = iteration
        stage.trainer = trainer()
        stage.trainer.datamodule = SimpleNamespace(scene=datamodule.scene)
        stage.setup("fit")
        stage.on_train_start()
        numbers = tuple(torch.randint(10**6, (4,), generator=stage.generator).tolist())
        drawn.setdefault((number, iteration, seed), set()).add(numbers)
    assert all(len(found) == 1 for found in drawn.values())
    assert len(set.union(*drawn.values())) == 4


@pytest.mark.parametrize("processes", [1, 2])
def test_what_methods_draw_in_several_processes_follows_from_the_step(
    canonical, monkeypatch, processes
):
    torch.manual_seed(0)
    stage = canonical()
    stage.batch_size.processes = processes
    drawn = []
    for number in (0, 1, 0, 1):  # they draw unequally many, and a file has the state of one
        monkeypatch.setattr(CanonicalStage, "global_rank", number)
        stage.seed_random()
        drawn.append(tuple(torch.rand(2 + number)[:2].tolist()))
    assert len({*drawn}) == (4 if processes == 1 else 2)
    assert (drawn[:2] == drawn[2:]) is (processes == 2)


def test_a_strategy_that_cannot_follow_growing_grids_is_refused(monkeypatch, trainer):
    stage = CanonicalStage()
    stage.trainer = trainer()
    monkeypatch.setattr(type(stage.trainer), "world_size", 2)
    with pytest.raises(DevrfError, match="2 processes need trainer=ddp"):
        stage.setup("fit")
