"""Callbacks: what watches a stage and acts on it from outside."""

from devrf.callbacks.curves import Curves
from devrf.callbacks.previews import Previews
from devrf.callbacks.progress import Progress
from devrf.callbacks.record import TrainingRecord
from devrf.callbacks.schedule import GridUpscaling, LearningRateDecay

__all__ = [
    "Curves", "GridUpscaling", "LearningRateDecay", "Previews", "Progress", "TrainingRecord",
]
