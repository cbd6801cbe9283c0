"""Small scenes on disk, written on the fly in the published layouts."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.errors import DevrfError
from devrf.geometry.cameras import Cameras, Distortion
from devrf.scenes.export import export
from devrf.scenes.lens import Lens
from devrf.scenes.reader import SceneReader
from devrf.scenes.resampling import shrink_pixels
from devrf.scenes.scene import Scene, Views
from layouts import write_rig, write_scene, write_sparse


@pytest.fixture
def refusal() -> Callable[..., str]:
    """A function that returns the one line with which a reader refuses a scene or an option."""

    def message_of(reader: type[SceneReader], root: Path | str, **options: Any) -> str:
        with pytest.raises(DevrfError) as caught:
            reader(root, **options).read()
        message = str(caught.value)
        assert len(message) < 500 and len(message.splitlines()) == 1 and message.isprintable()
        return message

    return message_of


# Not square, so that a swap of the axes cannot hide: 32 columns, 24 rows.
WIDTH, HEIGHT, ANGLE = 32, 24, 0.8


def ring(count: int, *, width: int, height: int, angle: float, turn: float = 0.0) -> Cameras:
    """``count`` cameras at distance 4 around the origin, 1.2 above it, looking at it."""
    theta = torch.arange(count) * (2 * math.pi / count) + turn
    level = math.sqrt(16 - 1.2**2)
    where = torch.stack(
        [level * theta.cos(), level * theta.sin(), torch.full_like(theta, 1.2)], dim=-1
    )
    focal = width / 2 / math.tan(angle / 2)
    return Cameras.looking_at(
        where, torch.zeros_like(where), focal=focal, width=width, height=height
    )


def frames_json(cameras: Cameras, times: list[float] | None, folder: str) -> list[dict[str, Any]]:
    """The ``frames`` of a transforms file for images ``folder/r_000`` and so on."""
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]])
    frames: list[dict[str, Any]] = []
    for i, pose in enumerate(cameras.camera_to_world):
        frame: dict[str, Any] = {
            "file_path": f"./{folder}/r_{i:03d}",
            "transform_matrix": torch.cat([pose, bottom]).tolist(),
        }
        if times is not None:
            frame["time"] = times[i]
        frames.append(frame)
    return frames


def write_split(
    folder: Path,
    split: str,
    cameras: Cameras,
    times: list[float] | None,
    pixels: Callable[[int], np.ndarray],
    suffix: str = ".png",
    angle: float = ANGLE,
) -> None:
    """One transforms file and its images."""
    (folder / split).mkdir(parents=True, exist_ok=True)
    content = {"camera_angle_x": angle, "frames": frames_json(cameras, times, split)}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    for i in range(len(cameras)):
        iio.imwrite(folder / split / f"r_{i:03d}{suffix}", pixels(i))


def matte(number: int) -> np.ndarray:
    """An RGBA image with an opaque block in the middle, whose red tells the number."""
    image = np.zeros((HEIGHT, WIDTH, 4), dtype=np.uint8)
    image[8:16, 12:20] = (number, 100, 200, 255)
    return image


class SceneFolder:
    """A valid scene of 2 views × 3 frames that a test then breaks in one place."""

    def __init__(self, root: Path) -> None:
        """Write it under ``root``."""
        self.root = root
        self.static, self.dynamic = root / "static", root / "dynamic_2views"
        size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "angle": ANGLE}
        pair = ring(2, turn=0.3, **size)
        moving = pair[[0, 1] * 3]
        self.times = [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]
        write_split(self.static, "train", ring(6, **size), None, matte)
        write_split(self.static, "test", ring(2, turn=0.1, **size), None, matte)
        write_split(self.dynamic, "train", moving, self.times, matte)
        write_split(self.dynamic, "test", ring(1, turn=2.0, **size)[[0] * 3], [0, 0.5, 1], matte)

    def edit(self, file: Path, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the content of a JSON file."""
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))


@pytest.fixture
def scene_folder(tmp_path) -> SceneFolder:
    """A valid scene on disk."""
    return SceneFolder(tmp_path / "scene")


