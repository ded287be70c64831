"""A gantry's grid of views read as a trinocular camera walking along one row.

The views are those of a pinhole camera moved in its own image plane and warped to a common focal
plane at depth Z0, where the disparity is zero. Writing ``p`` for a point's inverse depth and ``u``
for the camera's position along x, a view shows the point at ``c = cx + fx (X p - u (p - 1/Z0))``.
Shifting each view by ``-s`` pixels per grid step makes this ``cx + fx X p - fx u p'`` with
``p' = p - 1/Z0 + s / (fx * step)``: the image of a pinhole camera at the same place, of a scene
whose inverse depths have an offset. Hence any shift, focal length and principal point leave a
camera that moves in its image plane consistent with a rigid scene: the trajectory is right in the
gantry's units, only the scene's depth has the offset. docs/datasets/light_field.md has the details.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.calibration import pixels, read_json_object
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import read_lines
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA
from fgslam.core.sensors import CameraRig
from fgslam.datasets.images import read_sized_image, require_folder
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import LightFieldSettings

_POSITION_COLUMNS = "file, row, column, v, u"
_METRES_PER_UNIT = 0.001  # of positions.csv, whose unit nobody states: taken as mm


@dataclass(frozen=True, eq=False)
class Grid:
    """Views of a gantry by (row, column): file, and position (u, v) in the gantry's units.

    ``u`` grows with the column, towards the image's right; ``v`` falls with the row, upwards.
    """

    root: Path
    width: int
    height: int
    files: dict[tuple[int, int], Path]
    positions: dict[tuple[int, int], FloatArray]


@dataclass(frozen=True, eq=False)
class Walk:
    """The reference's walk along a row: which views make a frame, and how each is shifted.

    Attributes:
        grid: the views.
        views: per frame the (row, column) of right, left[, top] view.
        shifts: (n, cameras, 2) pixels (column, row) by which each view's content moves.
    """

    grid: Grid
    views: list[tuple[tuple[int, int], ...]]
    shifts: FloatArray

    def baselines(self) -> FloatArray:
        """Mean distance (2,) of the left and of the top view from the reference, gantry units.

        Without a top view the second is NaN.
        """
        return _mean_baselines(self.grid, self.views)

    def load(self, index: int) -> tuple[Image, ...]:
        """Shifted images of a frame. Raises FrameError when one is missing or damaged."""
        views, shifts = self.views[index], self.shifts[index]
        return tuple(self._view(view, shift) for view, shift in zip(views, shifts, strict=True))

    def _view(self, view: tuple[int, int], shift: FloatArray) -> Image:
        grid = self.grid
        return shift_image(read_sized_image(grid.files[view], grid.width, grid.height), shift)


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


def open_light_field(settings: LightFieldSettings) -> Recording:
    """Open a grid of views; the frames are the columns of ``settings.row`` that have neighbours.

    Raises:
        DatasetError: a file is missing or malformed, or the row has no frame.
        CalibrationError: the size in calib.json is missing or impossible.
    """
    root = Path(settings.path)
    require_folder(root, "the light field")
    grid = _read_grid(root)
    walk = _plan_walk(grid, settings)
    chosen = select_frames(len(walk.views), settings)
    stamps = np.arange(len(walk.views), dtype=np.float64)
    truth = _true_poses(walk)
    return Recording(
        name=root.resolve().name,
        rig=_rig(walk, settings),
        timestamps=stamps[chosen],
        identity=recording_identity(
            [root / "calib.json", root / "positions.csv"],
            [path for path in grid.files.values() if path.is_file()],
        ),
        ground_truth=Trajectory(stamps[chosen], truth[chosen]),
        notes=_notes(walk, settings),
        indices=chosen,
        load_images=walk.load,
    )


def _read_grid(root: Path) -> Grid:
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
                f"{path}, line {line}: expected {_POSITION_COLUMNS}; correct the line"
            )
        grid.files[key], grid.positions[key] = root / words[0], place
    if len(grid.files) < 2:
        raise DatasetError(f"{path} lists {len(grid.files)} views; restore the list")
    return grid


def _plan_walk(grid: Grid, settings: LightFieldSettings) -> Walk:
    """Frames at the columns of the row whose left (and top) neighbours exist."""
    row, spacing = settings.row, settings.spacing
    columns = sorted(c for r, c in grid.files if r == row)
    views: list[tuple[tuple[int, int], ...]] = []
    for column in columns:
        # Nearer points lie further right in a view of a lower column, lower in one of a higher
        # row (measured): so these are the left and the top camera.
        group: tuple[tuple[int, int], ...] = ((row, column), (row, column - spacing))
        if settings.use_top:
            group = (*group, (row + spacing, column))
        if all(view in grid.files for view in group):
            views.append(group)
    if not views:
        rows = sorted({r for r, _ in grid.files})
        raise DatasetError(
            f"{grid.root}: no view of row {row} has its left and top neighbours {spacing} steps "
            f"away; rows are {rows}, so choose dataset.row and dataset.spacing to fit"
        )
    return Walk(grid, views, _shifts(grid, views, settings))


def _mean_baselines(grid: Grid, views: list[tuple[tuple[int, int], ...]]) -> FloatArray:
    places = np.array([[grid.positions[view] for view in group] for group in views])
    horizontal = float(np.mean(places[:, 0, 0] - places[:, 1, 0]))
    vertical = float(np.mean(places[:, 0, 1] - places[:, 2, 1])) if len(views[0]) > 2 else np.nan
    if not horizontal > 0.0 or vertical <= 0.0:
        raise DatasetError(
            f"{grid.root}: u must grow with the column and v fall with the row in positions.csv"
        )
    return np.array([horizontal, vertical])


def _shifts(
    grid: Grid, views: list[tuple[tuple[int, int], ...]], settings: LightFieldSettings
) -> FloatArray:
    """Content shifts (n, cameras, 2) in pixels.

    The reference moves with its true position, which keeps the walk rigid. Its neighbours move by
    the *nominal* spacing more: the rig's baselines are fixed although the gantry's steps vary by
    5 %, and so only the small unshifted part of the disparity carries that error.
    """
    horizontal, vertical = _mean_baselines(grid, views)
    per_unit = settings.shift_px_per_step * settings.spacing / horizontal
    places = np.array([grid.positions[group[0]] for group in views])
    walked = places - places[0]
    shifts = np.empty((len(views), len(views[0]), 2))
    shifts[:] = -per_unit * walked[:, None, :]
    shifts[:, 1, 0] += per_unit * horizontal
    if settings.use_top:
        shifts[:, 2, 1] += per_unit * vertical
    return shifts


def _rig(walk: Walk, settings: LightFieldSettings) -> CameraRig:
    horizontal, vertical = walk.baselines() * _METRES_PER_UNIT
    width, height = walk.grid.width, walk.grid.height
    return CameraRig(
        width=width,
        height=height,
        fx=settings.focal_length_px,
        fy=settings.focal_length_px,
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
        baseline=float(horizontal),
        vertical_baseline=float(vertical) if settings.use_top else None,
        bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    )


def _true_poses(walk: Walk) -> FloatArray:
    """Poses (n, 4, 4) of the reference in its first frame: x with u, y (down) with v."""
    places = np.array([walk.grid.positions[group[0]] for group in walk.views])
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :2, 3] = (places - places[0]) * _METRES_PER_UNIT
    return poses


def _notes(walk: Walk, settings: LightFieldSettings) -> tuple[str, ...]:
    missing = [
        view for group in walk.views for view in group if not walk.grid.files[view].is_file()
    ]
    notes = [
        f"the focal length of {settings.focal_length_px:g} px is nominal: depths are not metric, "
        "the trajectory is"
    ]
    if missing:
        first = walk.grid.files[missing[0]].name
        notes.append(f"{len(set(missing))} views are missing, the first is {first}")
    return tuple(notes)
