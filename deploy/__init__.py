"""What a person runs: command line, launcher, live status."""