@pytest.fixture
def single_folder(tmp_path) -> Path:
    """A scene in D-NeRF's layout: 8 training images and 3 test images of a moving camera."""
    root = tmp_path / "monocular"
    size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "angle": ANGLE}
    times = [i / 7 for i in range(8)]
    write_split(root, "train", ring(8, **size), times, matte)
    write_split(root, "test", ring(3, turn=0.2, **size), [0.1, 0.4, 0.9], matte)
    return root


@pytest.fixture
def ball_views() -> Callable[..., Views]:
    """A function that makes alpha masks of a ball at places (T, 3), seen by a ring of cameras."""

    def make(places: torch.Tensor, radius: float, count: int = 4, channels: int = 4) -> Views:
        cameras = ring(count, width=96, height=80, angle=0.9)
        images = []
        for place in places:
            for camera in range(count):
                rays = cameras.image_rays(camera)
                offset = place - rays.origins
                along = (offset * rays.directions).sum(dim=1)
                miss = (offset - along[:, None] * rays.directions).norm(dim=1)
                alpha = (miss < radius).to(torch.uint8).reshape(80, 96, 1) * 255
                images.append(alpha.expand(-1, -1, channels))
        total = len(places) * count
        return Views(
            torch.stack(images),
            cameras[list(range(count)) * len(places)],
            torch.linspace(0, 1, len(places)).repeat_interleave(count),
            torch.arange(count).repeat(len(places)),
            tuple(f"{i}" for i in range(total)),
        )

    return make


@pytest.fixture
def ring_cameras() -> Callable[..., Cameras]:
    """The function :func:`ring`."""
    return ring


# A red, a green and a blue ball, none in the middle: a mirrored or turned axis shows.
BALLS = torch.tensor([[1.2, 0.1, 0.45], [-0.6, 1.0, 0.0], [0.1, -1.1, -0.45]])


def balls_picture(pose: torch.Tensor, lens: Lens, width: int, height: int) -> np.ndarray:
    """What a camera with distortion sees of the balls: RGBA, 3 × 3 exact samples a pixel.

    ``pose`` (3, 4) is camera-to-world in OpenGL axes, ``lens`` in pixels of the picture.
    """
    key = tuple(pose.flatten().tolist())
    return shrink_pixels(_balls(key, lens.scaled(3, 3), width * 3, height * 3), width, height)


@cache
def _balls(numbers: tuple[float, ...], lens: Lens, width: int, height: int) -> np.ndarray:
    pose = torch.tensor(numbers, dtype=torch.float64).reshape(3, 4)
    seen = _directions(lens, width, height)
    local = torch.cat([seen * torch.tensor([1, -1]), -torch.ones(height, width, 1)], dim=-1)
    rays = torch.nn.functional.normalize(local @ pose[:, :3].T, dim=-1)
    image = np.zeros((height, width, 4), dtype=np.uint8)
    for ball, center in enumerate(BALLS.double() - pose[:, 3]):
        along = (rays * center).sum(dim=-1, keepdim=True)
        hit = ((center - along * rays).norm(dim=-1) < 0.12).numpy()
        image[hit, ball] = 255
        image[hit, 3] = 255
    return image


@cache
def _directions(lens: Lens, width: int, height: int) -> torch.Tensor:
    """(H, W, 2) where the lens looks in each pixel: x/z and y/z, y down; by OpenCV."""
    (fx, fy), (cx, cy) = lens.focal, lens.center
    (k1, k2, k3, _), tangential = lens.distortion.radial, lens.distortion.tangential
    y, x = np.mgrid[:height, :width] + 0.5
    py = (y - cy) / fy
    px = (x - cx - lens.skew * py) / fx
    straight = cv2.undistortPoints(
        np.stack([px, py], axis=-1).reshape(-1, 1, 2),
        np.eye(3),
        np.array([k1, k2, *tangential, k3]),
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
    )
    return torch.from_numpy(straight.reshape(height, width, 2))


@pytest.fixture
def lens_directions() -> Callable[[Lens, int, int], torch.Tensor]:
    """The function :func:`_directions`."""
    return _directions


