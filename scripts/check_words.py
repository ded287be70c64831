"""Words of our own dialect in rooms that are written in the field's: `file:line: word`, and why.

`python -m scripts.check_words` prints each with what to write in its place and fails where there is
one; `make check` runs it. A room whose words have been read joins :data:`CLEAN`.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

CLEAN = (
    "docs/concepts",
    "docs/derivations",
    "fgslam/backend",
    "fgslam/cameras",
    "fgslam/cli",
    "fgslam/core",
    "fgslam/report",
    "fgslam/slam",
    "fgslam/datasets",
    "fgslam/evaluation",
    "fgslam/factors",
    "fgslam/frontend",
    "fgslam/homing",
    "fgslam/runs",
    "fgslam/worlds",
    "README.md",
)
"""Files and folders that hold none; the others follow."""

WORDS = {
    r"told|tells|said|says": "reported, states; or nothing",
    r"beside": "next to, relative to",
    r"anew": "again, re-",
    r"hangs? together|hangs? on": "are connected, correlated; depends on",
    r"nobody|somebody|whoever|who goes on": "no caller, the caller",
    r"(not )?to be believed": "rejected; trusted",
    r"astray|adrift": "outlier, untracked",
    r"sets? aside|gives? up|given up|takes? back": "evict, restore",
    r"crews?|flight|landed": "executor, pending, completed",
    r"doubts?": "consider covariance, uncertainty",
    r"books?|booked": "table, record",
    r"looks|sights?": "appearance, evaluates, observation",
    r"stretch(es)?|bends?": "segment, path, correction",
    r"_nobody|_goes_on|founds|heeding": "no_ids, is_tracked, can_initialise, masked",
}
"""What is not written, as a pattern of whole words, and the field's words for it."""

MEANT = {
    "docs/derivations": r"`doubt`",  # an attribute of answers
    # A bend of the way; the option `looks` of `PathFollower`; reasons in commands.csv.
    "fgslam/homing": r"\b(bends?|looks|matched anew)\b",
    "fgslam/runs": r"\blooks\b",  # where a camera looks; the option of `PathFollower`
    "fgslam/worlds": r"\bbooks\b",  # in a shelf
}
"""What a room means literally."""

_SUFFIXES = {".py", ".md", ".yaml"}
_PATTERN = re.compile("|".join(rf"(?P<w{k}>\b(?:{word})\b)" for k, word in enumerate(WORDS)))
_INSTEAD = tuple(WORDS.values())


def findings(root: Path, places: tuple[str, ...] = CLEAN) -> list[str]:
    """``file:line: word: what to write`` of each word in these places below a folder."""
    found = []
    for place in places:
        start = root / place
        files = [start] if start.is_file() else sorted(start.rglob("*"))
        for path in files:
            if path.suffix not in _SUFFIXES:
                continue
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                if place in MEANT:
                    line = re.sub(MEANT[place], "", line)
                for match in _PATTERN.finditer(line):
                    instead = _INSTEAD[int(str(match.lastgroup)[1:])]
                    where = f"{path.relative_to(root).as_posix()}:{number}"
                    found.append(f"{where}: {match[0]}: write {instead}")
    return found


def main() -> int:
    """Prints what is found; 1 where there is something."""
    found = findings(Path(__file__).parents[1])
    print("\n".join(found) or f"words: none of {len(WORDS)} patterns in {', '.join(CLEAN)}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
