"""Text files of recordings, plain or compressed."""

from __future__ import annotations

import lzma
from pathlib import Path

from sim.recordings.recording import RecordingError


def read_text(path: Path) -> str:
    """A file's text, unpacked if its name ends with `.xz`. Raises `RecordingError`."""
    try:
        raw = path.read_bytes()
        return (lzma.decompress(raw) if path.suffix == ".xz" else raw).decode()
    except (EOFError, lzma.LZMAError):
        raise RecordingError(f"{path}: the compressed file is cut or damaged; fetch it again") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read ({error.__class__.__name__}); fetch it again") from None
