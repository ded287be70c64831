"""Which names are those of a left and a right camera: of topics, folders, files."""

from __future__ import annotations

import re
from collections.abc import Iterable

_WORD = re.compile(
    r"(?:(?<![a-z])|(?<=cam)|(?<=camera)|(?<=img)|(?<=image)|(?<=front)|(?<=back)|(?<=rear))"
    r"(left|right)",
    re.IGNORECASE,
)
_LETTER = re.compile(
    r"(?:(?<![a-z0-9])|(?<=cam)|(?<=camera)|(?<=img)|(?<=image))([lr])(?:(?![a-z0-9])|(?=cam))",
    re.IGNORECASE,
)
_CAMERA_NUMBER = re.compile(
    r"(?:(?<=cam)|(?<=camera)|(?<=infra)|(?<=infrared))[_-]?(\d+)(?!\d)", re.IGNORECASE
)
_NUMBER = re.compile(r"(?<!\d)(\d{1,3})(?!\d)")
"""Of a camera. Longer ones are counters, of clips (GX010001) or pictures."""
_NO_VIEW = re.compile(
    r"depth|dispar|theora|segment|semantic"
    r"|(?<![a-z])(?:mask|debug|label|heat|thumb|normals|(?:disp|flow)(?![a-z]))",
    re.IGNORECASE,
)


def is_view(name: str) -> bool:
    """Whether a name of a topic, folder or file may be that of a camera's images; not of depth."""
    return _NO_VIEW.search(name) is None


def camera_pairs(names: Iterable[str], any_number: bool = True) -> tuple[tuple[str, str], ...]:
    """All pairs (left, right) of names that differ in the side alone, sorted.

    Sides are left and right, l and r, or two numbers that follow each other, of which the lower one
    is the left (cam0 and cam1, infra1 and infra2).

    Args:
        names: of topics, folders or files, all different.
        any_number: whether a number by itself may tell the side; else only one behind ``cam``
            or ``infra``: numbers of files count frames.
    """
    found: set[tuple[str, str]] = set()
    sides: dict[tuple[str, str], dict[int, str]] = {}
    for name in names:
        for key, side in _readings(name, any_number):
            sides.setdefault(key, {})[side] = name
    for by_side in sides.values():
        for side, name in by_side.items():
            if side + 1 in by_side:
                found.add((name, by_side[side + 1]))
    return tuple(sorted(found))


def camera_trio(names: Iterable[str]) -> tuple[str, ...]:
    """Of three names that differ in the side alone those of left, right and third; () of others.

    The third is called top, or t with l and r; or all three have numbers of cameras that follow
    each other, cam0 to cam2. Other numbers count the clips that one camera recorded.
    """
    given = set(names)
    pairs = camera_pairs(given, any_number=False) if len(given) == 3 else ()
    for left, right in pairs:
        (third,) = given - {left, right}
        if (right, third) in pairs or third.lower() in _called_top(left):
            return left, right, third
    return ()


def _called_top(left: str) -> set[str]:
    """Names of a third camera by that of a left one, in lower case."""
    found = [m for pattern in (_WORD, _LETTER) for m in pattern.finditer(left)]
    top = {1: "t", 4: "top"}
    return {f"{left[: m.start(1)]}{top[len(m[1])]}{left[m.end(1) :]}".lower() for m in found
            if m[1][0] in "lL"}  # fmt: skip


def _readings(name: str, any_number: bool) -> Iterable[tuple[tuple[str, str], int]]:
    """What the name is without its side, and the side as a number, in each way to read it."""
    for pattern in (_WORD, _LETTER):
        for match in pattern.finditer(name):
            side = 0 if match[1][0] in "lL" else 1
            yield (pattern.pattern, _without(name, match)), side
    for number in (_CAMERA_NUMBER, *([_NUMBER] if any_number else [])):
        for match in number.finditer(name):
            yield (number.pattern, _without(name, match)), int(match[1])


def _without(name: str, match: re.Match[str]) -> str:
    return f"{name[: match.start(1)]}\0{name[match.end(1) :]}"


def without_side(name: str, camera_number: bool = False) -> str:
    """A file's name without its camera's side: words, letters, or a camera's number."""
    for pattern in (_WORD, _LETTER, *([_CAMERA_NUMBER] if camera_number else [])):
        name = pattern.sub("", name)
    return name


def differ_in_number(left: str, right: str) -> bool:
    """Whether numbers, not sides, tell two names apart: cam0 and cam1."""
    return left != right and re.sub(r"\d+", "", left) == re.sub(r"\d+", "", right)
