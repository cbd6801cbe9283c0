"""Synchronised videos and their poses as a scene that moves before fixed cameras."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from devrf.geometry.cameras import Cameras
from devrf.pictures.video_file import write_pictures
from devrf.scenes.formats import recognise
from devrf.scenes.formats.neural_3d_video import Neural3DVideoReader
from layouts import write_rig

# Not square. The numbers of the videos leave some out.
WIDTH, HEIGHT, FRAMES = 32, 24, 7
NAMES = ["cam00.mp4", "cam02.mp4", "cam03.mp4", "cam10.mp4"]


@pytest.fixture
def message_of(refusal) -> Callable[..., str]:
    return partial(refusal, Neural3DVideoReader, downscale=1)


def film(camera: int, frames: int = FRAMES, width: int = WIDTH) -> Iterator[np.ndarray]:
    """Frame t of camera k is of one colour: red 30 k, green 30 t."""
    for t in range(frames):
        yield np.full((HEIGHT, width, 3), (30 * camera, 30 * t, 128), dtype=np.uint8)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """Four cameras 1 apart, 6 before what is nearest."""
    root = tmp_path_factory.mktemp("rig") / "coffee"
    where = torch.tensor([[k - 1.5, 0.0, 0.0] for k in range(4)])
    ahead = where + torch.tensor([0.0, 0.0, -1.0])
    cameras = Cameras.looking_at(
        where, ahead, focal=40.0, width=WIDTH, height=HEIGHT, up=torch.tensor([0.0, 1.0, 0.0])
    )
    films = {name: film(k) for k, name in enumerate(NAMES)}
    write_rig(root, films, cameras, 6.0, 60.0)
    return root


@pytest.fixture
def folder(tmp_path, written) -> Path:
    """The same, to be changed."""
    return Path(shutil.copytree(written, tmp_path / "coffee"))


def colours(views) -> list[tuple[int, int]]:
    """Camera and frame of each image, by its colour."""
    middle = views.pixels[:, views.height // 2, views.width // 2, :2].float() / 30
    return [tuple(one) for one in middle.round().int().tolist()]


def test_frames_belong_to_the_cameras_of_their_rows(folder):
    scene = Neural3DVideoReader(folder, downscale=1, frames=None).read()
    assert scene.kind == "forward" and scene.moves and scene.name == "coffee"
    train, test = scene.dynamic.train, scene.dynamic.test
    # All cameras at the first moment, then all at the next; cam00 is held out.
    assert colours(train) == [(k, t) for t in range(FRAMES) for k in (1, 2, 3)]
    assert colours(test) == [(0, t) for t in range(FRAMES)]
    assert train.view.tolist() == [0, 1, 2] * FRAMES
    torch.testing.assert_close(test.times, torch.arange(7) / 6)
    # The unit is 0.75 of the least depth, 6; the rig's middle is the origin.
    places = torch.tensor([-0.5, 0.5, 1.5]) / 4.5
    torch.testing.assert_close(train.cameras.positions[:3, 0], places)
    torch.testing.assert_close(train.cameras.focal[0], torch.tensor([40.0, 40.0]))
    assert colours(scene.static.train) == [(1, 0), (2, 0), (3, 0)]
    assert colours(scene.static.test) == [(0, 0)] and not scene.static.train.times.any()
    assert (train.names[4], test.names[6]) == ("cam03.mp4 frame 1", "cam00.mp4 frame 6")


def test_rows_go_by_characters(folder, caplog):
    """cam20 comes before cam8, as LLFF has it, and the log says so."""
    caplog.set_level("INFO")
    before = Neural3DVideoReader(folder).read().dynamic.test
    names = sorted(path for path in folder.iterdir() if path.suffix == ".mp4")
    for number, path in zip((20, 28, 8, 9), names, strict=True):
        path.rename(folder / f"cam{number}.mp4")
    after = Neural3DVideoReader(folder, test_view=20).read().dynamic.test
    assert torch.equal(after.cameras.camera_to_world, before.cameras.camera_to_world)
    assert torch.equal(after.pixels, before.pixels)
    assert "in the order of their characters: cam20.mp4 before cam8.mp4" in caplog.text


def test_some_frames_some_cameras_another_held_out(folder):
    scene = Neural3DVideoReader(
        folder, downscale=1, frames=3, length=5, test_view=10, train_views=2
    ).read()
    assert colours(scene.dynamic.train) == [(k, t) for t in (0, 2, 4) for k in (0, 1)]
    assert scene.dynamic.train.times.unique().tolist() == [0.0, 0.5, 1.0]
    assert colours(scene.dynamic.test) == [(3, t) for t in (0, 2, 4)]


def as_images(path: Path, into: str = "") -> None:
    """A video's frames in a folder in its place, as ``0.png`` and so on."""
    (path.with_suffix("") / into).mkdir(parents=True)
    for t, picture in enumerate(film(NAMES.index(path.name))):
        Image.fromarray(picture).save(path.with_suffix("") / into / f"{t}.png")
    path.unlink()


