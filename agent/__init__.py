"""One robot: the pure estimation core and the shell that runs it."""
