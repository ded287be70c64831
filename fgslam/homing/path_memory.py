"""A path as it is remembered: the features of its images, in order, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fgslam.core.array_files import ArrayFile, write_arrays
from fgslam.core.errors import StoredMapError
from fgslam.core.homing import OmniFeatures
from fgslam.homing.feature_file import pack_features, unpack_features

FILE = ArrayFile(
    name="fgslam path memory",
    versions=(1,),
    error=StoredMapError,
    give="give a file that holds one",
    again="write it again",
)


@dataclass(frozen=True, slots=True, eq=False)
class PathMemory:
    """Target images of a path.

    Attributes:
        images: their features, in the order in which they are to be reached.
        names: of the images, for people; as many.
    """

    images: tuple[OmniFeatures, ...]
    names: tuple[str, ...]

    @staticmethod
    def of(images: Sequence[OmniFeatures], names: Sequence[str] | None = None) -> PathMemory:
        """A memory; images without names are numbered.

        Raises:
            StoredMapError: there is not one name an image.
        """
        chosen = tuple(str(k) for k in range(len(images))) if names is None else tuple(names)
        if len(chosen) != len(images):
            raise StoredMapError(
                f"path: {len(chosen)} names for {len(images)} images; give one name an image"
            )
        return PathMemory(tuple(images), chosen)

    def __len__(self) -> int:
        return len(self.images)

    def save(self, path: str | Path) -> float:
        """Writes the memory atomically.

        Returns:
            Kilobytes (of 1000 bytes) an image.

        Raises:
            OutputError: it cannot be written.
        """
        arrays = FILE.header(names=list(self.names)) | pack_features(self.images)
        size = write_arrays(Path(path), arrays, compressed=True)
        return size / 1000.0 / max(len(self), 1)

    @staticmethod
    def load(path: str | Path) -> PathMemory:
        """Reads a memory; pixel positions of features are NaN.

        Raises:
            StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
        """
        arrays = FILE.load(Path(path))
        header = FILE.read_header(arrays, str(path))
        images = unpack_features(arrays, str(path))
        return PathMemory(images, read_names(header, len(images), str(path)))


def read_names(header: Mapping[str, object], count: int, where: str) -> tuple[str, ...]:
    """Names of images out of a header.

    Raises:
        StoredMapError: there are none, or not one an image.
    """
    names = header.get("names")
    if not isinstance(names, list) or len(names) != count:
        raise StoredMapError(f"{where}: not one name an image; write the file again")
    return tuple(str(name) for name in names)
