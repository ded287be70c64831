"""Trajectories, and their files: TUM and KITTI files, and the covariances of their poses as CSV.

The same poses give the same bytes. Time stamps keep 9 decimals; positions and quaternions keep
12, far below any measurement, with the quaternion's w not negative and no negative zeros.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, Brief, FloatArray, IntArray
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import as_path, read_text, write_text
from fgslam.core.geometry import pose, quaternion_from_rotation, rotation_from_quaternion
from fgslam.core.store import from_upper

_TUM_FORMAT = "%.9f" + 7 * " %.12f"
_EUROC_FORMAT = ",".join(7 * ["%.12f"])
_EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
    "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"
)
_KITTI_FORMAT = " ".join(12 * ["%.12e"])
_COVARIANCE_FORMAT = "%.9f" + 21 * ",%.9e"
_TUM_COLUMNS = 8
_KITTI_COLUMNS = 12
_NOT_FINITE = "a number is not finite; repair or remove the line"
_UPPER = np.triu_indices(6)
_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")
_COVARIANCE_NAMES = [f"c_{_TANGENT[i]}_{_TANGENT[j]}" for i, j in zip(*_UPPER, strict=True)]
_COVARIANCE_HEADER = (
    "# covariance of xi in wTc = wTc_estimate * Exp(xi), tangent [rotation, translation] in the "
    "reference camera's frame at the estimate (x right, y down, z forward); rad, m\n"
    f"timestamp,{','.join(_COVARIANCE_NAMES)}\n"
)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory(Brief):
    """Stamped poses of the reference camera.

    Attributes:
        timestamps: (n,) seconds, increasing.
        poses: (n, 4, 4) ``wTc``, metres.
    """

    timestamps: FloatArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.timestamps)

    def save(self, path: str | Path, remark: str = "") -> None:
        """Writes the poses in the format that the suffix names: `.tum`, `.kitti` or `.csv` (EuRoC).

        Args:
            path: the file, written whole or not at all.
            remark: put into a comment line; `.kitti` knows neither times nor comments.

        Raises:
            OutputError: the suffix is another one, a pose is not finite, or writing failed.
        """
        path = Path(path)
        texts = {".tum": _tum_text, ".kitti": _kitti_text, ".csv": _euroc_text}
        if path.suffix.lower() not in texts:
            raise OutputError(
                f"cannot write {path}: unknown trajectory format '{path.suffix}'; use .tum, .kitti "
                "or .csv"
            )
        _require_finite(path, self)
        write_text(path, texts[path.suffix.lower()](self, remark))

    @staticmethod
    def load(path: str | Path) -> Trajectory:
        """Reads a TUM file: `timestamp tx ty tz qx qy qz qw` a line, seconds and metres.

        Raises:
            DatasetError: the file is missing, a line is malformed, a quaternion is zero, or the
                time stamps do not increase. The message names the line.
        """
        path = as_path(path, DatasetError)
        expected = "timestamp tx ty tz qx qy qz qw on each line"
        values, lines = _parse_rows(
            path,
            read_text(path, remedy=f"check the path; it has {expected}"),
            _TUM_COLUMNS,
            expected,
        )
        _refuse(path, lines, np.asarray(~np.isfinite(values).all(axis=1)), _NOT_FINITE)
        norms = np.linalg.norm(values[:, 4:], axis=1)
        _refuse(path, lines, norms < 0.5, "the quaternion has no length; repair or remove the line")
        backwards = np.concatenate([[False], np.diff(values[:, 0]) <= 0.0])
        _refuse(path, lines, backwards, "the time stamp does not increase; sort or repair the file")
        poses = np.empty((len(values), 4, 4))
        for out, row in zip(poses, values, strict=True):
            out[:] = pose(rotation_from_quaternion(row[4:]), row[1:4])
        return Trajectory(values[:, 0].copy(), poses)


def _tum_text(trajectory: Trajectory, remark: str) -> str:
    """Lines of `timestamp tx ty tz qx qy qz qw` (seconds, metres), as evo reads them."""
    rows = np.column_stack([trajectory.timestamps, _printed_rows(trajectory)])
    return _comment(remark) + _format_rows(rows, _TUM_FORMAT)


def _euroc_text(trajectory: Trajectory, remark: str) -> str:
    """EuRoC's ground-truth columns: nanoseconds, position, quaternion w first; of ``wTc``."""
    rows = _printed_rows(trajectory)[:, [0, 1, 2, 6, 3, 4, 5]]
    lines = _format_rows(rows, _EUROC_FORMAT).splitlines()
    stamps = np.rint(trajectory.timestamps * 1e9).astype(np.int64).tolist()
    text = (f"{stamp},{line}\n" for stamp, line in zip(stamps, lines, strict=True))
    return _comment(remark) + _EUROC_HEADER + "".join(text)


