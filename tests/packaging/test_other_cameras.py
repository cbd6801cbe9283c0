"""docs/capture.md: what another program has posed becomes a scene by the scripts that it shows."""

from __future__ import annotations

import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from devrf.scenes.formats.nerfstudio import NerfstudioReader
from devrf.scenes.procedural import ProceduralForwardScene
from devrf.scenes.scene import Views
from devrf.scenes.splits import every_nth

PAGE = Path(__file__).parents[2] / "docs" / "capture.md"
SCRIPTS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def film() -> Views:
    """What one hand films."""
    small = {"frames": 10, "width": 40, "height": 30, "supersample": 1}
    return ProceduralForwardScene(camera="handheld", **small)().dynamic.train


def opencv(film: Views) -> np.ndarray:
    """(N, 4, 4) float32, camera to world, y down and z ahead."""
    poses = np.tile(np.eye(4), (len(film), 1, 1))
    poses[:, :3] = film.cameras.camera_to_world.numpy()
    return (poses @ OPENCV).astype(np.float32)


def check(folder: Path, film: Views, frames: list[int]) -> Views:
    """Read what a script wrote and compare cameras and times; one frame in eight is held out."""
    scene = NerfstudioReader(folder, downscale=1).read()
    train = scene.dynamic.train
    places, held_out = every_nth(len(frames), 8)
    learned = [frames[k] for k in places]
    assert train.by_moving_camera and len(scene.dynamic.test) == len(held_out) == 1
    times = torch.tensor([frame / 9 for frame in learned])
    torch.testing.assert_close(train.times, times)
    # The world of a scene without bounds is the file's.
    where = film.cameras.camera_to_world[learned]
    torch.testing.assert_close(train.cameras.camera_to_world, where, atol=1e-5, rtol=0)
    torch.testing.assert_close(train.cameras.focal, film.cameras.focal[learned])
    torch.testing.assert_close(train.cameras.center, film.cameras.center[learned])
    return train


def test_megasam(film, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs_cvd").mkdir()
    fx, fy = film.cameras.focal[0].tolist()
    cx, cy = film.cameras.center[0].tolist()
    np.savez(
        "outputs_cvd/walk_sgd_cvd_hr.npz",
        images=film.pixels.numpy(),
        cam_c2w=opencv(film),
        intrinsic=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
    )
    exec(SCRIPTS[0], {})
    train = check(tmp_path / "mine", film, list(range(10)))
    learned, _ = every_nth(10, 8)
    assert torch.equal(train.pixels, film.pixels[learned])


def test_vipe(film, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("pose", "intrinsics", "rgb"):
        (tmp_path / "vipe_results" / name).mkdir(parents=True)
    iio.imwrite("vipe_results/rgb/walk.mp4", film.pixels.numpy(), fps=10)
    placed = np.array([k for k in range(10) if k != 3])
    lens = torch.cat([film.cameras.focal, film.cameras.center], dim=1).numpy()
    np.savez("vipe_results/pose/walk.npz", data=opencv(film)[placed], inds=placed)
    np.savez("vipe_results/intrinsics/walk.npz", data=lens, inds=np.arange(10))
    exec(SCRIPTS[1], {})
    check(tmp_path / "mine", film, placed.tolist())
