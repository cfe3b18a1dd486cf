"""How a robot that does not know where it is finds out: evidence of its start, and when that is enough. Pure.

Evidence of the place and of the heading may be of different instants; the odometry in between connects them. What is
older than the horizon counts no more, and of two pieces of one kind the newer one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap_scalar
from agent.estimation.motion import STATES, SpatialMotion, split_increment
from agent.estimation.observation import ABSOLUTE, AbsoluteModel, relative_model
from agent.estimation.pose_start import Known, PoseStart, pose_from_peer
from agent.estimation.track_start import DETERMINING
from agent.settings import AgentSettings
from network.messages import Measurement

Array = NDArray[np.float64]

VIEWS = ("bearing", "range_bearing", "vector")
"""Kinds of measurement of a peer that tell the own heading, if the own place is known."""

A_PLACE = "a position fix (a sensor of kind 'position' or 'pose', or 'position' in mavlink.fixes)"
A_HEADING = "a heading fix (a sensor of kind 'heading' or 'pose', or 'heading' in mavlink.fixes)"
AN_ALTITUDE = "an altitude fix (a sensor of kind 'altitude', or 'altitude' in mavlink.fixes)"
A_CONTACT = (
    "the place by a localized peer: a measurement of this robot by the peer, or of the peer by this robot, of one of "
    f"the kinds {', '.join(DETERMINING)}"
)
A_VIEW = f"the heading: {A_HEADING}, or a view of the peer ({', '.join(VIEWS)}) at the instant it measures this robot"


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What a peer has told of itself: a belief of `model`, mean (n,) and cov (n, n)."""

    model: str
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Fixed:
    """A place x, y (2,) with covariance (2, 2) at an instant."""

    t_ns: int
    place: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Contact:
    """A measurement between the own robot and a peer that has told its belief of the instant."""

    t_ns: int
    peer: str
    told: Told
    measurement: Measurement
    own_observed: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """The odometry increment (4,), (4, 4) from one instant to the next."""

    t0_ns: int
    t_ns: int
    delta: Array
    cov: Array


