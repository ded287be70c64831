"""Views of a recording, its mirror checked; their features, found once; homing vectors of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.cameras.omni.lens_camera import LensCamera
from fgslam.cameras.omni.mirrors import RadialCamera
from fgslam.cameras.omni.ocamcalib import OCamCamera
from fgslam.cameras.omni.panoramas import Equirectangular
from fgslam.cameras.omni.ring_calibration import MirrorCircle, find_mirror_circle
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, FrameError, OutputError
from fgslam.core.files import make_subfolder
from fgslam.core.homing import (
    BearingMatches,
    FeatureKind,
    OmniFeatures,
    Refusal,
    TwoViewVector,
)
from fgslam.datasets.omni_recording import OmniRecording
from fgslam.datasets.omni_settings import OmniDatasetSettings
from fgslam.datasets.opening import open_omni
from fgslam.frontend.features.column_segments import empty_segments
from fgslam.frontend.features.omni_features import OmniFeatureExtractor
from fgslam.frontend.features.settings import OmniFeatureSettings, OmniMatchingSettings
from fgslam.frontend.homing.matching import plain_sift
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.view_pairs import pair_generator, vector_between
from fgslam.homing.link_consistency import sift_inliers
from fgslam.report.content import Picture
from fgslam.runs.engine import Context
from fgslam.runs.units import Stage, in_blocks, interleaved

_PICTURES = 3  # the rim may be as dark as its holder in one of them
_CLEARLY_OFF = 0.025
"""Of the radius: a calibrated mirror was seen off by 0.015, its rim and its axis not being one
(docs/datasets/mirror_images.md); this is an error of 1.4 degrees at the rim, more within."""
_LEAST_OFF_PX = 3.0
_UNEVEN = 1.25  # columns over rows a degree, or the reverse, that no one means
_BLACK = 16.0  # mean of red, green and blue; a film's black is up to that
_BESIDE = 0.01  # of the width: so many black columns are no dark corner
_STEEP = 0.01  # of the steps between columns are larger than any around a real panorama's end


def open_checked(settings: OmniDatasetSettings) -> OmniRecording:
    """Opens a recording, with a note where its pictures cannot be of the stated camera.

    Raises:
        DatasetError: as :func:`fgslam.datasets.opening.open_omni`.
    """
    recording = open_omni(settings)
    return replace(recording, notes=recording.notes + camera_notes(recording))


def camera_notes(recording: OmniRecording, stated: bool = True) -> tuple[str, ...]:
    """What the pictures show of the stated mirror or panoramas, and what a file does not state.

    The latter, and a mirror that is where it should be, only of a camera that is stated here, not
    of one that a route brings along.
    """
    camera = recording.camera
    if isinstance(camera, Equirectangular):
        return (*_panorama_notes(camera), *_side_notes(recording))
    if isinstance(camera, LensCamera):
        told = (_lens_note(camera),) if stated else ()
        hole, rim = camera.ring
        # A mirror reflects its camera in the middle; a lens has no rim that must be in the picture.
        if hole > 0.0:
            told = (*told, *_mirror_notes(recording, camera.centre, rim, stated))
        return told
    if isinstance(camera, RadialCamera):
        told = (_OCAM_NOTE,) if stated and isinstance(camera, OCamCamera) else ()
        return (*told, *_mirror_notes(recording, camera.frame.centre, camera.outer_radius, stated))
    return ()


_OCAM_NOTE = (
    "the picture's middle is taken to look down, as of a mirror above the camera; of a fisheye "
    "that looks up dataset.camera.kind=lens and dataset.camera.middle=up say so"
)


def _lens_note(camera: LensCamera) -> str:
    """What no calibration of a lens says."""
    stated, other = ("up", "down") if camera.up else ("down", "up")
    turn = "clockwise" if camera.clockwise else "counter-clockwise"
    return (
        f"the picture's middle is taken to look {stated}, bearings to grow {turn} in it; "
        f"dataset.camera.middle={other} and dataset.camera.clockwise say otherwise"
    )


def _panorama_notes(camera: Equirectangular) -> tuple[str, ...]:
    """A note where columns and rows are not equally fine: a cropped panorama, or none at all."""
    view = np.rad2deg(camera.top_elevation - camera.bottom_elevation)
    across, down = (camera.width - 1) / 360.0, (camera.height - 1) / view
    if max(across, down) <= _UNEVEN * min(across, down):
        return ()
    return (
        f"pictures of {camera.width}x{camera.height} pixels over 360 x {view:g} degrees have "
        f"{across:.1f} columns but {down:.1f} rows a degree: are they whole panoramas? Else give "
        "dataset.camera.top_elevation_deg and bottom_elevation_deg",
    )


def _side_notes(recording: OmniRecording) -> tuple[str, ...]:
    """A note where the pictures do not go on from their last column to the first one.

    In whole panoramas these are neighbours; here the step between them is larger than nearly all
    others, or what is beside the picture proper is black.
    """
    ends = [_ends(image.mean(axis=2)) for image in _first_pictures(recording)]
    if not ends:
        return ()
    black, step = np.median(ends, axis=0)
    if black > _BESIDE * recording.camera.width:
        what = f"{black:.0f} columns of the pictures are black at the sides"
    elif step > 0.0:
        what = "the right and left ends of the pictures do not meet"
    else:
        return ()
    return (
        f"{recording.name}: {what}: they are no panoramas of all 360 degrees from end to end, so "
        "directions are wrong; cut off what is beside them, or give the camera that took them",
    )


def _ends(grey: FloatArray) -> tuple[int, float]:
    """Black columns at both sides of a picture (h, w), and how unusual the step around it is.

    That is by how many grey levels it exceeds nearly all steps between two columns.
    """
    lit = np.flatnonzero(grey.max(axis=0) > _BLACK)
    if not len(lit):
        return 0, 0.0
    black = grey.shape[1] - int(lit[-1] - lit[0] + 1)
    steps = np.abs(np.diff(grey)).mean(axis=0)
    around = float(np.abs(grey[:, -1] - grey[:, 0]).mean())
    return black, around - float(np.quantile(steps, 1.0 - _STEEP))


def _first_pictures(recording: OmniRecording) -> Iterator[Image]:
    """As many as a check needs, without damaged ones."""
    for k in range(min(_PICTURES, len(recording))):
        with suppress(FrameError):
            yield recording.image(k)


def _mirror_notes(
    recording: OmniRecording, stated: tuple[float, float], radius: float, always: bool
) -> tuple[str, ...]:
    """A note on where the rim is in the first pictures; of one in its place only where asked."""
    circles = [c for k in _first_pictures(recording) if (c := _rim(stated, radius, k)) is not None]
    if not circles:
        return (
            f"the mirror's rim is not found in {recording.names[0]}, so its centre is unchecked",
        )
    column, row = np.median([c.centre for c in circles], axis=0)
    away = float(np.hypot(column - stated[0], row - stated[1]))
    if away <= max(_CLEARLY_OFF * radius, _LEAST_OFF_PX):
        found = f"the mirror's rim is found, {away:.1f} px from where it is stated"
        return (found,) if always else ()
    return (
        f"the mirror lies {away:.1f} px off its stated centre ({stated[0]:.1f}, {stated[1]:.1f}): "
        f"its rim's is ({column:.1f}, {row:.1f}); bearings are wrong by up to "
        f"{np.degrees(away / radius):.1f} degrees at the rim and more within: correct "
        "dataset.camera or the calibration",
    )


def _rim(stated: tuple[float, float], radius: float, image: Image) -> MirrorCircle | None:
    """The rim near where it should be, else around any circle: its holder's, say, is concentric."""
    found = _circle(image, (stated, radius))
    if found is not None:
        return found
    around = _circle(image, None)
    return None if around is None else _circle(image, (around.centre, radius))


