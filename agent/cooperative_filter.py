"""What the core needs of a form of cooperative localization.

The core orders events in time and hands them over one by one; a filter holds the estimate and talks to the peers.
Instants may lie in the past of the filter's own: late data are used or counted, as the form can.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from agent.effects import Effect, Estimate, Send
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.events import Completed, LinkChange, Observation, Received
from agent.saved_state import Saved
from network.messages import Body, Epoch, Measurement, PairReply, ReplyStatus

Array = NDArray[np.float64]


def refusal(peer: str, epoch: Epoch) -> Send:
    """The answer to a request of a form that is not the own one."""
    return Send(peer, epoch.t_meas_ns, PairReply(epoch, ReplyStatus.OTHER_FORM))


@dataclass(frozen=True, slots=True, eq=False)
class FilterMark:
    """What a filter, the `owner`, needs to return to an instant, if only own data were used since."""

    owner: object
    kept: object


@runtime_checkable
class Completing(Protocol):
    """A filter whose measurements of a peer are own data once the peer has told of itself, and need nothing of it then.

    Nobody is told of its belief: it may be made again as far back as anybody likes, whatever was sent or heard since.
    """

    def completed(self) -> list[Completed]:
        """What was completed since this was asked last."""
        ...

    def use(self, item: Completed) -> None:
        """Use one of them, at its instant or late."""
        ...

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What waits or is kept, and the most there may be of it, by name."""
        ...


class CooperativeFilter(Protocol):
    """One robot's estimator. Nothing here raises on foreign input, except `numpy.linalg.LinAlgError`."""

    @property
    def t_ns(self) -> int:
        """Instant of the newest state."""
        ...

    @property
    def complete_ns(self) -> int:
        """Instant up to which all that neighbours bring is in: that of the newest state, or of the last round."""
        ...

    @property
    def revision(self) -> object:
        """An object that is another one whenever the estimate has changed."""
        ...

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        """Move the newest state to `t_ns` by an odometry increment (4,) with covariance (4, 4)."""
        ...

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        """Use information about the own state alone, by the place of a landmark perhaps; `kind` names it in figures."""
        ...

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        """Use a relative measurement of a target."""
        ...

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        """A peer was measured: open a contact."""
        ...

    def instant_ns(self, event: Received) -> int:
        """The own-clock instant a message of a contact speaks of."""
        ...

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        """A peer has opened a contact for the instant `t_ns`."""
        ...

    def replied(self, peer: str, body: Body) -> None:
        """A peer has answered."""
        ...

    def heard(self, event: Received, effects: list[Effect]) -> None:
        """A peer has told something to everybody (a body that travels on the channel `belief`)."""
        ...

    def link_changed(self, event: LinkChange) -> None:
        """A peer appeared, fell silent or began a new life."""
        ...

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        """All own data of instants up to `until_ns` are in: what is for everybody may be told."""
        ...

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        """What has waited too long."""
        ...

    def deadline_ns(self) -> int:
        """When `expire` or `settled` has something to do next."""
        ...

    def mark(self) -> FilterMark | None:
        """What is needed to return to the present instant; None: what was used is used for good."""
        ...

    def rewind(self, mark: FilterMark) -> None:
        """Return to a mark of the filter. Since then only own data were used, none of them older than the mark."""
        ...

    def estimate(self) -> Estimate | None:
        """The own belief and the tracks at the newest instant; None while the robot does not know where it is."""
        ...

    def contacts(self) -> dict[str, Epoch]:
        """The last contact used, by peer."""
        ...

    def form(self) -> tuple[str, str]:
        """Name of the form that is on, and why."""
        ...

    @property
    def keeps_factors(self) -> bool:
        """Whether what is saved must not be older than the last message of a contact."""
        ...

    def saved(self) -> Saved | None:
        """What another filter of the form can begin with; None: nothing."""
        ...


@runtime_checkable
class AnonymousFilter(Protocol):
    """A filter that also takes measurements of others whose names nobody knows."""

    def anonymous(self, t_ns: int, event: Observation) -> None:
        """Use a measurement of somebody."""
        ...


@runtime_checkable
class NamingAnonymous(Protocol):
    """A filter that finds out whom anonymous measurements are of, and uses them as those of a peer then."""

    def unowned(self, t_ns: int, peer: str, measurement: Measurement) -> None:
        """A two-way range is known here, and used by the peer."""
        ...

    def hand_on(self, now_ns: int, unusable: Container[str], effects: list[Effect]) -> None:
        """Open contacts for what has a name by now; not with peers that are `unusable`."""
        ...

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What waits, and the most there may be of it, by name."""
        ...
