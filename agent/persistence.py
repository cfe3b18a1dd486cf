"""When the core has what it knows kept, and as which bytes."""

from __future__ import annotations

from agent.cooperative_filter import CooperativeFilter
from agent.effects import Effect, Persist, Send
from agent.health import Health
from agent.saved_state import encode
from agent.settings import AgentSettings


def saved_bytes(settings: AgentSettings, kept: CooperativeFilter, health: Health) -> bytes | None:
    """What is known now, for another life of this robot; None if it begins without."""
    saved = kept.saved()
    return None if saved is None else encode(settings, saved, health.saved())


class Persistence:
    """Has the state kept: before messages that it must not be older than, with new verdicts, from time to time.

    due_ns    from when on a state is kept that nothing else asks for
    revision  of the filter's state that was kept last
    """

    def __init__(self, now_ns: int) -> None:
        self.due_ns = now_ns
        self.revision: object = None

    def act(
        self,
        settings: AgentSettings,
        kept: CooperativeFilter,
        health: Health,
        now_ns: int,
        effects: list[Effect],
        judged: bool,
    ) -> None:
        """Put a `Persist` among the effects if it is due; `judged`: there is a new verdict on a peer."""
        first = next((index for index, effect in enumerate(effects) if isinstance(effect, Send)), None)
        ahead = first is not None and kept.keeps_factors and not settings.unsafe.send_before_saving
        due = now_ns >= self.due_ns and kept.revision is not self.revision
        if not ahead and not due and not judged:
            return
        payload = saved_bytes(settings, kept, health)
        if payload is None:
            return
        self.revision, self.due_ns = kept.revision, now_ns + settings.persist_ns
        effects.insert(first if ahead and first is not None else len(effects), Persist(payload, ahead))
