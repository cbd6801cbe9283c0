"""What the readers of all layouts share: their options, each declared and checked once."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, PlainValidator
from pydantic.dataclasses import dataclass

from devrf.geometry.box import Box
from devrf.geometry.clock import FrameClock
from devrf.scenes.files import Number, scene_folder
from devrf.scenes.flow_files import FlowDirection
from devrf.scenes.image_folders import Downscale, SizeAt, whole_factor
from devrf.scenes.layout import Layout, load_layout
from devrf.scenes.names import Missing
from devrf.scenes.scene import Background, Capture, OpticalFlow, Scene, Views
from devrf.scenes.space import SpaceChoice, centred, forward_facing_scene, inward_space
from devrf.scenes.splits import Split
from devrf.scenes.transforms import SceneBounds
from devrf.scenes.validation import LARGEST, checked_box, scene_error
from devrf.system.options import Count, Options, Several

log = logging.getLogger(__name__)

FlowSource = Literal["auto", "files", "dis", "raft", "none"]
Exposure = Literal["auto", "equal", "none"]
# The flow sources of layouts that have no place for flow files.
EstimatedFlow = Literal["auto", "dis", "raft", "none"]

Time = Annotated[Number, Field(ge=0, le=1)]


def _bound_scale(value: object) -> object:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    # NaN compares false.
    if value != "auto" and not (number and 1 <= value < LARGEST):  # type: ignore[operator]
        raise ValueError(f'expected "auto" or a number of at least 1, not {value!r}')
    return value


def _box(value: Any) -> Box | None:
    return value if value is None or isinstance(value, Box) else checked_box(value)


BoundScale = Annotated[float | str, PlainValidator(_bound_scale)]
# A config gives corners, of which the reader makes a Box.
BoxOption = Annotated[Any, PlainValidator(_box)]


@dataclass(frozen=True)
class SceneReader(Options, ABC):
    """Where a scene is on disk and how it is to be read.

    Attributes:
        root: the scene's folder.
        name: short name; None takes the folder's.
        downscale: integer factor ≥ 1 by which images and flow are made smaller; ``auto``, ``cpu``,
            ``gpu``, ``up_to_<factor>``: see :func:`~devrf.scenes.image_folders.whole_factor`.
        factor: by what images were made smaller; known once they have been read.
        has_flow_files: whether the layout has a place for flow files.
        background: what is behind the alpha masks of RGBA images; RGB images are used as they are.
        flow: ``auto`` reads the scene's backward flow where it has files of it, ``files`` insists
            on them, ``dis`` and ``raft`` estimate it, ``none`` does without.
        flow_cache: an ``.npz`` that keeps estimated flow; None estimates it every time.
        exposure: whether the images of one moving camera are given one exposure: ``auto`` where it
            changes by more than a seventh, ``equal`` or ``none`` always or never.
        frames: keep so many times, evenly spread, first and last included; None: all.
        validation: whether the layout's validation split is read, too, where it has one beside the
            test split (Blender's, nerfstudio's).

    Raises:
        DevrfError: an option is wrong; the message names it.
    """

    key: ClassVar[str] = "data"
    root: str | Path
    _: KW_ONLY
    name: str | None = None
    downscale: Downscale = 1
    background: Background = "white"
    flow: FlowSource = "auto"
    flow_cache: str | Path | None = None
    exposure: Exposure = "auto"
    frames: Several | None = None
    validation: bool = False

    factor: ClassVar[int] = 1
    has_flow_files: ClassVar[bool] = False

    def choose_factor(self, size_at: SizeAt) -> int:
        """The factor by which images of such sizes are made smaller; sets :attr:`factor`."""
        self.__dict__["factor"] = factor = whole_factor(self.downscale, size_at)
        return factor

    @abstractmethod
    def read(self) -> Scene:
        """Read the scene, with flow from files where they are asked for.

        DevrfError if a file is wrong, or does not go with an option; the message names it.
        """

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """Forward flow of the dynamic training ``views`` of :meth:`read`, from the scene's files.

        None where there are none, or no place for them; DevrfError if a file is wrong.
        """
        return None

    @property
    def wants_flow_files(self) -> bool:
        """Whether flow is to be read from files, and there is a place for them."""
        return self.has_flow_files and self.flow in ("auto", "files")

    @property
    def scene_name(self) -> str:
        """The scene's name, its folder's where none was given."""
        return self.name or scene_folder(self.root).resolve().name


@dataclass(frozen=True)
class LayoutReader(SceneReader):
    """Reads what lists images and their poses: a :class:`~devrf.scenes.layout.Layout`."""

    @abstractmethod
    def layout(self, folder: Path) -> Layout:
        """The splits of the scene in ``folder``, no image read but its header."""

    @abstractmethod
    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """The scene of the captures that were read, its bounds found."""

    def flow_of(self, split: Split, views: Views, direction: FlowDirection) -> OpticalFlow | None:
        """The flow in the files of a split's images, which are ``views``; None: there are none.

        It is asked for only where :attr:`has_flow_files`.
        """
        return None

    def read(self) -> Scene:
        """See :meth:`SceneReader.read`."""
        folder = scene_folder(self.root)
        layout = self.layout(folder)
        factor = layout.static_train.transforms.downscale or self.choose_factor(layout.size_at)
        static, dynamic = load_layout(layout, folder, factor)
        if self.wants_flow_files:
            flow = self._flow(layout, dynamic.train, "bwd")
            if flow is not None:  # else the captures may share images
                dynamic = replace(dynamic, train=replace(dynamic.train, flow=flow))
        return self.placed(layout, static, dynamic)

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """See :meth:`SceneReader.forward_flow`."""
        return self._flow(self.layout(scene_folder(self.root)), views, "fwd")

    def _flow(self, layout: Layout, views: Views, direction: FlowDirection) -> OpticalFlow | None:
        if not layout.moves:
            return None
        if layout.thinned:
            log.info("flow files dropped: data.frames=%s leaves out neighbours", self.frames)
            return None
        return self.flow_of(layout.dynamic_train, views, direction)


@dataclass(frozen=True)
class FixedViewsReader(LayoutReader):
    """Options of layouts with folders ``dynamic_<V>views/view1`` … of fixed cameras.

    Images come from ``images_<downscale>`` where it is there; else larger ones are made smaller.

    Attributes:
        dynamic: which ``dynamic_*views`` folder, where there are several.
        test_view: the fixed view to hold out: 4 is ``view4``, −1 the last, −2 the last but one.
        train_views: train on the first so many of the views that are not held out; None: all.
        holdout: every ``holdout``-th static image, in the order of their names, is held out, the
            first one included.
    """

    _: KW_ONLY
    dynamic: str | None = None
    downscale: Downscale = "auto"
    test_view: Annotated[int, Field(strict=True)] = -1
    holdout: Several = 8
    train_views: Count | None = None


@dataclass(frozen=True)
class InwardReader(LayoutReader):
    """Options of scenes that cameras look in at.

    Attributes:
        bound_scale: ``auto`` (room for motion from silhouettes) or a number ≥ 1 by which the
            tightened canonical box is enlarged.
        near: distance in world units before which nothing is; None: from the cameras.
        far: distance in world units behind which nothing is; None: from the cameras.
        box: [[x, y, z], [x, y, z]] in world units, enlarged only for silhouettes that move
            beyond it, or by a ``bound_scale``; None: from the cameras.
        space: ``world``: the scene is in the box, and nothing is around it; ``contracted``: it is
            unbounded, and the box is what is looked at; ``auto``: contracted if the images have no
            alpha masks and no box is given.
        missing: whether listed images that are absent are an ``error``, or left out (``skip``).
    """

    _: KW_ONLY
    bound_scale: BoundScale = "auto"
    near: Number | None = None
    far: Number | None = None
    box: BoxOption = None
    missing: Missing = "error"
    space: SpaceChoice = "auto"

    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """See :meth:`LayoutReader.placed`.

        The layout's offset is subtracted from positions already, and here from the box.
        """
        offset = layout.offset
        name = self.scene_name
        box = self.box
        if any(offset):
            log.info(
                "%s is far from the origin: %s is subtracted from positions, and added again to "
                "all that is written",
                name,
                ", ".join(f"{value:.12g}" for value in offset),
            )
            x, y, z = offset
            box = box and box.moved((-x, -y, -z))
        space, bounds = inward_space(
            self.space,
            static.train,
            dynamic.train if len(FrameClock.from_times(dynamic.train.times)) > 1 else None,
            [static.train, static.test, dynamic.train, dynamic.test],
            bound_scale=self.bound_scale,
            near=self.near,
            far=self.far,
            box=box,
        )
        return Scene(name, "inward", static, dynamic, bounds, self.background, space, offset)


@dataclass(frozen=True)
class PosedReader(InwardReader):
    """Options of layouts that may state bounds.

    Attributes:
        space: as of :class:`~devrf.scenes.reader.InwardReader`, or ``ndc`` for cameras that face
            the scene from one side: then the world is that of their average pose, ``near`` is
            the near plane, and the scene is a forward-facing one. Stated bounds say what ``auto``
            is, and ``near``, ``far`` and ``box`` where they are None.
        stater: who states them, in words.
    """

    stater: ClassVar[str]

    _: KW_ONLY
    space: SpaceChoice | Literal["ndc"] = "auto"  # type: ignore[assignment]

    def stated(self, layout: Layout, static: Capture) -> SceneBounds | None:
        """Where the scene is, if that is known."""
        return layout.bounds

    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """See :meth:`LayoutReader.placed`; captures of a scene always at rest are one.

        DevrfError if neither options nor cameras say where it is.
        """
        reader = _with_bounds(self, self.stated(layout, static))
        if reader.space != "ndc":
            scene = InwardReader.placed(reader, layout, static, dynamic)
            reason = scene.bounds.reason if reader.space == self.space else self.stater
            box_is_stated = self.box is None and reader.box is not None
            box_source = self.stater if box_is_stated else scene.bounds.box_source
            bounds = replace(scene.bounds, reason=reason, box_source=box_source)
            return replace(scene, bounds=bounds)
        name = self.scene_name
        static, dynamic = centred(static, dynamic)
        if reader.near is None or reader.near <= 0:
            apart = float(static.train.cameras.positions.norm(dim=1).max())
            raise scene_error(
                "data.near",
                "data.space=ndc needs a near plane before all that is seen, in world units; try "
                f"data.near={apart:.3g}, which is as far as cameras are from their middle",
            )
        return forward_facing_scene(name, static, dynamic, reader.near, self.background)


def _with_bounds(options: PosedReader, stated: SceneBounds | None) -> PosedReader:
    """The options, with what is stated where they leave it open."""
    if stated is None:
        return options
    space = stated.space if options.space == "auto" else options.space
    if (space == "ndc") != (stated.space == "ndc"):  # in another world, or of other meaning
        return replace(options, space=space)
    box = options.box
    if box is None and stated.box is not None and options.space == "auto":
        box = checked_box(stated.box)
    near = stated.near if options.near is None else options.near
    far = stated.far if options.far is None else options.far
    return replace(options, space=space, near=near, far=far, box=box)
