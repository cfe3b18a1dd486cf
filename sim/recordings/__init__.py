"""Loaders of recorded multi-robot data, by the `world.format` of a scenario."""

from __future__ import annotations

from sim.recordings import drone_cameras, tiers, utias

LOADERS = {"utias": utias.load, "tiers": tiers.load, "drone_cameras": drone_cameras.load}
