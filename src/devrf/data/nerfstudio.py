"""Inward-facing scenes from nerfstudio's ``transforms.json``, with a time on each image."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from devrf.data.flow_source import ESTIMATED, EstimatedFlow
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.masks import Masks
from devrf.scenes.nerfstudio import read_nerfstudio
from devrf.scenes.scene import Background


class NerfstudioDataModule(RecordedDataModule):
    """A scene in nerfstudio's layout, one file or ``static/`` and ``dynamic/``."""

    def __init__(
        self,
        root: str | Path,
        *,
        name: str | None = None,
        downscale: int = 1,
        background: Background = "white",
        bound_scale: float | str = "auto",
        near: float | None = None,
        far: float | None = None,
        box: Sequence[Sequence[float]] | None = None,
        flow: EstimatedFlow = "auto",
        flow_cache: str | Path | None = None,
        train_views: int | None = None,
        frames: int | None = None,
        holdout: int = 8,
        static_until: float | None = None,
        masks: Masks = "ignore",
    ) -> None:
        """Say where the scene is and how to read it; it is read when first needed.

        Args:
            root: the scene's folder.
            name: short name; None takes the folder's.
            downscale: integer factor by which images are made smaller.
            background: ``white``, ``black`` or ``random``: what is behind the mattes.
            bound_scale: ``auto`` (room for motion from the silhouettes), or a number ≥ 1.
            near: world units; None: from the cameras.
            far: world units; None: from the cameras.
            box: [[x, y, z], [x, y, z]] in world units; None: from the cameras.
            flow: ``dis`` and ``raft`` estimate it, ``none`` does without; ``auto`` estimates
                with DIS where OpenCV is installed, else does without.
            flow_cache: an ``.npz`` that keeps estimated flow; None estimates it every time.
            train_views: train on the first so many dynamic views; None: all.
            frames: keep so many times, evenly spread; None: all.
            holdout: without lists in the file, one of so many images is held out.
            static_until: the latest time that counts as static; None: 0 where several images
                are of time 0, else 1.
            masks: ``ignore``: what the frames' masks leave out is neither learned from nor
                scored; ``matte``: it is background; ``none``: they are left alone.
        """
        read = partial(
            read_nerfstudio,
            root,
            name=name,
            downscale=downscale,
            background=background,
            bound_scale=bound_scale,
            near=near,
            far=far,
            box=None if box is None else [list(corner) for corner in box],
            train_views=train_views,
            frames=frames,
            holdout=holdout,
            static_until=static_until,
            masks=masks,
        )
        super().__init__(read, flow, flow_cache, flows=ESTIMATED)
