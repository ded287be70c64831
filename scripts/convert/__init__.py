"""Recordings in formats of their own, written once as what fgslam reads (docs/datasets)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import FgslamError
from fgslam.core.files import write_text
from fgslam.core.types import pose_rows


def run(convert: Callable[[Path, Path], None], description: str | None) -> int:
    """Converts what the command line names; what is wrong with it is one line."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("recording", type=Path, help="the recording as published")
    parser.add_argument("folder", type=Path, help="where it is written as fgslam reads it")
    given = parser.parse_args()
    try:
        convert(given.recording, given.folder)
    except FgslamError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def write_poses(path: Path, stamps: FloatArray, poses: FloatArray) -> None:
    """Writes a TUM file with all digits, so that nothing is lost by the conversion."""
    rows = np.column_stack([stamps, pose_rows(poses)]).tolist()
    write_text(path, "".join(" ".join(map(repr, row)) + "\n" for row in rows))
