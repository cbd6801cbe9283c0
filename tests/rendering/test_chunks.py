"""Images are the same with less memory."""

from __future__ import annotations

import logging

import pytest
import torch

from devrf.geometry.rays import Rays
from devrf.methods.devrf import view as module
from devrf.rendering.chunks import FEWEST, in_chunks
from devrf.rendering.renderer import Renderer


@pytest.fixture
def rays(rng: torch.Generator) -> Rays:
    origins = torch.rand(1000, 3, generator=rng)
    return Rays(origins, origins, origins)


def test_rays_come_in_order(rays: Rays) -> None:
    assert [len(part) for part in in_chunks(lambda some: some, rays, 300)] == [300, 300, 300, 100]
    assert [len(part) for part in in_chunks(lambda some: some, rays[:0], 300)] == [0]


def test_fewer_rays_at_once_when_memory_runs_out(
    rays: Rays, caplog: pytest.LogCaptureFixture
) -> None:
    def see(some: Rays) -> torch.Tensor:
        if len(some) > 600:
            raise RuntimeError(
                "[enforce fail at alloc_cpu.cpp] . DefaultCPUAllocator: can't "
                "allocate memory: you tried to allocate 10 bytes."
            )
        return some.origins

    with caplog.at_level(logging.WARNING, logger="devrf"):
        parts = in_chunks(see, rays, 16384)
    assert [len(part) for part in parts] == [500, 500]
    assert torch.equal(torch.cat(parts), rays.origins)
    assert caplog.messages[-1].startswith("out of memory: pictures are rendered ")


@pytest.mark.parametrize(
    ("error", "sizes"),
    [(torch.OutOfMemoryError("CUDA out of memory."), [512, FEWEST]), (RuntimeError("ours"), [512])],
)
def test_errors_that_smaller_chunks_do_not_prevent(
    rays: Rays, error: Exception, sizes: list[int]
) -> None:
    tried: list[int] = []

    def render(some: Rays) -> None:
        tried.append(len(some))
        raise error

    with pytest.raises(type(error), match=str(error)):
        in_chunks(render, rays, 512)
    assert tried == sizes


def test_an_image_is_the_same_with_less_memory(
    rest, tiny_scene, same, monkeypatch: pytest.MonkeyPatch
) -> None:
    rays = tiny_scene.static.test.cameras.image_rays(0)
    rays = rays[torch.arange(len(rays)).repeat(2)]
    whole = Renderer(rest.model).picture(rays, 0.0, 1.0)
    usual, tried = module.render, []

    def render(some, *others, **named):
        tried.append(len(some))
        if len(some) > 450:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return usual(some, *others, **named)

    monkeypatch.setattr(module, "render", render)
    same(Renderer(rest.model).picture(rays, 0.0, 1.0), whole)
    assert tried == [864, 432, 432]