def test_frames_may_be_images_and_videos_have_any_suffix(folder):
    as_images(folder / "cam00.mp4")
    as_images(folder / "cam03.mp4", "images")
    (folder / "cam02.mp4").rename(folder / "cam02.MOV")
    # Some of its frames, for a program that wants images: the video is read.
    (folder / "cam10").mkdir()
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "cam10/0.png")
    assert recognise(folder).choice == "neural_3d_video"
    scene = Neural3DVideoReader(folder, downscale=1, frames=None).read()
    train = scene.dynamic.train
    assert colours(train) == [(k, t) for t in range(FRAMES) for k in (1, 2, 3)]
    assert colours(scene.dynamic.test) == [(0, t) for t in range(FRAMES)]
    assert train.names[3:6] == ("cam02.MOV frame 1", "cam03 frame 1", "cam10.mp4 frame 1")


def test_frames_of_another_number_than_the_others_are_warned_of(folder, caplog):
    for name in ("cam00", "cam03"):
        as_images(folder / f"{name}.mp4")
    images = sorted((folder / "cam03").iterdir(), key=lambda path: -int(path.stem))
    for path in images:
        path.rename(path.with_stem(str(int(path.stem) + 1)))
    Neural3DVideoReader(folder, downscale=1).read()
    assert f"cam03/1.png is taken to show the moment of {folder}/cam00/0.png" in caplog.text


def poses(folder: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    np.save(folder / "poses_bounds.npy", change(np.load(folder / "poses_bounds.npy")))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda root: write_pictures(root / "cam03.mp4", film(2, 5), 10),
            "cam03.mp4: 5 frames of 32x24 px, but cam00.mp4 has 7 frames of 32x24 px",
        ),
        (
            lambda root: (root / "cam03.mp4").unlink(),
            "poses_bounds.npy: has 4 cameras, but there are 3 videos",
        ),
        (
            lambda root: [path.unlink() for path in root.glob("cam*")],
            "coffee: 0 videos cam00.mp4, cam01.mp4, …, or folders",
        ),
        (
            lambda root: as_images(root / "cam03.mp4") or (root / "cam03/6.png").unlink(),
            "cam03: 6 frames of 32x24 px, but cam00.mp4 has 7 frames of 32x24 px",
        ),
        (
            lambda root: shutil.copy(root / "cam03.mp4", root / "cam3.mkv"),
            "cam3.mkv: has the number of cam03.mp4, too; remove one of them",
        ),
        (
            lambda root: poses(root, lambda rows: rows * np.where(np.arange(17) == 4, 2, 1)),
            "poses_bounds.npy: 32x24 px, but its camera is one for 32x48 px",
        ),
    ],
)
def test_what_is_wrong_is_one_line(folder, message_of, change, said):
    change(folder)
    assert said in message_of(folder)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"test_view": 1}, "data.test_view: 1 is the number of none of the videos (cam00.mp4, cam"),
        ({"train_views": 4}, "data.train_views: there are 3 videos"),
        ({"length": 9}, "data.length: 9 is more than the 7 frames"),
    ],
)
def test_options_that_do_not_fit(folder, message_of, options, said):
    assert said in message_of(folder, **options)
