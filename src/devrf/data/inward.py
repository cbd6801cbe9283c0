"""Inward-facing scenes from disk: cameras around a scene that look at its middle."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from devrf.data.flow_source import FlowSource, files_or_none
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.blender import read_blender
from devrf.scenes.scene import Background


class InwardFacingDataModule(RecordedDataModule):
    """A scene in DeVRF's published Blender layout, or D-NeRF's (method §4)."""

    def __init__(
        self,
        root: str | Path,
        *,
        name: str | None = None,
        dynamic: str | None = None,
        downscale: int = 1,
        background: Background = "white",
        bound_scale: float | str = "auto",
        near: float | None = None,
        far: float | None = None,
        box: Sequence[Sequence[float]] | None = None,
        flow: FlowSource = "auto",
        flow_cache: str | Path | None = None,
        train_views: int | None = None,
        frames: int | None = None,
        static_until: float = 1.0,
    ) -> None:
        """Say where the scene is and how to read it; it is read when first needed.

        Args:
            root: the scene's folder.
            name: short name; None takes the folder's.
            dynamic: which ``dynamic_*views`` folder, where there are several.
            downscale: integer factor by which images and flow are made smaller.
            background: ``white``, ``black`` or ``random``: what is behind the mattes.
            bound_scale: ``auto`` (room for motion from the silhouettes), or a number ≥ 1.
            near: world units; None: from the cameras.
            far: world units; None: from the cameras.
            box: [[x, y, z], [x, y, z]] in world units; None: from the cameras.
            flow: ``files`` reads the scene's, ``dis`` and ``raft`` estimate it, ``none`` does
                without; ``auto`` reads the files, else estimates with DIS where OpenCV is
                installed, else does without.
            flow_cache: an ``.npz`` that keeps estimated flow; None estimates it every time.
            train_views: train on the first so many dynamic views; None: all.
            frames: keep so many times, evenly spread; None: all.
            static_until: without a static set, the latest time that counts as static.
        """
        read = partial(
            read_blender,
            root,
            name=name,
            dynamic=dynamic,
            downscale=downscale,
            background=background,
            bound_scale=bound_scale,
            near=near,
            far=far,
            box=None if box is None else [list(corner) for corner in box],
            flow=files_or_none(flow),
            train_views=train_views,
            frames=frames,
            static_until=static_until,
        )
        super().__init__(read, flow, flow_cache)
