"""COLMAP's sparse models, and the normalised world of one, with the scene's bounds."""

from __future__ import annotations

import importlib
import mmap
import os
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import normalize

from devrf.errors import DevrfError
from devrf.geometry.box import Box
from devrf.geometry.poses import average_pose, from_opencv, relative_to
from devrf.scenes.bounds import frusta_in, nearest_point, reference_space
from devrf.scenes.files import MOST_IMAGES, decoding, entries
from devrf.scenes.lens import CameraKeys, Intrinsics, intrinsics_of
from devrf.scenes.names import in_order
from devrf.scenes.splits import pinholes
from devrf.scenes.transforms import SceneBounds
from devrf.scenes.validation import FARTHEST, in_reach, scene_error
from devrf.system.options import abbreviated

# The files of a model, binary or as text.
PARTS = ("cameras", "images", "points3D")
# Further ones, of COLMAP's later versions.
LATER_PARTS = ("rigs", "frames")
# Bytes of a text file at most.
LARGEST_TEXT = 2**28
# Records of binary files that end with a list: how many there may be, bytes before the list without
# a name, bytes of its length, and bytes of an entry.
LISTS = {
    "frames": (MOST_IMAGES, 64, 4, 16),
    "images": (MOST_IMAGES, 64, 8, 24),
    "points3D": (3_000_000, 43, 8, 8),
}
# Parameters of each camera model that can be read, in COLMAP's order; further ones have to be 0.
PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    # Its next three parameters divide the radial terms.
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
}


@dataclass(frozen=True)
class ModelImage:
    """An entry of ``images``.

    Attributes:
        name: relative to the folder of images.
        camera: number of its camera.
        to_camera: (3, 4) rigid, from the world to the camera: x right, y down, z ahead.
        points: (K,) int64, numbers of the points that it shows.
    """

    name: str
    camera: int
    to_camera: npt.NDArray[np.float64]
    points: npt.NDArray[np.int64]


@dataclass(frozen=True)
class SparseModel:
    """A model, images in the order of their names.

    Attributes:
        folder: its folder.
        cameras: by their numbers, in the keys of a transforms file (``fl_x``, ``cx``, ``k1``);
            pixels, (0, 0) is the outer corner of the first one.
        images: N of them.
        points: (P, 3) float64, world units.
        numbers: (P,) int64 ascending, the numbers of the points.
    """

    folder: Path
    cameras: dict[int, dict[str, float]]
    images: tuple[ModelImage, ...]
    points: npt.NDArray[np.float64]
    numbers: npt.NDArray[np.int64]

    @cached_property
    def poses(self) -> Tensor:
        """(N, 3, 4) float64 camera-to-world, OpenGL axes, world units."""
        return from_opencv(torch.from_numpy(np.stack([i.to_camera for i in self.images])))

    @property
    def intrinsics(self) -> list[Intrinsics]:
        """N, as the readers have them."""
        cameras = [self.cameras[image.camera] for image in self.images]
        return [
            intrinsics_of(CameraKeys.model_construct(None, **keys), self.folder) for keys in cameras
        ]

    def depths(self, image: int) -> Tensor:
        """(K,) float64 depths of the points of an image along its axis, world units."""
        visible = np.intersect1d(self.images[image].points, self.numbers)
        row = np.searchsorted(self.numbers, visible)
        pose = self.poses[image]
        offset = torch.from_numpy(self.points[row]) - pose[:, 3]
        return -(offset @ pose[:, 2])


@dataclass(frozen=True)
class ModelFolders:
    """The folders of a scene that hold a model, or a part of one.

    Attributes:
        whole: those with all files of a model, ``sparse/0`` first.
        missing: the first file that each of the others lacks, by the folder.
    """

    whole: list[Path] = field(default_factory=list)
    missing: dict[Path, Path] = field(default_factory=dict)

    @property
    def lacks(self) -> Path | None:
        """The missing file, if no model is whole, but some files of one exist."""
        return None if self.whole else next(iter(self.missing.values()), None)

    def check(self) -> None:
        """DevrfError that names the missing file :attr:`lacks`, if there is one."""
        if self.lacks is not None:
            raise scene_error(
                self.lacks,
                f"no such file; a COLMAP model is {', '.join(PARTS)}, all .bin or all .txt: copy "
                "it from where the mapper wrote it, or run the mapper again",
            )


