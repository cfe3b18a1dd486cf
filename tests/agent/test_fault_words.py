"""What people read of a fault: its name or kind, when, and what was stated of it."""

from __future__ import annotations

from agent.fault_parts import made
from agent.fault_words import told


def test_faults_are_told_in_words() -> None:
    loss = made(kind="loss", share=0.25, sources=["r1"], at_s=5.0, for_s=2.5)
    assert told("loss-1", loss) == "loss at 5 s for 2.5 s: sources r1, share 0.25"
    assert told("rain", loss).startswith("rain (loss) at 5 s")
    assert told("restart-1", made(kind="restart", robot="r1", at_s=3.0)) == "restart at 3 s once: robot r1"
    assert told("isolate-1", made(kind="isolate", robot="r1")) == "isolate at 0 s to the end: robot r1"
