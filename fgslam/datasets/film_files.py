"""Films as files: written frame by frame, MP4 or GIF."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import cv2
from PIL import Image as Pillow

from fgslam.core.arrays import Image
from fgslam.core.errors import OutputError
from fgslam.core.files import remove_left_behind, replacing

_GIF_FPS = 10.0  # what viewers show at least; more only makes the file larger
_GIF_WIDTH = 720


def require_film_suffix(path: Path) -> None:
    """Raises OutputError unless the file's name ends in .mp4 or .gif."""
    if path.suffix.lower() not in (".mp4", ".gif"):
        raise OutputError(
            f"cannot write {path}: unknown film format '{path.suffix}'; use .mp4 or .gif"
        )


def write_film(path: Path, frames: Iterable[Image], fps: float) -> int:
    """Writes a film whole or not at all; how many frames it has.

    A .gif has every so-maniest frame, so that it shows at most ten a second, at most 720 pixels
    wide.

    Args:
        path: the file, .mp4 or .gif.
        frames: (height, width, 3) red, green, blue, uint8, all of one even size.
        fps: frames a second.

    Raises:
        OutputError: another ending, no frame at all, or writing failed.
    """
    require_film_suffix(path)
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    remove_left_behind(path)
    with replacing(path) as partial:
        count = write(partial, frames, fps)
        if not count:
            raise OutputError(f"cannot write {path}: there is no frame to show")
    return count


def _write_mp4(path: Path, frames: Iterable[Image], fps: float) -> int:
    """Raises OSError or OutputError; OpenCV itself reports no file that it cannot write."""
    count, writer = 0, None
    path.write_bytes(b"\0")
    try:
        for frame in frames:
            if writer is None:
                size = (frame.shape[1], frame.shape[0])
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
                if not writer.isOpened():
                    raise OutputError("cannot write films as MP4: no encoder for them; use .gif")
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if count:  # its table of frames is written last: where the disk is full it lacks some
        film = cv2.VideoCapture(str(path))
        found = round(film.get(cv2.CAP_PROP_FRAME_COUNT)) if film.isOpened() else 0
        film.release()
        if found != count:
            raise OSError(errno.ENOSPC, f"of {count} frames {found} were written")
    return count


def _write_gif(path: Path, frames: Iterable[Image], fps: float) -> int:
    step = max(1, round(fps / _GIF_FPS))
    pages: list[Pillow.Image] = []
    for frame in islice(frames, 0, None, step):
        page = Pillow.fromarray(frame)
        if page.width > _GIF_WIDTH:
            page = page.resize((_GIF_WIDTH, round(page.height * _GIF_WIDTH / page.width)))
        pages.append(page.quantize(64))  # a palette each: a few hundred kilobytes in all
    if not pages:
        return 0
    duration = round(1000.0 * step / fps)
    pages[0].save(path, save_all=True, append_images=pages[1:], duration=duration, loop=0)
    return len(pages)