def model_folders(root: Path) -> ModelFolders:
    """The folders of models: those in ``sparse/``, itself, and the same below ``colmap/``."""
    models = ModelFolders()
    for above in (root / "sparse", root / "colmap/sparse"):
        inner = [path for path in entries(above) if path.is_dir()] if os.path.isdir(above) else []
        for folder in (*in_order(inner, name=lambda path: path.name, where=above), above):
            lacks = [
                [file for part in PARTS if not os.path.isfile(file := folder / f"{part}.{suffix}")]
                for suffix in ("bin", "txt")
            ]
            fewest = min(lacks, key=len)
            if not fewest:
                models.whole.append(folder)
            elif len(fewest) < len(PARTS):
                models.missing[folder] = fewest[0]
    return models


def scene_model(root: Path) -> tuple[SparseModel, list[str]]:
    """The model of a scene that poses the most images, the first of equal ones; and the others.

    The mapper writes several if it cannot join all images. The others are in words, for the log.
    DevrfError if there is no model, or none can be read; the message names the missing file.
    """
    folders = model_folders(root)
    folders.check()
    models = dict[Path, Any]()
    others = {folder: f"no {file.name}" for folder, file in folders.missing.items()}
    errors = list[DevrfError]()
    for folder in folders.whole:
        try:
            models[folder] = _opened(folder)
            others[folder] = f"{models[folder].num_reg_images()} images"
        except DevrfError as error:
            errors.append(error)
            others[folder] = "not readable"
    if not models:
        nothing = "no COLMAP model; set data.root to the folder of sparse/ and images/"
        raise errors[0] if errors else scene_error(root, nothing)
    best = max(models, key=lambda folder: models[folder].num_reg_images())
    del others[best]
    words = [f"{folder.relative_to(root)} ({what})" for folder, what in others.items()]
    return _of_reconstruction(best, models[best]), words


def read_model(folder: Path) -> SparseModel:
    """The sparse model in a folder, read by pycolmap: binary if both forms exist.

    DevrfError without pycolmap, for a missing or damaged file, or an unknown camera model.
    """
    return _of_reconstruction(folder, _opened(folder))


def colmap(wanted: object = "stage=capture") -> Any:
    """COLMAP's library, which is ``wanted``, without its log; DevrfError without the library."""
    try:
        library: Any = importlib.import_module("pycolmap")
    except ModuleNotFoundError:
        raise scene_error(wanted, 'needs pycolmap; run pip install "devrf[capture]"') from None
    library.logging.minloglevel = 3
    return library


def _opened(folder: Path) -> Any:
    """The pycolmap.Reconstruction in a folder."""
    library = colmap(folder)
    with decoding(folder, "COLMAP model", "run COLMAP's mapper again"):
        _check_files(folder)
        return library.Reconstruction(folder)


def _check_files(folder: Path) -> None:
    """ValueError if COLMAP would wait for a file of a model, or find no end of it.

    COLMAP itself checks the binary files that are not checked here.
    """
    binary = all(os.path.isfile(folder / f"{part}.bin") for part in PARTS)
    for part in (*PARTS, *LATER_PARTS):
        file = folder / f"{part}.{'bin' if binary else 'txt'}"
        if not os.path.isfile(file):
            if file.exists():
                raise ValueError(f"{file.name} is no file")
        elif not binary and file.stat().st_size > LARGEST_TEXT:
            raise ValueError(f"{file.name} is larger than 256 MiB: convert the model to binary")
        elif binary and part in LISTS:
            _check_counts(file, *LISTS[part])


def _check_counts(file: Path, most: int, fixed: int, width: int, entry: int) -> None:
    """ValueError if a binary file counts more than it may, or than it holds."""
    with file.open("rb") as stream:  # mapped: it may be larger than memory, of zeros
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    count, at = int.from_bytes(data[:8], "little"), 8
    if count > most:
        raise ValueError(f"{file.name} counts more than {most}")
    while count > 0 and at < len(data):
        at += fixed
        if file.stem == "images":
            at = data.find(b"\0", at) + 1 or len(data)  # after its name
        at += width + entry * int.from_bytes(data[at : at + width], "little")
        count -= 1
    if count > 0 or at > len(data):
        raise ValueError(f"{file.name} counts more than it holds")


