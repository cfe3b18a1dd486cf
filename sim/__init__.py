"""Everything that stands in for the world: truth, sensors, recordings, virtual time, metrics."""
