"""A forward-facing procedural scene: a soft toy before a painted wall, all of it exact."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from devrf.scenes.forward_bounds import forward_bounds, reference_space
from devrf.scenes.procedural.backdrop import OnStage
from devrf.scenes.procedural.facing_rig import dynamic_rig, static_rig
from devrf.scenes.procedural.filming import Filming, one_thread
from devrf.scenes.procedural.plush import Plush
from devrf.scenes.procedural.recipe import check_recipe
from devrf.scenes.procedural.shape import Shape
from devrf.scenes.scene import Capture, Scene, Views

# Radius of a ball about the origin that holds all that the cameras see of wall and floor.
_REACH = 9.0
# Faster, the toy is squashed to pieces.
_FASTEST = 2.0
# Every so manieth static view is held out, the first one included: as readers of LLFF do it.
HOLDOUT = 8
NEAR = 1.0
# Rays that creep past the toy have to reach the wall: with 256 steps a few in a million do not.
_STEPS = 400


@dataclass(frozen=True)
class ProceduralForwardScene:
    """A recipe; calling it renders the scene. The same recipe always gives the same scene.

    The world is the one that :class:`devrf.scenes.llff.LlffReader` makes: the static cameras'
    average pose is the identity, and nothing is nearer to a camera than 1/0.75. Wrong values
    raise :class:`~devrf.errors.DevrfError` when the recipe is called.

    Attributes:
        name: the scene's name.
        width: image width in pixels.
        height: image height in pixels.
        static_views: training views of the scene at rest; one in eight more is held out.
        train_views: fixed cameras that watch the scene move (V); one more is held out.
        frames: number of frames T, at times k / (T − 1).
        speed: scales how far the toy moves; 0 is still.
        supersample: n × n rays a pixel.
        light: share of the lamp in the lighting, 0 … 1: how much motion changes the colours.
    """

    name: str = "plush"
    width: int = 96
    height: int = 72
    static_views: int = 20
    train_views: int = 4
    frames: int = 12
    speed: float = 1.0
    supersample: int = 2
    light: float = 0.2

    def __call__(self) -> Scene:
        """Render everything.

        Raises:
            DevrfError: an argument is out of range.
        """
        # Not in __post_init__: Hydra would wrap the error in one of its own, many lines long.
        check_recipe(self, fastest=_FASTEST)
        with one_thread():
            return self._rendered()

    def model(self) -> Shape:
        """The toy and its stage themselves, for exact answers at any point and time."""
        return OnStage(Plush(float(self.speed)))

    def _rendered(self) -> Scene:
        filming = Filming(self.model(), _REACH, self.supersample, self.light, steps=_STEPS)
        size = {"width": self.width, "height": self.height}
        # Of each eight views seven are learned from.
        held_out = -(-self.static_views // (HOLDOUT - 1))
        static = static_rig(self.static_views + held_out, **size)
        order = torch.arange(len(static))
        learned, tested = static[order % HOLDOUT != 0], static[order % HOLDOUT == 0]
        watching, unseen = dynamic_rig(self.train_views, **size)
        at_rest = Capture(
            _opaque(filming.at_rest(learned, "train")), _opaque(filming.at_rest(tested, "test"))
        )
        moving = Capture(
            _opaque(filming.moving(watching, self.frames, "train")),
            _opaque(filming.moving(unseen, self.frames, "test")),
        )
        space = reference_space(static, NEAR)
        source = "all that the cameras see (procedural scene)"
        bounds = forward_bounds([at_rest.train, moving.train], space, source)
        return Scene(self.name, "forward", at_rest, moving, bounds, "white", space)


def _opaque(views: Views) -> Views:
    """The views without their mattes: wall and floor are everywhere."""
    return replace(views, pixels=views.pixels[..., :3].contiguous())
