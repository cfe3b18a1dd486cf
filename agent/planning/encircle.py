"""Flying around a target so that bearings to it cross at right angles, in a ring above it (STT 2023, section 7).

Pursuers hold a circle of radius r at r / sqrt(2) above the target, 120 degrees apart: bearings of any two then subtend
90 degrees, where they tell most of its place. Two pursuers stay 120 degrees apart too, instead of facing each other: so
bearings go on crossing at right angles, and nobody has to move when one falls silent. More than three divide the
circle.

The ring turns as a whole to where robots are already, and its order is that of ids, either way round, whichever is
nearer: all who hear each other find the same ring, and nobody has to fly through another one's place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap_scalar
from agent.planning.situation import Command, Member, Situation, TargetView
from agent.planning.team_view import usable

Array = NDArray[np.float64]

HEIGHT_SHARE = math.sqrt(0.5)
"""Height over radius at which bearings 120 degrees apart on the circle cross at right angles."""

FEWEST_SLOTS = 3
FOLLOW_GAIN = 1.0
"""Speed to the slot per distance from it [1/s]."""

CLEAR_GAIN = 0.5
"""A body is approached at this rate [1/s] of what is left to the least distance: half, for it may approach as well."""

TURN_GAIN = 1.5
SEARCH_TURN_RADPS = 0.3
UNSURE_SHARE = 0.5
"""A target is lost whose deviation along any axis is above this share of the radius: it is not flown after."""


def ring(azimuths: Array) -> Array:
    """Azimuths (n,) [rad] of the slots of n robots, in order of ids, now at `azimuths` (n,) around the target."""
    apart = 2.0 * math.pi / max(len(azimuths), FEWEST_SLOTS)
    found, least = azimuths, math.inf
    for way in (1.0, -1.0):
        steps = way * apart * np.arange(len(azimuths))
        offset = np.exp(1j * (azimuths - steps)).sum()
        slots = np.angle(offset) + steps
        away = float(np.sum(1.0 - np.cos(azimuths - slots)))
        # Of equal ways the first: who sees the same chooses the same.
        if away < least - 1e-9:
            found, least = slots, away
    return found


def slots_of(places: Array, target: Array, radius_m: float) -> Array:
    """Places (n, 3) where robots at `places` (n, 3), in order of ids, should be around a target at (3,) [m]."""
    apart = places - target
    azimuths = ring(np.arctan2(apart[:, 1], apart[:, 0]))
    level = radius_m * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    return np.asarray(target + np.column_stack([level, np.full(len(places), HEIGHT_SHARE * radius_m)]))


@dataclass(frozen=True, slots=True)
class _Seen:
    """A target of now: place (3,) [m], velocity (3,) [m/s]."""

    place: Array
    velocity: Array


@dataclass(frozen=True, slots=True)
class Encircle:
    """The planner of one pursuer.

    It goes with the target as fast as that is believed to go, and on to its slot; keeps `closest_m` off the target and
    all it knows of, those who have fallen silent too; and faces the target. A target that is not known, or not well
    enough, is not flown after: it hovers and turns slowly.
    """

    radius_m: float
    closest_m: float
    max_speed_mps: float
    max_climb_mps: float
    max_turn_radps: float

    def command(self, situation: Situation) -> Command:
        """Within the vehicle's limits; see `agent.planning.situation.Planner`."""
        situation = usable(situation)
        own, others = situation.own, situation.others
        here, bodies = own.place, np.array([other.place for other in others]).reshape(-1, 3)
        target = self._target(situation)
        if target is None:
            wanted = self._clear(np.zeros(3), here, bodies, np.zeros_like(bodies))
            return self._limited(wanted, own, min(SEARCH_TURN_RADPS, self.max_turn_radps))
        team = sorted((own, *(other for other in others if not other.silent)), key=lambda member: member.robot)
        slots = slots_of(np.array([member.place for member in team]), target.place, self.radius_m)
        slot = slots[[member.robot for member in team].index(own.robot)]
        wanted = self._saturated(target.velocity + FOLLOW_GAIN * (slot - here))
        around = np.vstack([bodies, target.place])
        wanted = self._clear(wanted, here, around, np.vstack([np.zeros_like(bodies), target.velocity]))
        away = target.place - here
        turn = TURN_GAIN * wrap_scalar(math.atan2(away[1], away[0]) - own.pose.item(2))
        return self._limited(wanted, own, min(max(turn, -self.max_turn_radps), self.max_turn_radps))

    def _target(self, situation: Situation) -> _Seen | None:
        """The nearest target that is known well enough: by itself, or else by who knows it best."""
        found = []
        for member in (situation.own, *situation.others):
            for view in member.targets:
                rank = member.robot != situation.own.robot
                seen = self._moved(view, member.age_s)
                if seen is not None:
                    found.append((rank, float(view.cov.trace()) if rank else 0.0, seen))
        if not found:
            return None
        here = situation.own.place
        return min(found, key=lambda item: (*item[:2], float(np.linalg.norm(item[2].place - here))))[2]

    def _moved(self, view: TargetView, age_s: float) -> _Seen | None:
        """A belief moved on to the present; None if it is too vague to fly after."""
        layout, mean, cov = view.motion.layout, view.mean, view.cov
        if age_s > 0.0:
            moved = view.motion.drift(mean, cov, age_s, "jacobian")
            mean, cov = moved.mean, moved.cov
        axes = len(layout.position)
        widest = float(np.linalg.eigvalsh(cov[:axes, :axes])[-1])
        if layout.heading is not None or widest > (UNSURE_SHARE * self.radius_m) ** 2:
            return None
        place, velocity = np.zeros(3), np.zeros(3)
        place[:axes], velocity[:axes] = mean[:axes], mean[axes : 2 * axes]
        return _Seen(place, velocity)

    def _clear(self, wanted: Array, here: Array, bodies: Array, velocities: Array) -> Array:
        """The velocity (3,) nearest to `wanted` that approaches no body (m, 3) faster than its distance allows.

        Of several bodies one after the other, the nearest last: it counts most.
        """
        apart = here - bodies
        distances = np.linalg.norm(apart, axis=1)
        for index in np.argsort(-distances, kind="stable"):
            if distances[index] < 1e-6:
                continue
            off = apart[index] / distances[index]
            least = float(velocities[index] @ off) - CLEAR_GAIN * (float(distances[index]) - self.closest_m)
            wanted = wanted + max(0.0, least - float(wanted @ off)) * off
        return wanted

    def _saturated(self, velocity: Array) -> Array:
        """The velocity (3,) within the vehicle's limits, level and up apart."""
        level = float(np.hypot(velocity[0], velocity[1]))
        share = min(1.0, self.max_speed_mps / level) if level > 0.0 else 1.0
        up = min(max(float(velocity[2]), -self.max_climb_mps), self.max_climb_mps)
        return np.array([share * velocity[0], share * velocity[1], up])

    def _limited(self, velocity: Array, own: Member, turn: float) -> Command:
        """The command of a velocity (3,) in ENU for a robot with its heading."""
        east, north, up = self._saturated(velocity).tolist()
        cos, sin = math.cos(own.pose.item(2)), math.sin(own.pose.item(2))
        return Command(cos * east + sin * north, turn, cos * north - sin * east, up)
