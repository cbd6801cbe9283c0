"""The options that the readers of all layouts share, each declared and checked once."""

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
from devrf.geometry.contraction import ContractedSpace
from devrf.scenes.files import Number, scene_folder
from devrf.scenes.flow_files import FlowDirection
from devrf.scenes.image_folders import Downscale, SizeAt, whole_factor
from devrf.scenes.layout import Layout, fewer, load_layout
from devrf.scenes.names import Missing
from devrf.scenes.scene import Background, Capture, GivenBounds, OpticalFlow, Scene, Views
from devrf.scenes.space import SpaceChoice, centred, forward_facing_scene, inward_space
from devrf.scenes.splits import Split
from devrf.scenes.transforms import SceneBounds
from devrf.scenes.validation import checked_box, scene_error
from devrf.system.options import Count, Options, Several

log = logging.getLogger(__name__)

FlowSource = Literal["auto", "files", "dis", "raft", "none"]
Exposure = Literal["auto", "equal", "none"]
# The flow sources of layouts without flow files.
EstimatedFlow = Literal["auto", "dis", "raft", "none"]

Time = Annotated[Number, Field(ge=0, le=1)]


def _box(value: Any) -> Box | None:
    return value if value is None or isinstance(value, Box) else checked_box(value)


BoundScale = Literal["auto"] | Annotated[Number, Field(ge=1)]
# A config gives corners; the reader turns them into a Box.
BoxOption = Annotated[Any, PlainValidator(_box)]


@dataclass(frozen=True)
class SceneReader(Options, ABC):
    """A scene on disk, and the options of its reader.

    Attributes:
        root: the scene's folder.
        name: short name; None takes the folder's.
        downscale: integer factor ≥ 1 by which images and flow are made smaller; ``auto``, ``cpu``,
            ``gpu``, ``up_to_<factor>``: see :func:`~devrf.scenes.image_folders.whole_factor`.
        factor: the factor by which images were made smaller, set when they are read.
        has_flow_files: whether the layout may have flow files.
        background: the colour behind the alpha masks of RGBA images; RGB images stay as they are.
        flow: ``dis`` and ``raft`` estimate flow, ``none`` does without it; of layouts with flow
            files ``auto`` reads those of backward flow if the scene has them, ``files`` requires
            them.
        flow_cache: an ``.npz`` file for estimated flow; None: flow is estimated every time.
        exposure: whether the images of one moving camera get one exposure: ``auto``: if it changes
            by more than a seventh; ``equal``: always; ``none``: never.
        frames: keep so many times, evenly spread, first and last included; None: all.
        validation: whether to read the layout's validation split, too, if it has one beside the
            test split (Blender's, nerfstudio's).

    Raises:
        DevrfError: an option is wrong; the message names it.
    """

    key: ClassVar[str] = "data"
    root: str | Path
    _: KW_ONLY
    name: str | None = None
    downscale: Downscale = "auto"
    background: Background = "white"
    flow: EstimatedFlow = "auto"
    flow_cache: Path | None = None
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
        """Read the scene, with flow from files if :attr:`wants_flow_files`.

        DevrfError if a file is wrong, or contradicts an option; the message names it.
        """

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """Forward flow of the dynamic training ``views`` of :meth:`read`, from the scene's files.

        None without such files; DevrfError if a file is wrong.
        """
        return None

    @property
    def wants_flow_files(self) -> bool:
        """Whether flow is to be read from files, and the layout may have them."""
        return self.has_flow_files and self.flow in ("auto", "files")

    @property
    def scene_name(self) -> str:
        """The scene's name; its folder's if none is given."""
        return self.name or scene_folder(self.root).resolve().name


@dataclass(frozen=True, kw_only=True)
class LayoutReader(SceneReader):
    """Reads lists of images and their poses: a :class:`~devrf.scenes.layout.Layout`.

    Attributes:
        train_views: train on the first so many fixed views of the scene in motion; None: all.
    """

    train_views: Count | None = None

    @abstractmethod
    def layout(self, folder: Path) -> Layout:
        """The splits of the scene in ``folder``, from files and the headers of images.

        All views and times; those that options leave out are left out afterwards.
        """

    @abstractmethod
    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """The scene of the captures, with its bounds."""

    def flow_of(self, split: Split, views: Views, direction: FlowDirection) -> OpticalFlow | None:
        """The flow in the files of a split's images, which are ``views``; None without files.

        It is called only if :attr:`has_flow_files`.
        """
        return None

    def read(self) -> Scene:
        """See :meth:`SceneReader.read`."""
        folder = scene_folder(self.root)
        layout = fewer(self.layout(folder), self.train_views, self.frames)
        factor = layout.static_train.transforms.downscale or self.choose_factor(layout.size_at)
        static, dynamic = load_layout(layout, folder, factor)
        if self.wants_flow_files:
            flow = self._flow(layout, dynamic.train, "bwd")
            if flow is not None:  # else the captures may share images
                dynamic = replace(dynamic, train=replace(dynamic.train, flow=flow))
        return self.placed(layout, static, dynamic)

    def forward_flow(self, views: Views) -> OpticalFlow | None:
        """See :meth:`SceneReader.forward_flow`."""
        layout = self.layout(scene_folder(self.root))
        return self._flow(fewer(layout, self.train_views, self.frames), views, "fwd")

    def _flow(self, layout: Layout, views: Views, direction: FlowDirection) -> OpticalFlow | None:
        if not layout.moves:
            return None
        if layout.thinned:
            log.info("no flow files are read: data.frames=%s leaves out neighbours", self.frames)
            return None
        return self.flow_of(layout.dynamic_train, views, direction)