def _of_reconstruction(folder: Path, model: Any) -> SparseModel:
    with decoding(folder, "COLMAP model", "run COLMAP's mapper again"):  # numbers may be too large
        images = [_image(folder, image) for image in model.images.values() if image.has_pose]
        numbers = np.array(sorted(model.point3D_ids()), np.int64)
    if not images:
        raise scene_error(folder, "poses no image; run COLMAP's mapper again")
    ordered = tuple(sorted(images, key=lambda image: image.name))
    for before, after in pairwise(ordered):
        if before.name == after.name:
            raise scene_error(
                folder,
                f"poses {abbreviated(after.name)} twice; text models cut names at spaces: rename "
                "the images, and run COLMAP again",
            )
    used = sorted({image.camera for image in images})
    cameras = {number: _camera(folder, model.cameras[number]) for number in used}
    points = np.array([model.point3D(n).xyz for n in numbers.tolist()], np.float64)
    return SparseModel(folder, cameras, ordered, points.reshape(-1, 3), numbers)


def _camera(folder: Path, camera: Any) -> dict[str, float]:
    model = str(camera.model_name)
    names = PARAMETERS.get(model, ())
    values = camera.params.tolist()
    if not names or any(values[len(names) :]):
        raise scene_error(
            folder,
            f"camera model {model} is not supported, only {', '.join(PARAMETERS)} (k4 to k6 all "
            "0); run COLMAP's image_undistorter, and give its folder",
        )
    parameters = dict(zip(names, values, strict=False))
    focal = parameters.pop("f", 0.0)
    fx = parameters.pop("fx", focal)
    fy = parameters.pop("fy", focal)
    return {"fl_x": fx, "fl_y": fy, "w": camera.width, "h": camera.height, **parameters}


def _image(folder: Path, image: Any) -> ModelImage:
    try:
        name = str(image.name)
    except UnicodeDecodeError as error:
        name = error.object.decode(errors="backslashreplace")
        what = f"the name of its image {name} is not UTF-8 text; rename it, and run COLMAP again"
        raise scene_error(folder, what) from None
    pose = image.cam_from_world()
    pose.rotation.normalize()
    visible = np.array([point.point3D_id for point in image.get_observation_points2D()], np.int64)
    return ModelImage(name, image.camera_id, pose.matrix(), visible)


Corner = tuple[float, float, float]
Facing = Literal["auto", "forward", "inward"]

# Cameras that look within so many degrees of one direction face the scene from one side.
ONE_SIDE = 45.0
# The widest box that is worth normalised device coordinates, in widths of their reference camera's
# picture: DirectVoxGO's boxes of LLFF's scenes are 1.67 wide. Cameras that turn, or come near, make
# a wider one, most of which no camera sees.
WIDEST = 1.7
# The least number of points, counted in every image that shows them, for near and far.
LEAST_POINTS = 50
# So many per cent of the points on either side may be wrong.
OUTLIERS = 1.0
# So many per cent of the points around the middle lie beyond each face of the inner box, before
# its margin is added. In a video they are more, so that voxels are finer where it looks: methods
# for videos also move points outside the box.
LEFT_OUT = 2.0
LEFT_OUT_OF_VIDEO = 5.0
# The nearest point's distance in the forward-facing world, whose unit is LLFF's.
NEAREST = 1 / 0.75
# Median distance of cameras around a scene from its middle, in world units.
AROUND = 4.0


def normalised(
    model: SparseModel, facing: Facing = "auto", *, left_out: float = LEFT_OUT
) -> tuple[Tensor, SceneBounds]:
    """The poses of a model in a world of its own origin, axes and unit, and the bounds there.

    ``facing`` is the kind of capture; ``left_out`` is the percentage of the points beyond each face
    of the inner box, before its margin, if points give the box. DevrfError if points or cameras do
    not determine the bounds.

    Returns:
        (N, 3, 4) float64 camera-to-world, OpenGL axes; and ``ndc`` or ``contracted``, distances,
        and the part that the cameras look at: no box for ``ndc``, and if the cameras' axes meet:
        then the part that all cameras see is the better guess.
    """
    poses = model.poses
    near, far = _depth_range(model)
    if facing == "auto":
        facing = "forward" if widest_angle(poses) <= ONE_SIDE else "inward"
    if facing == "forward":
        scale = NEAREST / near
        poses = relative_to(average_pose(poses), poses, scale)
        near, far, box = 1.0, far * scale, None
    else:
        poses, scale, box = _inward(poses, torch.from_numpy(model.points), left_out)
        near, far = 0.5 * near * scale, far * scale
    here = bool(in_reach(poses[:, :, 3]).all())
    if not here or not 0 < near < far <= FARTHEST:  # NaN compares false
        raise scene_error(
            model.folder, f"its cameras do not look {facing} at a scene; run COLMAP's mapper again"
        )
    space = "ndc" if facing == "forward" else "contracted"
    bounds = {"space": space, "near": near, "far": far, "box": box}
    return poses, SceneBounds.model_validate(bounds)


