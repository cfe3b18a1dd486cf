"""Comparisons: what cofix does next to a yardstick run by the same code on the same data."""
