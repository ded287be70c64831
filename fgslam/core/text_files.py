"""Text files of other tools, line by line."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.errors import DatasetError


def read_lines(path: Path, error: type[DatasetError] = DatasetError) -> list[tuple[int, str]]:
    """Numbered lines, without blank ones and comments (``#``). Raises ``error`` if unreadable."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as cause:
        reason = "it is not text" if isinstance(cause, UnicodeDecodeError) else cause.strerror
        raise error(f"cannot read {path}: {reason}; restore the file") from cause
    stripped = ((k, line.strip()) for k, line in enumerate(text.splitlines(), 1))
    return [(k, line) for k, line in stripped if line and not line.startswith("#")]
