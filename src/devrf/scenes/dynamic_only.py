"""A scene as methods see it that know its dynamic views alone."""

from __future__ import annotations

from dataclasses import replace

from devrf.geometry.ndc import NormalizedDevice
from devrf.scenes.forward_bounds import forward_bounds
from devrf.scenes.inward_space import SpaceChoice, inward_space
from devrf.scenes.scene import Capture, Scene


def dynamic_only(scene: Scene) -> Scene:
    """The scene without its static set: the dynamic images of time 0 stand in for it.

    Bounds are found anew, from the dynamic training cameras alone.

    Raises:
        DevrfError: these cameras do not say where the scene is.
    """
    views, held_out = scene.dynamic.train, scene.dynamic.test
    at_rest = [v[(v.times == v.times.min()).nonzero()[:, 0]] for v in (views, held_out)]
    if isinstance(scene.space, NormalizedDevice):
        bounds = forward_bounds([views], scene.space, "all that the dynamic cameras see")
        return replace(scene, static=Capture(*at_rest), bounds=bounds)
    choice: SpaceChoice = "world" if scene.space.is_linear else "contracted"
    space, bounds = inward_space(choice, views, views, [views, held_out])
    return replace(scene, static=Capture(*at_rest), bounds=bounds, space=space)
