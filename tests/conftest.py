"""What tests of every package share: one thread, seeded numbers, one tiny scene."""

from __future__ import annotations

import copy
import gc
import json
import logging
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

gc.disable()  # what is imported until all tests are collected stays

# A shell without job control starts what is in the background with SIGINT ignored, and so would
# be every command that a test starts.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import settings
from lightning import Callback, Trainer
from scipy.spatial.transform import Rotation

from devrf.callbacks import GridUpscaling, LearningRateDecay
from devrf.checkpoints.checkpoint import ChecksummedCheckpointIO, LoadedCheckpoint
from devrf.data.datamodule import SceneDataModule
from devrf.engine.stage import Stage
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.rays import Rays
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_schedule import CanonicalSchedule
from devrf.methods.devrf.canonical_stage import CanonicalStage
from devrf.methods.devrf.deformation_field import DeformationField
from devrf.methods.devrf.extensions.color_residual import ResidualField
from devrf.methods.devrf.model import DeVRFModel
from devrf.methods.devrf.settings import CanonicalRates
from devrf.methods.devrf.volume_rendering import render
from devrf.pictures.video_file import write_pictures
from devrf.rendering.output import RenderedImage
from devrf.scenes.lens import Lens
from devrf.scenes.procedural import ProceduralForwardScene, ProceduralScene
from devrf.scenes.scene import Scene, Views

logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)

# The same examples on every machine, however slow it is.
settings.register_profile("house", derandomize=True, deadline=None, database=None)
settings.load_profile("house")


@pytest.fixture(scope="session", autouse=True)
def single_thread() -> Iterator[None]:
    """Small tensors: on a busy machine threads cost more than they bring."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def pytest_collection_finish() -> None:
    """Keep Python from looking for garbage, again and again, among all that was imported."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def seeded() -> None:
    """The global generator starts each test at the same place, whatever ran before."""
    torch.manual_seed(0)


@pytest.fixture
def rng() -> torch.Generator:
    """A generator of a test's own."""
    return torch.Generator().manual_seed(1)


@pytest.fixture(scope="session")
def cube() -> Box:
    """The cube from −1 to 1."""
    return Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


@pytest.fixture(scope="session")
def tiny_recipe() -> ProceduralScene:
    """How the tiny scene is made; its ``model()`` knows every motion exactly."""
    return ProceduralScene(
        shape="robot",
        width=24,
        height=18,
        static_views=8,
        static_test_views=2,
        train_views=2,
        frames=3,
        supersample=1,
    )


@pytest.fixture(scope="session")
def tiny_scene(tiny_recipe: ProceduralScene) -> Scene:
    """A robot in 24×18 pixels (not square): 8 static views, 2 moving views of 3 frames."""
    return tiny_recipe()


@pytest.fixture(scope="session")
def tiny_toy() -> Scene:
    """A toy before a wall in 24×18 pixels: 7 static views, 3 moving views of 3 frames."""
    return ProceduralForwardScene(
        width=24, height=18, static_views=7, train_views=3, frames=3, supersample=1
    )()


@pytest.fixture(scope="session")
def tiny_room(tiny_recipe: ProceduralScene) -> Scene:
    """The tiny scene in a room: an unbounded scene whose images have no alpha masks."""
    return replace(tiny_recipe, surroundings="room")()


def sparse_model(
    folder: Path,
    cameras: Cameras,
    names: Sequence[str],
    points: torch.Tensor,
    model: str = "PINHOLE",
    parameters: Sequence[float] | None = None,
) -> None:
    """Write a sparse model as COLMAP's text files: one lens, all points in all images.

    ``parameters`` are those of ``model``; None: a pinhole with the first camera's numbers.
    """
    folder.mkdir(parents=True)
    given = parameters or [*cameras.focal[0].tolist(), *cameras.center[0].tolist()]
    numbers = " ".join(map(repr, given))
    (folder / "cameras.txt").write_text(f"1 {model} {cameras.width} {cameras.height} {numbers}\n")
    lines = []
    for k, pose in enumerate(cameras.camera_to_world.double()):
        turn = Rotation.from_matrix((pose[:, :3] * pose.new_tensor([1, -1, -1])).T.numpy())
        x, y, z, w = turn.as_quat().tolist()
        moved = (-turn.as_matrix() @ pose[:, 3].numpy()).tolist()
        lines.append(" ".join(map(repr, (k + 1, w, x, y, z, *moved, 1))) + f" {names[k]}")
        lines.append(" ".join(f"0.5 0.5 {number}" for number in range(len(points))))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{n} {x!r} {y!r} {z!r} 9 9 9 0.5" for n, (x, y, z) in enumerate(points.tolist())]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


