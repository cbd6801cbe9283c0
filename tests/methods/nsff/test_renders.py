"""Renders from other frames: where nothing moves, and where everything moves alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from devrf.data.batch import RayBatch
from devrf.methods.nerf.samples import accumulated
from devrf.methods.nsff.fields import BACKWARD, FORWARD
from devrf.methods.nsff.model import NSFF
from devrf.methods.nsff.renders import Renders
from devrf.ops.compositing import composite
from devrf.rendering.view import MovingView
from devrf.scenes.scene import Scene

Compared = Callable[..., Renders]


def share(model: NSFF, v: float) -> None:
    """Make v the same everywhere, nearly 0 or 1."""
    torch.nn.init.zeros_(model.fields.static.further.weight)
    torch.nn.init.constant_(model.fields.static.further.bias, 1000 * (2 * v - 1))


def move(model: NSFF, forward: tuple[float, ...], backward: tuple[float, ...]) -> None:
    """Make the flows the same everywhere."""
    head = model.fields.dynamic.further
    wanted = torch.tensor([*forward, *backward]) / model.fields.dynamic.reach
    with torch.no_grad():
        head.weight[:6], head.bias[:6] = 0.0, torch.atanh(wanted)


def test_without_a_share_it_is_a_static_field(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    share(placed, 0.0)
    out = compared(placed, batch).output
    samples = out.samples
    density = torch.nn.functional.softplus(out.static.raw) * placed.settings.density_scale
    weight, end = composite(density * samples.length, samples.ray, samples.rays)
    weighed = weight[:, None] * out.static.color
    plain = accumulated(samples, weight, weighed, end, batch.background)
    torch.testing.assert_close(out.color, plain.color, atol=1e-5, rtol=1e-5)
    later = placed(replace(batch, time=torch.ones_like(batch.time)))
    torch.testing.assert_close(later.color, out.color, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("both", [True, False])
def test_without_motion_and_time_another_frame_is_this_one(
    placed: NSFF, batch: RayBatch, compared: Compared, both: bool
) -> None:
    share(placed, 1.0)
    move(placed, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    placed.times[:] = batch.time[0]  # all frames at one time
    renders = compared(placed, batch, both=both)
    assert len(renders.warps) == (2 if both else 1)
    for warp in renders.warps:
        torch.testing.assert_close(warp.color, renders.alone[0])
        torch.testing.assert_close(warp.color, renders.output.color, atol=1e-5, rtol=1e-5)
        assert warp.exists.all()


def test_a_translation_is_chained(placed: NSFF, batch: RayBatch, compared: Compared) -> None:
    """At frame 0 of three; two steps of a constant flow lead twice as far."""
    move(placed, (0.05, 0.0, -0.02), (-0.05, 0.0, 0.02))
    first = replace(batch, frame=torch.zeros_like(batch.frame), time=torch.zeros_like(batch.time))
    renders = compared(placed, first)
    after, before = renders.warps
    assert after.exists.all() and not before.exists.any() and len(before.sample) == 0
    assert (renders.trust(before) == 0).all() and (renders.trust(after) > 0).all()
    further = renders.chained()
    start = renders.output.samples.points
    step = torch.tensor([0.05, 0.0, -0.02])
    torch.testing.assert_close(further.points, start + 2 * step, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.points, start + step, atol=1e-5, rtol=0)
    # There and back again.
    back = after.dynamic.flow[:, BACKWARD]
    torch.testing.assert_close(after.moved + back, torch.zeros_like(back), atol=1e-5, rtol=0)
    assert (further.frame == 2).all() and not replace(renders, step=1).chained().exists.any()


def test_what_is_dynamic_moves_in_pictures_frame_by_frame(
    placed: NSFF, batch: RayBatch, tiny_scene: Scene
) -> None:
    """From the last frame of three back by half a frame, one, and two; what is static stays."""
    move(placed, (0.05, 0.0, -0.02), (-0.05, 0.0, 0.02))
    camera, view = tiny_scene.dynamic.train.cameras[[2]], placed.at(1.0)
    assert isinstance(view, MovingView)
    rays, pixels = batch.rays[:3], batch.pixel[:3]
    for v, time, steps in ((1, 0.75, 0.5), (1, 0.5, 1.0), (1, 0.0, 2.0), (0, 0.0, 0.0)):
        share(placed, v)
        out = placed.render_rays(rays, torch.ones(3), torch.zeros(3))
        moved = placed.placement.world(
            out.samples.points + steps * torch.tensor([-0.05, 0.0, 0.02])
        )
        weight, ray = (out.blend.dynamic + out.blend.static)[:, None], out.samples.ray
        flows = weight * (camera.project_into(0, moved)[0] - pixels[ray])
        flow, mass = view.induced_flow(rays, pixels, camera, time)
        total = torch.zeros(3, 2).index_add(0, ray, flows)
        torch.testing.assert_close(flow * mass[:, None], total, atol=1e-3, rtol=1e-3)


def test_one_neighbour_is_at_either_side_and_exists(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    frame = torch.tensor([0, 1, 2, 0, 1, 2, 0, 2])
    many = replace(batch, frame=frame, time=placed.times[frame])
    sides = set()
    for _ in range(8):
        (warp,) = compared(placed, many, both=False).warps
        assert warp.exists.all()
        assert (warp.side[frame == 0] == FORWARD).all()
        assert (warp.side[frame == 2] == BACKWARD).all()
        sides.update(warp.side[frame == 1].tolist())
    assert sides == {FORWARD, BACKWARD}


def test_what_the_other_frame_does_not_show_is_not_trusted(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    head = placed.fields.dynamic.further
    with torch.no_grad():
        head.weight[6:], head.bias[6:] = 0.0, 50.0  # o = 1 everywhere
    renders = compared(placed, batch)
    for warp in renders.warps:
        seen = torch.zeros(8).index_add(0, warp.ray, warp.weight)
        torch.testing.assert_close(renders.trust(warp), 1 - seen)


def test_added_densities_keep_the_static_part_in_other_frames(
    placed: NSFF, batch: RayBatch, compared: Compared
) -> None:
    placed.fields.additive = True
    move(placed, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    placed.times[:] = batch.time[0]
    renders = compared(placed, batch)
    for warp in renders.warps:
        torch.testing.assert_close(warp.color, renders.output.color)
        torch.testing.assert_close(renders.trust(warp), torch.ones(8))
