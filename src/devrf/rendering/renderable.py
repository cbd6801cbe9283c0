"""A learned scene of any method, to be rendered from any view at any time.

Everything that shows a learned scene (videos, stills, evaluation) asks for :meth:`Renderable.at`;
exports also for :meth:`Renderable.surface` and :meth:`Renderable.forward_warp`, which a method may
have, and tracks for :meth:`Renderable.backward_warp`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.space import Space
from devrf.ops.splatting import Gaussians
from devrf.rendering.view import ImageView, SurfaceField, View
from devrf.system.stored_class import StoredClass


class Renderable(StoredClass, nn.Module, ABC):
    """A scene, learned by some method, to be rendered from any view at any time.

    Attributes:
        name: the method's name: what ``method=`` chooses, and tables say.
        box: what holds the scene, in the space of the fields.
        space: the space that the fields live in: world units, or NDC.
        depth_limits: distances along a ray before and behind which nothing is sampled, in the
            space of the fields.
    """

    name: ClassVar[str]
    box: Box
    space: Space
    depth_limits: tuple[float, float]

    @abstractmethod
    def config(self) -> dict[str, Any]:
        """Plain data from which :meth:`from_config` builds a module that takes this one's state.

        A checkpoint holds it, beside the class.
        """

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Renderable:
        """The module that :meth:`config` described, with other values in it."""
        return cls(**config)

    @abstractmethod
    def at(self, time: float) -> View | ImageView:
        """The scene at ``time`` in [0, 1], ready to be looked at from anywhere."""

    def rays_per_pixel(self, camera: Cameras) -> int:
        """Rays of a pixel of a ``camera``'s picture, as a stage has learned it: 1 or 4."""
        return 1

    def surface(self) -> SurfaceField | None:
        """The scene at rest as a field of which a surface can be taken; None: there is none.

        Of a method that has not this and :meth:`forward_warp`, nor :meth:`surface_at`, exports take
        what :meth:`at` shows.
        """
        return None

    def surface_at(self, time: float) -> SurfaceField | None:
        """The scene at ``time`` as a field of which a surface can be taken; None: there is none.

        Of a method whose surface is not carried through time by :meth:`forward_warp`.
        """
        return None

    def gaussians_at(self, time: float) -> Gaussians | None:
        """The scene at ``time`` as Gaussians, as many at each time; None: it is none of Gaussians.

        Their colours are those that are the same from everywhere.
        """
        return None

    def forward_warp(self, time: float) -> Callable[[Tensor], Tensor] | None:
        """q → x(q, t): where canonical points (M, 3) are at ``time``, both in the fields' space.

        The identity at time 0. None: the method knows only :meth:`backward_warp`, or neither.
        """
        return None

    def backward_warp(self, time: float) -> Callable[[Tensor], Tensor] | None:
        """x → q(x, t): the canonical points of points (M, 3) at ``time``, in the fields' space.

        None: the method follows no points.
        """
        return None

    def moving_and_still(self, size: float) -> Mapping[str, Renderable]:
        """What is ``moving`` in a scene of radius ``size`` (docs/stages.md#moving), what ``still``.

        They share this scene's memory. Empty: nothing moves, all does, or the method cannot tell.
        """
        return {}

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return next(self.parameters()).device

    @property
    def moves(self) -> bool:
        """Whether it has learned to move: False for a rest state alone."""
        return True

    @property
    def resolution(self) -> tuple[int, ...]:
        """Present shape of the grid that is learned; empty where there is none."""
        return ()

    @property
    def size(self) -> int:
        """Number of learned values."""
        return sum(parameter.numel() for parameter in self.parameters())

    def stored_state(self) -> dict[str, Any]:
        """The state for a finished checkpoint: tensors and plain data, as small as can be."""
        return self.state_dict()

    def load_stored_state(self, state: Mapping[str, Any]) -> None:
        """Take what :meth:`stored_state` gave, or a full state.

        Raises:
            RuntimeError | KeyError | ValueError | TypeError: it does not fit.
        """
        self.load_state_dict(dict(state))
