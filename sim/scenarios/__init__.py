"""Bundled scenarios (TOML)."""