def _circle(image: Image, near: tuple[tuple[float, float], float] | None) -> MirrorCircle | None:
    try:
        return find_mirror_circle(image, np.random.default_rng(0), near)
    except CalibrationError:
        return None


VIEWS_A_BLOCK = 4


@dataclass(frozen=True, slots=True)
class _Block:
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings | None
    views: tuple[int, ...]


def view_names(views: OmniRecording) -> tuple[str, ...]:
    """(n) the recording's own numbers of its views, as text."""
    return tuple(str(number) for number in views.ids.tolist())


def extract_features(
    views: OmniRecording,
    dataset: OmniDatasetSettings,
    settings: OmniFeatureSettings | None,
    context: Context,
) -> list[OmniFeatures]:
    """Features of all views in their order; stopped early, of the first ones without a gap.

    Args:
        views: opened.
        dataset: that it is opened with, in any process.
        settings: of the features; None for plain SIFT, the baseline.
        context: of the run.

    Raises:
        DatasetError: a view cannot be read.
        OutputError: a process ended by itself, perhaps for lack of memory.
    """
    what = "features" if settings is not None else "plain SIFT"
    stage = Stage(
        name=what.replace(" ", "_"),
        label=what,
        count=len(views),
        work=_extract,
        argument=lambda units: _Block(dataset, settings, units),
        kind=OmniFeatures,
        blocks=in_blocks(VIEWS_A_BLOCK),
        small=True,
    )
    done = context.perform(stage)
    if done.ended and not context.stopped():
        raise OutputError(f"features of {views.name}: {done.ended[0][1]}")
    gap = next((k for k in range(len(views)) if k not in done.results), len(views))
    return [done.results[k] for k in range(gap)]


def _extract(block: _Block) -> list[OmniFeatures]:
    recording = open_omni(block.dataset)
    if block.features is None:
        return [
            OmniFeatures(plain_sift(recording.camera, recording.image(i)), empty_segments())
            for i in block.views
        ]
    extractor = _extractor(block.dataset, block.features)
    return [extractor.extract(recording.image(i)) for i in block.views]


