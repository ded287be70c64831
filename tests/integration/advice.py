"""A message that advises something, as a row of the tables that test_advice.py follows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest


class Advice(NamedTuple):
    """A message and what follows its advice.

    Attributes:
        make: what makes the input in a folder, and gives what a command is given.
        message: pattern of the message; its groups are what it advises.
        follow: words added to the command: its groups, `{}` for the folder; or in its place, where
            they begin with `fgslam`.
        mend: what the advice changes in the folder, if anything; a path is given from then on.
        command: words before what is given, and behind; `python` runs what is given as a program.
        drop: words of the command that the advice takes away.
        slow: it takes more than a second.
        where: what makes this machine one on which the message comes, until its advice is followed.
    """

    make: Callable[[Path], Path]
    message: str
    follow: str = ""
    mend: Callable[[Path], object] = lambda root: None
    command: tuple[str, str] = ("inspect", "")
    drop: str = ""
    slow: bool = False
    where: Callable[[pytest.MonkeyPatch], object] = lambda patch: None