def _printed_rows(trajectory: Trajectory) -> FloatArray:
    """:func:`pose_rows`, rounded as they are printed, without negative zeros."""
    return _without_negative_zeros(pose_rows(trajectory.poses), decimals=12)


def pose_rows(poses: FloatArray) -> FloatArray:
    """(n, 7) x y z qx qy qz qw of poses (n, 4, 4), w not negative."""
    rows = np.empty((len(poses), _TUM_COLUMNS - 1))
    rows[:, :3] = poses[:, :3, 3]
    for row, aTb in zip(rows, poses, strict=True):
        row[3:] = _canonical(quaternion_from_rotation(aTb[:3, :3]))
    return rows


def _kitti_text(trajectory: Trajectory, _: str) -> str:
    """One row-major 3x4 ``wTc`` a line (metres), as KITTI odometry and evo read; no time stamps."""
    rows = trajectory.poses[:, :3, :].reshape(len(trajectory), _KITTI_COLUMNS)
    return _format_rows(rows + 0.0, _KITTI_FORMAT)


# --------------------------------------------------------------------------------------------
# Covariances


def write_covariances(
    path: Path, timestamps: FloatArray, covariances: FloatArray, remark: str = ""
) -> None:
    """Write the upper triangles of pose covariances, row by row, with a header naming the frame.

    Args:
        path: the file to write, atomically.
        timestamps: (n,) seconds.
        covariances: (n, 6, 6), [rotation, translation], in the tangent space at the estimate.
        remark: put into a further comment line.
    """
    upper = covariances[:, _UPPER[0], _UPPER[1]]
    rows = np.column_stack([timestamps, upper + 0.0])
    header = _comment(remark) + _COVARIANCE_HEADER
    write_text(path, header + _format_rows(rows, _COVARIANCE_FORMAT))


def read_covariances(path: Path) -> tuple[FloatArray, FloatArray]:
    """Time stamps (n,) and covariances (n, 6, 6) of a covariance.csv; NaN where unknown.

    Raises:
        DatasetError: the file is missing, or a line is malformed; the message names the line.
    """
    text = read_text(path, remedy="give a covariance.csv").replace(_COVARIANCE_HEADER, "", 1)
    columns = 1 + len(_COVARIANCE_NAMES)
    expected = "timestamp and 21 covariances, separated by commas"
    values, _ = _parse_rows(path, text.replace(",", " "), columns, expected)
    return values[:, 0].copy(), from_upper(values[:, 1:], 6)


# --------------------------------------------------------------------------------------------
# Rows of numbers


def _comment(remark: str) -> str:
    return f"# {remark}\n" if remark else ""


def _format_rows(rows: FloatArray, row_format: str) -> str:
    buffer = io.StringIO()
    np.savetxt(buffer, rows, fmt=row_format)
    return buffer.getvalue()


def _without_negative_zeros(values: FloatArray, decimals: int) -> FloatArray:
    """Values rounded as they will be printed; adding zero turns -0 into 0."""
    return np.asarray(np.round(values, decimals) + 0.0)


def _canonical(quaternion: FloatArray) -> FloatArray:
    """The one of the two quaternions (x, y, z, w) of a rotation that has w >= 0."""
    return -quaternion if quaternion[3] < 0.0 else quaternion


def _require_finite(path: Path, trajectory: Trajectory) -> None:
    bad = ~np.isfinite(trajectory.poses).all(axis=(1, 2)) | ~np.isfinite(trajectory.timestamps)
    if bad.any():
        row = int(np.argmax(bad))
        raise OutputError(
            f"cannot write {path}: pose {row} (t = {trajectory.timestamps[row]:.9f} s) is not "
            "finite; the estimator diverged there, check its input before that time"
        )


def _parse_rows(path: Path, text: str, columns: int, expected: str) -> tuple[FloatArray, IntArray]:
    """Numbers (n, columns) and the line number (n,) of each row; `#` starts a comment."""
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.partition("#")[0].split()
        if not cells:
            continue
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError as error:
            raise DatasetError(f"{path}, line {number}: {error}; give {expected}") from error
        if len(cells) != columns:
            raise DatasetError(
                f"{path}, line {number}: {len(cells)} numbers instead of {columns}; give {expected}"
            )
        lines.append(number)
    values = np.array(rows, dtype=np.float64).reshape(-1, columns)
    return values, np.array(lines, dtype=np.int64)


def _refuse(path: Path, lines: IntArray, bad: BoolArray, what: str) -> None:
    if bad.any():
        raise DatasetError(f"{path}, line {lines[int(np.argmax(bad))]}: {what}")
