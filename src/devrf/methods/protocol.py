"""Protocols: which data trains which parts of a method, as data (``conf/protocol``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from devrf.errors import DevrfError

CaptureChoice = Literal["static", "dynamic", "both"]


@dataclass(frozen=True)
class ProtocolStage:
    """One stage of a protocol.

    Attributes:
        name: of the stage, its checkpoint, and ``stage=``.
        capture: the part of the scene that is learned from.
        iterations: share of the method's iterations, in (0, 1].
        frozen: parts of the method that stay as they are; ``canonical*`` is every part whose name
            begins so.
        builds_on: the stage whose result is taken up; None begins afresh.
        optional: whether only methods learn by it that have a stage of its name, with iterations.
    """

    name: str
    capture: CaptureChoice
    iterations: float = 1.0
    frozen: Sequence[str] = ()
    builds_on: str | None = None
    optional: bool = False

    def __post_init__(self) -> None:
        key = f"protocol.stages.{self.name}"
        if self.capture not in get_args(CaptureChoice):
            raise DevrfError(
                f"{key}.capture: expected static, dynamic or both, not {self.capture!r}"
            )
        if not 0 < self.iterations <= 1:
            raise DevrfError(
                f"{key}.iterations: expected a share above 0, at most 1, not {self.iterations}"
            )


@dataclass(frozen=True)
class Protocol:
    """An order of stages.

    Attributes:
        name: what ``protocol=`` chooses, and tables say.
        stages: settings of each :class:`ProtocolStage` by its name, in their order.
        static_share: share of static rays in each batch of a stage that learns from both
            captures.
        freeze: what of the stages' ``frozen`` holds: ``true``, as they say; ``false``, nothing is
            frozen; ``all``, their parts with all that enters these (of a method whose frozen part
            has inputs that an earlier stage left shut, such as HyperNeRF).
    """

    name: str
    stages: Mapping[str, Any]
    static_share: float = 0.5
    freeze: bool | Literal["all"] = True
    steps: tuple[ProtocolStage, ...] = field(init=False)

    def __post_init__(self) -> None:
        if not 0 < self.static_share < 1:
            raise DevrfError(
                f"protocol.static_share: expected between 0 and 1, not {self.static_share}"
            )
        try:
            steps = tuple(
                self._frozen_as_asked(ProtocolStage(name, **given))
                for name, given in self.stages.items()
            )
        except TypeError as error:
            raise DevrfError(f"protocol.stages: {error}") from None
        names = [step.name for step in steps]
        for k, step in enumerate(steps):
            if step.builds_on is not None and step.builds_on not in names[:k]:
                raise DevrfError(
                    f"protocol.stages.{step.name}.builds_on: expected an earlier stage, not "
                    f"{step.builds_on!r}"
                )
        object.__setattr__(self, "steps", steps)

    def _frozen_as_asked(self, step: ProtocolStage) -> ProtocolStage:
        if self.freeze is True:
            return step
        return replace(step, frozen=[f"{part}*" for part in step.frozen] if self.freeze else ())

    def __getitem__(self, name: str) -> ProtocolStage:
        """The stage called ``name``.

        Raises:
            KeyError: there is none.
        """
        return {step.name: step for step in self.steps}[name]
