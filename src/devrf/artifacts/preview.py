"""A look at one held-out view."""

from __future__ import annotations

from torch import Tensor

from devrf.artifacts.colors import error_colors
from devrf.artifacts.contact_sheet import side_by_side
from devrf.artifacts.film import depth_picture
from devrf.evaluation.held_out import background_value, compare, truth_image
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import Viewable
from devrf.scenes.scene import Background, Views


def preview(model: Viewable, views: Views, index: int, background: Background) -> dict[str, Tensor]:
    """Pictures (H, W', 3) in [0, 1] by name.

    ``view`` is what the model sees beside the truth and the error, ``depth`` how far away.

    Args:
        model: what has been learned so far.
        views: the held-out views, on the host.
        index: which of them.
        background: what is behind the matte.
    """
    renderer = Renderer(model, times=1)
    behind = background_value(background)
    seen = renderer.view(views.cameras, index, float(views.times[index]), behind)
    prediction = seen.color.view(views.height, views.width, 3).clamp(0, 1).cpu()
    truth = truth_image(views, index, background).cpu()
    error = error_colors(compare(prediction, truth, views.valid_mask_of(index)), truth)
    strip = side_by_side([prediction, truth, error])
    depth = depth_picture(model, seen, views.cameras.positions[index], strip.shape[0])
    return {"view": strip, "depth": depth}
