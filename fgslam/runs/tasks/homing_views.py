"""The views of a recording and their features, found in processes, each view once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OutputError
from fgslam.core.homing import OmniFeatures
from fgslam.datasets.omni.opening import open_omni
from fgslam.datasets.omni.recording import OmniRecording
from fgslam.datasets.omni.settings import OmniDatasetSettings
from fgslam.frontend.features.column_segments import empty_segments
from fgslam.frontend.features.omni_features import OmniFeatureExtractor
from fgslam.frontend.features.omni_settings import OmniFeatureSettings
from fgslam.frontend.homing.plain_sift import plain_sift
from fgslam.runs.engine import Context
from fgslam.runs.tasks.homing_mirror_check import open_checked
from fgslam.runs.units import Stage, in_blocks

_VIEWS_A_BLOCK = 4


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """A recording of single views.

    Attributes:
        settings: that it is opened with, in any process.
        recording: opened.
    """

    settings: OmniDatasetSettings
    recording: OmniRecording

    def __len__(self) -> int:
        return len(self.recording)

    @property
    def names(self) -> tuple[str, ...]:
        """(n) the recording's own numbers, as text."""
        return tuple(str(number) for number in self.recording.ids.tolist())

    @property
    def poses(self) -> FloatArray | None:
        """(n, 3) true planar poses, or None."""
        return self.recording.poses

    @property
    def rooms(self) -> tuple[str, ...] | None:
        """(n) names of the rooms, or None."""
        return self.recording.rooms

    @property
    def provenance(self) -> dict[str, Any]:
        """What the run's configuration says about its data."""
        return {"name": self.recording.name, "identity": self.recording.identity}


@dataclass(frozen=True, slots=True)
class _Block:
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings | None
    views: tuple[int, ...]


def open_views(settings: OmniDatasetSettings) -> Views:
    """Opens the recording and checks its mirror, if it has one. Raises DatasetError."""
    return Views(settings, open_checked(settings))


def extract_features(
    views: Views, settings: OmniFeatureSettings | None, context: Context
) -> list[OmniFeatures]:
    """Features of all views in their order; stopped early, of the first ones without a gap.

    Args:
        views: opened.
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
        argument=lambda units: _Block(views.settings, settings, units),
        kind=OmniFeatures,
        blocks=in_blocks(_VIEWS_A_BLOCK),
    )
    done = context.perform(stage)
    if done.ended and not context.stopped():
        raise OutputError(f"features of {views.recording.name}: {done.ended[0][1]}")
    gap = next((k for k in range(len(views)) if k not in done.results), len(views))
    return [done.results[k] for k in range(gap)]


def _extract(block: _Block) -> list[OmniFeatures]:
    recording = open_omni(block.dataset)
    if block.features is None:
        return [
            OmniFeatures(plain_sift(recording.camera, recording.image(i)), empty_segments())
            for i in block.views
        ]
    extractor = OmniFeatureExtractor(recording.camera, block.features)
    return [extractor.extract(recording.image(i)) for i in block.views]