def rig_of_videos(
    root: Path, films: Mapping[str, Iterable[np.ndarray]], cameras: Cameras, near: float, far: float
) -> None:
    """Write a video for each of the fixed cameras, and ``poses_bounds.npy``, as Neural 3D Video.

    A row of it is [down, right, back, position, (H, W, f)] as 3 × 5, then two depths.
    """
    root.mkdir(parents=True)
    for name, pictures in films.items():
        write_pictures(root / name, iter(pictures), 10)
    right, up, back, position = cameras.camera_to_world.double().unbind(dim=2)
    size = [cameras.height, cameras.width, float(cameras.focal[0, 0])]
    column = torch.tensor(size, dtype=torch.float64).expand(len(cameras), 3)
    rows = torch.stack([-up, right, back, position, column], dim=2).reshape(-1, 15)
    depths = torch.tensor([[near, far]], dtype=torch.float64).expand(len(cameras), 2)
    np.save(root / "poses_bounds.npy", torch.cat([rows, depths], dim=1).numpy())


@pytest.fixture(scope="session")
def write_sparse() -> Callable[..., None]:
    """The function :func:`sparse_model`."""
    return sparse_model


@pytest.fixture(scope="session")
def write_rig() -> Callable[..., None]:
    """The function :func:`rig_of_videos`."""
    return rig_of_videos


