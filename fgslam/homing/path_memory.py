"""A path as it is remembered: the features of its images, in order, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix, diags

from fgslam.cameras.omni import OmniCamera
from fgslam.cameras.omni_files import camera_of, camera_values
from fgslam.core.array_files import (
    ArrayFile,
    Items,
    by_field,
    fields_from,
    of_rows,
    write_arrays,
)
from fgslam.core.array_values import require_covariances
from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.errors import CalibrationError, StoredMapError
from fgslam.core.files import as_path
from fgslam.core.geometry import is_rigid
from fgslam.core.homing import OmniFeatures
from fgslam.homing.feature_files import VERSIONS, pack_features, unpack_features

FILE = ArrayFile(
    name="fgslam path memory",
    versions=VERSIONS,
    error=StoredMapError,
    give="give a file that holds one, as fgslam teach writes it",
    again="write it again",
)


_METRIC = "metric_"
_PER_POSE: Items = {f"{_METRIC}poses": ("f", (4, 4)), f"{_METRIC}covariances": ("f", (6, 6))}


@dataclass(frozen=True, slots=True, eq=False)
class MetricPoses:
    """Poses of path images, as SLAM on the same drive found them.

    Attributes:
        poses: (n, 4, 4) ``wTc`` of the SLAM run's reference camera; NaN where not known.
        covariances: (n, 6, 6) in the tangent space at them; NaN where not known.
    """

    poses: FloatArray
    covariances: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PathMemory:
    """Target images of a path.

    Attributes:
        images: their features, in the order in which they are to be reached.
        names: of the images, for people; as many.
        camera: that took them; None where it is not known.
        metric: their poses; None where there are none.
    """

    images: tuple[OmniFeatures, ...]
    names: tuple[str, ...]
    camera: OmniCamera | None = None
    metric: MetricPoses | None = None

    @staticmethod
    def of(
        images: Sequence[OmniFeatures],
        names: Sequence[str] | None = None,
        camera: OmniCamera | None = None,
    ) -> PathMemory:
        """A memory; images without names are numbered.

        Raises:
            StoredMapError: there is not one name an image.
        """
        chosen = (
            tuple(str(k) for k in range(len(images))) if names is None else tuple(map(str, names))
        )
        if len(chosen) != len(images):
            raise StoredMapError(
                f"path: {len(chosen)} names for {len(images)} images; give one name an image"
            )
        return PathMemory(tuple(images), chosen, camera)

    def __len__(self) -> int:
        return len(self.images)

    def graph(self) -> csr_matrix:
        """(n, n) symmetric matrix of costs between neighbours: 1 a leg."""
        n = len(self)
        return diags([[1.0] * (n - 1)] * 2, [-1, 1], shape=(n, n), format="csr")

    def save(self, path: str | Path) -> float:
        """Writes the memory atomically.

        Returns:
            Kilobytes (of 1000 bytes) an image.

        Raises:
            OutputError: it cannot be written.
            CalibrationError: the camera is a model of the user's own.
        """
        return save_images(FILE, path, self)

    @staticmethod
    def load(path: str | Path) -> PathMemory:
        """Reads a memory; pixel positions of features are NaN.

        Raises:
            StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
        """
        return load_images(FILE, path)[0]


# --------------------------------------------------------------------------------------------
# Files of named images


def save_images(
    kind: ArrayFile, path: str | Path, memory: PathMemory, others: StateArrays | None = None
) -> float:
    """Writes features, names and camera of images atomically, and ``others`` beside them.

    Returns:
        Kilobytes (of 1000 bytes) an image.

    Raises:
        OutputError: the file cannot be written.
        CalibrationError: the camera is a model of the user's own.
    """
    camera = None if memory.camera is None else camera_values(memory.camera)
    header = kind.header(names=list(memory.names), camera=camera)
    arrays = header | pack_features(memory.images) | (others or {})
    if memory.metric is not None:
        arrays |= by_field(memory.metric, _METRIC)
    return write_arrays(Path(path), arrays, compressed=True) / 1000.0 / max(len(memory), 1)


def load_images(kind: ArrayFile, path: str | Path) -> tuple[PathMemory, StateArrays]:
    """Images of a file with names and camera, and all its arrays.

    Raises:
        StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
    """
    arrays = kind.load(as_path(path, StoredMapError))
    header = kind.read_header(arrays, str(path))
    images = unpack_features(arrays, str(path))
    names, values = header.get("names"), header.get("camera")
    if not isinstance(names, list) or len(names) != len(images):
        raise StoredMapError(f"{path}: not one name an image; write the file again")
    try:
        camera = None if values is None else camera_of(values, str(path))
    except CalibrationError as error:
        raise StoredMapError(str(error)) from None
    metric = _metric_of(kind, arrays, len(images), str(path))
    return PathMemory(images, tuple(str(name) for name in names), camera, metric), arrays


def _metric_of(kind: ArrayFile, arrays: StateArrays, count: int, where: str) -> MetricPoses | None:
    if f"{_METRIC}poses" not in arrays:
        return None
    kind.require(arrays, of_rows(count, _PER_POSE), where)
    metric = MetricPoses(**fields_from(MetricPoses, arrays, _METRIC))
    if not all(is_rigid(pose) for pose in metric.poses if not np.isnan(pose).all()):
        raise kind.damaged(f"{_METRIC}poses", where)
    known = metric.covariances[~np.isnan(metric.covariances).all(axis=(1, 2))]
    require_covariances(kind, f"{_METRIC}covariances", known, where, definite=False)
    return metric
