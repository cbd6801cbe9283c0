"""Callbacks: what watches a stage and acts on it from outside."""

from devrf.callbacks.divergence_guard import DivergenceGuard
from devrf.callbacks.frame_fit import FrameFit
from devrf.callbacks.meter import Meter
from devrf.callbacks.periodic_checkpoint import PeriodicCheckpoint, StopOnSignal
from devrf.callbacks.previews import Previews
from devrf.callbacks.progress import Progress
from devrf.callbacks.schedule import GridUpscaling, LearningRateDecay
from devrf.callbacks.time_budget import TimeBudget
from devrf.callbacks.training_curve import TrainingCurve
from devrf.callbacks.training_record import TrainingRecord

__all__ = [
    "GridUpscaling",
    "DivergenceGuard",
    "FrameFit",
    "LearningRateDecay",
    "Meter",
    "Previews",
    "Progress",
    "PeriodicCheckpoint",
    "StopOnSignal",
    "TimeBudget",
    "TrainingCurve",
    "TrainingRecord",
]