def put_json(file: Path, content: Any) -> None:
    """Write a JSON file, and the folders above it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def write_item(
    root: Path, size: str, item: str, pixels: np.ndarray, pose: torch.Tensor, lens: Lens
) -> None:
    """An image and its camera file as Nerfies has them; the lens is that of the full image."""
    (root / "rgb" / size).mkdir(parents=True, exist_ok=True)
    iio.imwrite(root / f"rgb/{size}/{item}.png", pixels)
    factor, (fx, fy) = int(size[0]), lens.focal
    camera = {
        "orientation": (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])).T.tolist(),
        "position": pose[:, 3].tolist(),
        "focal_length": fx,
        "pixel_aspect_ratio": fy / fx,
        "skew": lens.skew,
        "principal_point": lens.center,
        "image_size": [pixels.shape[1] * factor, pixels.shape[0] * factor],
        "radial_distortion": lens.distortion.radial[:3],
        "tangential_distortion": lens.distortion.tangential,
    }
    put_json(root / f"camera/{item}.json", camera)


@pytest.fixture
def write_camera() -> Callable[..., None]:
    """The function :func:`write_item`."""
    return write_item


def in_one_list(scene: Scene) -> dict[str, tuple[Views, int]]:
    """Every image of an inward-facing scene by a name, held-out ones last."""
    parts = {
        "static": scene.static.train,
        "moving": scene.dynamic.train,
        "test_static": scene.static.test,
        "test_moving": scene.dynamic.test,
    }
    return {f"{name}_{i}": (views, i) for name, views in parts.items() for i in range(len(views))}


def write_nerfstudio(scene: Scene, root: Path) -> None:
    """The scene as nerfstudio lists it: all images in one file, at rest at time 0."""
    root.mkdir(parents=True)
    frames: list[dict[str, Any]] = []
    for name, (views, i) in in_one_list(scene).items():
        view = views.single(i)
        iio.imwrite(root / f"{name}.png", view.pixels[0].numpy())
        pose = [*view.cameras.camera_to_world[0].tolist(), [0, 0, 0, 1]]
        (fx, fy), (cx, cy) = view.cameras.focal[0].tolist(), view.cameras.center[0].tolist()
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": view.width, "h": view.height}
        placed = {"time": float(view.times[0]), "transform_matrix": pose}
        frames.append({"file_path": f"{name}.png", **placed, **lens})
    names = [frame["file_path"] for frame in frames]
    listed = {"frames": frames, "test_filenames": [n for n in names if n.startswith("test")]}
    put_json(root / "transforms.json", listed)


def cut(views: Views) -> Views:
    """The views with every second image cut to 18 of its columns, and the others to 16 rows."""
    height, width = views.pixels.shape[1:3]
    sizes = torch.tensor([[18, height], [width, 16]]).repeat(len(views), 1)[: len(views)]
    across = torch.arange(width) < sizes[:, :1, None]
    inside = across & (torch.arange(height) < sizes[:, 1:])[..., None]
    black = torch.tensor([0, 0, 0, 255], dtype=torch.uint8)[: views.pixels.shape[3]]
    flow = views.flow and replace(views.flow, valid=views.flow.valid & inside)
    return replace(
        views,
        pixels=torch.where(inside[..., None], views.pixels, black),
        cameras=replace(views.cameras, sizes=sizes),
        valid_mask=inside,
        flow=flow,
    )


@pytest.fixture(scope="session")
def two_sizes(tiny_scene: Scene) -> Scene:
    """The tiny scene with images of 18×18 and of 24×16 pixels in turn."""
    static, dynamic = tiny_scene.static.mapped(cut), tiny_scene.dynamic.mapped(cut)
    return replace(tiny_scene, static=static, dynamic=dynamic)


def write_nerfies(scene: Scene, root: Path, size: str = "4x") -> None:
    """The scene as Nerfies lists it, its images already made smaller."""
    images, factor = in_one_list(scene), int(size[0])
    for name, (views, i) in images.items():
        focal, center = views.cameras.focal[i] * factor, views.cameras.center[i] * factor
        lens = Lens(tuple(focal.tolist()), tuple(center.tolist()))
        pose = views.cameras.camera_to_world[i]
        write_item(root, size, name, views.pixels[i].numpy(), pose, lens)
    ids = list(images)
    held_out = [name for name in ids if name.startswith("test")]
    times = {name: {"warp_id": round(2 * float(v.times[i]))} for name, (v, i) in images.items()}
    train = [name for name in ids if name not in held_out]
    put_json(root / "dataset.json", {"ids": ids, "train_ids": train, "val_ids": held_out})
    put_json(root / "metadata.json", times)
    world = {"center": [0, 0, 0], "scale": 1, "near": scene.bounds.near, "far": scene.bounds.far}
    put_json(root / "scene.json", world)


def write_dycheck(scene: Scene, root: Path) -> None:
    """The scene as DyCheck lists it: the dynamic images alone, made smaller by two."""
    write_nerfies(scene, root, "2x")
    times = json.loads((root / "metadata.json").read_text())
    for split, part in (("train", "moving"), ("val", "test_moving")):
        names = [name for name in times if name.startswith(part)]
        ids = [times[name]["warp_id"] for name in names]
        put_json(root / f"splits/{split}.json", {"frame_names": names, "time_ids": ids})


@pytest.fixture(scope="session")
def write_scene() -> Callable[[str, Scene, Path], None]:
    """``write_scene(choice, scene, root)``: an inward-facing scene as ``data=CHOICE`` reads it."""
    writers = {"nerfstudio": write_nerfstudio, "nerfies": write_nerfies, "dycheck": write_dycheck}
    return lambda choice, scene, root: writers[choice](scene, root)


class GivenScene(SceneDataModule):
    """Serves a scene that is there already, and counts how often it was asked for."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.given, self.loads = scene, 0

    def load(self) -> Scene:
        """The scene."""
        self.loads += 1
        return self.given


@pytest.fixture(scope="session")
def serve() -> Callable[[Scene], SceneDataModule]:
    """``serve(scene)``: a datamodule of a scene that is there already."""
    return GivenScene


@pytest.fixture
def datamodule(tiny_scene: Scene) -> SceneDataModule:
    """Serves the tiny scene."""
    return GivenScene(tiny_scene)


@pytest.fixture(scope="session")
def four_frame_scene(tiny_recipe: ProceduralScene) -> Scene:
    """The tiny scene in 4 frames, of which the first and the last that move are no neighbours."""
    return replace(tiny_recipe, frames=4)()


@pytest.fixture
def four_frames(four_frame_scene: Scene) -> SceneDataModule:
    """Serves the tiny scene in 4 frames."""
    return GivenScene(four_frame_scene)


def quiet_trainer(*callbacks: Callback, **options: Any) -> Trainer:
    """A trainer on the CPU with the two callbacks that a schedule needs, and no files."""
    warnings.filterwarnings("ignore", module="lightning")
    quiet: dict[str, Any] = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "limit_val_batches": 0,
        "num_sanity_val_steps": 0,
    }
    schedule = [GridUpscaling(), LearningRateDecay()]
    return Trainer(
        accelerator="cpu", devices=1, callbacks=[*schedule, *callbacks], **{**quiet, **options}
    )


@pytest.fixture
def trainer() -> Callable[..., Trainer]:
    """The function :func:`quiet_trainer`."""
    return quiet_trainer


