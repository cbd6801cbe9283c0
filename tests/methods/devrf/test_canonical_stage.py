"""The canonical stage, trained for moments from plain Lightning code, without Hydra."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import LambdaCallback

from devrf.callbacks import Previews
from devrf.engine.schedule import scale_schedule
from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage, warn_of_motion_beyond
from devrf.methods.devrf.free_space import possibly_occupied, view_count, view_count_weight
from devrf.methods.devrf.settings import Sampling
from recorder import Entry, by_samples, recording

SMALL = Architecture(channels=4, width=16, frequencies=2)
CARVED = CanonicalSchedule(
    search_iterations=0,
    search_side=16,
    visual_hull_init=True,
    iterations=60,
    side=16,
    upsample_at=(20,),
    rays=256,
)
SEARCHED = CanonicalSchedule(
    search_iterations=200, search_side=24, iterations=10, side=12, upsample_at=(), rays=256
)


class Watch(Callback):
    """Keeps the loss and which grids there were after each Lightning step."""

    def __init__(self) -> None:
        self.loss: list[float] = []
        self.seen: list[tuple[str, tuple[int, int, int], str]] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, *_: Any) -> None:
        self.loss.append(float(outputs["loss"]))
        decoder = type(pl_module.scene_model.canonical.decoder).__name__
        self.seen.append((pl_module.phase.kind, pl_module.scene_model.resolution, decoder))


def test_an_iteration_asks_little_of_the_device(canonical, datamodule, trainer):
    iterations: list[list[Entry]] = []
    stage = canonical()
    stage.__class__ = recording(CanonicalStage, iterations)
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    entries = iterations[-1]
    assert len(entries) <= 49
    assert sum(entry.waits for entry in entries) == 1  # for the number of samples
    # Nothing but the number of samples and the numbers of the step differs from the one before.
    assert by_samples(iterations[-2]) == by_samples(entries)
    assert any("K" in entry for entry in by_samples(entries))


def test_all_in_reduced_precision_is_refused(datamodule, trainer):
    with pytest.raises(DevrfError, match="trainer.precision"):
        fit = trainer(max_steps=1, precision="bf16-mixed")
        fit.fit(CanonicalStage(CARVED, SMALL), datamodule=datamodule)


def test_the_whole_schedule_is_run_and_the_loss_falls(datamodule, trainer):
    watch, stage = Watch(), CanonicalStage(CARVED, SMALL, iterations_per_step=7)
    fit = trainer(watch, max_epochs=1)
    fit.fit(stage, datamodule=datamodule)
    # Seven at a time, never across the growth at 20: 7 + 7 + 6, then 5 · 7 + 5.
    assert len(watch.seen) == 9 and stage.position.iteration == fit.global_step == 60
    coarse, fine = {seen[1] for seen in watch.seen[:3]}, {seen[1] for seen in watch.seen[3:]}
    box = stage.scene_model.canonical.box
    assert coarse == {box.grid_shape(16**3 // 2)} and fine == {box.grid_shape(16**3)}
    assert sum(watch.loss[-2:]) / 2 < 0.6 * watch.loss[0]


def test_the_last_validation_scores_what_is_saved(datamodule, trainer, tmp_path, monkeypatch):
    looks, stage = Previews(times=3), CanonicalStage(CARVED, SMALL)
    fit = trainer(looks, max_epochs=1, limit_val_batches=1)
    fit.fit(stage, datamodule=datamodule)
    iterations, last = looks.psnr[-1]
    saved = fit.validate(stage, datamodule=datamodule, verbose=False)[0]["val/psnr"]
    assert iterations == 60 and last == pytest.approx(saved, abs=1e-4)
    # What is loaded has been finished: nothing is emptied a second time, which is not the same.
    monkeypatch.setattr(CanonicalStage, "_clear_unobserved", lambda stage: pytest.fail("emptied"))
    fit.save_checkpoint(tmp_path / "stage.ckpt")
    loaded = CanonicalStage(CARVED, SMALL)
    file = str(tmp_path / "stage.ckpt")
    again = trainer(max_epochs=1, limit_val_batches=1)
    again.validate(loaded, datamodule=datamodule, ckpt_path=file, verbose=False)
    assert loaded.is_complete
    densities = [s.scene_model.canonical.density.values for s in (stage, loaded)]
    torch.testing.assert_close(densities[0], densities[1], rtol=0, atol=0)


def test_the_dynamic_views_first_frames_are_learned_from_if_asked_for(fit):
    images = []
    for first_frames in (False, True):
        schedule = replace(CARVED, iterations=2, upsample_at=(), first_frames=first_frames)
        stage = fit(CanonicalStage(schedule, SMALL))
        images.append(stage.pool.image.unique().tolist())
    assert images == [list(range(8)), list(range(10))]


def test_coarse_and_few_pixels_make_a_coarse_grid_and_small_batches(fit):
    few = {"iterations": 6, "upsample_at": (2,)}
    resolved = replace(CARVED, side=64, voxels_per_pixel=1.0, rays=4096, **few)
    stages = [fit(CanonicalStage(replace(resolved, epochs=n), SMALL)) for n in (None, 2.0)]
    assert stages[0].scene_model.canonical.base_voxels < 64**3 / 8
    assert stages[0].scene_model.resolution == stages[1].scene_model.resolution
    assert stages[0].scene_model.resolution == stages[0].scene_model.canonical.box.grid_shape(
        stages[0].scene_model.canonical.base_voxels
    )
    pixels = len(stages[1].pool)
    drawn = [len(stage.draw()[0]) for stage in stages]
    assert drawn == [4096, max(64, round(2 * pixels / 6))]


def test_a_batch_has_as_many_rays_whatever_a_pixel_has(fit):
    schedule = replace(CARVED, rays=103, iterations=2, upsample_at=())
    stage = fit(CanonicalStage(schedule, SMALL, sampling=Sampling(rays_per_pixel=4)))
    assert len(stage.draw()[0]) == 25  # 100 rays
    settings = stage.scene_model.settings
    assert settings.rays_per_pixel == 4
    assert settings.focal == float(stage.scene.static.train.cameras.focal.median())
    pixels = len(stage.pool)
    often = replace(schedule, rays=10**6, epochs=2.0)
    stage = fit(CanonicalStage(often, SMALL, sampling=Sampling(rays_per_pixel=4)))
    assert len(stage.draw()[0]) == max(64, pixels)  # shown twice in two iterations


def test_the_search_hands_over_to_a_radiance_field_with_room_for_motion(
    datamodule, tiny_scene, trainer
):
    watch, stage = Watch(), CanonicalStage(SEARCHED, SMALL)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    kinds = [(kind, decoder) for kind, _, decoder in watch.seen]
    assert kinds == [("search", "SigmoidColor")] * 20 + [("fine", "ColorDecoder")]
    assert watch.loss[19] < 0.6 * watch.loss[0]
    motion, box = tiny_scene.bounds.motion, stage.scene_model.canonical.box
    assert motion is not None and box.union(motion) == box
    # The search's box was the whole rest box: it has been tightened.
    assert box.volume < tiny_scene.bounds.box.scaled(1.05).union(motion).volume


@pytest.mark.parametrize(("share", "told"), [(0.3, True), (1.0, False)])
def test_motion_beyond_the_fields_box_is_warned_of(tiny_recipe, caplog, share, told):
    scene = replace(tiny_recipe, train_views=4)()  # by two views it has no end
    warn_of_motion_beyond(scene.bounds.whole.scaled(share), scene)
    assert ("what leaves it is cut off: give data.bound_scale=auto" in caplog.text) is told
    warn_of_motion_beyond(scene.bounds.whole.scaled(0.3), replace(scene, dynamic=scene.static))
    assert caplog.text.count("is cut off") == told


def test_a_search_goes_on_past_renewals_of_its_occupancy_and_finds_the_robot(
    datamodule, tiny_scene, trainer
):
    # The paper's search at a twentieth of its iterations: where it begins so much less faint, its
    # opacities grow as many times sooner, and are as faint as the paper's when first renewed.
    schedule = replace(SEARCHED, search_iterations=250, search_side=24, occupancy_every=50)
    architecture = replace(SMALL, search_alpha_init=2e-5)
    opaque_at_first: list[float] = []

    class Watched(CanonicalStage):
        def opaque(self) -> torch.Tensor:
            opaque_at_first.append(float(self.scene_model.canonical.voxel_alpha(0.5).max()))
            return super().opaque()

    stage = Watched(schedule, architecture)
    trainer(max_epochs=1).fit(stage, datamodule=datamodule)
    assert len(opaque_at_first) > 5 and opaque_at_first[0] < 1e-3
    occupancy = stage.scene_model.occupancy
    assert 0.01 < occupancy.share < 0.5
    # What the search has found is where the robot's surface is.
    views = tiny_scene.static.train
    assert views.depth is not None
    camera, row, column = views.depth.isfinite().nonzero().unbind(-1)
    rays = views.cameras.rays(camera, torch.stack([column, row], dim=-1) + 0.5)
    surface = rays.at(torch.arange(len(rays)), views.depth[camera, row, column])
    assert float(occupancy.at(surface).float().mean()) > 0.95


def test_a_search_that_finds_nothing_says_what_to_check(datamodule, trainer):
    schedule = CanonicalSchedule(1, 8, False, 10, 8, (), rays=16)
    with pytest.raises(DevrfError, match="search_iterations"):
        trainer(max_epochs=1).fit(CanonicalStage(schedule, SMALL), datamodule=datamodule)


def test_a_shorter_search_begins_less_faintly(datamodule, trainer):
    stage, opacities = CanonicalStage(SEARCHED, SMALL), []

    def shorten(trainer: Trainer, stage: CanonicalStage, *_: Any) -> None:
        opacities.append(stage.scene_model.canonical.alpha_init)
        if stage.position.schedule_scale == 1:
            scale_schedule(stage, 0.5)

    watch = LambdaCallback(on_train_batch_end=shorten)
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    assert stage.position.iterations_done < SEARCHED.total and stage.is_complete
    faint = SMALL.search_alpha_init
    assert opacities[:2] == [faint, 2 * faint]


def test_afterwards_what_is_not_occupied_is_empty(learned):
    model = learned[0].scene_model
    alpha = model.canonical.voxel_alpha(1.0)
    assert model.occupancy.mask.shape == alpha.shape
    assert alpha[~model.occupancy.mask].max() < 1.1e-6
    assert alpha[model.occupancy.mask].max() > 0.1
    assert 0.01 < model.occupancy.share < 0.6


def test_share_of_views_by_hand():
    # Two cameras at the origin, along −z and along +x, with a right angle of view.
    poses = torch.eye(3, 4).repeat(2, 1, 1)
    poses[1, :, :3] = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    cameras = Cameras(poses, torch.full((2, 2), 4.0), torch.full((2, 2), 4.0), 8, 8)
    points = torch.tensor([[0.1, 0.0, -2.0], [3.0, 0.5, 0.0], [1.0, 0.0, -1.0], [-1.0, 0.0, 2.0]])
    assert cameras.forwards.tolist() == [[0, 0, -1], [1, 0, 0]]
    share = view_count_weight(cameras, points.view(2, 2, 1, 3))
    # Seen by one, one, both (on their edges), none: none counts as one.
    assert share.flatten().tolist() == [0.5, 0.5, 1.0, 0.5]


def test_no_matter_is_possible_before_a_lens(datamodule, tiny_scene, trainer):
    bounds = replace(tiny_scene.bounds, box=Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)), near=3.0)
    datamodule._scene = replace(tiny_scene, bounds=bounds)
    schedule = CanonicalSchedule(2, 16, False, 2, 8, (), rays=16, min_views=1)
    stage = CanonicalStage(schedule, SMALL)
    trainer(max_steps=1).fit(stage, datamodule=datamodule)
    occupancy = stage.scene_model.occupancy
    points = bounds.box.grid_points((16, 16, 16), torch.zeros(())).reshape(-1, 3)
    nearest = torch.cdist(points, tiny_scene.static.train.cameras.positions).amin(dim=1)
    assert torch.equal(occupancy.mask.flatten(), nearest > 3.0)
    assert 0 < occupancy.share < 1


def test_no_matter_is_possible_where_too_few_cameras_look(tiny_scene):
    bounds = replace(tiny_scene.bounds, box=Box((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0)))
    scene = replace(tiny_scene, bounds=bounds)
    points = bounds.box.grid_points((12, 12, 12), torch.zeros(()))
    views = scene.static.train
    seen = view_count(views.cameras, points)
    assert 0 < (seen < 3).float().mean() < 1
    apart = {
        n: possibly_occupied(scene, views, scene.bounds.box, (12, 12, 12), carve=False, min_views=n)
        for n in (1, 3)
    }
    assert torch.equal(apart[3], apart[1] & (seen >= 3))
    # A capture of fewer views than that is kept whole.
    everywhere = possibly_occupied(
        scene, views, scene.bounds.box, (12, 12, 12), carve=False, min_views=1000
    )
    assert torch.equal(everywhere, apart[1])


def test_a_grown_grid_is_thinned_and_gets_a_new_optimiser(fit):
    renewed, grown = [], []

    class Watched(CanonicalStage):
        def opaque(self) -> torch.Tensor:
            renewed.append(self.position.iteration)
            return super().opaque()

        def enter(self, phase: Any) -> None:
            # A corner of the grid is the same point at every resolution.
            before = self.scene_model.canonical.density.values[0, 0, 0, 0].item()
            super().enter(phase)
            corner = self.scene_model.canonical.density.values[0, 0, 0, 0].item()
            grown.append((round(before - corner, 4), len(self.optimizer.state)))

    schedule = replace(CARVED, iterations=30, occupancy_every=8, density_drop=1.5)
    fit(Watched(schedule, SMALL, iterations_per_step=5))
    # Every 8 from 4 on, at the growth, and at the end.
    assert renewed == [4, 12, 20, 20, 28, 30]
    assert grown == [(0, 0), (1.5, 0)]
    fit(Watched(replace(schedule, restart_at_growth=False, occupancy_every=None), SMALL))
    assert renewed[6:] == [20, 30]
    assert grown[2:] == [(0, 0), (1.5, 7)]  # what the decoder's weights and biases have


@pytest.mark.parametrize("tv", [0.0, 1e-3])
def test_all_gradients_lie_where_the_optimiser_looks_for_them(fit, tv):
    looked_at: list[float] = []

    class Watched(CanonicalStage):
        def prepare(self) -> None:
            super().prepare()
            density, color = self.optimizer.param_groups[:2]
            assert density["rows"] is color["rows"]
            if (rows := color["rows"]) is not None:
                looked_at.append(len(rows) / self.scene_model.canonical.density.values.numel())
            for values in (*density["params"], *color["params"]):
                assert values.grad is None or not values.grad.any()

    schedule = replace(CARVED, iterations=30, occupancy_every=8, dense_tv_iterations=10)
    fit(Watched(schedule, SMALL, fine_loss={"render": 1.0, "tv": tv}))
    # Total variation reaches all voxels in the first ten iterations.
    assert len(looked_at) == (20 if tv else 30)
    assert 0 < looked_at[-1] < looked_at[0] < 1


def test_the_total_variation_reaches_all_voxels_until_the_schedule_says_so(datamodule, trainer):
    schedule = CanonicalSchedule(0, 8, True, 40, 8, (), rays=16, dense_tv_iterations=20)
    stage = CanonicalStage(schedule, SMALL, fine_loss={"render": 1.0, "tv": 1e-3})
    touched: list[list[bool]] = []
    watch = LambdaCallback(
        on_train_batch_end=lambda *_: touched.append(
            [group["touched_only"] for group in stage.optimizer.param_groups[:2]]
        )
    )
    trainer(watch, max_epochs=1).fit(stage, datamodule=datamodule)
    assert touched == [[False] * 2] * 2 + [[True] * 2] * 2
