"""The small scene that checks learn, and how stages learn it."""

from __future__ import annotations

import copy
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer

from devrf.callbacks import GridUpscaling, LearningRateDecay
from devrf.checkpoints.checkpoint import ChecksummedCheckpointIO, LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.graphs import Graphs
from devrf.engine.stage import ScheduledStage
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_schedule import DeformationSchedule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.methods.devrf.settings import MotionSettings, Precision, Sampling
from devrf.ops.dispatch import Kind, using
from devrf.scenes.procedural import ProceduralScene
from devrf.scenes.scene import Scene
from devrf.system.speed import wait

STAGES = ("canonical", "deformation")


@dataclass(frozen=True)
class Size:
    """How much there is to learn.

    Attributes:
        width: of the images, in pixels; they are three quarters as high.
        static_views: how many.
        frames: T of the moving views.
        side: of the canonical grid at the end.
        sides: of the motion grid, by level.
        rays: of a batch.
        decoder: width of the colour network.
        iterations: of each stage, about.
    """

    width: int
    static_views: int
    frames: int
    side: int
    sides: tuple[int, int]
    rays: int
    decoder: int
    iterations: int = 100


ON_GPU = Size(96, 24, 9, 64, (10, 20), 4096, 128)
ON_CPU = Size(32, 10, 5, 24, (5, 10), 256, 32)


class GivenScene(SceneDataModule):
    """Serves a scene that is there already."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self._given = scene

    def load(self) -> Scene:
        """The scene."""
        return self._given


@dataclass(frozen=True)
class Way:
    """How iterations are carried out.

    Attributes:
        kernels: which implementation of the hot operations runs.
        graphs: whether CUDA graphs are captured.
        precision: what the colour network computes in.
        deterministic: whether only operations are allowed that add in a fixed order.
    """

    kernels: Kind = "torch"
    graphs: Graphs = "off"
    precision: Precision = "float32"
    deterministic: bool = False

    @property
    def in_words(self) -> str:
        """Kernels, graphs and precision, as in a check's name."""
        replayed = "graphs" if self.graphs == "auto" else "eager"
        return f"{self.kernels} {replayed} {self.precision}"


@dataclass
class Learned:
    """What came of learning a stage.

    Attributes:
        stage: the stage.
        losses: mean loss of each Lightning step.
        seconds: of learning.
    """

    stage: ScheduledStage
    losses: list[float] = field(default_factory=list)
    seconds: float = 0.0


class LossCurve(Callback):
    """Keeps the loss of each Lightning step on the device, so that nothing waits for it."""

    def __init__(self) -> None:
        self._kept: list[torch.Tensor] = []

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep the step's mean loss, if it had an iteration."""
        if outputs:
            self._kept.append(outputs["loss"].detach().clone())

    def values(self) -> list[float]:
        """The losses so far, on the host."""
        return torch.stack(self._kept).tolist() if self._kept else []


def small_scene(size: Size) -> Scene:
    """The embedded robot in images of ``size``: at rest, and seen moving by three cameras."""
    recipe = ProceduralScene(
        shape="robot",
        width=size.width,
        height=size.width * 3 // 4,
        static_views=size.static_views,
        static_test_views=1,
        train_views=3,
        frames=size.frames,
        supersample=1,
    )
    return recipe()


