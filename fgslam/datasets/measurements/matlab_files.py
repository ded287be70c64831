"""MATLAB files of numbers, read strictly: errors name file, variable and remedy."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError

_UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    ArithmeticError,
    MemoryError,
    NotImplementedError,
    MatReadError,
    struct.error,
    zlib.error,
)
"""What SciPy raises on truncated, damaged and foreign files."""


@dataclass(frozen=True, slots=True, eq=False)
class MatlabFile:
    """The variables of a .mat file (version 5)."""

    path: Path
    values: dict[str, object]

    def array(self, name: str, shape: tuple[int | None, ...]) -> FloatArray:
        """A variable as float64; None in ``shape`` leaves that length free.

        Raises:
            DatasetError: it is absent, of another shape, not of numbers, or not finite.
        """
        value = self.values.get(name)
        wanted = " x ".join("n" if size is None else str(size) for size in shape)
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            raise DatasetError(
                f"{self.path}: no variable {name} of numbers ({wanted}); give the file of the "
                "data set that dataset.kind names"
            )
        fits = len(value.shape) == len(shape) and all(
            size is None or size == length for size, length in zip(shape, value.shape, strict=True)
        )
        if not fits:
            got = " x ".join(str(length) for length in value.shape)
            raise DatasetError(
                f"{self.path}: variable {name} is {got}, expected {wanted}; restore the file"
            )
        if not np.isfinite(value).all():
            raise DatasetError(f"{self.path}: variable {name} is not finite; restore the file")
        return value.astype(np.float64)

    def positive(self, name: str, shape: tuple[int | None, ...]) -> FloatArray:
        """Like :meth:`array`, for variances and lengths. DatasetError unless all are above 0."""
        value = self.array(name, shape)
        if not (value > 0.0).all():
            raise DatasetError(f"{self.path}: variable {name} must be positive; restore the file")
        return value

    def stamps(self, values: FloatArray) -> FloatArray:
        """Time stamps (n,), checked to increase."""
        if not (np.diff(values) > 0.0).all():
            raise DatasetError(f"{self.path}: the times t do not increase; restore the file")
        return values


def read_matlab(path: Path) -> MatlabFile:
    """All variables of a file.

    Raises:
        DatasetError: it is missing, truncated, or no MATLAB file of version 5.
    """
    if not path.is_file():
        raise DatasetError(
            f"{path} does not exist; check dataset.path, or say where the .mat file is: "
            "--set dataset.path=FILE"
        )
    try:
        return MatlabFile(path, loadmat(str(path)))
    except _UNREADABLE as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(
            f"{path}: not a readable MATLAB file ({cause}); it may be truncated, restore it"
        ) from None
