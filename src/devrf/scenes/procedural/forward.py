"""A forward-facing procedural scene: a soft toy before a painted wall, all of it exact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch

from devrf.scenes.forward_bounds import forward_bounds, reference_space
from devrf.scenes.procedural.backdrop import Backdrop
from devrf.scenes.procedural.facing_rig import dynamic_rig, static_rig
from devrf.scenes.procedural.filming import Filming
from devrf.scenes.procedural.plush import Plush
from devrf.scenes.procedural.recipe import Recipe
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.procedural.surrounded import Surrounded
from devrf.scenes.scene import Scene

# Radius of a ball about the origin that holds all that the cameras see of wall and floor.
_REACH = 9.0
# One static view in so many is held out, the first one included, as readers of LLFF do.
HOLDOUT = 8
NEAR = 1.0
# Rays that creep past the toy have to reach the wall: with 256 steps a few in a million do not.
_STEPS = 400


@dataclass(frozen=True)
class ProceduralForwardScene(Recipe):
    """A soft toy on a pedestal before a painted wall, seen from one side.

    The world is the one that :class:`devrf.scenes.llff.LlffReader` makes: the static cameras'
    average pose is the identity, and nothing is nearer to a camera than 1/0.75. Besides
    ``static_views`` to learn from there are held-out ones, one in eight of all. The other
    numbers are those of :class:`~devrf.scenes.procedural.recipe.Recipe`.

    Attributes:
        name: the scene's name.
        texture: how wall and floor are painted: ``soft``, or ``fine`` for images of about 240
            pixels or more, in which it has waves of five to twelve pixels.
    """

    name: str = "plush"
    texture: Literal["soft", "fine"] = field(default="soft", kw_only=True)
    height: int = field(default=72, kw_only=True)
    static_views: int = field(default=20, kw_only=True)
    frames: int = field(default=12, kw_only=True)

    def render(self) -> Scene:
        """The scene, from checked numbers."""
        film = Filming(self.model(), _REACH, self.supersample, self.light, _STEPS, opaque=True)
        size = {"width": self.width, "height": self.height}
        # Of each eight views seven are learned from.
        held_out = -(-self.static_views // (HOLDOUT - 1))
        static = static_rig(self.static_views + held_out, **size)
        order = torch.arange(len(static))
        learned, tested = static[order % HOLDOUT != 0], static[order % HOLDOUT == 0]
        watching, unseen = dynamic_rig(self.train_views, **size)
        at_rest = film.at_rest(learned, tested)
        moving = film.moving(watching, unseen, self.frames, self.unseen_frames)
        space = reference_space(static, NEAR)
        source = "all that the cameras see (procedural scene)"
        bounds = forward_bounds([at_rest.train, moving.train], space, source)
        return Scene(self.name, "forward", at_rest, moving, bounds, "white", space)

    def filmed(self) -> Shape:
        """The toy and its stage."""
        return self.model()

    def model(self) -> Shape:
        """The toy and its stage themselves, for exact answers at any point and time."""
        return Surrounded(Plush(float(self.speed)), Backdrop(weave=self.texture == "fine"))