class StartEvidence:
    """What is known of the start of one robot; see `AgentSettings.source`."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._fix: _Fixed | None = None
        self._contacts: dict[tuple[str, bool], _Contact] = {}
        self._heading: tuple[int, Known] | None = None
        self._altitude: tuple[int, Known] | None = None
        self._views: dict[str, tuple[int, Measurement]] = {}
        self._steps: list[_Step] = []

    # -- evidence -------------------------------------------------------------------------------------------

    def moved(self, t0_ns: int, t_ns: int, delta: Array, cov: Array) -> None:
        """The robot has moved by an odometry increment (4,), (4, 4)."""
        oldest = t_ns - self._settings.lateness.horizon_ns
        self._steps = [step for step in self._steps if step.t_ns > oldest]
        self._steps.append(_Step(t0_ns, t_ns, delta, cov))
        if self._fix is not None and self._fix.t_ns < oldest:
            self._fix = None
        self._contacts = {key: item for key, item in self._contacts.items() if item.t_ns >= oldest}
        if self._heading is not None and self._heading[0] < oldest:
            self._heading = None
        if self._altitude is not None and self._altitude[0] < oldest:
            self._altitude = None
        self._views = {peer: view for peer, view in self._views.items() if view[0] >= oldest}

    def fix(self, t_ns: int, model: AbsoluteModel, z: Array, R: Array) -> None:
        """Absolute information; a start from a peer takes no place of it."""
        layout, rows = self._settings.layout, {column: row for row, column in enumerate(model.components)}
        for column, keep in ((layout.heading, "_heading"), (layout.altitude, "_altitude")):
            row = None if column is None else rows.get(column)
            if row is not None:
                setattr(self, keep, (t_ns, Known(float(z[row]), float(R[row, row]))))
        if model.kind in ABSOLUTE and 0 in rows and self._settings.source == "fix":
            place = [rows[0], rows[1]]
            self._fix = _Fixed(t_ns, z[place], R[np.ix_(place, place)])

    def view(self, t_ns: int, peer: str, measurements: Sequence[Measurement]) -> None:
        """The own robot has measured a peer."""
        seen = next((item for item in measurements if item.kind in VIEWS), None)
        if seen is not None:
            self._views[peer] = (t_ns, seen)

    def contact(
        self, t_ns: int, peer: str, told: Told, measurements: Sequence[Measurement], own_observed: bool
    ) -> bool:
        """A peer has told of itself and a measurement between both; False if that does not tell the place."""
        found = next((item for item in measurements if item.kind in DETERMINING), None)
        if found is None or self._settings.source != "peer":
            return False
        self._contacts[peer, own_observed] = _Contact(t_ns, peer, told, found, own_observed)
        return True

    # -- what follows ---------------------------------------------------------------------------------------

    def missing(self) -> tuple[str, ...]:
        """What the start waits for, in words."""
        found = []
        fixed = self._settings.source == "fix"
        if (self._fix is None) if fixed else not self._contacts:
            found.append(A_PLACE if fixed else A_CONTACT)
        if self._heading is None and not any(self._view(item) for item in self._contacts.values()):
            found.append(A_HEADING if fixed else A_VIEW)
        if self._settings.layout.altitude is not None and self._known_altitude() is None:
            found.append(AN_ALTITUDE)
        return tuple(found)

    def _known_altitude(self) -> Known | None:
        motion = self._settings.motion
        if isinstance(motion, SpatialMotion) and motion.held is not None:
            return Known(motion.held.altitude_m, motion.held.sigma_m**2)
        return None if self._altitude is None else self._altitude[1]

    def _view(self, place: _Contact) -> Measurement | None:
        """The own view of a peer that has measured the own robot, at the same instant."""
        if place.own_observed:
            return None
        t_ns, seen = self._views.get(place.peer, (0, None))
        return seen if abs(t_ns - place.t_ns) <= self._settings.lateness.tolerance_ns else None

    def _heading_at(self, t_ns: int) -> Known | None:
        """The heading fix carried to another instant by the odometry."""
        if self._heading is None:
            return None
        since_ns, known = self._heading
        value, variance = known.value, known.variance
        for step in self._between(min(since_ns, t_ns), max(since_ns, t_ns)):
            value += step.delta[3] if since_ns < t_ns else -step.delta[3]
            variance += step.cov[3, 3]
        return Known(wrap_scalar(value), variance)

    def _between(self, from_ns: int, to_ns: int) -> list[_Step]:
        """The motion between two instants; steps are cut at both."""
        tolerance, found = self._settings.lateness.tolerance_ns, []
        for step in self._steps:
            begin, end = max(step.t0_ns, from_ns), min(step.t_ns, to_ns)
            if end - begin <= tolerance:
                continue
            delta, cov, span = step.delta, step.cov, step.t_ns - step.t0_ns
            if end < step.t_ns:
                delta, cov, _, _ = split_increment(delta, cov, (end - step.t0_ns) / span)
            if begin > step.t0_ns:
                _, _, delta, cov = split_increment(delta, cov, (begin - step.t0_ns) / (end - step.t0_ns))
            found.append(_Step(begin, end, delta, cov))
        return found

    def begun(self, t_ns: int) -> AgentSettings | None:
        """The settings of a robot that starts at `t_ns`, the instant of the last evidence or step; None: not yet."""
        if self._fix is not None:
            pose = self._fixed(self._fix)
            return None if pose is None else self._started(pose, self._fix.t_ns, t_ns)
        for place in self._contacts.values():
            pose = self._told(place)
            if pose is not None:
                return self._started(pose, place.t_ns, t_ns)
        return None

    def _started(self, pose: PoseStart, since_ns: int, t_ns: int) -> AgentSettings:
        """The settings of a robot that has been at `pose` at `since_ns` and starts at `t_ns`."""
        settings, layout = self._settings, self._settings.layout
        mean, cov, shared = settings.mean.copy(), settings.cov.copy(), np.zeros_like(settings.cov)
        assert layout.heading is not None
        here = [*layout.position, layout.heading]
        square = np.ix_(here, here)
        mean[here], cov[square], shared[square] = pose.mean, pose.cov, pose.shared
        transform = settings.localization.transform
        for step in self._between(since_ns, t_ns):
            dt_s = (step.t_ns - step.t0_ns) * 1e-9
            moved = settings.motion.advance(mean, cov, step.delta, step.cov, dt_s, transform)
            mean, cov, shared = moved.mean, moved.cov, moved.F @ shared @ moved.F.T
        targets = []
        for target in settings.targets:
            if target.mean is not None and t_ns > settings.start_ns:
                dt_s = (t_ns - settings.start_ns) * 1e-9
                drifted = target.motion.drift(target.mean, target.cov, dt_s, transform)
                target = replace(target, mean=drifted.mean, cov=drifted.cov)
            targets.append(target)
        return replace(
            settings,
            source="survey",
            found_out=True,
            start_ns=t_ns,
            mean=mean,
            cov=cov,
            shared=shared if shared.any() else None,
            targets=tuple(targets),
        )

    def _fixed(self, place: _Fixed) -> PoseStart | None:
        heading, altitude = self._heading_at(place.t_ns), self._known_altitude()
        spatial = self._settings.layout.altitude is not None
        if heading is None or (spatial and altitude is None):
            return None
        rest = [altitude, heading] if spatial and altitude is not None else [heading]
        d = 2 + len(rest)
        cov = np.zeros((d, d))
        cov[:2, :2] = place.cov
        for index, item in enumerate(rest):
            cov[2 + index, 2 + index] = item.variance
        return PoseStart(np.array([*place.place, *(item.value for item in rest)]), cov, np.zeros((d, d)))

    def _told(self, place: _Contact) -> PoseStart | None:
        layout, other = self._settings.layout, STATES[place.told.model]
        observer, subject = (layout, other) if place.own_observed else (other, layout)
        seen = self._view(place)
        view = None
        if seen is not None:
            view = relative_model(seen, layout, other), _azimuth(seen)
        return pose_from_peer(
            relative_model(place.measurement, observer, subject),
            place.own_observed,
            layout,
            (place.told.mean, place.told.cov),
            place.measurement.z,
            place.measurement.R,
            heading=self._heading_at(place.t_ns),
            view=view,
            altitude=self._known_altitude() if layout.altitude is not None else None,
            parameters=self._settings.localization.parameters,
        )


def _azimuth(seen: Measurement) -> Known:
    """Azimuth of a view and its variance."""
    if seen.kind == "vector":
        x, y = seen.z
        along = np.array([-y, x]) / (x**2 + y**2)
        return Known(float(np.arctan2(y, x)), float(along @ seen.R @ along))
    index = 1 if seen.kind == "range_bearing" else 0
    return Known(float(seen.z[index]), float(seen.R[index, index]))
