"""When tracks of targets start and end; the same for every form of the estimator, and pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import StateLayout
from agent.estimation.observation import OutOfViewError, RelativeModel
from agent.estimation.track_start import MAX_NONLINEAR, TrackStart, start_track, start_vaguely
from agent.estimation.unscented import observe
from agent.settings import AgentSettings, TargetSettings, TrackEnd

Array = NDArray[np.float64]


VAGUE = 0.1
"""Variance of a track's place beyond which it is vague, as a share of the squared distance."""

CONTRADICTIONS = 3
"""So many contradicting sightings on end are a track's fault, not the sensor's."""

MUCH_BETTER = 0.25
"""What is new takes the place of a track whose position variance is so much larger."""


class TrackRules:
    """The targets of one robot's settings, and what its settings say of the ends of their tracks."""

    def __init__(self, settings: AgentSettings) -> None:
        self._start_ns, self._end, self._within_m = settings.start_ns, settings.track_end, settings.track_within_m
        self._transform, self._parameters = settings.localization.transform, settings.localization.parameters
        self._targets: dict[str, TargetSettings] = {target.id: target for target in settings.tracked}

    def __contains__(self, target: str) -> bool:
        return target in self._targets

    def model(self, target: str) -> str:
        """Name of the state a track of `target` is of."""
        return self._targets[target].motion.layout.name

    def started(
        self,
        target: str,
        model: RelativeModel,
        own: tuple[Array, Array],
        t_ns: int,
        z: Array,
        R: Array,
    ) -> TrackStart | None:
        """A track from a sighting at `t_ns` by a robot of belief `own`; None if it does not tell the place, or would
        end at once."""
        found = start_track(model, own, self._rest(self._targets[target], t_ns), z, R, self._parameters)
        return None if found is None or self.ended(target, found.cov(own[1]), t_ns, t_ns) else found

    def started_vaguely(
        self,
        target: str,
        model: RelativeModel,
        own: tuple[Array, Array],
        t_ns: int,
        z: Array,
        R: Array,
        within_m: float | None = None,
    ) -> TrackStart | None:
        """The same from a bearing or a range alone, if `within_m` or the settings say how far off a target can be."""
        within_m = self._within_m if within_m is None else within_m
        if within_m is None:
            return None
        rest = self._rest(self._targets[target], t_ns)
        found = start_vaguely(model, own, rest, z, R, within_m, self._parameters)
        return None if found is None or self.ended(target, found.cov(own[1]), t_ns, t_ns) else found

    def begun_again(
        self,
        target: str,
        model: RelativeModel,
        own: tuple[Array, Array],
        track: tuple[Array, Array],
        t_ns: int,
        z: Array,
        R: Array,
    ) -> TrackStart | None:
        """A new track in place of a belief `track` that is so vague that a sighting which tells the place beats it.

        Where a target may be on any side of the robot no update of a Gaussian makes much of a sighting.
        """
        if not self.vague(own, track) or not self._far_from_linear(model, own, track):
            return None
        found = self.started(target, model, own, t_ns, z, R)
        if found is None:
            return None
        place = found.cov(own[1])[:2, :2]
        return found if float(np.trace(place)) < MUCH_BETTER * float(np.trace(track[1][:2, :2])) else None

    def vague(self, own: tuple[Array, Array], track: tuple[Array, Array]) -> bool:
        """Whether a track is about as unsure as its target is far from the robot."""
        apart = track[0][:2] - own[0][:2]
        return float(np.trace(track[1][:2, :2])) >= VAGUE * float(apart @ apart)

    def _far_from_linear(self, model: RelativeModel, own: tuple[Array, Array], track: tuple[Array, Array]) -> bool:
        n, joint = len(own[0]), np.concatenate([own[0], track[0]])
        cov = np.zeros((len(joint), len(joint)))
        cov[:n, :n], cov[n:, n:] = own[1], track[1]
        try:
            seen = observe(
                model.h, model.jacobian, joint, cov, model.angles, "unscented", self._parameters, model.turning
            )
        except OutOfViewError:
            return True
        return bool(np.any(seen.residual.diagonal() > MAX_NONLINEAR * seen.cov.diagonal()))

    def _rest(self, target: TargetSettings, t_ns: int) -> tuple[Array, Array]:
        """What is known of a target that is out of sight, but for its place, mean (d,) and cov (d, d).

        A prior at the start, which all have in common, has drifted since then.
        """
        if target.mean is None:
            return unseen_mean(target.motion.layout, target.altitude_m), target.cov
        dt_s = (t_ns - self._start_ns) * 1e-9
        if dt_s <= 0.0:
            return target.mean, target.cov
        drifted = target.motion.drift(target.mean, target.cov, dt_s, self._transform)
        return drifted.mean, drifted.cov

    def ended(self, target: str, cov: Array, learnt_ns: int, t_ns: int) -> bool:
        """Whether a track of covariance (d, d), last learnt of at `learnt_ns`, is over at `t_ns`."""
        return track_ended(self._end, self._targets[target].motion.layout, cov, learnt_ns, t_ns)


def unseen_mean(layout: StateLayout, altitude_m: float) -> Array:
    """Mean (d,) of a target nobody has told anything of but its altitude."""
    mean = np.zeros(layout.dim)
    if layout.altitude is not None:
        mean[layout.altitude] = altitude_m
    return mean


def track_ended(end: TrackEnd, layout: StateLayout, cov: Array, learnt_ns: int, t_ns: int) -> bool:
    """Whether a track of covariance (d, d) over a state of `layout` is over at `t_ns`; see `TrackEnd`."""
    if end.after_ns is not None and t_ns - learnt_ns > end.after_ns:
        return True
    if end.above_m is None:
        return False
    return float(np.sum(cov.diagonal()[list(layout.position)])) > end.above_m**2 * len(layout.position)