def ball_centers(pixels: torch.Tensor) -> torch.Tensor:
    """(3, 2) the centres of mass x, y of the balls in a picture (H, W, 4) uint8."""
    height, width = pixels.shape[:2]
    weight = pixels[..., :3].float() * pixels[..., 3:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    place = torch.stack([x, y], dim=-1) + 0.5
    mass = weight.sum(dim=(0, 1))
    return torch.einsum("hwb,hwc->bc", weight, place) / mass[:, None]


@pytest.fixture
def picture() -> Callable[..., np.ndarray]:
    """The function :func:`balls_picture`."""
    return balls_picture


@pytest.fixture
def balls_are_where_they_project() -> Callable[..., None]:
    """A function that compares each image with where its camera projects the balls."""

    def check(views: Views, balls: torch.Tensor = BALLS) -> None:
        for image, pixels in enumerate(views.pixels):
            expected, depth = views.cameras.project_into(image, balls)
            assert (depth > 0).all()
            torch.testing.assert_close(ball_centers(pixels), expected, atol=0.15, rtol=0)

    return check


LISTED = ("nerfstudio", "nerfies", "dycheck", "panoptic", "easyvolcap")


@pytest.fixture
def write_layout(
    tiny_scene: Scene,
    tiny_toy: Scene,
) -> Callable[[str, Path], None]:
    """A function that writes a tiny scene in the layout that ``data=CHOICE`` reads."""

    def colmap(root: Path) -> None:
        views = tiny_scene.static.train
        names = [f"{k}.png" for k in range(len(views))]
        points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)) - 0.5
        write_sparse(root / "sparse/0", views.cameras, names, points)
        (root / "images").mkdir()
        for name, pixels in zip(names, views.pixels, strict=True):
            iio.imwrite(root / "images" / name, pixels.numpy())

    def colmap_binary(root: Path) -> None:
        colmap(root)
        model = root / "sparse/0"
        library = importlib.import_module("pycolmap")
        library.Reconstruction(model).write_binary(model)
        for file in model.glob("*.txt"):
            file.unlink()

    def videos(root: Path) -> None:
        train, test = tiny_toy.dynamic.train, tiny_toy.dynamic.test
        shots = {"cam00.mp4": test.pixels}
        shots |= {f"cam{v + 1:02d}.mp4": train.pixels[train.view == v] for v in range(3)}
        films = {name: list(pixels.numpy()) for name, pixels in shots.items()}
        poses = [test.cameras.camera_to_world[:1], train.cameras.camera_to_world[:3]]
        cameras = replace(train.cameras[[0] * 4], camera_to_world=torch.cat(poses))
        write_rig(root, films, cameras, 1.5, 12.0)

    writers: dict[str, Callable[[Path], None]] = {
        "inward": partial(export, tiny_scene),
        "forward": partial(export, tiny_toy),
        **{name: partial(write_scene, name, tiny_scene) for name in LISTED},
        "colmap": colmap,
        "colmap_binary": colmap_binary,
        "neural_3d_video": videos,
    }
    return lambda choice, root: writers[choice](root)


