"""Callbacks: what watches a stage and acts on it from outside."""

from devrf.callbacks.excerpts import Excerpts
from devrf.callbacks.health import Health
from devrf.callbacks.meter import Meter
from devrf.callbacks.previews import Previews
from devrf.callbacks.progress import Progress
from devrf.callbacks.record import TrainingRecord
from devrf.callbacks.saving import Saving
from devrf.callbacks.schedule import GridUpscaling, LearningRateDecay
from devrf.callbacks.stopping import StopOnSignal

__all__ = [
    "Excerpts", "GridUpscaling", "Health", "LearningRateDecay", "Meter", "Previews", "Progress",
    "Saving", "StopOnSignal", "TrainingRecord",
]
