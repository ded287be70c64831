"""Images with what was found in them, by OpenCV: features, disparities, flow (Se et al., Fig. 1-3).

A frame takes milliseconds: every run draws some.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten, wrap
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.core.files import replacing
from fgslam.core.geometry import unit
from fgslam.core.types import Features
from fgslam.report.content import bulk_limits, level_axes
from fgslam.report.results import ReportData

# Okabe and Ito's colours, which the colour-blind can tell apart.
ORANGE, SKY, YELLOW, INK = "#E69F00", "#56B4E9", "#F0E442", "#222222"
VERMILLION, FAINT = "#D55E00", "#DDDDDD"
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
    title = f"{data.title}: {one.title}, {len(dots):,} landmarks"
    plan = Plan(way, dots, truth, (round(shape[0]), round(shape[1])), title)
    _write(path, _headed(_headed(plan.drawn(dots, len(way) - 1), plan.words, ""), title, ""))


class Plan:
    """Path and landmarks from above, drawn again as they grow; ``words`` say what is what."""

    def __init__(
        self,
        way: FloatArray,
        dots: FloatArray,
        truth: FloatArray | None,
        size: tuple[int, int],
        title: str,
    ) -> None:
        """Takes all that will be drawn, metres to the right and ahead, and the size in pixels."""
        limits, (wide, tall) = np.array(bulk_limits(way, dots)), size
        scale = float(np.min(np.array(size) / np.diff(limits)[:, 0]))
        self._middle, self._scale, self.title = limits.mean(axis=1), scale, title
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


ROOM_PX = _FILM_PX[1] - _FILM_IMAGE_PX - _MARGIN_PX, _FILM_PX[0] - 2 * _HEADING_PX
"""Width and height of the plan in a frame."""


def film_frame(
    plan: Plan,
    image: Image | None,
    seen: tuple[FloatArray, FloatArray, FloatArray],
    title: str,
    known: FloatArray,
    row: int,
) -> Image:
    """A drive: the image with its matches, next to the growing map (540, 1280, 3), R G B.

    Args:
        plan: of the whole drive, :data:`ROOM_PX` large.
        image: what the reference camera saw; None where it cannot be read.
        seen: pixels (k, 2) of the matched landmarks in the last frame and in this one, and
            (l, 2) of landmarks seen for the first time.
        title: above the image.
        known: (m, 2) landmarks of the map.
        row: of the present pose.
    """
    whole = np.full((*_FILM_PX, 3), 255, np.uint8)
    above = _headed(plan.drawn(known, row), plan.title, "")
    whole[: len(above), -above.shape[1] :] = above
    _put_text(whole, plan.words, (_FILM_PX[1] - above.shape[1], len(above) + 28))
    _put_text(whole, title, (_MARGIN_PX, 0.65 * _HEADING_PX), weight=700)
    if image is not None:
        panel, scale = _fitted(image, (_FILM_IMAGE_PX, _FILM_PX[0] - 2 * _HEADING_PX))
        start, end, new = (scale * (pixels + 0.5) for pixels in seen)
        _draw_lines(panel, np.stack([start, end], axis=1), [_bgr(SKY)])
        _draw_dots(panel, end, [_bgr(ORANGE)], 3)
        _draw_dots(panel, new, [_bgr(YELLOW)], 2)
        whole[_HEADING_PX : _HEADING_PX + len(panel), : panel.shape[1]] = panel
    words = "orange: matched, with its motion; yellow: new landmark"
    _put_text(whole, words, (_MARGIN_PX, _FILM_PX[0] - 16))
    return np.asarray(whole[..., ::-1])


@dataclass(frozen=True, slots=True, eq=False)
class PathPicture:
    """What is shown of a path image.

    Attributes:
        name: for people.
        size: columns and rows of its picture.
        features: (k, 2) pixels of the features that are remembered; NaN where not in view.
        image: the picture itself; None where only the features are at hand.
    """

    name: str
    size: tuple[int, int]
    features: FloatArray
    image: Image | None


_ROUTE_PX = (720, 1280)  # height and width of a frame
_SEEN_PX, _REMEMBERED_PX = (740, 540), (460, 260)  # room for the image and the path image
_SECOND_PX = 800  # column of what stands at the right
_COMPASS_PX, _COMPASS_RADIUS_PX = (910, 490), 100
_ROUTE_ROW_PX = 680
_LINE, _LINES = 26, 5  # letters of a reason in a line
_MOST_NAMED = 25  # path images whose numbers stand below the route


def route_frame(
    path: Sequence[PathPicture],
    row: Mapping[str, Any],
    image: Image | None,
    lines: tuple[FloatArray, FloatArray],
    command: str,
) -> Image:
    """A route that is followed: image, path image, homing vector, place (720, 1280, 3), R G B.

    Args:
        path: what is shown of each path image, in order.
        row: of follow.csv by name of the column; numbers are NaN where they are not known.
        image: as recorded; None where it cannot be read.
        lines: (m, 2) pixels along the heading, and along the homing vector; NaN where not in view.
        command: speed and turning rate, or why there is no homing vector.
    """
    canvas = np.full((*_ROUTE_PX, 3), 255, np.uint8)
    nearest, target = (
        int(row[column]) if np.isfinite(row[column]) else None
        for column in ("path_image", "target")
    )
    title = f"{row['name']} at {row['time_s']:.1f} s; white: ahead, orange: home"
    if image is not None:
        panel, scale = _fitted(image, _SEEN_PX)
        for points, tint in zip(lines, ("#FFFFFF", ORANGE), strict=True):
            if len(known := points[np.isfinite(points).all(axis=1)]):
                _draw_lines(panel, scale * (known[None] + 0.5), [_bgr(tint)])
        canvas[_HEADING_PX : _HEADING_PX + len(panel), _MARGIN_PX:][:, : panel.shape[1]] = panel
    _put_text(canvas, title, (_MARGIN_PX, 0.65 * _HEADING_PX), weight=700)
    title = "Path image: not known"
    if nearest is not None:
        shown = path[nearest]
        title = f"Path image {nearest}: {shorten(shown.name, 24, placeholder='...')}"
        picture = np.zeros(shown.size[::-1], np.uint8) if shown.image is None else shown.image
        panel, scale = _fitted(picture, _REMEMBERED_PX)
        if shown.image is None:
            seen = shown.features[np.isfinite(shown.features).all(axis=1)]
            _draw_dots(panel, scale * (seen + 0.5), [_bgr(SKY)], 2)
            title += " (its features)"
        canvas[_HEADING_PX : _HEADING_PX + len(panel), _SECOND_PX:][:, : panel.shape[1]] = panel
    _put_text(canvas, title, (_SECOND_PX, 0.65 * _HEADING_PX), weight=700)
    _draw_compass(canvas, row, command)
    _draw_place(canvas, nearest, target, row["probability"], len(path))
    return np.asarray(canvas[..., ::-1])


def _draw_compass(canvas: Image, row: Mapping[str, Any], command: str) -> None:
    """The robot from above, ahead is up: an arrow home with its deviation, and the command."""
    x, y = _COMPASS_PX
    cv2.circle(canvas, (x, y), _COMPASS_RADIUS_PX, _bgr(FAINT), 2, cv2.LINE_AA)
    direction, sigma = np.deg2rad([row["direction_deg"], row["sigma_direction_deg"]]).tolist()
    if np.isfinite(direction):
        around = direction + sigma * np.linspace(-1.0, 1.0, 21)
        rim = np.array([x, y]) - _COMPASS_RADIUS_PX * unit(around)[:, ::-1]
        wedge = [_fixed(np.vstack([[x, y], rim]))]
        cv2.fillPoly(canvas, wedge, _bgr("#F8E2B3"), cv2.LINE_AA, _SHIFT)
        tip = tuple(np.rint(rim[10]).astype(int).tolist())
        cv2.arrowedLine(canvas, (x, y), tip, _bgr(ORANGE), 4, cv2.LINE_AA, tipLength=0.2)
    robot = np.array([[x - 10, y + 10], [x + 10, y + 10], [x, y - 16]], np.int32)
    cv2.fillPoly(canvas, [robot], _bgr(INK), cv2.LINE_AA)
    _put_text(canvas, "Homing vector, ahead is up", (_SECOND_PX, y - 130), weight=700)
    lines = [part for line in command.splitlines() for part in wrap(line, _LINE)]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], lines[_LINES - 1] + " ..."]
    refused = row["refusal"] and row["state"] != "arrived"
    for k, line in enumerate(lines):
        at = x + 120, y - 50 + 28 * k
        _put_text(canvas, line, at, colour=_bgr(VERMILLION if refused else INK))


def _draw_place(
    canvas: Image, nearest: int | None, target: int | None, probability: float, count: int
) -> None:
    """The path images in a row; where the robot is, and where it goes next."""
    room = _ROUTE_PX[1] - 4.0 * _MARGIN_PX
    columns = 2.0 * _MARGIN_PX + room * (np.arange(count) + 0.5) / max(count, 1)
    places = np.column_stack([columns, np.full(count, float(_ROUTE_ROW_PX))])
    _draw_path(canvas, places[[0, -1]], FAINT, 3)
    _draw_dots(canvas, places, [_bgr(_DOT)], 4)
    title = "Place: not known"
    if nearest is not None:
        _draw_dots(canvas, places[[nearest]], [_bgr(SKY)], 9)
        title = f"Place: path image {nearest}, probability {100 * probability:.0f} %"
    if target is not None and target != nearest:
        ring = round(float(places[target, 0])), _ROUTE_ROW_PX
        cv2.circle(canvas, ring, 13, _bgr(ORANGE), 3, cv2.LINE_AA)
        title += f"; next {target}"
    _put_text(canvas, title, (_MARGIN_PX, _ROUTE_ROW_PX - 40), weight=700)
    for k in range(0, count, -(-count // _MOST_NAMED)):
        _put_text(canvas, str(k), (places[k, 0] - 8, _ROUTE_ROW_PX + 34))


# ------------------------------------------------------------------------------------------
# Pictures of homing: matches of two views, tracks, path images side by side


def draw_view_matches(
    path: Path,
    images: tuple[Image, Image],
    pixels: tuple[FloatArray, FloatArray],
    columns: BoolArray,
    titles: tuple[str, str],
) -> None:
    """One picture above the other, each match with a number of its own colour in both.

    Args:
        path: of the PNG.
        images: (h, w, 3) red, green, blue.
        pixels: (n, 2) column and row of the accepted matches in either, from centre to centre.
        columns: (n,) which are column segments: drawn as bars, the others as rings.
        titles: above each picture.

    Raises:
        OutputError: the file cannot be written.
    """
    # Neighbours in bearing get neighbouring hues, so that a wrong match stands out.
    order = np.argsort(np.argsort(pixels[0][:, 0]))
    colours = _colours(order / max(len(order), 1), cv2.COLORMAP_HSV)
    bar = np.array([[0.0, -8.0], [0.0, 8.0]])
    panels = []
    for image, points, title in zip(images, pixels, titles, strict=True):
        panel, scale = _fitted(image, _SHEET_PX)
        for k, place in enumerate(scale * (points + 0.5)):
            if columns[k]:
                _draw_lines(panel, (place + bar)[None], [colours[k]])
            else:
                cv2.circle(
                    panel, tuple(np.rint(place).astype(int).tolist()), 5, colours[k], 1, cv2.LINE_AA
                )
            _put_text(panel, str(k), (place[0] + 6.0, place[1] - 6.0), 400, colours[k], 11)
        panels.append(_headed(panel, title, ""))
    _write(path, np.concatenate(panels))


def draw_view_tracks(path: Path, view: Image, trails: Sequence[FloatArray], title: str) -> None:
    """Each point with its trail; those that are new are red.

    Args:
        path: of the PNG.
        view: (h, w) grey panorama; its last column is followed by its first.
        trails: (k, 2) column and row of one point in the last k images, the present one last.
        title: above it.

    Raises:
        OutputError: the file cannot be written.
    """
    panel, scale = _fitted(view, _SHEET_PX)
    for trail in trails:
        # Parts between crossings of the seam.
        seams = np.flatnonzero(np.abs(np.diff(trail[:, 0])) > view.shape[1] / 2.0) + 1
        for part in np.split(scale * (trail + 0.5), seams):
            _draw_path(panel, part, YELLOW, 1)
        tint = SKY if len(trail) > 1 else VERMILLION
        _draw_dots(panel, scale * (trail[-1:] + 0.5), [_bgr(tint)], 3)
    _write(path, _headed(panel, title, ""))


_SHEET_PX, _SHEET_COLUMNS = (1400, 1400), 4  # room for a picture, or for four in a row


def draw_sheet(path: Path, images: Sequence[Image], titles: Sequence[str]) -> None:
    """Pictures side by side, row after row.

    Args:
        path: of the PNG.
        images: (h, w, 3) red, green, blue, of one size; at least one.
        titles: above each.

    Raises:
        OutputError: the file cannot be written.
    """
    across = min(_SHEET_COLUMNS, len(images))
    room = _SHEET_PX[0] // across - _MARGIN_PX, _SHEET_PX[1]
    panels = [
        np.pad(_headed(_fitted(image, room)[0], title, ""), ((0, 0), (0, _MARGIN_PX), (0, 0)),
               constant_values=255)
        for image, title in zip(images, titles, strict=True)
    ]  # fmt: skip
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % across)
    rows = [panels[k : k + across] for k in range(0, len(panels), across)]
    _write(path, np.concatenate([np.concatenate(row, axis=1) for row in rows]))


# ------------------------------------------------------------------------------------------
# Panels, marks and texts


def _enlarged(image: Image, width: int) -> tuple[Image, float]:
    """The image, dimmed, in blue, green, red at a width near to ``width``; and its scale."""
    scale = max(1.0, float(round(width / image.shape[1])))
    return _scaled(image, scale), scale


def _fitted(image: Image, room: tuple[int, int]) -> tuple[Image, float]:
    """The same as large as a room (columns, rows) holds it."""
    scale = min(room[0] / image.shape[1], room[1] / image.shape[0])
    return _scaled(image, scale), scale


def _scaled(image: Image, scale: float) -> Image:
    """A grey image, or one in R, G, B, in blue, green, red; dimmed, so that marks stand out."""
    darkest, brightest = np.percentile(image, [0.5, 99.5]).tolist()
    span = max(brightest - darkest, 32.0) / _WHITE
    above = np.maximum(image, darkest) - darkest
    dimmed = np.asarray(cv2.convertScaleAbs(above, alpha=255.0 / span), np.uint8)
    kind = cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR
    how = cv2.INTER_CUBIC if scale > 1.0 else cv2.INTER_AREA
    larger = cv2.resize(cv2.cvtColor(dimmed, kind), None, fx=scale, fy=scale, interpolation=how)
    return np.asarray(larger, np.uint8)


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


def _put_text(
    canvas: Image,
    text: str,
    at: tuple[float, float],
    weight: int = 400,
    colour: tuple[int, ...] = (34, 34, 34),
    size: int = _TEXT_PX,
) -> None:
    place = (round(at[0]), round(at[1]))
    cv2.putText(canvas, text, place, colour, cv2.FontFace("sans"), size, weight)


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


def _colours(parts: FloatArray, table: int = cv2.COLORMAP_PLASMA) -> list[tuple[int, ...]]:
    """Of parts from 0 to 1; without Plasma's dark end, which would be lost in shadows."""
    parts = 0.3 + 0.7 * parts if table == cv2.COLORMAP_PLASMA else parts
    levels = np.rint(255.0 * parts).astype(np.uint8).reshape(-1, 1)
    painted = cv2.applyColorMap(levels, table) if len(levels) else np.empty((0, 3))
    return [tuple(row) for row in painted.reshape(-1, 3).astype(np.int64).tolist()]


# Level 1 takes a third of the time of 3, for a tenth more bytes.
_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)


def _write(path: Path, canvas: Image, how: Sequence[int] = _PNG) -> None:
    packed = cv2.imencode(path.suffix, canvas, how)[1]
    with replacing(path) as partial:
        partial.write_bytes(packed.tobytes())