@dataclass(frozen=True, kw_only=True)
class FixedViewsReader(LayoutReader):
    """Options of layouts with folders ``dynamic_<V>views/view1`` … of fixed cameras.

    Images come from ``images_<downscale>`` if it exists; else larger ones are made smaller.

    Attributes:
        dynamic: name of the ``dynamic_*views`` folder, if there are several.
        test_view: the held-out fixed view: 4 is ``view4``, −1 the last, −2 the last but one.
        holdout: every ``holdout``-th static image, in the order of their names, is held out, the
            first one included.
    """

    dynamic: str | None = None
    test_view: Annotated[int, Field(strict=True)] = -1
    holdout: Several = 8


@dataclass(frozen=True, kw_only=True)
class InwardReader(LayoutReader):
    """Options of inward-facing scenes.

    Attributes:
        bound_scale: ``auto`` (room for motion from silhouettes) or a number ≥ 1 by which the
            tightened canonical box is enlarged.
        near: least distance of the scene in world units; None: from the cameras.
        far: largest distance of the scene in world units; None: from the cameras.
        box: [[x, y, z], [x, y, z]] in world units, enlarged only for silhouettes that move
            beyond it, or by a ``bound_scale``; None: from the cameras.
        space: ``world``: the whole scene is in the box; ``contracted``: the scene is unbounded, and
            the cameras look at the box; ``auto``: contracted if the images have no alpha masks and
            no box is given.
        missing: whether absent images of the list are an ``error``, or left out (``skip``).
    """

    bound_scale: BoundScale = "auto"
    near: Number | None = None
    far: Number | None = None
    box: BoxOption = None
    missing: Missing = "error"
    space: SpaceChoice = "auto"

    def read(self) -> Scene:
        """See :meth:`SceneReader.read`; DevrfError if an unbounded scene is given an end."""
        scene = super().read()
        if self.far is not None and isinstance(scene.space, ContractedSpace):
            raise scene_error(
                "data.far",
                f"the scene is unbounded ({scene.bounds.reason}); leave it null, or set "
                "data.space=world",
            )
        return scene

    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """See :meth:`LayoutReader.placed`.

        Positions have the layout's offset subtracted already; here it is subtracted from the box.
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
            GivenBounds(scale=self.bound_scale, near=self.near, far=self.far, box=box),
        )
        return Scene(name, "inward", static, dynamic, bounds, self.background, space, offset)


@dataclass(frozen=True, kw_only=True)
class PosedReader(InwardReader):
    """Options of layouts that may state bounds.

    Attributes:
        space: as of :class:`~devrf.scenes.reader.InwardReader`, or ``ndc`` for cameras that face
            the scene from one side: then the world is that of their average pose, ``near`` is
            the near plane, and the scene is a forward-facing one. Stated bounds are the values of
            ``auto``, and of ``near``, ``far`` and ``box`` that are None.
        stater: the source of stated bounds, in words.
    """

    stater: ClassVar[str]

    space: SpaceChoice | Literal["ndc"] = "auto"  # type: ignore[assignment]

    def stated(self, layout: Layout, static: Capture) -> SceneBounds | None:
        """The stated bounds, if there are any."""
        return layout.bounds

    def placed(self, layout: Layout, static: Capture, dynamic: Capture) -> Scene:
        """See :meth:`LayoutReader.placed`; a static scene's captures are one.

        DevrfError if neither options nor cameras determine its bounds.
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
        for key, given in (("box", self.box), ("far", self.far)):
            if given is not None:
                raise scene_error(
                    f"data.{key}",
                    "the scene is forward-facing, and its space reaches from the near plane to "
                    "infinity; leave it null, or set data.space=contracted",
                )
        static, dynamic = centred(static, dynamic)
        if reader.near is None or reader.near <= 0:
            apart = float(static.train.cameras.positions.norm(dim=1).max())
            raise scene_error(
                "data.near",
                "data.space=ndc needs a near plane before the whole scene, in world units; try "
                f"data.near={apart:.3g}, the cameras' largest distance from their middle",
            )
        return forward_facing_scene(name, static, dynamic, reader.near, self.background)


def _with_bounds(options: PosedReader, stated: SceneBounds | None) -> PosedReader:
    """The options, with stated values in place of open ones."""
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
