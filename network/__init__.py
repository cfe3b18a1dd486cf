"""Messages between robots: wire format, endpoint, transports, link model, clocks."""
