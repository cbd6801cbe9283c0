"""Scenes in nerfstudio's and instant-ngp's layout: one ``transforms.json`` for all images."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal

from pydantic.dataclasses import dataclass

from devrf.scenes.layout import (
    Layout,
    dynamic_images,
    static_alone,
    two_captures,
    with_static_times,
)
from devrf.scenes.masks import Masks
from devrf.scenes.reader import PosedReader, Time
from devrf.scenes.splits import parted
from devrf.scenes.transforms import Transforms, TransformsFiles
from devrf.scenes.validation import scene_error
from devrf.system.options import Several, abbreviated

FILE = "transforms.json"


@dataclass(frozen=True, kw_only=True)
class NerfstudioReader(PosedReader):
    """Reads ``transforms.json`` and images.

    The file may lie in ``root``, with a ``time`` in [0, 1] on every frame, or in ``root/static``
    and, with times, in ``root/dynamic``. Without times, or without ``root/dynamic``, the scene is
    static. Cameras may be fixed or move. Held-out images are those in ``test_filenames`` (else
    ``val_filenames``), else every ``holdout``-th; beside ``test_filenames``, ``val_filenames`` are
    the validation split. Images are undistorted; the world is that of the file's poses.

    A frame's ``mask_path`` is a grey image of the size of the image or of its camera, with black
    pixels left out.

    Attributes:
        holdout: without lists in the file, one of so many images is held out.
        times: ``file`` takes each frame's ``time``; ``order`` spreads times evenly over the images
            in the order of their names, for a video that another program posed.
        static_until: in one file, the latest time of an image that counts as static; None: 0 if
            several images have time 0, else 1.
        masks: the meaning of black pixels. ``ignore``, nerfstudio's meaning: they (people who walk
            by) count neither in training nor in scores. ``alpha``: they are background, as around
            a person who was cut out; then masks also give the bounds of scene and motion.
            ``none``: masks are not read.
        space: as of :class:`~devrf.scenes.reader.PosedReader`; a file of ``stage=capture`` states
            the value of ``auto`` itself (``scene_bounds``).
    """

    stater: ClassVar[str] = f"scene_bounds in {FILE}"

    holdout: Several = 8
    times: Literal["file", "order"] = "file"
    static_until: Time | None = None
    masks: Masks = "ignore"

    def layout(self, folder: Path) -> Layout:
        """See :meth:`devrf.scenes.reader.LayoutReader.layout`."""
        files = TransformsFiles(folder, self.missing, self.masks)
        if os.path.isfile(folder / FILE):
            train, test, validation = self._splits(files, folder / FILE)
            layout = with_static_times(train, test, self.static_until)
            if layout.static_train.transforms is not layout.dynamic_train.transforms:
                validation = validation[dynamic_images(validation)]
        else:
            static = folder / "static" / FILE
            moving = folder / "dynamic" / FILE
            train, test, validation = replace(self, times="file")._splits(files, static)
            if os.path.isfile(moving):
                static_pair = (train, test)
                train, test, validation = self._splits(files, moving)
                if train.times is None:
                    raise scene_error(
                        moving, 'its frames have no "time"; give every frame its time in [0, 1]'
                    )
                layout = two_captures(static_pair, (train, test))
            else:
                layout = static_alone(train, test, f"there is no dynamic/{FILE}")
        return layout.with_validation(validation)

    def _splits(
        self, files: TransformsFiles, file: Path
    ) -> tuple[Transforms, Transforms, Transforms]:
        """The training, held-out and validation images of a file, the last if ``validation``."""
        listing, transforms = files.read(file, times_by_order=self.times == "order")
        position = {image: k for k, image in enumerate(transforms.images)}

        def listed(key: str) -> set[int]:
            """Positions of the images in a list of the file."""
            positions = set[int]()
            for name in getattr(listing, key) or ():
                image = files.find(name, file)
                if image in position:
                    positions.add(position[image])
                elif image is not None or not transforms.skipped:
                    what = f"{key} lists {abbreviated(name)}, which is in no frame; correct it"
                    raise scene_error(file, what)
            return positions

        everyone = set(range(len(transforms.images)))
        train = listed("train_filenames")
        val = listed("val_filenames")
        test = listed("test_filenames") or val
        if train or test:
            test = test or everyone - train
            train = train or everyone - val - test
        else:
            train, test = map(set, parted(sorted(everyone), (), self.holdout, file))
        if not train or not test or train & test:
            raise scene_error(
                file,
                f"{len(train)} images to learn from, {len(test)} held out, {len(train & test)} of "
                "them both; correct train_filenames, test_filenames",
            )
        validation = val if self.validation else ()
        return transforms[sorted(train)], transforms[sorted(test)], transforms[sorted(validation)]
