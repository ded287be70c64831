"""Images of known pose and the points they show, for COLMAP (https://colmap.github.io/format.html).

It has our camera axes and world-to-camera poses, but pixel centres at one half.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.errors import OutputError
from fgslam.core.files import write_bytes, write_text
from fgslam.core.geometry import inverse
from fgslam.core.sensors import CameraRig
from fgslam.core.trajectories import pose_rows

_PINHOLE = 1  # COLMAP's number of that camera model
_CAMERA = 1  # all images are of one camera: rectified rigs have equal intrinsics
_PIXEL_CENTRE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ImageModel:
    """Images (n), points (m) and where the ones show the others (k); rows name rows.

    Attributes:
        rig: the rectified cameras, for size and intrinsics.
        names: (n,) file names of the images, below the folder of images.
        poses: (n, 4, 4) ``wTi`` of each image's camera.
        ids: (m,) identities of the points, ascending.
        positions: (m, 3) world, metres.
        colours: (m, 3) red, green, blue.
        image: (k,) rows of the images that show a point, ascending.
        point: (k,) rows of the points.
        pixels: (k, 2) column and row, the first pixel's centre at zero.
    """

    rig: CameraRig
    names: tuple[str, ...]
    poses: FloatArray
    ids: IntArray
    positions: FloatArray
    colours: ByteArray
    image: IntArray
    point: IntArray
    pixels: FloatArray

    def errors(self) -> FloatArray:
        """(k,) pixels between where a point is seen and where it projects."""
        wTi = self.poses[self.image]
        apart = self.positions[self.point] - wTi[:, :3, 3]
        x, y, z = np.einsum("kji,kj->ik", wTi[:, :3, :3], apart)
        column = self.rig.cx + self.rig.fx * x / z
        row = self.rig.cy + self.rig.fy * y / z
        return np.asarray(np.hypot(column - self.pixels[:, 0], row - self.pixels[:, 1]))

    def point_errors(self) -> FloatArray:
        """(m,) pixels: of each point, the mean over its images."""
        total = np.bincount(self.point, self.errors(), len(self.ids))
        return np.asarray(total / np.maximum(np.bincount(self.point, minlength=len(self.ids)), 1))


def write_colmap(folder: Path, model: ImageModel) -> None:
    """Writes cameras, images and points3D into a folder, as .bin and as .txt.

    Image and point numbers are rows plus one; the same model gives the same bytes.

    Raises:
        OutputError: a pose or point is not finite, or writing failed.
    """
    _require_finite(folder, model)
    table = _Table.of(model)
    for name, content in (
        ("cameras.bin", _camera_bytes(model.rig)),
        ("images.bin", _image_bytes(model, table)),
        ("points3D.bin", _point_bytes(model, table)),
    ):
        write_bytes(folder / name, content)
    for name, text in (
        ("cameras.txt", _camera_text(model.rig)),
        ("images.txt", _image_text(model, table)),
        ("points3D.txt", _point_text(model, table)),
    ):
        write_text(folder / name, text)


# --------------------------------------------------------------------------------------------
# COLMAP's tables


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """What both notations need.

    ``seven``: (n, 7) world-to-camera, w x y z and translation. ``first``: (n + 1,) first
    observation of each image. ``by_point``: (k,) observations ordered by point, and ``tracks``:
    (m + 1,) where each point's begin there. ``error``: (m,) mean of each point, pixels.
    """

    seven: FloatArray
    first: IntArray
    by_point: IntArray
    tracks: IntArray
    error: FloatArray

    @staticmethod
    def of(model: ImageModel) -> _Table:
        by_point = np.argsort(model.point, kind="stable")
        tracks = np.searchsorted(model.point[by_point], np.arange(len(model.ids) + 1))
        first = np.searchsorted(model.image, np.arange(len(model.names) + 1))
        seven = _world_to_camera(model.poses)
        return _Table(seven, first, by_point, tracks, model.point_errors())

    def track(self, model: ImageModel, row: int) -> IntArray:
        """(l, 2) number of the image and row among its observations, of each time it is seen."""
        seen = self.by_point[self.tracks[row] : self.tracks[row + 1]]
        image = model.image[seen]
        return np.column_stack([image + 1, seen - self.first[image]])


def _world_to_camera(poses: FloatArray) -> FloatArray:
    rows = pose_rows(np.array([inverse(wTi) for wTi in poses]).reshape(-1, 4, 4))
    return rows[:, [6, 3, 4, 5, 0, 1, 2]] + 0.0


def _camera_numbers(rig: CameraRig) -> tuple[float, ...]:
    return rig.fx, rig.fy, rig.cx + _PIXEL_CENTRE, rig.cy + _PIXEL_CENTRE


def _camera_bytes(rig: CameraRig) -> bytes:
    head = struct.pack("<QiiQQ", 1, _CAMERA, _PINHOLE, rig.width, rig.height)
    return head + struct.pack("<4d", *_camera_numbers(rig))


def _camera_text(rig: CameraRig) -> str:
    numbers = " ".join(f"{number:.17g}" for number in _camera_numbers(rig))
    head = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy\n"
    return head + f"{_CAMERA} PINHOLE {rig.width} {rig.height} {numbers}\n"


_SEEN = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


def _image_bytes(model: ImageModel, table: _Table) -> bytes:
    seen = np.empty(len(model.image), _SEEN)
    seen["x"], seen["y"] = (model.pixels + _PIXEL_CENTRE).T
    seen["point"] = model.point + 1
    parts = [struct.pack("<Q", len(model.names))]
    for row, name in enumerate(model.names):
        own = seen[table.first[row] : table.first[row + 1]]
        parts.append(struct.pack("<i7di", row + 1, *table.seven[row], _CAMERA))
        parts.append(name.encode() + b"\0" + struct.pack("<Q", len(own)) + own.tobytes())
    return b"".join(parts)


def _image_text(model: ImageModel, table: _Table) -> str:
    seen = [
        f"{x:.9f} {y:.9f} {point}"
        for (x, y), point in zip(
            (model.pixels + _PIXEL_CENTRE).tolist(), (model.point + 1).tolist(), strict=True
        )
    ]
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID, ..."]
    for row, name in enumerate(model.names):
        numbers = " ".join(f"{number:.17g}" for number in table.seven[row])
        lines.append(f"{row + 1} {numbers} {_CAMERA} {name}")
        lines.append(" ".join(seen[table.first[row] : table.first[row + 1]]))
    return "\n".join(lines) + "\n"


def _point_bytes(model: ImageModel, table: _Table) -> bytes:
    parts = [struct.pack("<Q", len(model.ids))]
    for row, (place, colour) in enumerate(zip(model.positions, model.colours, strict=True)):
        track = table.track(model, row).astype("<i4")
        head = (row + 1, *place, *colour.tolist(), table.error[row], len(track))
        parts.append(struct.pack("<Q3d3BdQ", *head) + track.tobytes())
    return b"".join(parts)


def _point_text(model: ImageModel, table: _Table) -> str:
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, (IMAGE_ID, POINT2D_IDX), ..."]
    for row, (place, colour) in enumerate(zip(model.positions, model.colours, strict=True)):
        numbers = " ".join(f"{number:.17g}" for number in place)
        track = " ".join(map(str, table.track(model, row).ravel().tolist()))
        tint = " ".join(map(str, colour.tolist()))
        lines.append(f"{row + 1} {numbers} {tint} {table.error[row]:.9g} {track}")
    return "\n".join(lines) + "\n"


def _require_finite(path: Path, model: ImageModel) -> None:
    for name in ("poses", "positions", "pixels"):
        if not np.isfinite(getattr(model, name)).all():
            raise OutputError(
                f"cannot write {path}: {name} are not all finite; the estimator diverged or the "
                "log is damaged, run the experiment again"
            )