@dataclass
class Bench:
    """A device, and the small scene for it.

    Attributes:
        device: where stages learn.
        size: how much there is to learn.
        scene: the small scene.
        seed: of everything that is drawn.
    """

    device: torch.device
    size: Size
    scene: Scene
    seed: int = 0

    def canonical(self, way: Way, **other: Any) -> CanonicalStage:
        """A canonical stage; ``other`` replaces settings of its schedule."""
        size = self.size
        settings: dict[str, Any] = {
            "search_iterations": 0,
            "search_side": max(12, size.side // 2),
            "carve": True,
            "least_views": 1,
            "iterations": size.iterations,
            "side": size.side,
            "doublings": (size.iterations // 2,),
            "decay_iterations": size.iterations,
            "rays": size.rays,
        }
        return CanonicalStage(
            CanonicalSchedule(**{**settings, **other}),
            Architecture(width=size.decoder),
            sampling=Sampling(alpha_threshold=3e-3),
            iterations_per_step=5,
            graphs=way.graphs,
            decoder_precision=way.precision,
        )

    def deformation(self, rest: LoadedCheckpoint, way: Way, **other: Any) -> DeformationStage:
        """A deformation stage on a copy of ``rest``; ``other`` replaces settings of its schedule.

        The frames of its second level are learned in parallel.
        """
        size = self.size
        settings: dict[str, Any] = {
            "sides": size.sides,
            "iterations_per_frame": self._visits(),
            "rays": size.rays,
            "parallel_frames": (1, (size.frames - 1) // 2),
        }
        return DeformationStage(
            copy.deepcopy(rest),
            DeformationSchedule(**{**settings, **other}),
            MotionSettings(learning_rate=2e-3, unit="box", views="one", start="flow"),
            iterations_per_step=5,
            graphs=way.graphs,
            decoder_precision=way.precision,
        )

    def _visits(self) -> tuple[int, int]:
        """Iterations of a frame at each level: the first frame of the first takes twice as many."""
        first = max(1, self.size.iterations * 3 // 4 // self.size.frames)
        return first, max(1, self.size.iterations // 4 // 2)

    def learn(
        self,
        stage: ScheduledStage,
        way: Way,
        *callbacks: Callback,
        resumed_from: str | None = None,
    ) -> Learned:
        """Learn the whole schedule of ``stage``, from the same random state each time."""
        self.set_random_state()
        curve = LossCurve()
        trainer = Trainer(
            accelerator="gpu" if self.device.type == "cuda" else "cpu",
            devices=[self.device.index or 0] if self.device.type == "cuda" else 1,
            deterministic=way.deterministic,
            max_epochs=1,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
            callbacks=[GridUpscaling(), LearningRateDecay(), curve, *callbacks],
        )
        trainer.strategy.checkpoint_io = ChecksummedCheckpointIO()
        before = time.perf_counter()
        try:
            with using(way.kernels):
                trainer.fit(stage, datamodule=GivenScene(self.scene), ckpt_path=resumed_from)
            wait(self.device)
        finally:
            torch.use_deterministic_algorithms(False)
        return Learned(stage, curve.values(), time.perf_counter() - before)

    def rest(self, way: Way | None = None) -> LoadedCheckpoint:
        """The scene at rest, learned in PyTorch unless ``way`` says otherwise."""
        way = way or Way()
        stage = self.canonical(way)
        self.learn(stage, way)
        return stage.result()

    def build(self, name: str, way: Way, rest: LoadedCheckpoint | None) -> ScheduledStage:
        """The stage ``name``."""
        if name == "canonical":
            return self.canonical(way)
        assert rest is not None
        return self.deformation(rest, way)

    def below(self, name: str) -> LoadedCheckpoint | None:
        """What the stage ``name`` builds on."""
        return None if name == "canonical" else self.rest()

    def set_random_state(self) -> None:
        """Begin with the same random numbers, whatever ran before."""
        torch.manual_seed(self.seed)
        np.random.seed(self.seed)
        random.seed(self.seed)


def same_bits(one: Sequence[torch.Tensor], other: Sequence[torch.Tensor]) -> bool:
    """Whether two lists of tensors are equal, bit for bit."""
    return len(one) == len(other) and all(map(torch.equal, one, other))


def tensors_of(stage: ScheduledStage) -> list[torch.Tensor]:
    """All that a stage has learned, on the host."""
    return [t.cpu() for t in stage.state_dict().values() if isinstance(t, torch.Tensor)]