@pytest.fixture
def fit(datamodule: SceneDataModule, trainer: Callable[..., Trainer]) -> Callable[..., Stage]:
    """``fit(stage, *callbacks)``: the stage, fitted; no row of the curves is due before the end."""

    def learn(
        stage: Stage,
        *callbacks: Callback,
        data: SceneDataModule = datamodule,
        ckpt_path: Path | None = None,
        every: int = 1000,
    ) -> Stage:
        fitted = trainer(*callbacks, max_epochs=1, log_every_n_steps=every)
        fitted.strategy.checkpoint_io = ChecksummedCheckpointIO()
        fitted.fit(stage, datamodule=data, ckpt_path=ckpt_path and str(ckpt_path))
        return stage

    return learn


@pytest.fixture
def canonical() -> Callable[..., CanonicalStage]:
    """``canonical(**changes)``: a stage of 12 iterations; changes of its schedule and field."""
    schedule = CanonicalSchedule(
        search_iterations=0,
        search_side=12,
        visual_hull_init=True,
        iterations=12,
        side=12,
        upsample_at=(3, 7),
        decay_iterations=6,
        density_drop=0.0,
        rays=64,
    )

    def build(
        alpha_init: float = 0.01,
        rates: CanonicalRates | None = None,
        iterations_per_step: int = 1,
        **changes: Any,
    ) -> CanonicalStage:
        field = Architecture(channels=4, width=8, frequencies=1, alpha_init=alpha_init)
        changed = replace(schedule, **changes)
        return CanonicalStage(changed, field, rates, iterations_per_step=iterations_per_step)

    return build


SMALL = Architecture(channels=4, width=16, frequencies=2)


@pytest.fixture(scope="session")
def learned(tiny_scene: Scene) -> tuple[CanonicalStage, Trainer]:
    """The tiny scene at rest, learned in under a second; not to be changed."""
    torch.manual_seed(0)
    schedule = CanonicalSchedule(
        search_iterations=0,
        search_side=16,
        visual_hull_init=True,
        iterations=120,
        side=20,
        upsample_at=(40,),
        density_drop=0.0,
        rays=256,
    )
    stage = CanonicalStage(schedule, SMALL)
    fitted = quiet_trainer(max_epochs=1)
    fitted.fit(stage, datamodule=GivenScene(tiny_scene))
    return stage, fitted


@pytest.fixture
def rest(learned: tuple[CanonicalStage, Trainer]) -> LoadedCheckpoint:
    """A copy of the tiny scene at rest, for a deformation stage to build on."""
    return copy.deepcopy(learned[0].result())


@pytest.fixture
def moving(learned: tuple[CanonicalStage, Trainer], rng: torch.Generator) -> DeVRFModel:
    """The tiny scene; at the times 0.4 and 1 every point has moved by up to 5 % of its box.

    Its colours have changed, too.
    """
    model = copy.deepcopy(learned[0].scene_model)
    box = model.canonical.box
    motion = DeformationField(box, FrameClock((0.0, 0.4, 1.0)), voxels=5**3)
    shape = motion.to_canonical[1:].shape
    motion.to_canonical[1:] = 0.1 * box.longest * (torch.rand(shape, generator=rng) - 0.5)
    model.deformation = motion
    model.color_residual = ResidualField(box, motion.clock, voxels=4**3)
    shape = model.color_residual.values[1:].shape
    model.color_residual.values[1:] = 2 * torch.rand(shape, generator=rng) - 1
    return model


def plain_picture(
    model: DeVRFModel, rays: Rays, time: float, background: torch.Tensor
) -> RenderedImage:
    """What rays in the fields' space see of a model at ``time``, by the plain renderer."""
    scene = model.canonical, model.occupancy_at(time), model.settings
    with torch.no_grad():
        warp, colors = model.warp(time), model.color_change(time)
        return RenderedImage.of(render(rays, *scene, background, warp, color_change=colors))


@pytest.fixture
def reference() -> Callable[[DeVRFModel, Rays, float, torch.Tensor], RenderedImage]:
    """The function :func:`plain_picture`."""
    return plain_picture


@pytest.fixture
def same() -> Callable[[RenderedImage, RenderedImage], None]:
    """Fails unless two pictures show the same, up to 1e-5."""

    def compare(one: RenderedImage, other: RenderedImage) -> None:
        for name in ("color", "depth", "opacity"):
            torch.testing.assert_close(
                getattr(one, name), getattr(other, name), atol=1e-5, rtol=1e-5
            )

    return compare