def _depth_range(model: SparseModel) -> tuple[float, float]:
    """Least and largest depth of the points, each in every image that shows it; model's unit."""
    depths = torch.cat([model.depths(k) for k in range(len(model.images))])
    depths = depths[depths > 0]
    if len(depths) < LEAST_POINTS:
        raise scene_error(
            model.folder,
            f"its images show {len(depths)} sparse points, expected {LEAST_POINTS} or more; "
            "film it with more texture in sight",
        )
    near = float(np.percentile(depths.numpy(), OUTLIERS))
    far = float(np.percentile(depths.numpy(), 100 - OUTLIERS))
    return near, far


def ndc_holds(model: SparseModel) -> bool:
    """Whether NDC is a good space for the video of one hand-held camera.

    The camera looks within :data:`ONE_SIDE` of one direction, from behind one plane with all of the
    scene before it, and its view from there on is no wider than :data:`WIDEST`. DevrfError if there
    are too few points.
    """
    nearest, _ = _depth_range(model)
    plane = nearest / NEAREST
    poses = relative_to(average_pose(model.poses), model.poses)
    if widest_angle(model.poses) > ONE_SIDE or float(poses[:, 2, 3].min()) <= -plane:
        return False
    keys = [model.cameras[image.camera] for image in model.images]
    sizes = [(int(camera["w"]), int(camera["h"])) for camera in keys]
    lenses = [
        intrinsics.lens(width, height, model.folder)
        for intrinsics, (width, height) in zip(model.intrinsics, sizes, strict=True)
    ]
    cameras = pinholes(poses, lenses, sizes)
    space = reference_space(cameras, plane)
    try:
        ends = frusta_in(space, cameras, [image.name for image in model.images])
    except DevrfError:
        return False
    across = ends[:, :2].amax(dim=0) - ends[:, :2].amin(dim=0)
    return float(across.max()) / 2 <= WIDEST  # NDC are from −1 to 1


def widest_angle(poses: Tensor) -> float:
    """The largest angle in degrees between a camera's axis and their mean."""
    axes = -poses[:, :, 2]
    mean = normalize(axes.sum(dim=0), dim=0)
    return float(torch.rad2deg((axes @ mean).clamp(-1, 1).acos()).max())


def _inward(
    poses: Tensor, points: Tensor, left_out: float
) -> tuple[Tensor, float, tuple[Corner, Corner] | None]:
    """Poses in the world of an inward-facing scene, its unit in the model's, and its inner box."""
    axes_meet = nearest_point(poses[:, :, 3], poses[:, :, 2], 1e-2)
    # The axes of cameras that do not go round the scene meet anywhere, or behind them.
    if axes_meet is not None:
        ahead = ((axes_meet - poses[:, :, 3]) * -poses[:, :, 2]).sum(dim=1).median()
        if widest_angle(poses) <= ONE_SIDE or float(ahead) <= 0:
            axes_meet = None
    middle = points.median(dim=0).values if axes_meet is None else axes_meet
    # z up, as far as the cameras were held upright.
    up = normalize(poses[:, :, 1].sum(dim=0), dim=0)
    aside = torch.eye(3, dtype=poses.dtype)[int(up.abs().argmin())]
    right = normalize(torch.linalg.cross(aside, up), dim=0)
    frame = torch.stack([right, torch.linalg.cross(up, right), up, middle], dim=1)
    scale = AROUND / float((poses[:, :, 3] - middle).norm(dim=1).median())
    poses = relative_to(frame, poses, scale)
    if axes_meet is not None:
        # Sparse points are on floor and walls, too: the subject would have a fraction of the voxels
        # in their box.
        return poses, scale, None
    # The span of the sparse points around the middle, within the cameras' circle.
    points = (points - frame[:, 3]) @ frame[:, :3] * scale
    around = points[points.norm(dim=1) < AROUND]
    if len(around) < 10:
        around = points
    low = np.percentile(around.numpy(), left_out, axis=0).clip(-AROUND, AROUND)
    high = np.percentile(around.numpy(), 100 - left_out, axis=0).clip(-AROUND, AROUND)
    margin = 0.1 * np.maximum(high - low, 0.1 * AROUND)
    inner = Box.of((low - margin).tolist(), (high + margin).tolist())
    return poses, scale, (inner.low, inner.high)
