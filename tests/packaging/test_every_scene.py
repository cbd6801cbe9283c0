"""Every config of a scene reads its layout and trains two steps of both stages on a CPU."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from devrf.cli.config import config_folder
from devrf.data.datamodule import SceneDataModule
from devrf.methods.devrf.deformation_stage import DeformationStage
from devrf.scenes.export import export
from devrf.scenes.procedural.recipe import ProceduralForwardScene
from devrf.scenes.scene import Scene, Views

PUBLISHED_INWARD = ["lego", "floating_robot", "daisy", "glove", "kuka", "flower_360"]
PUBLISHED_FORWARD = ["plant", "rabbit", "pig_toy"]
FILES = sorted(path.stem for path in (config_folder() / "data").glob("*.yaml"))
TINY = [
    "field.width=8",
    "field.channels=4",
    "video=default",
    "schedule.canonical.search_iterations=0",
    "schedule.canonical.search_side=12",
    "schedule.canonical.iterations=2",
    "schedule.canonical.side=12",
    "schedule.canonical.upsample_at=[]",
    "schedule.canonical.rays=128",
    "schedule.deformation.levels.1={side:4,iterations:2}",
    "schedule.deformation.levels.2=null",
    "schedule.deformation.levels.3=null",
    "schedule.deformation.rays=128",
    "canonical.iterations_per_step=1",
    "deformation.iterations_per_step=1",
    "trainer=cpu",
]
FORWARD = [
    "field=forward",
    "loss=forward",
    "field.planes=8",
    "schedule.canonical.visual_hull_init=false",
]
# Layouts of what does not move.
AT_REST = ["colmap"]
# The embedded scenes in sizes that take no time.
EMBEDDED = {
    "procedural": ["data.static_views=8", "data.static_test_views=2"],
    "flower": ["data.static_views=8", "data.static_test_views=2"],
    "procedural_forward": ["data.static_views=7"],
}


@pytest.fixture(scope="session")
def forward_scene() -> Scene:
    """The tiny forward-facing scene: three views of three frames, one more held out."""
    return ProceduralForwardScene(
        width=24, height=18, static_views=7, train_views=3, frames=3, supersample=1
    )()


def in_one_list(scene: Scene) -> list[tuple[Views, int, str]]:
    """Every image of an inward-facing scene, dynamic test views last: views, position, name."""
    parts = [
        ("static", scene.static.train),
        ("rest", scene.static.test),
        ("dynamic", scene.dynamic.train),
        ("held_out", scene.dynamic.test),
    ]
    return [(views, i, f"{name}_{i:03d}") for name, views in parts for i in range(len(views))]


def write_nerfstudio(scene: Scene, root: Path) -> None:
    """The scene as nerfstudio lists it: all images in one file, at rest at time 0."""
    (root / "images").mkdir(parents=True)
    frames: list[dict[str, Any]] = []
    for views, i, name in in_one_list(scene):
        iio.imwrite(root / f"images/{name}.png", views.pixels[i].numpy())
        pose = views.cameras.camera_to_world[i].tolist()
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "time": float(views.times[i]),
                "transform_matrix": [*pose, [0, 0, 0, 1]],
            }
        )
    cameras, paths = scene.static.train.cameras, [frame["file_path"] for frame in frames]
    (fl_x, fl_y), (cx, cy) = cameras.focal[0].tolist(), cameras.center[0].tolist()
    content = {
        "camera_model": "OPENCV",
        **{"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy},
        **{"w": cameras.width, "h": cameras.height, "frames": frames},
        "test_filenames": [path for path in paths if "rest" in path or "held" in path],
    }
    (root / "transforms.json").write_text(json.dumps(content))


def write_nerfies(scene: Scene, root: Path) -> None:
    """The scene as Nerfies lists it, its images already made smaller by four."""
    for folder in ("camera", "rgb/4x"):
        (root / folder).mkdir(parents=True)
    ids, metadata = [], {}
    for views, i, name in in_one_list(scene):
        ids.append(name)
        iio.imwrite(root / f"rgb/4x/{name}.png", views.pixels[i].numpy())
        metadata[name] = {"warp_id": round(float(views.times[i]) * 2), "appearance_id": 0}
        pose, focal = views.cameras.camera_to_world[i], views.cameras.focal[i] * 4
        camera = {
            "orientation": (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])).T.tolist(),
            "position": pose[:, 3].tolist(),
            "focal_length": float(focal[0]),
            "principal_point": (views.cameras.center[i] * 4).tolist(),
            "image_size": [views.width * 4, views.height * 4],
            "skew": 0.0,
            "pixel_aspect_ratio": float(focal[1] / focal[0]),
            "radial_distortion": [0.0] * 3,
            "tangential_distortion": [0.0] * 2,
        }
        (root / f"camera/{name}.json").write_text(json.dumps(camera))
    val = [name for name in ids if name.startswith(("rest", "held"))]
    train = [name for name in ids if name not in val]
    bounds = {"near": scene.bounds.near, "far": scene.bounds.far}
    world = {"center": [0, 0, 0], "scale": 1, **bounds}
    for file, content in (
        ("dataset", {"count": len(ids), "ids": ids, "train_ids": train, "val_ids": val}),
        ("metadata", metadata),
        ("scene", world),
    ):
        (root / f"{file}.json").write_text(json.dumps(content))


def write_dycheck(scene: Scene, root: Path) -> None:
    """The scene as DyCheck lists it: the dynamic images alone, made smaller by two."""
    write_nerfies(scene, root)
    metadata = json.loads((root / "metadata.json").read_text())
    (root / "rgb/4x").rename(root / "rgb/2x")
    (root / "splits").mkdir()
    for split, part in (("train", "dynamic"), ("val", "held")):
        names = [name for name in metadata if name.startswith(part)]
        content = {"frame_names": names, "time_ids": [metadata[name]["warp_id"] for name in names]}
        (root / f"splits/{split}.json").write_text(json.dumps(content))


def write_colmap(scene: Scene, root: Path, write_sparse: Callable[..., None]) -> None:
    """The static images as COLMAP poses them, with points in the middle of the scene."""
    (root / "images").mkdir(parents=True)
    views = scene.static.train
    names = [f"{k:03d}.png" for k in range(len(views))]
    for name, pixels in zip(names, views.pixels, strict=True):
        iio.imwrite(root / "images" / name, pixels.numpy())
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    write_sparse(root / "sparse/0", views.cameras, names, points)


def write_videos(scene: Scene, root: Path, write_rig: Callable[..., None]) -> None:
    """The dynamic images as a video of each fixed camera; the held-out one is the first."""
    train, test = scene.dynamic.train, scene.dynamic.test
    shots = {"cam00.mp4": test.pixels[test.view == 0]}
    shots |= {f"cam{v + 1:02d}.mp4": train.pixels[train.view == v] for v in range(3)}
    films = {name: list(pixels[..., :3].numpy()) for name, pixels in shots.items()}
    poses = [test.cameras.camera_to_world[:1], train.cameras.camera_to_world[:3]]
    cameras = replace(train.cameras[[0] * 4], camera_to_world=torch.cat(poses))
    write_rig(root, films, cameras, 1.5, 12.0)


@pytest.fixture
def write_scene(
    tiny_scene: Scene,
    forward_scene: Scene,
    write_sparse: Callable[..., None],
    write_rig: Callable[..., None],
) -> Callable[[str, Path], None]:
    """A function that writes a tiny scene in the layout that a reader reads."""
    writers: dict[str, Callable[[Path], None]] = {
        "NerfstudioReader": partial(write_nerfstudio, tiny_scene),
        "NerfiesReader": partial(write_nerfies, tiny_scene),
        "DycheckReader": partial(write_dycheck, tiny_scene),
        "ColmapReader": partial(write_colmap, tiny_scene, write_sparse=write_sparse),
        "Neural3DVideoReader": partial(write_videos, forward_scene, write_rig=write_rig),
        "LlffReader": partial(export, forward_scene),
    }

    def write(target: str, root: Path) -> None:
        writers.get(target.rpartition(".")[2], partial(export, tiny_scene))(root)

    return write


def scene_config(
    composed: Callable[..., Any],
    name: str,
    tmp_path: Path,
    write_scene: Callable[[str, Path], None],
) -> Any:
    """The whole config of ``data=<name>`` with a tiny scene and tiny fields."""
    choice = [f"data={name}"]
    data = composed(*choice).data
    target = (data.get("reader") or data.get("recipe") or data)["_target_"]
    if name in EMBEDDED:
        choice += [
            *EMBEDDED[name],
            "data.width=24",
            "data.height=18",
            "data.frames=3",
            "data.train_views=2",
            "data.supersample=1",
        ]
    else:
        write_scene(target, tmp_path / "scene")
        choice.append(f"data.root={tmp_path}/scene")
    facing = any(word in target for word in ("Forward", "Llff", "Video"))
    return composed(*choice, *(FORWARD if facing else ()), *TINY)


@pytest.mark.parametrize("name", FILES)
def test_two_steps_of_both_stages(
    name: str,
    composed: Callable[..., Any],
    trainer: Callable[..., Any],
    tmp_path: Path,
    write_scene: Callable[[str, Path], None],
) -> None:
    config = scene_config(composed, name, tmp_path, write_scene)
    module = instantiate(config.data)
    assert isinstance(module, SceneDataModule)
    canonical = instantiate(config.canonical, _convert_="all")
    trainer(max_steps=2).fit(canonical, datamodule=module)
    assert canonical.iteration == 2
    assert canonical.scene_model.canonical.color.values.abs().max() > 0
    assert module.scene.moves is (name not in AT_REST)
    if name in AT_REST:
        return
    build = instantiate(config.deformation, _partial_=True, _convert_="all")
    deformation: DeformationStage = build(canonical.result())
    trainer(max_steps=2).fit(deformation, datamodule=module)
    assert deformation.iteration == 2
    assert module.scene.dynamic.train.flow is not None
    assert torch.isfinite(deformation.field.to_canonical).all()


@pytest.mark.parametrize("name", PUBLISHED_INWARD + PUBLISHED_FORWARD)
def test_a_published_scene_leaves_only_its_folder_to_give(
    composed: Callable[..., Any], name: str
) -> None:
    data = composed(f"data={name}").data
    assert [key for key in data if OmegaConf.is_missing(data, key)] == ["root"]
    forward = name in PUBLISHED_FORWARD
    assert data.name == name and data.background == "white"
    assert data.downscale == (4 if forward else 2)
    assert ("Forward" in data["_target_"]) is forward


def test_the_layouts_say_the_same(
    composed: Callable[..., Any],
    tmp_path: Path,
    tiny_scene: Scene,
    write_scene: Callable[[str, Path], None],
) -> None:
    """One scene through four layouts: the same rays, times and pixels."""
    scenes = {}
    for name in ("inward", "nerfstudio", "nerfies", "dycheck"):
        folder = tmp_path / name
        config = scene_config(composed, name, folder, write_scene)
        scenes[name] = instantiate(config.data).scene
    given = tiny_scene.dynamic.train
    for name, scene in scenes.items():
        train = scene.dynamic.train
        kept = torch.tensor([k for k, n in enumerate(train.names) if "static" not in Path(n).stem])
        views = train[kept] if name == "nerfies" else train
        torch.testing.assert_close(views.times, given.times)
        assert torch.equal(views.pixels, given.pixels)
        for image in range(len(given)):
            expected, found = given.cameras.image_rays(image), views.cameras.image_rays(image)
            torch.testing.assert_close(found.origins, expected.origins, atol=1e-5, rtol=0)
            torch.testing.assert_close(found.directions, expected.directions, atol=1e-5, rtol=0)
