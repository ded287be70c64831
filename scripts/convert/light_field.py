"""A gantry's grid of views as a trinocular image folder (docs/datasets/images.md).

`python -m scripts.convert.light_field GRID FOLDER`. The reference camera walks along one row; its
left and top neighbours are the other two. A grid, as of the Stanford (New) Light Field Archive::

    calib.json       width, height
    positions.csv    file, row, column, v, u    one line a view; '#' starts a comment
    r08_c04.png ...

``u`` grows with the column, ``v`` falls with the row (gantry coordinates, taken as millimetres).

The views are those of a pinhole camera moved in its own image plane and warped to a common focal
plane at depth Z0, where the disparity is zero. Writing ``p`` for a point's inverse depth and ``u``
for the camera's position along x, a view shows the point at ``c = cx + fx (X p - u (p - 1/Z0))``.
Shifting each view by ``-s`` pixels per grid step makes this ``cx + fx X p - fx u p'`` with
``p' = p - 1/Z0 + s / (fx * step)``: the image of a pinhole camera at the same place, of a scene
whose inverse depths have an offset. Hence any shift, focal length and principal point leave a
camera that moves in its image plane consistent with a rigid scene: the trajectory is right in the
gantry's units, depth only up to an offset of inverse depth and a scale.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.calib_json import pixels, read_json_object
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_lines
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA
from fgslam.core.sensors import CameraRig
from fgslam.datasets.folders import write_image_folder
from fgslam.datasets.images import read_grey_image, require_size
from scripts.convert import run, write_poses

ROW = 8
"""Of the grid, along which the reference walks."""
SPACING = 4
"""Grid steps to the left and to the top view."""
FOCAL_PX = 800.0
"""Nominal: it scales depth, not the trajectory."""
SHIFT_PX = 1.0
"""Of a view per grid step: disparities become 2.1 to 11.7 px (half of it leaves 0.25 px)."""
METRES_PER_UNIT = 0.001
"""Of positions.csv, whose unit nobody states: taken as mm."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Views of a gantry by (row, column): file, and position (u, v) in the gantry's units."""

    root: Path
    width: int
    height: int
    files: dict[tuple[int, int], Path]
    positions: dict[tuple[int, int], FloatArray]

    def image(self, view: tuple[int, int]) -> Image:
        """One view. Raises FrameError when it is missing, damaged or of another size."""
        path = self.files[view]
        return require_size(read_grey_image(path), f"image {path}", self.width, self.height)


def convert(root: Path, folder: Path) -> None:
    """Writes the columns of the row that have both neighbours: images, calibration, true places.

    The reference's content is shifted by its true position, which keeps the walk rigid; that of its
    neighbours by the *nominal* spacing more: the rig's baselines are fixed although the gantry's
    steps vary by 5 %, and so only the small unshifted part of the disparity has that error.

    Raises:
        DatasetError: a file is missing or malformed, or the row has no frame.
        CalibrationError: the size in calib.json is missing or impossible.
        FrameError: a view is missing or damaged.
        OutputError: the folder cannot be written.
    """
    grid = read_grid(root)
    columns = walked_columns(grid)
    groups = [((ROW, c), (ROW, c - SPACING), (ROW + SPACING, c)) for c in columns.tolist()]
    places = np.array([[grid.positions[view] for view in group] for group in groups])
    horizontal = float(np.mean(places[:, 0, 0] - places[:, 1, 0]))
    vertical = float(np.mean(places[:, 0, 1] - places[:, 2, 1]))
    if not horizontal > 0.0 or vertical <= 0.0:
        raise DatasetError(
            f"{root}: u must grow with the column and v fall with the row in positions.csv"
        )
    per_unit = SHIFT_PX * SPACING / horizontal
    walked = places[:, 0] - places[0, 0]
    shifts = np.repeat(-per_unit * walked[:, None, :], 3, axis=1)
    shifts[:, 1, 0] += per_unit * horizontal
    shifts[:, 2, 1] += per_unit * vertical
    cx, cy = 0.5 * (grid.width - 1), 0.5 * (grid.height - 1)
    rig = CameraRig(
        grid.width, grid.height, FOCAL_PX, FOCAL_PX, cx, cy,
        horizontal * METRES_PER_UNIT, vertical * METRES_PER_UNIT, BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    )  # fmt: skip
    shots = (
        (float(i), [shift_image(grid.image(group[k]), shifts[i, k]) for k in range(3)])
        for i, group in enumerate(groups)
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_image_folder(folder, rig, shots)
    poses = np.tile(np.eye(4), (len(groups), 1, 1))
    poses[:, :2, 3] = walked * METRES_PER_UNIT
    write_poses(folder / "gt_right_cam.txt", np.arange(len(groups), dtype=np.float64), poses)


def read_grid(root: Path) -> Grid:
    """The views that positions.csv lists. Raises DatasetError or CalibrationError."""
    calibration = root / "calib.json"
    values = read_json_object(calibration)
    width, height = pixels(calibration, values, "width"), pixels(calibration, values, "height")
    grid = Grid(root, width, height, {}, {})
    path = root / "positions.csv"
    for line, text in read_lines(path):
        words = [word.strip() for word in text.split(",")]
        try:
            key = (int(words[1]), int(words[2]))
            place = np.array([float(words[4]), float(words[3])])
        except (IndexError, ValueError):
            place = np.array([np.nan])
        if not np.isfinite(place).all():
            raise DatasetError(
                f"{path}, line {line}: expected file, row, column, v, u; correct the line"
            )
        grid.files[key], grid.positions[key] = root / words[0], place
    return grid


def walked_columns(grid: Grid) -> IntArray:
    """Columns of the row whose left and top neighbours exist. Raises DatasetError for none.

    Nearer points lie further right in a view of a lower column, lower in one of a higher row
    (measured): so these are the left and the top camera.
    """
    found = sorted(
        c
        for r, c in grid.files
        if r == ROW and {(ROW, c - SPACING), (ROW + SPACING, c)} <= grid.files.keys()
    )
    if not found:
        raise DatasetError(
            f"{grid.root}: no view of row {ROW} has its left and top neighbours {SPACING} steps "
            f"away; rows are {sorted({r for r, _ in grid.files})}"
        )
    return np.array(found, np.int64)


def shift_image(image: Image, shift: FloatArray) -> Image:
    """The image (h, w) with its content moved by ``shift`` (2,) pixels (column, row).

    Lanczos interpolation, exact for whole pixels; the border is repeated into the gap.
    """
    matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
    size = (image.shape[1], image.shape[0])
    moved = cv2.warpAffine(
        image, matrix, size, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, np.uint8)


if __name__ == "__main__":
    sys.exit(run(convert, __doc__))
