"""Each kernel against its PyTorch twin, and by hand, at tiny sizes in Triton's interpreter."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from devrf.geometry.box import Box
from devrf.ops import check, color_network
from devrf.ops.check import CASES, Draw, check_kernels, compare
from devrf.ops.color_network import ColorNetwork, listed_colors
from devrf.ops.dispatch import using
from devrf.ops.motion import ListedSamples, SeenEarlier, motion_sum
from devrf.ops.photometric import photometric_sum
from devrf.ops.search import PackedSamples, select_listed


@pytest.mark.parametrize("case", [case for cases in CASES.values() for case in cases])
def test_both_implementations_agree(case, device):
    state = torch.get_rng_state()
    error, share = compare(case, device)
    assert error > 0 or case is check.selection, "nothing was compared"
    # The check's tolerance covers a GPU's exponential and bfloat16; the interpreter is exact.
    assert share < (0.1 if device.type == "cpu" else 1)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_broken_kernel_is_found(device, monkeypatch):
    from devrf.accel import compositing

    def askew(depth: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        weights, end = right(depth, first)
        return 1.01 * weights, end

    right = compositing.composite_segments
    monkeypatch.setattr(compositing, "composite_segments", askew)
    chosen = {name: CASES[name] for name in ("compositing", "pixel_rays")}
    monkeypatch.setattr(check, "CASES", chosen)
    reasons = check_kernels(device)
    assert reasons.keys() == {"compositing"} and reasons["compositing"].startswith("off by 0.00")


@pytest.mark.parametrize("kernels", ["torch", "triton"])
@pytest.mark.parametrize("matte", [False, True])
def test_photometric_terms_by_hand(device, kernels, matte):
    image = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]).to(device)
    left = torch.tensor([0.5, 0.25]).to(device).requires_grad_()
    colors = torch.tensor([[1.0, 1.0, 0.0], [9.0, 9.0, 9.0]]).to(device).requires_grad_()
    weights, first = torch.tensor([0.5, 3.0]).to(device), torch.tensor([0, 1, 1]).to(device)
    truth, alpha = torch.zeros(2, 3, device=device), torch.ones(2, device=device)
    given = weights, colors, first, truth, alpha if matte else None  # the second place is padding
    with using(kernels):
        found = photometric_sum(image, left, *given, (1.0, 2.0, 0.0, 4.0))
        found.total.backward()
    ln2, quarter, bare = 0.6931472, 0.5623351, (0.25 + 0.0625) / 2 if matte else 0.0
    assert found.terms.tolist() == pytest.approx(
        [0.25 / 6, 0.5 * 2 / 2, (ln2 + quarter) / 2, bare], rel=1e-5
    )
    assert found.total.item() == pytest.approx(0.25 / 6 + 2 * 0.5 + 4 * bare, rel=1e-5)
    assert found.opacity.item() == pytest.approx(1 - 0.375)
    assert found.coverage.item() == 1 if found.coverage is not None else not matte
    assert left.grad is not None and colors.grad is not None
    # 4 · 2 (T − 0) / R; 2 · 2 · w · c / R, and nothing for the padding.
    assert left.grad.tolist() == pytest.approx([2.0, 1.0] if matte else [0.0, 0.0])
    assert colors.grad.tolist() == [[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_motion_terms_by_hand(device, kernels):
    """Everything has moved by 0.2 along x, and by 0.1 one frame earlier; a camera looks down −z."""
    points = torch.tensor([[0.5, 0.0, -2.0], [0.0, 0.3, -2.0], [9.0, 9.0, 9.0]])
    canonical = torch.tensor([[0.2, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    weight, ray = torch.tensor([0.5, 0.25, 7.0]), torch.tensor([0, 1, 0])
    forward, before = torch.zeros(2, 2, 2, 3), torch.zeros(2, 2, 2, 3)
    forward[..., 0], before[..., 0] = 0.2, 0.1
    seen = SeenEarlier(
        torch.tensor([[1.0, -1.0], [5.0, 5.0]]),
        torch.tensor([True, False]),
        torch.tensor([[8.0, 6.0], [1.0, 1.0]]),
        torch.tensor([1, 1]),
        torch.tensor([0, 0]),
        torch.eye(3, 4).repeat(2, 1, 1),
        torch.tensor([[10.0, 20.0], [0.0, 0.0]]),
        torch.tensor([[8.0, 6.0], [0.0, 0.0]]),
    )
    seen = SeenEarlier(*(tensor.to(device) for tensor in seen))
    present = torch.tensor([True, True, False])
    listed = [t.to(device) for t in (points, canonical, weight, ray, present)]
    leaves = [listed[1].requires_grad_(), listed[2].requires_grad_()]
    leaves.append(forward.to(device).requires_grad_())
    with using(kernels):
        found = motion_sum(
            ListedSamples(*listed),
            leaves[2],
            before.to(device),
            seen,
            (2.0, 4.0),
            box=Box((-1.0, -1.0, -3.0), (1.0, 1.0, -1.0)),
            over_samples=True,
        )
        found.total.backward()
    # Missed by (0.1, 0, 0) and (−0.2, 0.3, 0): half of 0.01 + 0.13, over two samples.
    # The first is seen 10·0.3/2 = 1.5 right of the centre: (0.5, 1) off, weight 0.5, two numbers.
    assert found.terms.tolist() == pytest.approx([0.035, 0.375], rel=1e-5)
    assert found.total.item() == pytest.approx(2 * 0.035 + 4 * 0.375, rel=1e-5)
    moved, changed, pulled = (leaf.grad for leaf in leaves)
    assert moved is not None and changed is not None and pulled is not None
    assert changed.tolist() == pytest.approx([4 * 1.5 / 2, 0.0, 0.0], rel=1e-5)
    # Cycle: −2·0.1/2; flow: 4·0.5/2·10/2 across, −4·0.5/2·20/2·sgn(1) down,
    # and along the axis 5·0.3/2 of the first, as its height is 0.
    assert moved[0].tolist() == pytest.approx([-0.1 + 5.0, -10.0, 0.75], rel=1e-4)
    assert moved[1].tolist() == pytest.approx([0.2, -0.3, 0.0], rel=1e-4)
    assert moved[2].tolist() == [0.0, 0.0, 0.0]
    # The corners' weights add up to 1: −2·(0.1 − 0.2)/2 and −2·0.3/2.
    assert pulled.sum(dim=(0, 1, 2)).tolist() == pytest.approx([0.1, -0.3, 0.0], abs=1e-6)


@pytest.mark.parametrize("kernels", ["torch", "triton"])
@pytest.mark.parametrize("ndc", [None, (1.1, 1.3, 1.0)])
def test_flow_at_infinity_or_at_the_camera_stays_finite(draw, kernels, ndc):
    device = draw.device
    at = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.5, 1.0], [0.5, 0.5, 0.0]]).to(device)
    canonical, weight = at.requires_grad_(), torch.ones(3, device=device, requires_grad=True)
    ray, present = torch.zeros(3, dtype=torch.long, device=device), torch.ones(3) > 0
    samples = ListedSamples(draw(3, 3), canonical, weight, ray, present.to(device))
    still, valid = torch.zeros(2, 2, 2, 3, device=device), torch.ones(1) > 0
    pose = torch.eye(3, 4).to(device)[None]
    seen = SeenEarlier(
        *(draw(1, 2), valid.to(device), draw(1, 2), ray[:1], ray[:1]),
        *(pose, 9 + draw(1, 2), draw(1, 2)),
    )
    box = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    with using(kernels):
        found = motion_sum(
            samples, still, still, seen, (1.0, 1.0), box=box, over_samples=False, ndc=ndc
        )
        gradients = torch.autograd.grad(found.total, (canonical, weight))
    assert found.total.isfinite() and all(gradient.isfinite().all() for gradient in gradients)


@pytest.mark.parametrize("kernels", ["torch", "triton"])
def test_selection_of_listed_samples_by_hand(draw, kernels):
    device = draw.device
    flags = torch.tensor([True, False, True, True, False, True, False, False]).to(device)
    ray, first = torch.tensor([0, 0, 2, 2, 3, 3, 4, 4]), torch.tensor([0, 2, 2, 4, 6]).to(device)
    known = draw(8), draw(8, 3), flags, first, first[-1], first.diff(), 8
    found = PackedSamples(ray.to(device), *known)
    canonical = torch.arange(24.0).view(8, 3).to(device).requires_grad_()
    weight = torch.arange(1.0, 9.0).to(device).requires_grad_()
    with using(kernels):
        chosen = select_listed(found, canonical, weight, 6)
        up = torch.arange(10.0, 16.0).to(device)
        ((chosen.canonical * up[:, None]).sum() + (chosen.weight * up).sum()).backward()
        with pytest.raises(ValueError, match="9 of 8"):
            select_listed(found, canonical, weight, 9)
    assert chosen.first.tolist() == [0, 1, 1, 3, 4] and chosen.total == 4
    assert chosen.present.tolist() == [True] * 4 + [False] * 2
    # Padding has any ray, but different ones.
    assert chosen.ray.tolist() == [0, 2, 2, 3, 0, 1]
    assert chosen.weight.tolist() == [1, 3, 4, 6, 0, 0]
    assert chosen.canonical[:4, 0].tolist() == [0, 6, 9, 15]
    assert torch.equal(chosen.points[:4], found.points[[0, 2, 3, 5]])
    assert torch.equal(chosen.distance[:4], found.distance[[0, 2, 3, 5]])
    assert weight.grad is not None and canonical.grad is not None
    assert weight.grad.tolist() == [10, 0, 11, 12, 0, 13, 0, 0]
    assert torch.equal(canonical.grad, weight.grad[:, None].expand(8, 3))


@pytest.mark.parametrize(
    ("width", "precision", "fused"),
    [
        (6, torch.float32, True),
        (33, torch.float32, False),
        (33, torch.float16, True),
        (129, torch.float16, False),
        (6, torch.bfloat16, False),  # Triton's interpreter cannot multiply bfloat16.
    ],
)
def test_a_network_that_a_program_has_no_room_for_is_left_to_torch(
    monkeypatch, width, precision, fused
):
    draw, decoded = Draw(torch.device("cpu")), []
    usual = color_network.decode
    monkeypatch.setattr(color_network, "decode", lambda *a: decoded.append(a) or usual(*a))
    shapes = (width, 4), (width,), (width, 9), (width, width), (width,), (3, width), (3,)
    network = ColorNetwork(*(draw(*shape) for shape in shapes), torch.ones(1))
    ray, first = torch.zeros(5, dtype=torch.long), torch.tensor([0, 4])
    with using("triton"):
        listed_colors(
            *(draw(3, 3, 3, 4), draw(5, 3), check.BOX, draw(1, 3), ray, first, network, precision)
        )
    assert bool(decoded) != fused
