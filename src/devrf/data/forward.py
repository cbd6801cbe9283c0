"""Forward-facing scenes from disk: cameras that face a scene from one side."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from devrf.data.flow_source import FlowSource, files_or_none
from devrf.data.recorded import RecordedDataModule
from devrf.scenes.llff import read_llff
from devrf.scenes.scene import Background


class ForwardFacingDataModule(RecordedDataModule):
    """A scene in DeVRF's published forward-facing layout: LLFF's, and fixed views (method §4)."""

    def __init__(
        self,
        root: str | Path,
        *,
        name: str | None = None,
        dynamic: str | None = None,
        downscale: int = 4,
        background: Background = "white",
        test_view: int = -1,
        holdout: int = 8,
        near: float = 1.0,
        flow: FlowSource = "auto",
        flow_cache: str | Path | None = None,
        train_views: int | None = None,
        frames: int | None = None,
    ) -> None:
        """Say where the scene is and how to read it; it is read when first needed.

        Args:
            root: the scene's folder.
            name: short name; None takes the folder's.
            dynamic: which ``dynamic_*views`` folder, where there are several.
            downscale: integer factor: images from ``images_<downscale>``, or made smaller.
            background: ``white``, ``black`` or ``random``: what is behind the mattes.
            test_view: the fixed view to hold out: 4 is ``view4``, −1 the last.
            holdout: every so manieth static image is held out.
            near: distance of the near plane; the nearest point of the static scene is at 1/0.75.
            flow: ``files`` reads the scene's, ``dis`` and ``raft`` estimate it, ``none`` does
                without; ``auto`` reads the files, else estimates with DIS where OpenCV is
                installed, else does without.
            flow_cache: an ``.npz`` that keeps estimated flow; None estimates it every time.
            train_views: train on the first so many of the other fixed views; None: all.
            frames: keep so many times, evenly spread; None: all.
        """
        read = partial(
            read_llff,
            root,
            name=name,
            dynamic=dynamic,
            downscale=downscale,
            background=background,
            test_view=test_view,
            holdout=holdout,
            near=near,
            flow=files_or_none(flow),
            train_views=train_views,
            frames=frames,
        )
        super().__init__(read, flow, flow_cache)