class LlffFolder:
    """A valid forward-facing scene, written by hand, that a test then breaks in one place.

    9 static cameras that look along world −x, 4.5 world units apart along world y; world z is
    up. The least depth is 6, so the reader's unit is 4.5. Then 3 fixed views of 3 frames, in
    the reader's own frame. Images are 24×16; static poses speak of 96×64, the others of 48×32.
    """

    WIDTH, HEIGHT = 24, 16

    def __init__(self, root: Path) -> None:
        """Write it under ``root``."""
        self.root = root
        self.static, self.dynamic = root / "static", root / "dynamic_3views"
        self.images(self.static / "images_4", 9)
        self.save("static/poses_bounds.npy", self.static_rows())
        for view in range(3):
            self.images(self.dynamic / f"view{view + 1}" / "images_4", 3, first=10 * view)
        poses = np.zeros((5, 3, 5))
        poses[:, :, :3] = np.eye(3)
        # Two of the static cameras come first; the last three are the fixed ones.
        poses[:, 0, 3] = [-4, -3, -0.5, 0, 0.5]
        poses[:, :, 4] = [32, 48, 40]
        self.save("dynamic_3views/poses.npy", poses)
        self.save("dynamic_3views/bds.npy", np.tile([1.2, 9.0], (5, 1)))

    @staticmethod
    def static_rows() -> np.ndarray:
        """(9, 17): axes [down, right, back], position, [H, W, focal], near, far."""
        matrix = np.zeros((9, 3, 5))
        matrix[:, :, 0] = [0, 0, -1]
        matrix[:, :, 1] = [0, 1, 0]
        matrix[:, :, 2] = [1, 0, 0]
        matrix[:, :, 3] = [10, 20, 30]
        matrix[:, 1, 3] += 4.5 * np.arange(9)
        matrix[:, :, 4] = [64, 96, 80]
        depths = np.tile([6.0, 50.0], (9, 1))
        depths[1:, 0] = 7
        return np.concatenate([matrix.reshape(9, 15), depths], axis=1)

    def save(self, file: str, values: np.ndarray) -> Path:
        """Write an array; its path."""
        np.save(self.root / file, values)
        return self.root / file

    def images(self, folder: Path, count: int, first: int = 0, times: int = 1) -> None:
        """Images 000.png, …, ``times`` as large, whose red tells the number."""
        folder.mkdir(parents=True, exist_ok=True)
        for k in range(count):
            image = np.full((self.HEIGHT * times, self.WIDTH * times, 3), 50, dtype=np.uint8)
            image[..., 0] = first + k
            iio.imwrite(folder / f"{k:03d}.png", image)

    def flow(self, view: int, name: str, value: float, direction: str = "bwd") -> None:
        """A flow file of ``view`` whose vectors are all (value, −value)."""
        folder = self.dynamic / f"view{view}" / "images_4_flow"
        folder.mkdir(exist_ok=True)
        vectors = np.full((self.HEIGHT, self.WIDTH, 2), value, dtype=np.float32)
        vectors[..., 1] *= -1
        mask = np.ones((self.HEIGHT, self.WIDTH), dtype=bool)
        np.savez(folder / f"{name}_{direction}.npz", flow=vectors, mask=mask)


@pytest.fixture
def llff_folder(tmp_path) -> LlffFolder:
    """A valid forward-facing scene on disk."""
    return LlffFolder(tmp_path / "toy")


BALLS_LENS = Lens((88.0, 84.0), (42.0, 28.0), Distortion((-0.3, 0.1, 0.01, 0.0), (0.006, -0.008)))


class BallsFolder:
    """Writes ``transforms.json`` and pictures of the balls, 80×60 px, in nerfstudio's layout."""

    WIDTH, HEIGHT = 80, 60
    # BALLS_LENS in the words of the file, and keys that say nothing of the cameras.
    SHARED = {
        **{"camera_model": "OPENCV", "fl_x": 88.0, "fl_y": 84.0, "cx": 42.0, "cy": 28.0},
        **{"w": 80, "h": 60, "k1": -0.3, "k2": 0.1, "k3": 0.01, "p1": 0.006, "p2": -0.008},
        **{"applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], "applied_scale": 0.5},
    }

    @classmethod
    def write(
        cls,
        folder: Path,
        times: list[float] | None,
        *,
        turn: float = 0.0,
        lens: Callable[[int], Lens] = lambda index: BALLS_LENS,
        shared: dict[str, Any] = SHARED,
        views: int | None = None,
    ) -> dict[str, Any]:
        """One image for each time (None: nine images without), by ``views`` cameras in turn."""
        count = 9 if times is None else len(times)
        cameras = ring(views or count, turn=turn, width=cls.WIDTH, height=cls.HEIGHT, angle=0.9)
        frames = frames_json(cameras[torch.arange(count) % len(cameras)], times, "images")
        (folder / "images").mkdir(parents=True)
        for i, frame in enumerate(frames):
            frame["file_path"] += ".png"
            pose = torch.tensor(frame["transform_matrix"][:3])
            picture = balls_picture(pose, lens(i), cls.WIDTH, cls.HEIGHT)
            iio.imwrite(folder / frame["file_path"], picture)
        content = {**shared, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(content))
        return content

    @staticmethod
    def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the content of ``transforms.json``."""
        content = json.loads((folder / "transforms.json").read_text())
        change(content)
        (folder / "transforms.json").write_text(json.dumps(content))


@pytest.fixture
def balls() -> type[BallsFolder]:
    """The writer of pictures of the balls."""
    return BallsFolder
