"""Images with what was found in them, by OpenCV: features, disparities, flow (Se et al., Fig. 1-3).

A frame takes milliseconds: every run draws some.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.files import replacing
from fgslam.core.types import Features
from fgslam.report.content import bulk_limits, level_axes
from fgslam.report.results import ReportData

# Okabe and Ito's colours, which the colour-blind can tell apart.
ORANGE, SKY, YELLOW, INK = "#E69F00", "#56B4E9", "#F0E442", "#222222"
_DOT, _RIM = "#8C96A0", "#141414"
_WHITE = 0.78  # whites become this grey, so that bright marks stand out on windows and posters
_ALONE_PX, _BESIDE_PX = 1400, 900  # widths of images, alone in a row or not
_PANORAMIC_ASPECT = 2.2  # wider images are stacked rather than set side by side
_HEADING_PX, _BAR_PX, _MARGIN_PX = 44, 110, 10
_TEXT_PX = 20
_FILM_PX, _FILM_IMAGE_PX = (540, 1280), 664  # height and width of a frame; room for its image
_SHIFT = 4  # binary digits of a pixel's part in OpenCV's drawing
_CAMERAS = ("Right", "Left", "Top")
# The descriptor covers a window of about twelve scales; a square of four stays readable.
_SQUARE_SIDE_IN_SCALES = 4.0


def draw_features(
    path: Path, images: tuple[Image, ...], features: tuple[Features, ...], title: str = ""
) -> None:
    """SIFT features as squares: side proportional to scale, turned by orientation (Fig. 1).

    Args:
        path: the PNG to write.
        images: (height, width) uint8, in the order right, left[, top]; drawn as top, left, right.
        features: of each image, or of the first ones alone: only these are drawn.
        title: heading of the whole picture, e.g. the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    count, (height, width) = len(features), images[0].shape
    stacked = count == 1 or width > _PANORAMIC_ASPECT * height
    panels = []
    for k in reversed(range(count)):
        panel, scale = _enlarged(images[k], _ALONE_PX if stacked else _BESIDE_PX)
        _draw_lines(panel, scale * (oriented_squares(features[k]) + 0.5), [_bgr(YELLOW)])
        panel = _headed(panel, _CAMERAS[k], f"{len(features[k])} features")
        apart = (0, 0 if stacked else _MARGIN_PX)
        panels.append(np.pad(panel, ((0, 0), apart, (0, 0)), constant_values=255))
    whole = np.concatenate(panels, axis=0 if stacked else 1)
    _write(path, _headed(whole, title, "") if title else whole)


def oriented_squares(features: Features) -> FloatArray:
    """Outlines (n, 7, 2): once around the square, then a stroke from its centre ahead."""
    corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [0, 0]], dtype=float)
    half = 0.5 * _SQUARE_SIDE_IN_SCALES * features.scale[:, None]
    ahead = half * np.column_stack([np.cos(features.orientation), np.sin(features.orientation)])
    # A quarter turn clockwise on the screen, where rows grow downwards.
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    offsets = corners[None, :, :1] * ahead[:, None] + corners[None, :, 1:] * aside[:, None]
    return np.asarray(features.xy[:, None] + offsets)


