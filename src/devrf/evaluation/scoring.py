"""Scores sets of held-out views: a learned scene's by Lightning's ``trainer.test``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from statistics import fmean

from lightning import LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from devrf.evaluation.held_out import HeldOutView, compared_with_truth, score
from devrf.evaluation.motion import with_flicker
from devrf.evaluation.suite import MetricInput, MetricSuite
from devrf.rendering.renderable import Renderable
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import Background, Views
from devrf.system.progress import followed

# The set that shows the scene at rest, at any time.
STATIC = "static"


class HeldOutScores(LightningModule):
    """Renders and scores every view of some sets, one after another.

    The means are logged as ``test/SET/METRIC``.

    Attributes:
        scored: the views of each set, in their order, with their scores.
    """

    def __init__(
        self,
        model: Renderable,
        sets: Mapping[str, Views],
        background: Background,
        suite: MetricSuite | None = None,
    ) -> None:
        """Take held-out views by the name of their set; ``static`` is rendered at time 0.

        A set of the same views as ``static`` has the scores of its views at rest from there.
        """
        super().__init__()
        self.model = model
        self.sets = sets
        self.background = background
        self.suite = suite or MetricSuite()
        self.renderer = Renderer(model)
        self.scored: dict[str, list[HeldOutView]] = {name: [] for name in sets}

    def on_test_epoch_end(self) -> None:
        """Add what compares consecutive images: :func:`~devrf.evaluation.motion.flicker`."""
        for name in (name for name in self.sets if name != STATIC):
            self.scored[name] = with_flicker(self.sets[name], self.scored[name])
            values = [view.further["flicker"] for view in self.scored[name]]
            known = [value for value in values if value is not None]
            if known:
                self.log(f"test/{name}/flicker", fmean(known))

    def test_dataloader(self) -> _HeldOut:
        """The name of the set and the position there of each view."""
        return _HeldOut(self.sets)

    def test_step(self, batch: tuple[str, int], batch_idx: int) -> dict[str, HeldOutView]:
        """Render and score a ``view``."""
        name, index = batch
        views = self.sets[name]
        shared = name != STATIC and views is self.sets.get(STATIC)
        view = score(
            self.renderer,
            views,
            index,
            self.background,
            self.suite,
            time=0.0 if name == STATIC else None,
            rest_pose_psnr=self.scored[STATIC][index].psnr if shared else None,
        )
        self.scored[name].append(view)
        log_scores(self, name, view)
        return {"view": view}


def log_scores(module: LightningModule, name: str, view: HeldOutView) -> None:
    """Log a view's scores within ``test_step``: their means over its set ``name``."""
    known = {metric: value for metric, value in view.scores.items() if value is not None}
    means = {f"test/{name}/{metric}": value for metric, value in known.items()}
    module.log_dict(means, on_epoch=True, batch_size=1, sync_dist=True)


def log_validation(module: LightningModule, view: HeldOutView, curve: str, step: int) -> None:
    """Log a view's PSNR and SSIM within ``validation_step``: their means over the views.

    They are ``val/METRIC``, which callbacks monitor, whatever learns. While it learns loggers get
    them as ``CURVE/val_METRIC``, at iteration ``step``: curves of stages are apart.
    """
    scores = {"psnr": view.psnr, "ssim": view.ssim}
    log_means = partial(module.log_dict, on_epoch=True, batch_size=1, sync_dist=True)
    learning = module.trainer.state.fn == TrainerFn.FITTING
    log_means({f"val/{name}": value for name, value in scores.items()}, logger=not learning)
    if learning:
        curves = {f"{curve}/val_{name}": value for name, value in scores.items()}
        log_means({**curves, "step": float(step)})


class _HeldOut:
    """A dataloader of positions, which shows its progress."""

    def __init__(self, sets: Mapping[str, Views]) -> None:
        self._sets = sets

    def __len__(self) -> int:
        return sum(map(len, self._sets.values()))

    def __iter__(self) -> Iterator[tuple[str, int]]:
        for name, views in self._sets.items():
            positions = ((name, index) for index in range(len(views)))
            yield from followed(positions, len(views), f"held-out images, {name}")


def score_held_out(
    model: Renderable,
    sets: Mapping[str, Views],
    background: Background,
    suite: MetricSuite | None = None,
) -> dict[str, list[HeldOutView]]:
    """The scores of every view of the held-out ``sets``, on the device of the model."""
    device = model.device
    trainer = Trainer(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        devices=[device.index or 0] if device.type == "cuda" else 1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    scores = HeldOutScores(model, sets, background, suite)
    trainer.test(scores, verbose=False)
    return scores.scored


def score_pictures(
    name: str,
    picture: Callable[[int], Tensor],
    views: Views,
    background: Background,
    suite: MetricSuite,
) -> list[HeldOutView]:
    """The scores of another program's pictures of all ``views`` of the held-out set ``name``.

    ``picture(k)`` is that of image ``k``, (H, W, 3) in [0, 1] on the host.
    """
    scored = []
    for k in followed(range(len(views)), len(views), f"held-out images, {name}"):
        view = compared_with_truth(picture(k), views, k, background)
        inputs = MetricInput(
            None, views, k, view.compared, view.truth, view.depth, view.opacity, suite.lpips
        )
        scored.append(replace(view, further=suite.scores(inputs)))
    return scored if name == STATIC else with_flicker(views, scored)
