"""Property tests draw the same examples in every run; COFIX_EXPLORE=1 draws new ones."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None, print_blob=True)
settings.load_profile("explore" if os.environ.get("COFIX_EXPLORE") else "fixed")


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder of one's own whose name leaves room for those of sockets, which may have 107 characters."""
    with tempfile.TemporaryDirectory(prefix="cofix-") as name:
        yield Path(name)
