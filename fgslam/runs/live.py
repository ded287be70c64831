"""SLAM as a library: a session that experiments configure and whose results can be saved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml

from fgslam.core import __version__
from fgslam.core.errors import ConfigError
from fgslam.core.sensors import CameraRig
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.maps import Map, map_points
from fgslam.runs.named_experiments import find_experiment
from fgslam.runs.opening import open_sequence
from fgslam.slam.arrival import saved_map
from fgslam.slam.feature_stream import FeatureExtractor
from fgslam.slam.results import SessionResult
from fgslam.slam.session import Session

Overrides = Mapping[str, Any] | Iterable[str]
"""Settings by dotted key, {"seed": 3, "frontend.sift.scale_levels": 6}; or as texts "seed=3"."""


@dataclass(frozen=True, eq=False, repr=False)
class Result(SessionResult):
    """Everything that a session knows at one moment: trajectory, covariances, map, remarks.

    Attributes:
        kind: the estimator.
        estimate: trajectory, pose covariances and landmarks as known now.
        online: each pose as it was first estimated, at its own time.
        online_covariances: (n, 6, 6) of those.
        closed: of all loop closures offered so far, whether the estimator took them.
        frames: the record of every frame, by name of the column.
        map: landmarks with covariances and appearance, to save or to find oneself in.
    """

    map: Map


class Slam(Session):
    """SLAM over two or three cameras, one frame at a time.

    ::

        slam = fgslam.Slam(rig, estimator="isam2")
        for t, images, odometry in frames:
            step = slam.track(t, images, odometry)
        slam.result().map.save("map.ply")

    All of :class:`fgslam.slam.session.Session`, with maps that can be saved and sessions that an
    experiment configures.
    """

    _remark = ""

    @classmethod
    def from_config(
        cls,
        config: str | Path | ExperimentConfig,
        overrides: Overrides = (),
        *,
        rig: CameraRig | None = None,
        features: FeatureExtractor | None = None,
    ) -> Self:
        """The session that an experiment describes, before its first frame.

        Given the frames of the experiment's recording (:func:`fgslam.open_recording` of the same
        name gives them), it computes the same bytes as ``fgslam run``.

        Args:
            config: the name of an experiment that comes with fgslam, a YAML file, or a
                configuration.
            overrides: settings that differ from the file's: ``{"estimator.kind": "ekf"}`` or
                ``["estimator.kind=ekf"]``.
            rig: the cameras; None for those of the experiment's recording, which is then opened.
            features: an own extractor, as for :class:`Slam`.

        Raises:
            ConfigError: no such experiment, a key or value is wrong, or it begins in a saved map.
            DatasetError: the recording cannot be opened.
        """
        settings = slam_config(config, overrides)
        if settings.map.given:
            raise ConfigError(
                f"{settings.name}: begins in a saved map, which a run finds its place in; use "
                "fgslam.run"
            )
        slam = cls(
            open_sequence(settings).rig if rig is None else rig,
            settings.estimator,
            frontend=settings.frontend,
            odometry=settings.odometry,
            features=features,
            seed=settings.seed,
        )
        slam.numbering = (settings.dataset.start, settings.dataset.stride)
        slam._remark = settings.remark
        return slam

    def result(self) -> Result:
        """Trajectory, covariances, map and remarks as known now; tracking may go on afterwards.

        Raises:
            SessionError: there is no frame yet.
        """
        found = super().result()
        points = map_points(found.estimate.landmarks, self.pipeline.tracker.database)
        about = {"drives": [self._drive(found)]}
        saved = saved_map(self.pipeline, self.rig, found.estimate, about)
        values = {name: getattr(found, name) for name in found.__dataclass_fields__}
        return Result(**values, map=Map(saved, points, self._remark))

    def _drive(self, found: SessionResult) -> dict[str, Any]:
        return {
            "name": "session",
            "fgslam": __version__,
            "frames": len(self),
            "estimator": found.kind,
            "valid_hits": self.frontend.database.valid_hits,
            "remark": self._remark,
            "remarks": list(found.remarks),
        }


def slam_config(
    config: str | Path | ExperimentConfig, overrides: Overrides = ()
) -> ExperimentConfig:
    """The configuration of an experiment of SLAM, by name or file, with overrides.

    Raises:
        ConfigError: no such experiment, it is of another task, or a key or value is wrong.
    """
    texts = override_texts(overrides)
    if not isinstance(config, ExperimentConfig):
        return load_config(find_experiment(Path(config)), texts)
    if texts:
        raise ConfigError("overrides are for experiments by name or file; change the configuration")
    return config


def override_texts(overrides: Overrides) -> list[str]:
    """Overrides as the command line writes them, `a.b=value`.

    Raises:
        ConfigError: a value is not plain (number, text, list, mapping).
    """
    if isinstance(overrides, str):
        raise ConfigError(f"overrides: {overrides!r} is one text; give a list of texts or a dict")
    if not isinstance(overrides, Iterable):
        raise ConfigError(
            f"overrides: {overrides!r} is no settings; give a dict or a list of texts"
        )
    if not isinstance(overrides, Mapping):
        return list(overrides)
    return [f"{key}={_as_yaml(key, value)}" for key, value in overrides.items()]


def _as_yaml(key: str, value: Any) -> str:
    if isinstance(value, str | Path):
        return str(value)
    plain = value.item() if isinstance(value, np.generic) else value
    try:
        text = yaml.safe_dump(plain, default_flow_style=True, width=float("inf"))
    except yaml.YAMLError:
        raise ConfigError(
            f"overrides: {key} is a {type(value).__name__}; give numbers, texts, lists or dicts"
        ) from None
    return text.removesuffix("...\n").strip()
