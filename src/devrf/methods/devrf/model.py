"""DeVRF's model: a canonical voxel field, its occupancy, and its deformation; and its views."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import lru_cache
from typing import Any, ClassVar

import torch
from torch import Tensor

from devrf.checkpoints.stored_grids import pack, unpack
from devrf.geometry.box import Box
from devrf.geometry.cameras import Cameras
from devrf.geometry.clock import FrameClock
from devrf.geometry.motion import moving
from devrf.geometry.rays import Rays
from devrf.geometry.space import WORLD, Space, space_config, space_from
from devrf.kernels.march import march
from devrf.methods.devrf.architecture import Architecture
from devrf.methods.devrf.canonical_field import CanonicalField
from devrf.methods.devrf.color_decoder import ColorDecoder
from devrf.methods.devrf.deformation_field import DeformationField, GridWarp
from devrf.methods.devrf.frame_store import NAMES, FrameField, fits_on_device
from devrf.methods.devrf.losses import induced_flow
from devrf.methods.devrf.surface import CanonicalSurface
from devrf.methods.devrf.volume_rendering import deformed_occupancy, march_inputs, render
from devrf.ops.compositing import LEAST_MASS, sum_by_ray
from devrf.ops.trilinear import shape_of
from devrf.rendering.occupancy import Occupancy
from devrf.rendering.output import ColorResidual, RenderedImage
from devrf.rendering.renderable import Renderable
from devrf.rendering.sampling import RenderSettings
from devrf.system.plain_data import validate
from devrf.system.stored_class import StoredClass, class_path, stored_class
from devrf.system.threads import one_thread

# Samples of a ray, at most, before empty space is skipped.
SAMPLES = 2**14
# Opacity of a base voxel that is left out.
EMPTY = 1e-9
# Rays at once: on a CPU so many that the cost of a chunk by itself, 0.8 ms, is small
# (docs/notebook/costs.md#tiles); a GPU is kept busy, and they fit.
ON_CPU = 2**14
ON_GPU = 2**15
# Points of a grid that are worth several threads.
MANY = 2**20
# Samples of unbounded scenes' pictures are so much further apart than in training: far things are
# blurred over many voxels. Their PSNR stays, and a fifth of the time is saved.
UNBOUNDED_STEP = 1.5


class ColorResidualField(StoredClass, FrameField):
    """The colour residual of all frames; an extension brings it."""

    def at(self, time: float) -> ColorResidual | None:
        """q → A_t(q) at ``time`` in [0, 1]; None: it is zero."""
        raise NotImplementedError


class DeVRFModel(Renderable):
    """A scene, to be rendered from any view at any time.

    Attributes:
        architecture: sizes of the canonical field.
        canonical: the scene's look at rest.
        occupancy: of the scene at rest.
        deformation: V_motion; None shows the rest state at every time.
        settings: of the sampling of rays.
        space: the space that the fields live in.
        color_residual: A_t, by which colours change over time; None: they do not.
    """

    name: ClassVar[str] = "devrf"

    def __init__(
        self,
        architecture: Architecture,
        canonical: CanonicalField,
        occupancy: Occupancy,
        settings: RenderSettings,
        deformation: DeformationField | None = None,
        space: Space = WORLD,
        color_residual: ColorResidualField | None = None,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.canonical = canonical
        self.occupancy = occupancy
        self.settings = settings
        self.deformation = deformation
        self.color_residual = color_residual
        self.space = space

    @property
    def box(self) -> Box:  # type: ignore[override]
        """The fields' box."""
        return self.canonical.box

    @property
    def depth_limits(self) -> tuple[float, float]:  # type: ignore[override]
        """Near and far of the sampling."""
        return self.settings.near, self.settings.far

    def config(self) -> dict[str, Any]:
        """Sizes, sampling, space, and which fields there are."""
        residual = self.color_residual
        return {
            "architecture": asdict(self.architecture),
            "settings": asdict(self.settings),
            "space": space_config(self.space),
            "radiance": isinstance(self.canonical.decoder, ColorDecoder),
            "deforms": self.moves,
            "color_residual": None if residual is None else class_path(type(residual)),
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> DeVRFModel:
        """Fields of a few voxels; the stored state gives them their shapes."""
        box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        build = validate(Architecture, config["architecture"])
        # A stage that was stopped in its search has no colour network yet.
        radiance = config["radiance"]
        clock = FrameClock((0.0, 1.0))
        path = config["color_residual"]
        residual: Callable[..., ColorResidualField] | None = None
        if path is not None:
            residual = stored_class(path, ColorResidualField)
        return cls(
            build,
            build.radiance_field(box, 8, 8) if radiance else build.search_field(box, 8),
            Occupancy.full((2, 2, 2), box),
            validate(RenderSettings, config["settings"]),
            DeformationField(box, clock, voxels=8) if config["deforms"] else None,
            space_from(config["space"]),
            residual and residual(box, clock, voxels=8),
        )

    def rays_per_pixel(self, camera: Cameras) -> int:
        """As close together as in learning."""
        return self.settings.rays_at(float(camera.focal.min()))

    def color_residual_at(self, time: float) -> ColorResidual | None:
        """q → A_t(q) at ``time``; None where colours are those of the canonical field."""
        return None if self.color_residual is None else self.color_residual.at(time)

    def occupancy_at(self, time: float) -> Occupancy:
        """The occupancy at ``time`` in [0, 1]."""
        warp = self.backward_warp(time)
        if warp.displacement is None:
            return self.occupancy
        return deformed_occupancy(self.canonical, self.occupancy, self.settings, warp)

    def at(self, time: float) -> DeVRFView:
        """The scene at ``time``: its occupancy and its displacements, ready."""
        return DeVRFView(self, time)

    def surface(self) -> CanonicalSurface:
        """The canonical field."""
        return CanonicalSurface(self.canonical, self.occupancy)

    def forward_warp(self, time: float) -> GridWarp:
        """q → q + Δ_f(q, t) (docs/method.md#warp)."""
        field = self.deformation
        return GridWarp(None, self.box) if field is None else field.forward_warp(time)

    def backward_warp(self, time: float) -> GridWarp:
        """x → q = x + Δ_b(x, t) (docs/method.md#warp)."""
        field = self.deformation
        return GridWarp(None, self.box) if field is None else field.backward_warp(time)

    @torch.no_grad()
    def moving_points(self, size: float) -> Tensor:
        """Mask (X, Y, Z) of the density grid's points that move in a scene of radius ``size``."""
        moves = self.occupancy.points_near(self.canonical.density.shape, self.box)
        points = self.box.grid_points(self.canonical.density.shape, self.canonical.density.values)
        near = points[moves]
        times = (0.0,) if self.deformation is None else self.deformation.clock.times
        places = (self.space.to_world(self.forward_warp(time)(near)) for time in times)
        return moves.masked_scatter(moves, moving(places, size))

    def moving_and_still(self, size: float) -> dict[str, Renderable]:
        """The scene with densities that are emptied elsewhere; the other fields are shared."""
        moves = self.moving_points(size)
        parts: dict[str, Renderable] = {}
        for name, others in (("moving", ~moves), ("still", moves)) if bool(moves.any()) else ():
            shared = (self.canonical.color, self.canonical.decoder)
            field = copy.deepcopy(self.canonical, {id(module): module for module in shared})
            field.clear(others, EMPTY)
            fields = (self.settings, self.deformation, self.space, self.color_residual)
            parts[name] = DeVRFModel(self.architecture, field, self.occupancy, *fields)
        return parts

    @property
    def moves(self) -> bool:
        """Whether there is a deformation field."""
        return self.deformation is not None

    @property
    def resolution(self) -> tuple[int, ...]:
        """Grid points of the displacements; of the canonical grids before there are any."""
        return (self.canonical.density if self.deformation is None else self.deformation).shape

    @property
    def size(self) -> int:
        """Values of all fields."""
        deformation, residual = self.deformation, self.color_residual
        frames = [] if deformation is None else [*deformation.frames.buffers()]
        frames += [] if residual is None else [residual.values]
        return super().size + sum(tensor.numel() for tensor in frames)

    @torch.no_grad()
    def stored_state(self) -> dict[str, Any]:
        """The state with packed grids: in half precision, in detail near space ever occupied.

        A grid with a value that half precision cannot hold stays as it is.
        """
        state, deformation, residual = self.state_dict(), self.deformation, self.color_residual
        occupied = self.occupancy.points_near(self.canonical.density.shape, self.box)[None]
        if not self.space.is_linear:  # rays end in the field's outer faces
            rim = torch.ones_like(occupied)
            rim[:, 1:-1, 1:-1, 1:-1] = False
            occupied |= rim
        for name in ("canonical.density.values", "canonical.color.values"):
            state[name] = pack(state[name], occupied, smooth=False)
        if deformation is not None:
            grid = deformation.shape, deformation.box
            at_rest = self.occupancy.points_near(*grid)[None]
            near = [self.occupancy_at(t).points_near(*grid) for t in deformation.clock.times]
            # Between two frames both are blended.
            moving = [torch.stack(near[max(k - 1, 0) : k + 2]).any(dim=0) for k in range(len(near))]
            frames = {"backward_slices": torch.stack(moving), "forward_slices": at_rest}
            for name, keep in frames.items():
                values = getattr(deformation.frames, name)
                state[f"deformation.frames.{name}"] = pack(values, keep, smooth=True)
        if residual is not None:
            values = residual.values
            at_rest = self.occupancy.points_near(shape_of(values[0]), residual.box)[None]
            state["color_residual.values"] = pack(values, at_rest, smooth=False)
        return state

    def load_stored_state(self, state: Mapping[str, Any]) -> None:
        """Take the result of :meth:`stored_state`, or a full state.

        Packed displacements stay in half precision, on the model's device if they fit there. Those
        that are not packed are held as they are, without a copy.

        Raises:
            RuntimeError | KeyError | ValueError: it does not fit, or a packed grid lacks a part.
        """
        full = dict(state)
        if self.deformation is not None:
            names = [f"deformation.frames.{name}" for name in NAMES]
            frames = [full[name] for name in names]
            device = _device_of_frames(frames[0], self.device)
            frames = [unpack(value, device, torch.float16) for value in frames]
            self.deformation.frames.take(*frames)
            full |= zip(names, frames, strict=True)
        self.load_state_dict({name: unpack(v, self.device) for name, v in full.items()})
        deformation, residual = self.deformation, self.color_residual
        timed = [(deformation.clock, deformation.backward_slices)] if deformation else []
        timed += [(residual.clock, residual.values)] if residual else []
        if any(len(clock) != len(frames) for clock, frames in timed):
            raise ValueError("frames of other times")
        field = self.canonical
        if field.grid_shape(field.voxels) != shape_of(field.density.values):
            raise ValueError("a grid of another size than its description says")
        if field.box.diagonal > SAMPLES * field.step_length(self.settings.step):
            raise ValueError("a ray of more samples than any grid has")


class DeVRFView:
    """The occupancy and the displacements of one time t; it shares the fields' memory.

    Attributes:
        occupancy: as of the view's time.
        at_rest: whether the warps of this time are the identity.
    """

    @torch.no_grad()
    def __init__(self, model: DeVRFModel, time: float) -> None:
        """Blend the displacements of ``time``; find its occupancy, and the distances to it."""
        self._model = model
        self._canonical, self._settings = model.canonical, model.settings
        self._forward_warp = lru_cache(maxsize=1)(model.forward_warp)  # of all chunks of an image
        self._color_residual = model.color_residual_at(time)
        self._backward_warp: GridWarp | None = None
        self.occupancy = model.occupancy
        deformation = model.deformation
        self.at_rest = deformation is None or deformation.clock.at(time).after == 0
        if deformation is None or self.at_rest:
            return
        with one_thread() if model.canonical.density.values.numel() < MANY else nullcontext():
            self._backward_warp = deformation.backward_warp(time)
            self.occupancy = deformed_occupancy(
                model.canonical, model.occupancy, self.picture_settings, self._backward_warp
            )
            self.occupancy.find_distances()

    @property
    def chunk(self) -> int:
        """Rays that are best rendered at once."""
        return ON_GPU if self._model.device.type == "cuda" else ON_CPU

    @property
    def picture_settings(self) -> RenderSettings:
        """The settings by which rays of pictures are sampled."""
        settings = self._settings
        if self._model.space.is_linear:
            return settings
        return replace(settings, step=UNBOUNDED_STEP * settings.step)

    @torch.no_grad()
    def render(self, rays: Rays, background: Tensor) -> RenderedImage:
        """The render of R rays in the fields' space."""
        output = render(
            rays,
            self._canonical,
            self.occupancy,
            self.picture_settings,
            background,
            self._backward_warp,
            color_residual=self._color_residual,
        )
        return RenderedImage.of(output)

    @torch.no_grad()
    def induced_flow(
        self, rays: Rays, pixels: Tensor, cameras: Cameras, time: float
    ) -> tuple[Tensor, Tensor]:
        """Σ w_i φ_i / Σ w_i (R, 2) of R rays back to ``time``, and Σ w_i (R,).

        See docs/method.md#flow for φ_i, with ``time`` in place of t − 1.
        """
        inputs = march_inputs(self._canonical, self.occupancy, self._settings, self._backward_warp)
        samples = march(rays, inputs)
        ray, weight = samples.ray, samples.weight
        moved = induced_flow(
            samples.canonical,
            self._forward_warp(time),
            cameras,
            torch.zeros_like(ray),
            pixels[ray],
            self._model.space,
        )
        mass = sum_by_ray(weight, ray, len(rays))
        total = sum_by_ray(weight[:, None] * moved, ray, len(rays))
        return total / mass.clamp(min=LEAST_MASS)[:, None], mass


def _device_of_frames(backward: Any, device: torch.device) -> torch.device:
    """The device on which both directions are unpacked, one of them given: it or the host."""
    if device.type != "cuda" or torch.is_tensor(backward):
        return torch.device("cpu")
    free, _ = torch.cuda.mem_get_info(device)
    frames, (x, y, z) = len(backward["elsewhere"]), backward["shape"]
    fits = fits_on_device(free, frames, (x, y, z), half=True, learned=False)
    return device if fits else torch.device("cpu")
