"""Opens the recording of an experiment, with the odometry that its configuration wants."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from fgslam.core.errors import ConfigError
from fgslam.core.log import ImageSequence
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import with_synthetic_odometry
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    MeasurementDatasetSettings,
    RecordedOdometrySettings,
    RenderedLabSettings,
    SyntheticOdometrySettings,
)
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.units import Progress


def open_sequence(config: ExperimentConfig, progress: Progress | None = None) -> ImageSequence:
    """Opens the recording, rendered or read, with the odometry that the configuration wants.

    ``progress`` is called after each frame that is rendered.
    """
    dataset = config.dataset
    if isinstance(dataset, RenderedLabSettings):
        from fgslam.datasets.rendered import RenderedLabSequence  # the world and its textures

        # The rendered robot's odometry has its noise among the data set's keys: no key may be idle.
        known = config.odometry == RecordedOdometrySettings()
        if not (known or isinstance(config.odometry, ConstantVelocitySettings)):
            raise ConfigError(
                "the rendered lab has wheels of its own, with their noise under dataset.odometry; "
                "set odometry.kind to recorded or constant_velocity, and leave out its other keys"
            )
        rendered = None if progress is None else partial(progress, "rendering")
        selected = dataset.start, dataset.stop, dataset.stride
        return RenderedLabSequence(dataset, config.seed, *selected, rendered)
    if isinstance(dataset, MeasurementDatasetSettings):
        raise ConfigError(
            f"dataset.kind {dataset.kind} holds measurements, no images; choose a recording of "
            "images here"
        )
    noise = config.odometry if isinstance(config.odometry, RecordedOdometrySettings) else None
    recording = open_recording(dataset, noise)
    if isinstance(config.odometry, SyntheticOdometrySettings):
        return with_synthetic_odometry(recording, config.odometry, config.seed)
    if noise is None:  # constant velocity needs none, so one that cannot be read does no harm
        return replace(recording, odometry_source=None)
    return recording
