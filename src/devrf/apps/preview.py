"""One held-out view while a stage learns."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from devrf.apps.colors import error_colors
from devrf.apps.images import side_by_side
from devrf.apps.still import still
from devrf.evaluation.held_out import background_value, compare, truth_image
from devrf.metrics.image import psnr
from devrf.rendering.renderer import Renderer
from devrf.rendering.view import Viewable
from devrf.scenes.scene import Background, Views


class Preview(NamedTuple):
    """A held-out view as rendered so far.

    Attributes:
        images: (H, W', 3) in [0, 1] by name: ``view`` is the rendered image beside the truth and
            the error, ``depth`` its depth.
        psnr: dB, of the whole image, pixels that are not valid taken as right.
    """

    images: dict[str, Tensor]
    psnr: float


def preview(model: Viewable, views: Views, index: int, background: Background) -> Preview:
    """Render a held-out view and compare it with the truth.

    Args:
        model: what has been learned so far.
        views: the held-out views, on the host.
        index: which of them.
        background: what is behind the alpha mask.
    """
    time, behind = float(views.times[index]), background_value(background)
    prediction, depth = still(Renderer(model, times=1), views.cameras, time, behind, index)
    truth = truth_image(views, index, background).cpu()
    compared = compare(prediction, truth, views.valid_mask_of(index))
    shown = side_by_side([prediction, truth, error_colors(compared, truth)])
    return Preview({"view": shown, "depth": depth}, psnr(compared, truth))
