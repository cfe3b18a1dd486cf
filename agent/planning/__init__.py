"""Where robots should go: laws of motion as pure functions."""
