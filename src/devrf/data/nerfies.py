"""Scenes of Nerfies and HyperNeRF: a moving camera before a moving subject."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from devrf.data.flow_source import ESTIMATED, EstimatedFlow
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.nerfies import read_nerfies
from devrf.scenes.scene import Background


class NerfiesDataModule(RecordedDataModule):
    """A scene in the layout of Nerfies and HyperNeRF."""

    def __init__(
        self,
        root: str | Path,
        *,
        name: str | None = None,
        downscale: int = 4,
        background: Background = "white",
        bound_scale: float | str = "auto",
        near: float | None = None,
        far: float | None = None,
        box: Sequence[Sequence[float]] | None = None,
        flow: EstimatedFlow = "auto",
        flow_cache: str | Path | None = None,
        frames: int | None = None,
        holdout: int = 8,
        static_until: float = 1.0,
    ) -> None:
        """Say where the scene is and how to read it; it is read when first needed.

        Args:
            root: the scene's folder.
            name: short name; None takes the folder's.
            downscale: integer factor: ``rgb/<downscale>x``, else larger images made smaller.
            background: ``white``, ``black`` or ``random``: what is behind the mattes.
            bound_scale: ``auto`` (room for motion from the silhouettes), or a number ≥ 1.
            near: world units; None: what scene.json says.
            far: world units; None: what scene.json says.
            box: [[x, y, z], [x, y, z]] in world units; None: from the cameras.
            flow: ``dis`` and ``raft`` estimate it, ``none`` does without; ``auto`` estimates
                with DIS where OpenCV is installed, else does without.
            flow_cache: an ``.npz`` that keeps estimated flow; None estimates it every time.
            frames: keep so many times, evenly spread; None: all.
            holdout: without ``val_ids``, one of so many images is held out.
            static_until: the latest time in [0, 1] that counts as static.
        """
        read = partial(
            read_nerfies,
            root,
            name=name,
            downscale=downscale,
            background=background,
            bound_scale=bound_scale,
            near=near,
            far=far,
            box=None if box is None else [list(corner) for corner in box],
            frames=frames,
            holdout=holdout,
            static_until=static_until,
        )
        super().__init__(read, flow, flow_cache, flows=ESTIMATED)
