"""SLAM as a library: a session that experiments configure and whose results can be saved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import DEFAULT_ESTIMATOR, EstimatorSettings
from fgslam.core import __version__
from fgslam.core.checks import require_flag
from fgslam.core.errors import ConfigError, MapError
from fgslam.core.saved_map import load_map
from fgslam.core.sensors import CameraRig
from fgslam.datasets.layouts import is_recording
from fgslam.datasets.settings import OdometrySettings
from fgslam.frontend.settings import FrontendSettings
from fgslam.runs.bare_recording import bare_experiment
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.maps import Map, drives_of, map_points
from fgslam.runs.named_experiments import find_experiment
from fgslam.runs.opening import open_sequence
from fgslam.slam.arrival import MapStart, evidence_of, saved_map
from fgslam.slam.feature_stream import FeatureExtractor
from fgslam.slam.map_settings import MapSettings
from fgslam.slam.motion import MotionModel
from fgslam.slam.results import SessionResult
from fgslam.slam.session import Session

Overrides = Mapping[str, Any] | Iterable[str]
"""Settings by dotted key, {"seed": 3, "frontend.sift.max_features": 500}; or as texts "seed=3"."""


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

    def __init__(
        self,
        rig: CameraRig,
        estimator: str | EstimatorSettings | Estimator = DEFAULT_ESTIMATOR,
        *,
        frontend: FrontendSettings | Mapping[str, Any] | None = None,
        odometry: OdometrySettings | MotionModel | None = None,
        features: FeatureExtractor | None = None,
        seed: int = 0,
        start_map: Map | MapStart | None = None,
        extend_map: bool = True,
    ) -> None:
        """Begins with an empty map, or in a saved one.

        In a saved map the first pose is found without a prior. Until a frame can be located by the
        map's landmarks, :meth:`track` answers with status `not_located` and no pose; those frames
        are in no result. The map itself is not changed; :meth:`result` has what became of it.

        Args:
            rig: the rectified cameras, two or three; those that made ``start_map``.
            estimator: the kind (`odometry`, `landmark_kalman`, `landmark_kalman_graph`,
                `ekf`, `fixed_lag`, `sliding_window`, `isam2` or `batch`), settings of one, or an
                own object with the members of :class:`fgslam.Estimator`.
                In a saved map `landmark_kalman`, `ekf`, `sliding_window`, `isam2` or `batch`.
            frontend: settings of features, matching and tracking; None for the defaults; a mapping
                for what differs from these: ``{"stereo": {"max_disparity_px": 80}}``.
            odometry: what predicts the motion. None: the odometry that is handed in, and constant
                velocity over frames without any. With `constant_velocity` what is handed in is
                ignored. Or an own object with the members of :class:`fgslam.MotionModel`, for this
                session alone.
            features: an own extractor, from a grey image (height, width) uint8 to
                :class:`~fgslam.core.features.Features`, descriptors of any kind; it is called from
                several threads, with two cameras for the right image alone
                (``frontend.stereo.others``). None for SIFT.
            seed: of everything random: samples of place recognition.
            start_map: where to begin, as :meth:`fgslam.Map.load` gives it; None: an empty map.
            extend_map: False leaves the map as it is, and the session only localises in it
                (`landmark_kalman` or `ekf`).

        Raises:
            CalibrationError: the rig is impossible.
            ConfigError: no such estimator, it cannot use what will be measured or begin in a map,
                the seed is negative, or a setting of the front-end is not known or not usable.
            MapError: other cameras made the map, or it is empty.
        """
        require_flag(extend_map, "extend_map")
        if isinstance(start_map, Map):
            start_map = MapStart(start_map.saved, MapSettings(extend=extend_map))
        elif start_map is None and not extend_map:
            raise ConfigError("extend_map: without a start_map there is none to leave as it is")
        elif start_map is not None and not isinstance(start_map, MapStart):
            raise MapError(
                f"start_map is a {type(start_map).__name__}; give fgslam.Map.load(file), or the "
                "map of a result"
            )
        self._before = None if start_map is None else start_map.saved
        super().__init__(
            rig,
            estimator,
            frontend=frontend,
            odometry=odometry,
            features=features,
            seed=seed,
            beginning=start_map,
        )

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
            config: a recording's folder, the name of an experiment that comes with fgslam, a YAML
                file, or a configuration.
            overrides: settings that differ from the file's: ``{"estimator.kind": "ekf"}`` or
                ``["estimator.kind=ekf"]``.
            rig: the cameras; None for those of the experiment's recording, which is then opened.
            features: an own extractor, as for :class:`Slam`.

        Raises:
            ConfigError: no such experiment, a key or value is wrong, or its map is made by a drive
                of its own (`map.made_from`) or goes on with another run (`map.start: continue`).
            DatasetError: the recording cannot be opened.
            MapError: the map of `map.load` cannot be read, is empty, or was made by other cameras.
        """
        settings = slam_config(config, overrides)
        slam = cls(
            open_sequence(settings).rig if rig is None else rig,
            settings.estimator,
            frontend=settings.frontend,
            odometry=settings.odometry,
            features=features,
            seed=settings.seed,
            start_map=_beginning(settings),
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
        drives = [] if self._before is None else drives_of(self._before)
        about = {"drives": [*drives, self._drive(found)]}
        evidence = evidence_of(self.pipeline, self.recorder, self._before)
        saved = saved_map(self.pipeline, self.rig, found.estimate, about, evidence)
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


def _beginning(config: ExperimentConfig) -> MapStart | None:
    """The map that an experiment loads; None where it begins with an empty one."""
    settings = config.map
    if settings.made_from is not None:
        raise ConfigError(
            f"{config.name}: its map is made by a drive of its own; use fgslam.run, or "
            "Slam(start_map=...) with a map that is there"
        )
    if settings.load is None:
        return None
    return MapStart(load_map(Path(settings.load)), settings, settings.load)


def slam_config(
    config: str | Path | ExperimentConfig, overrides: Overrides = ()
) -> ExperimentConfig:
    """The configuration of an experiment of SLAM, by name or file, or of a recording's folder.

    Raises:
        ConfigError: no such experiment, it is of another task, or a key or value is wrong.
    """
    texts = override_texts(overrides)
    if not isinstance(config, ExperimentConfig):
        path = find_experiment(Path(config))
        bare = is_recording(path)
        return bare_experiment(path, None, texts).config if bare else load_config(path, texts)
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
        texts = list(overrides)
        if not all(isinstance(text, str) for text in texts):
            raise ConfigError("overrides: a list of other things than texts; write a.b=value each")
        return texts
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
