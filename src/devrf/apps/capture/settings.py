"""The settings ``capture.…``; without heavy imports, because every command reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from devrf.errors import DevrfError

# capture.mattes=subtract
SUBTRACT = "subtract"

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of ``stage=capture``.

    Attributes:
        static: a video, or a folder of photographs, of the scene at rest; None with one view: that
            is a video by one moving camera, and is all there is.
        views: videos by cameras that stand still while the scene moves; none: it is at rest.
        into: the scene's folder.
        frames: so many frames are picked from a moving camera's video, the sharpest of each
            stretch; of a folder of photographs all are taken.
        moments: at most so many times are taken from the fixed cameras' videos, evenly spread.
        size: images are written with at most so many pixels of the longer side.
        camera: COLMAP's model of the lenses.
        intrinsics: whether each video has a lens of its own (``separate``), or all have one.
        matching: which frames are compared: all (``exhaustive``), or those of the static video
            that follow one another, and the fixed views with all (``sequential``).
        offsets: seconds between the first video's beginning and each one's, in the order of
            ``views``, positive where it began later; None: found from the motion.
        facing: from where the cameras look: from one side (``forward``), or from around
            (``inward``); ``auto``: as their axes say.
        test_view: which of the fixed views is held out, counted from 1; −1 is the last.
        holdout: one frame of so many of a moving camera is held out; of a single fixed view, one
            moment.
        mattes: a folder of mattes of all footage (:mod:`devrf.apps.capture.mattes`);
            ``subtract``: none, but what moves before the fixed cameras says where the box is;
            None: neither.
    """

    static: str | Path | None = None
    views: Sequence[str | Path] = ()
    into: str | Path | None = None
    frames: int = 60
    moments: int = 50
    size: int = 960
    camera: CameraModel = "SIMPLE_RADIAL"
    intrinsics: Literal["separate", "shared"] = "separate"
    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    offsets: Sequence[float] | None = None
    facing: Literal["auto", "forward", "inward"] = "auto"
    test_view: int = -1
    holdout: int = 8
    mattes: str | Path | None = None

    @property
    def subtracts(self) -> bool:
        """Whether the background of the fixed views is to be subtracted."""
        return str(self.mattes) == SUBTRACT

    @property
    def monocular(self) -> bool:
        """Whether one moving camera has filmed the scene in motion."""
        alone = len(self.views) == 1
        return alone and self.static in (None, self.views[0])

    def check(self) -> None:
        """Check what can be checked before any file is opened.

        Raises:
            DevrfError: a setting is missing, out of range, or does not go with another.
        """
        if self.into is None:
            raise DevrfError("capture.into: stage=capture needs a folder; give capture.into=PATH")
        if self.static is None and len(self.views) != 1:
            raise DevrfError(
                "capture.static: needs a video, or a folder of photographs, of the scene at rest; "
                "give capture.static=PATH (a moving camera's video alone is capture.views=[PATH])"
            )
        least = {"frames": 3, "moments": 2, "size": 64, "holdout": 2}
        for key, value in least.items():
            if getattr(self, key) < value:
                raise DevrfError(
                    f"capture.{key}: expected at least {value}, not {getattr(self, key)}"
                )
        views = len(self.views)
        if self.offsets is not None and len(self.offsets) != views:
            raise DevrfError(
                f"capture.offsets: {len(self.offsets)} offsets for {views} views; give one of "
                "each, 0 for the first, or null"
            )
        if self.subtracts and (views < 2 or self.monocular):
            raise DevrfError(
                f"capture.mattes: subtract needs at least 2 views by cameras that stand still, not "
                f"{0 if self.monocular else views}; give capture.mattes=FOLDER, or leave it out"
            )
        if self.test_view == 0 or (views > 1 and not -views <= self.test_view <= views):
            raise DevrfError(
                f"capture.test_view: {self.test_view} is none of the {views} views; give 1 … "
                f"{views}, or -1 for the last one"
            )