def draw_disparities(path: Path, image: Image, pixels: FloatArray, title: str = "") -> None:
    """Matches over the cameras: lines as long as the disparities, coloured by them (Fig. 2).

    Args:
        path: the PNG to write.
        image: the reference (right) image, (height, width) uint8.
        pixels: (n, 3, 2) raw (column, row) in right, left and top image; NaN without a top one.
        title: heading, e.g. the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    panel, scale = _enlarged(image, _ALONE_PX)
    right, left, top = scale * (pixels.transpose(1, 0, 2) + 0.5)
    disparity = pixels[:, 1, 0] - pixels[:, 0, 0]
    low, high = (float(disparity.min()), float(disparity.max())) if len(pixels) else (0.0, 1.0)
    high = max(high, low + 1.0)
    # Logarithmic where disparities span a wide range, so that far features differ too.
    wide = low > 0.0 and high > 8.0 * low
    ends = np.log([low, high]) if wide else np.array([low, high])
    values = np.log(disparity) if wide else disparity
    colours = _colours((values - ends[0]) / (ends[1] - ends[0]))
    across = np.stack([right, np.column_stack([left[:, 0], right[:, 1]])], axis=1)
    _draw_lines(panel, across, colours)
    down = np.stack([right, np.column_stack([right[:, 0], top[:, 1]])], axis=1)
    seen = np.isfinite(top).all(axis=1)
    _draw_lines(panel, down[seen], [colours[k] for k in np.flatnonzero(seen)])
    _draw_dots(panel, right, colours)
    panel = _headed(panel, title or "Stereo matches", f"{len(pixels)} matches")
    # The colour bar: its ends and steps between them.
    tall = len(panel) - _HEADING_PX
    ramp = np.array(_colours(np.linspace(1.0, 0.0, tall)), np.uint8)[:, None]
    bar = np.full((len(panel), _BAR_PX, 3), 255, np.uint8)
    bar[_HEADING_PX:, _MARGIN_PX : 3 * _MARGIN_PX] = ramp
    for part in np.linspace(0.0, 1.0, 5).tolist():
        value = ends[0] + part * (ends[1] - ends[0])
        row = _HEADING_PX + (1.0 - part) * (tall - _TEXT_PX) + 0.85 * _TEXT_PX
        _put_text(bar, f"{np.exp(value) if wide else value:.3g} px", (3.5 * _MARGIN_PX, row))
    _write(path, np.concatenate([panel, bar], axis=1))


def draw_flow(
    path: Path, image: Image, before: FloatArray, after: FloatArray, title: str = ""
) -> None:
    """How matched features moved between two frames: dot, line, cross (Fig. 3).

    Args:
        path: the PNG to write.
        image: the later frame's reference image, (height, width) uint8.
        before: (n, 2) (column, row) in the earlier frame, pixels.
        after: (n, 2) in the later frame.
        title: heading, e.g. the frames and the motion between them.

    Raises:
        OutputError: the file cannot be written.
    """
    note = f"{len(before)} matches"
    if len(before):
        flow = np.linalg.norm(after - before, axis=1)
        note += f", median flow {np.median(flow):.1f} px"
    panel, scale = _enlarged(image, _ALONE_PX)
    start, end = scale * (before + 0.5), scale * (after + 0.5)
    _draw_lines(panel, np.stack([start, end], axis=1), [_bgr(SKY)])
    _draw_dots(panel, start, [_bgr(YELLOW)])
    arm = np.array([[-5.0, -5.0], [5.0, 5.0]])
    for stroke in (arm, arm * [1.0, -1.0]):
        _draw_lines(panel, end[:, None] + stroke, [_bgr(ORANGE)])
    legend = "dot: where it was in the earlier frame; line: its motion; cross: where it is"
    below = np.full((_HEADING_PX, panel.shape[1], 3), 255, np.uint8)
    _put_text(below, legend, (_MARGIN_PX, 0.65 * _HEADING_PX))
    panel = _headed(panel, title or "Flow between frames", note)
    _write(path, np.concatenate([panel, below]))


_VIEW_PX, _VIEW_QUALITY = 240, 55


def draw_view(path: Path, image: Image) -> None:
    """What a camera saw, small. Raises OutputError.

    Args:
        path: the JPEG to write.
        image: (height, width) or (height, width, 3) uint8.
    """
    scale = min(1.0, _VIEW_PX / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _write(path, np.asarray(small, np.uint8), [cv2.IMWRITE_JPEG_QUALITY, _VIEW_QUALITY])


def draw_plan(path: Path, data: ReportData) -> None:
    """The first estimator's path and landmarks from above, with the truth and a scale (Fig. 5).

    Args:
        path: the PNG to write.
        data: of the run.

    Raises:
        OutputError: the file cannot be written.
    """
    one, level = data.estimators[0], level_axes(data.up)[:2]
    way, dots = one.final_poses[:, :3, 3] @ level.T, one.landmarks.positions @ level.T
    truth = None if data.truth is None else data.truth.poses[:, :3, 3] @ level.T
    sides = np.diff(bulk_limits(way, dots))[:, 0]
    shape = np.maximum(_ALONE_PX * sides / float(sides.max()), _ALONE_PX // 3)
    plan = _Plan(way, dots, truth, (round(shape[0]), round(shape[1])))
    title = f"{data.title}: {one.title}, {len(dots):,} landmarks"
    _write(path, _headed(_headed(plan.drawn(dots, len(way) - 1), plan.words, ""), title, ""))


class _Plan:
    """Path and landmarks from above, drawn again as they grow; ``words`` say what is what."""

    def __init__(
        self, way: FloatArray, dots: FloatArray, truth: FloatArray | None, size: tuple[int, int]
    ) -> None:
        """Takes all that will be drawn, metres to the right and ahead, and the size in pixels."""
        limits, (wide, tall) = np.array(bulk_limits(way, dots)), size
        scale = float(np.min(np.array(size) / np.diff(limits)[:, 0]))
        self._middle, self._scale = limits.mean(axis=1), scale
        self._ground = np.full((tall, wide, 3), 255, np.uint8)
        self._way = self._pixels(way)
        self.words = "blue: path; grey: landmarks" + "; black: truth" * (truth is not None)
        if truth is not None:
            _draw_path(self._ground, self._pixels(truth), INK, 1)
        # The longest of 1, 2 and 5 times a power of ten metres that a third of the picture holds.
        room = wide / 3.0 / scale
        power = 10.0 ** np.floor(np.log10(room))
        length = power * max(k for k in (1.0, 2.0, 5.0) if k * power <= room)
        ends = [[_MARGIN_PX, tall - 15.0], [_MARGIN_PX + scale * length, tall - 15.0]]
        _draw_path(self._ground, np.array(ends), INK, 3)
        _put_text(self._ground, f"{length:g} m", (_MARGIN_PX, tall - 24.0))

    def _pixels(self, points: FloatArray) -> FloatArray:
        middle = np.array(self._ground.shape[1::-1]) / 2.0
        return np.asarray(middle + self._scale * (points - self._middle) * [1.0, -1.0])

    def drawn(self, dots: FloatArray, row: int) -> Image:
        """Landmarks (l, 2) and the path up to a pose."""
        canvas, (tall, wide) = self._ground.copy(), self._ground.shape[:2]
        at = self._pixels(dots)
        inside = ((at >= 0.0) & (at < [wide, tall])).all(axis=1)
        columns, rows = at[inside].astype(int).T
        for right, down in ((0, 0), (0, 1), (1, 0), (1, 1)):
            near = np.minimum(rows + down, tall - 1), np.minimum(columns + right, wide - 1)
            canvas[near] = np.minimum(canvas[near], np.array(_bgr(_DOT), np.uint8))
        _draw_path(canvas, self._way[: row + 1], SKY, 3)
        _draw_dots(canvas, self._way[row : row + 1], [_bgr(ORANGE)])
        return canvas


def _draw_path(canvas: Image, points: FloatArray, colour: str, thickness: int) -> None:
    known = points[np.isfinite(points).all(axis=1)]
    cv2.polylines(canvas, [_fixed(known)], False, _bgr(colour), thickness, cv2.LINE_AA, _SHIFT)


# ------------------------------------------------------------------------------------------
# Frames of a film, one after the other


class FilmCanvas:
    """A drive: the image with its matches, next to the growing map."""

    def __init__(
        self, path: FloatArray, landmarks: FloatArray, truth: FloatArray | None, title: str
    ) -> None:
        """Takes what does not change.

        Args:
            path: (n, 2) metres to the right and ahead, of all poses.
            landmarks: (m, 2) all that will be drawn, for the limits.
            truth: (k, 2) true path, or None.
            title: above the map.
        """
        tall, wide = _FILM_PX
        room = wide - _FILM_IMAGE_PX - _MARGIN_PX, tall - 2 * _HEADING_PX
        self._plan, self._title = _Plan(path, landmarks, truth, room), title

    def draw(
        self,
        image: Image | None,
        seen: tuple[FloatArray, FloatArray, FloatArray],
        title: str,
        known: FloatArray,
        row: int,
    ) -> Image:
        """The frame (540, 1280, 3) in red, green, blue.

        Args:
            image: what the reference camera saw; None where it cannot be read.
            seen: pixels (k, 2) of the matched landmarks in the last frame and in this one, and
                (l, 2) of landmarks seen for the first time.
            title: above the image.
            known: (m, 2) landmarks of the map.
            row: of the present pose.
        """
        whole = np.full((*_FILM_PX, 3), 255, np.uint8)
        plan = _headed(self._plan.drawn(known, row), self._title, "")
        whole[: len(plan), -plan.shape[1] :] = plan
        _put_text(whole, self._plan.words, (_FILM_PX[1] - plan.shape[1], len(plan) + 28))
        _put_text(whole, title, (_MARGIN_PX, 0.65 * _HEADING_PX), weight=700)
        if image is not None:
            panel = self._with_matches(image, seen)
            whole[_HEADING_PX : _HEADING_PX + len(panel), : panel.shape[1]] = panel
        words = "orange: matched, with its motion; yellow: new landmark"
        _put_text(whole, words, (_MARGIN_PX, _FILM_PX[0] - 16))
        return np.asarray(whole[..., ::-1])

    def _with_matches(self, image: Image, seen: tuple[FloatArray, ...]) -> Image:
        tall, wide = image.shape[:2]
        scale = min(_FILM_IMAGE_PX / wide, (_FILM_PX[0] - 2 * _HEADING_PX) / tall)
        dimmed = _dimmed(image)
        coloured = (
            cv2.cvtColor(dimmed, cv2.COLOR_GRAY2BGR) if dimmed.ndim == 2 else dimmed[..., ::-1]
        )
        size = round(scale * wide), round(scale * tall)
        panel: Image = np.asarray(
            cv2.resize(coloured, size, interpolation=cv2.INTER_AREA), np.uint8
        )
        start, end, new = (scale * (pixels + 0.5) for pixels in seen)
        _draw_lines(panel, np.stack([start, end], axis=1), [_bgr(SKY)])
        _draw_dots(panel, end, [_bgr(ORANGE)], 3)
        _draw_dots(panel, new, [_bgr(YELLOW)], 2)
        return panel


def _enlarged(image: Image, width: int) -> tuple[Image, float]:
    """The image, dimmed, in blue, green, red at a width near to ``width``; and its scale."""
    scale = max(1.0, float(round(width / image.shape[1])))
    grey = cv2.resize(_dimmed(image), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8), scale


def _dimmed(image: Image) -> Image:
    darkest, span = dimmed_range(image)
    above = np.maximum(image, darkest) - darkest
    return np.asarray(cv2.convertScaleAbs(above, alpha=255.0 / span), np.uint8)


def dimmed_range(image: Image) -> tuple[float, float]:
    """The level that is shown black, and how far above it white would be."""
    darkest, brightest = np.percentile(image, [0.5, 99.5]).tolist()
    return darkest, max(brightest - darkest, 32.0) / _WHITE


def _bgr(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour[1:])[::-1])


def _headed(panel: Image, title: str, note: str) -> Image:
    """A panel below its title, in bold, and a note at the right."""
    head = np.full((_HEADING_PX, panel.shape[1], 3), 255, np.uint8)
    row = 0.65 * _HEADING_PX
    _put_text(head, title, (_MARGIN_PX, row), weight=700)
    if note:
        wide = cv2.getTextSize((1, 1), note, (0, 0), cv2.FontFace("sans"), _TEXT_PX)[2]
        _put_text(head, note, (panel.shape[1] - wide - _MARGIN_PX, row))
    return np.concatenate([head, panel])


def _put_text(canvas: Image, text: str, at: tuple[float, float], weight: int = 400) -> None:
    place = (round(at[0]), round(at[1]))
    cv2.putText(canvas, text, place, _bgr(INK), cv2.FontFace("sans"), _TEXT_PX, weight)


def _draw_lines(canvas: Image, lines: FloatArray, colours: list[tuple[int, ...]]) -> None:
    """Polylines (n, k, 2) with a dark rim, visible on bright and dark ground alike.

    Of one colour, or each of its own.
    """
    points = list(_fixed(lines))
    cv2.polylines(canvas, points, False, _bgr(_RIM), 4, cv2.LINE_AA, _SHIFT)
    for colour, group in zip(colours, [points] if len(colours) == 1 else points, strict=True):
        own = group if len(colours) == 1 else [group]
        cv2.polylines(canvas, own, False, colour, 2, cv2.LINE_AA, _SHIFT)


def _draw_dots(
    canvas: Image, centres: FloatArray, colours: list[tuple[int, ...]], radius: int = 4
) -> None:
    for k, centre in enumerate(_fixed(centres)):
        place = tuple(centre.tolist())
        cv2.circle(canvas, place, (radius + 1) << _SHIFT, _bgr(_RIM), -1, cv2.LINE_AA, _SHIFT)
        colour = colours[k % len(colours)]
        cv2.circle(canvas, place, radius << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)


def _fixed(points: FloatArray) -> npt.NDArray[np.int32]:
    """Points as OpenCV's numbers of fixed parts of a pixel, whose centres are whole."""
    return np.rint((points - 0.5) * (1 << _SHIFT)).astype(np.int32)


def _colours(parts: FloatArray) -> list[tuple[int, ...]]:
    """Of parts from 0 to 1; without the dark end, which would be lost in shadows."""
    levels = np.rint(255.0 * (0.3 + 0.7 * parts)).astype(np.uint8).reshape(-1, 1)
    painted = cv2.applyColorMap(levels, cv2.COLORMAP_PLASMA) if len(levels) else np.empty((0, 3))
    return [tuple(row) for row in painted.reshape(-1, 3).astype(np.int64).tolist()]


# Level 1 takes a third of the time of 3, for a tenth more bytes.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def _write(path: Path, canvas: Image, how: Sequence[int] = _PNG) -> None:
    packed = cv2.imencode(path.suffix, canvas, how)[1]
    with replacing(path) as partial:
        partial.write_bytes(packed.tobytes())