@lru_cache(maxsize=1)
def _extractor(dataset: OmniDatasetSettings, settings: OmniFeatureSettings) -> OmniFeatureExtractor:
    """Its maps take as long as an image's features; a process does several blocks of views."""
    return OmniFeatureExtractor(open_omni(dataset).camera, settings)


_BLOCKS_A_JOB = 4  # so that progress moves, and no process waits long for the last one


@dataclass(frozen=True, slots=True, eq=False)
class PairAnswer:
    """What was found about one pair.

    Attributes:
        a, b: numbers of the views; b is the target.
        found: the homing vector, or why there is none.
        matches: tentative ones.
        rows: (k, 2) SIFT features of both views that are inliers; None where they were not kept.
    """

    a: int
    b: int
    found: TwoViewVector | Refusal
    matches: int
    rows: IntArray | None = None

    @property
    def answered(self) -> bool:
        """Whether there is a homing vector."""
        return isinstance(self.found, TwoViewVector)

    @property
    def inliers(self) -> int:
        """Of the answer; 0 where there is none."""
        return self.found.support if isinstance(self.found, TwoViewVector) else 0


@dataclass(frozen=True, slots=True, eq=False)
class PairSearch:
    """Some pairs for one process.

    Attributes:
        features: of all views.
        pairs: numbers (a, b) of views; b is the target.
        matching, vector: settings.
        seed: of the experiment; each pair draws from a generator of its own.
    """

    features: tuple[OmniFeatures, ...]
    pairs: tuple[tuple[int, int], ...]
    matching: OmniMatchingSettings
    vector: HomingVectorSettings
    seed: int


def answer_pair(search: PairSearch, a: int, b: int) -> tuple[PairAnswer, BearingMatches]:
    """One pair's answer and its tentative matches."""
    views, rng = (search.features[a], search.features[b]), pair_generator(search.seed, a, b)
    found, matches = vector_between(*views, search.matching, search.vector, rng)
    return PairAnswer(a, b, found, len(matches), sift_inliers(found, matches)), matches


def answer_pairs(
    search: PairSearch, context: Context, what: str = "pairs"
) -> tuple[list[PairAnswer], list[str]]:
    """All pairs in their order (stopped early, those that are done), and what went wrong."""
    stage = Stage(
        # Their numbers depend on how many views there are: fewer where a run was stopped.
        name=f"{what.replace(' ', '_')}_of_{len(search.features)}_views",
        label=what,
        count=len(search.pairs),
        work=_perform,
        argument=lambda units: replace(search, pairs=tuple(search.pairs[k] for k in units)),
        kind=PairAnswer,
        blocks=interleaved(_BLOCKS_A_JOB * context.jobs),
        small=True,
    )
    done = context.perform(stage)
    failures = [f"{len(units)} pairs: {why}" for units, why in done.ended]
    return list(done.results.values()), failures


def inlier_rows(answers: Sequence[PairAnswer]) -> dict[tuple[int, int], IntArray]:
    """Of each answered pair (a, b): (k, 2) SIFT features of both views that are inliers."""
    return {(k.a, k.b): k.rows for k in answers if k.rows is not None}


def _perform(search: PairSearch) -> list[PairAnswer]:
    return [answer_pair(search, a, b)[0] for a, b in search.pairs]


FOLDER = "pictures"


def draw_pair(
    folder: Path, views: OmniRecording, search: PairSearch, answer: PairAnswer
) -> Picture:
    """One pair: its accepted matches on both views."""
    from fgslam.report.pictures.image_overlays import MatchedPixels, draw_view_matches

    found, matches = answer_pair(search, answer.a, answer.b)
    a, b = view_names(views)[answer.a], view_names(views)[answer.b]
    vector = found.found
    kept = (
        matches.select(vector.inliers)
        if isinstance(vector, TwoViewVector)
        else matches.select(np.zeros(len(matches), np.bool_))
    )
    camera = views.camera
    pixels = MatchedPixels(
        _pixels(camera, kept.bearing_a, kept.elevation_a),
        _pixels(camera, kept.bearing_b, kept.elevation_b),
        kept.kind == FeatureKind.COLUMN,
    )
    caption = _caption(vector, matches) if isinstance(vector, TwoViewVector) else "refused"
    path = make_subfolder(folder, FOLDER) / f"matches_{a}_{b}.png"
    images = views.image(answer.a), views.image(answer.b)
    draw_view_matches(path, images, pixels, (f"view {a}: {caption}", f"view {b}"))
    return Picture(f"Matches of views {a} and {b}: {caption}", path.read_bytes())


def _caption(vector: TwoViewVector, matches: BearingMatches) -> str:
    direction, rotation = np.rad2deg([vector.direction, vector.rotation])
    return (
        f"{vector.support} of {len(matches)} matches, direction {direction:.1f}, "
        f"rotation {rotation:.1f} degrees"
    )


def _pixels(camera: OmniCamera, bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), np.tan(elevation)])
    return camera.pixels(rays)
