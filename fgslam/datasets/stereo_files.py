"""Image files of several cameras, frame by frame: what is missing, sizes, reading."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.datasets.images import read_grey_image

CAMERA_NAMES = ("right", "left", "top")
_NAMED_IN_NOTES = 5


@dataclass(frozen=True, eq=False)
class StereoFiles:
    """Where the images of every frame are; readable by index.

    Attributes:
        paths: per frame the files of right, left[, top] camera; they need not exist.
        width, height: the calibrated size in pixels.
    """

    paths: tuple[tuple[Path, ...], ...]
    width: int
    height: int

    def load(self, index: int) -> tuple[Image, ...]:
        """Images of a frame. Raises FrameError when one is missing, damaged or of another size."""
        images = []
        for path in self.paths[index]:
            image = read_grey_image(path)
            if image.shape != (self.height, self.width):
                raise FrameError(
                    f"image {path} is {size(image)} but the calibration says "
                    f"{self.width}x{self.height}; restore the right file"
                )
            images.append(image)
        return tuple(images)

    def first_images(self) -> tuple[Image, ...] | None:
        """Images of the first frame that can be read, whatever their size; None without any."""
        for paths in self.paths:
            try:
                return tuple(read_grey_image(path) for path in paths)
            except FrameError:
                continue
        return None


def size(image: Image) -> str:
    """Width and height in words."""
    return f"{image.shape[1]}x{image.shape[0]}"


def check_sizes(files: StereoFiles, where: Path) -> None:
    """Compare the first readable frame with the calibration; later frames are checked when read.

    Raises:
        DatasetError: no frame can be read, or the cameras' images differ in size.
        CalibrationError: their size is not the calibrated one.
    """
    images = files.first_images()
    if images is None:
        raise DatasetError(
            f"{where}: not one of {len(files.paths)} frames has a readable image from each of "
            f"{len(files.paths[0])} cameras; check that the file names fit the list of times"
        )
    sizes = [size(image) for image in images]
    if len(set(sizes)) > 1:
        named = ", ".join(f"{n} {s}" for n, s in zip(CAMERA_NAMES, sizes, strict=False))
        raise DatasetError(
            f"{where}: the cameras' images differ in size ({named}); all must be rectified to one "
            "size"
        )
    if sizes[0] != f"{files.width}x{files.height}":
        raise CalibrationError(
            f"{where}: images are {sizes[0]} but the calibration says {files.width}x{files.height}"
            "; if the images were resized, scale fx, fy, cx, cy, width and height alike"
        )


def missing_notes(files: StereoFiles, stamps: FloatArray) -> tuple[str, ...]:
    """In words, which frames lack an image (existence only: damage shows when reading)."""
    missing = [
        (k, CAMERA_NAMES[c])
        for k, paths in enumerate(files.paths)
        for c, path in enumerate(paths)
        if not path.is_file()
    ]
    frames = sorted({k for k, _ in missing})
    if not frames:
        return ()
    first = ", ".join(f"{k} ({camera})" for k, camera in missing[:_NAMED_IN_NOTES])
    more = ", ..." if len(missing) > _NAMED_IN_NOTES else ""
    return (f"{len(frames)} of {len(stamps)} frames lack an image: {first}{more}",)


def require_folder(path: Path, what: str) -> None:
    """Raises DatasetError unless the folder exists."""
    if not path.is_dir():
        raise DatasetError(
            f"{what} {path} does not exist; check dataset.path and the layout, or say where the "
            "recording is: --set dataset.path=FOLDER"
        )
