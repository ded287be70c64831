"""SLAM as a library: a session that experiments configure and whose results can be saved."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt
import yaml

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import DEFAULT_ESTIMATOR, EstimatorSettings
from fgslam.cameras.rig import StereoRig, require_rig
from fgslam.core import __version__
from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, Image, IntArray
from fgslam.core.checks import require_flag, require_seed
from fgslam.core.errors import ConfigError, FrameError, MapError, OutputError
from fgslam.core.files import as_path, require_output
from fgslam.core.geometry import so3_log
from fgslam.core.log import Frame, MeasurementLog
from fgslam.core.open3d_library import load_open3d
from fgslam.core.saved_map import SavedMap, load_map, require_rig as require_rig_of_map, save_map
from fgslam.core.sensors import CameraRig, Measured, Odometry
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import Estimate, LandmarkMap, Relocalisation, Trajectory
from fgslam.datasets.layouts import is_recording
from fgslam.datasets.settings import OdometrySettings
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.report.content import sentence
from fgslam.report.formats import Axes, MapPoints, write_map
from fgslam.runs.bare import bare_experiment
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.named_experiments import find_experiment
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import (
    MapStart,
    chosen_frontend,
    evidence_of,
    make_describer,
    make_relocaliser,
    make_stereo,
    saved_map,
)
from fgslam.slam.feature_stream import FeatureExtractor
from fgslam.slam.motion import MotionModel
from fgslam.slam.results import SessionResult, Step
from fgslam.slam.rig_memory import RigMemory
from fgslam.slam.session import Images, Session, checked_images
from fgslam.slam.settings import MapSettings

if TYPE_CHECKING:
    from fgslam.runs.dense import DenseMap

# ------------------------------------------------------------------------------------------
# Maps for other tools and later days: point clouds, map files, and finding oneself in one

_VALID_HITS = 3  # where the map does not say how many its run asked for (Se et al. 6.1)
_SUFFIX = ".fgmap"


@dataclass(frozen=True, eq=False, repr=False)
class Map:
    """Landmarks with their covariances and appearance: a session's, or one that was saved.

    Attributes:
        saved: everything that a map file holds.
        points: the landmarks as other tools get them: positions (n, 3) metres, covariances
            (n, 3, 3), grey values, numbers of frames that saw and missed each.
        remark: what any display of the map must state; mostly empty.
    """

    saved: SavedMap
    points: MapPoints
    remark: str = ""

    def __repr__(self) -> str:
        return f"<map of {len(self.saved.landmarks)} landmarks>"

    @staticmethod
    def load(path: str | Path) -> Map:
        """Reads a `.fgmap` file and checks its checksum.

        Raises:
            MapError: the file is missing, truncated, damaged, foreign, or of a newer fgslam.
        """
        saved = load_map(as_path(path, MapError))
        return Map(saved, points_of(saved), remark_of_map(saved))

    def save(self, path: str | Path, axes: Axes = "camera") -> None:
        """Writes the map in the format that the suffix names.

        `.fgmap` holds all of it, for :meth:`load`; `.ply` and `.pcd` are point clouds
        for other tools, in the world: x right, y down, z forward, or with ``axes="ros"`` x forward,
        y left, z up; metres. The same map gives the same bytes; a file is written whole or not at
        all.

        Raises:
            OutputError: the suffix is another one, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() == _SUFFIX:
            save_map(self.saved, path)
        elif path.suffix.lower() in (".ply", ".pcd"):
            write_map(path, self.points, self.remark, axes)
        else:
            raise OutputError(
                f"cannot write {path}: unknown map format '{path.suffix}'; use .fgmap, .ply or .pcd"
            )

    def locate(
        self,
        rig: CameraRig,
        images: Sequence[npt.ArrayLike],
        frontend: FrontendSettings | Mapping[str, Any] | None = None,
        seed: int = 0,
    ) -> Relocalisation:
        """Pose of a frame in the map without a prior, or why there is none.

        The same images, map and seed give the same answer. Of the landmarks those count that are
        permanent or were seen often enough (Se et al. 6.1).

        Args:
            rig: the cameras that made the map.
            images: (left, right[, top]), as for :meth:`fgslam.Slam.track`.
            frontend: settings of features, matching and relocalisation, or a mapping for what
                differs from the defaults.
            seed: of RANSAC's samples.

        Returns:
            ``found``: whether to trust ``wTc`` (4, 4) with ``covariance`` (6, 6), ordered
            [rotation, translation]; ``why`` gives the reason in words.

        Raises:
            CalibrationError: the rig is impossible.
            MapError: the map is of other cameras, or holds no landmark.
            FrameError: wrong number, size, type or shape of images.
        """
        require_rig(rig)
        require_seed(seed, "locate")
        require_rig_of_map(self.saved, rig, "the map")
        if not len(self.saved):
            raise MapError("the map holds no landmark; make it again")
        frontend = chosen_frontend(frontend)
        checked = checked_images(images, rig)
        with one_blas_thread():
            relocaliser = make_relocaliser(rig, frontend)
            sure = self.saved.permanent | valid_of(self.saved)
            landmarks = self.saved.landmarks.select(sure)
            relocaliser.learn(landmarks, self.saved.appearances.of(landmarks.ids))
            describer = make_describer(rig, frontend)
            found = describer.describe(0, Frame(0, 0.0, checked))
            describer.close()
            stereo = make_stereo(rig, frontend).match(found.frame, found.features).whole
            return relocaliser.locate(stereo, np.random.default_rng(seed))

    def __len__(self) -> int:
        """Number of landmarks."""
        return len(self.points)

    @property
    def positions(self) -> FloatArray:
        """(n, 3) landmarks in the world, metres."""
        return self.points.positions

    @property
    def covariances(self) -> FloatArray:
        """(n, 3, 3) of the positions, metres squared."""
        return self.points.covariances

    @property
    def ids(self) -> IntArray:
        """(n,) identities of the landmarks, ascending."""
        return self.points.ids

    @property
    def colours(self) -> ByteArray:
        """(n, 3) red, green, blue where each was first seen, uint8; grey from grey images."""
        return self.points.colours

    def to_open3d(self) -> Any:
        """The landmarks as an ``open3d.t.geometry.PointCloud``.

        Besides positions and colours it has ``landmark_id``, ``hits``, ``valid`` and ``covariance``
        (n, 9), row by row.

        Raises:
            MissingDependencyError: Open3D or a system library it needs is absent.
        """
        o3d, points = load_open3d(), self.points
        cloud = o3d.t.geometry.PointCloud()
        arrays: dict[str, npt.NDArray[Any]] = {
            "positions": points.positions,
            "colors": points.colours,
            "landmark_id": points.ids,
            "hits": points.hits,
            "valid": points.valid,
            "covariance": points.covariances,
        }
        for name, values in arrays.items():
            flat = np.ascontiguousarray(values.reshape(len(points), -1))
            cloud.point[name] = o3d.core.Tensor(flat)
        return cloud

    @property
    def rig(self) -> CameraRig:
        """The cameras that made the map."""
        return self.saved.rig

    @property
    def trajectory(self) -> Trajectory:
        """The drive that made the map."""
        return self.saved.trajectory


def map_points(landmarks: LandmarkMap, database: LandmarkDatabase) -> MapPoints:
    """The estimator's geometry joined with the front-end's bookkeeping."""
    rows = database.rows(landmarks.ids)
    colours = np.repeat(database.colour[rows, None], 3, axis=1)
    counted: tuple[Any, ...] = (database.hits, database.misses, database.valid, database.permanent)
    geometry = (landmarks.ids, landmarks.positions, landmarks.covariances)
    return MapPoints(*geometry, colours, *(column[rows] for column in counted))


def drives_of(saved: SavedMap) -> list[dict[str, Any]]:
    """What the map records of the drives that made it, the last one last."""
    found = saved.about.get("drives")
    return [drive for drive in found if isinstance(drive, dict)] if isinstance(found, list) else []


_DRIVE = (
    *("name", "fgslam", "recording", "frames", "estimator", "valid_hits"),
    *("truth_frame", "remark", "remarks", "settings"),
)
"""What a map records of a drive, in this order."""


def map_of(session: Session, estimate: Estimate, before: SavedMap | None, **drive: Any) -> SavedMap:
    """The map of a session that may have begun in another one, with what is recorded of its drive.

    Args:
        session: as it is now.
        estimate: its estimator's.
        before: the map that it began in.
        drive: of :data:`_DRIVE` what the session itself does not know.
    """
    known = drive | {
        "fgslam": __version__,
        "frames": len(session.recorder),
        "estimator": session.pipeline.estimator.kind,
        "valid_hits": session.frontend.database.valid_hits,
    }
    drives = [] if before is None else drives_of(before)
    about = {"drives": [*drives, {name: known[name] for name in _DRIVE if name in known}]}
    evidence = evidence_of(session.pipeline, session.recorder, before)
    return saved_map(session.pipeline, session.rig, estimate, about, evidence)


def remark_of_map(saved: SavedMap) -> str:
    """Marks maps whose odometry was made from ground truth; empty otherwise."""
    return next((str(drive["remark"]) for drive in drives_of(saved) if drive.get("remark")), "")


def valid_of(saved: SavedMap) -> BoolArray:
    """(n,) landmarks seen as often as the strictest of the drives asked for (Se et al. 6.1)."""
    asked = [drive.get("valid_hits") or 0 for drive in drives_of(saved)]
    if not all(isinstance(hits, int) for hits in asked):
        raise MapError(
            f"the map's drives have valid_hits {asked}, not whole numbers; make it again"
        )
    return np.asarray(saved.hits >= max(asked, default=_VALID_HITS))


def points_of(saved: SavedMap) -> MapPoints:
    """The landmarks of a map file as a point cloud."""
    landmarks = saved.landmarks
    geometry = (landmarks.ids, landmarks.positions, landmarks.covariances, saved.shown)
    return MapPoints(*geometry, saved.hits, saved.misses, valid_of(saved), saved.permanent)


# --------------------------------------------------------------------------------------------
# Two maps made into one

_SEED = 0  # the same maps give the same bytes


def merge_files(first: Path, second: Path, out: Path, overwrite: bool = False) -> list[str]:
    """Lays the second map onto the first and writes both as one; lines about what was found.

    Where every frame of the second is in the first already, that one is written as it is.

    Raises:
        MapError: one is no map, another rig made it, they do not overlap or that is ambiguous.
        OutputError: ``out`` is there already, is one of the two, or cannot be written.
    """
    # Not before: no run merges maps, and these load much of SciPy.
    from fgslam.frontend.places.merging import (
        adds_nothing,
        align_maps,
        merge_maps,
        shared_frames,
        shared_moments,
    )

    require_output(out, overwrite, (first, second))
    a, b = load_map(first), load_map(second)
    require_rig_of_map(b, a.rig, str(second))
    if adds_nothing(b, a):
        size = save_map(a, out)
        return [
            f"all {len(b.evidence)} frames of {second} are in {first} already, and count once: "
            "nothing to merge",
            f"{out}: {first} as it is, {len(a)} landmarks, {size / 1e6:.2f} MB",
        ]
    found = align_maps(a, b, np.random.default_rng(_SEED), f"{first} and {second}")
    merged = merge_maps(a, b, found)
    size = save_map(merged, out)
    x, y, z = found.aTb[:3, 3]
    turn = np.degrees(np.linalg.norm(so3_log(found.aTb[:3, :3])))
    lines = [
        f"{second} lies at ({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {turn:.2f} deg, in {first}",
        f"{found.agreeing} of {found.candidates} landmarks that look alike agree, {found.second} "
        "with the second-best alignment elsewhere",
        f"{len(found.pairs)} landmarks fused, residual {100.0 * found.residual_m:.2f} cm rms "
        f"({found.residual_sigmas:.2f} sigma); {found.found} of the {found.among} that lie among "
        "the first map's were found there",
    ]
    # Evidence that both maps hold.
    once = "they count once (covariance intersection)"
    if common := shared_frames(a, b):
        lines.append(
            f"{common} of the {len(b.evidence)} frames of {second} are in {first}, too: {once}"
        )
    elif moments := shared_moments(a, b):
        lines.append(
            f"{moments} poses of {second} have times of poses of {first}, though no image is the "
            f"same: one recording read in two ways, by all appearances; {once}"
        )
    size_text = f"{len(merged)} landmarks of {len(a)} and {len(b)}, {size / 1e6:.2f} MB"
    return [*lines, f"{out}: {size_text}"]


Overrides = Mapping[str, Any] | Iterable[str]
"""Settings by dotted key, {"seed": 3, "frontend.sift.max_features": 500}; or as texts "seed=3"."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Result(SessionResult):
    """Everything that a session knows at one moment: trajectory, covariances, map, remarks.

    Attributes:
        map: landmarks with covariances and appearance, to save or to find oneself in.
        log: the session's measurements; it grows where tracking goes on.
        cameras: the session's.
    """

    notes: tuple[str, ...]
    map: Map
    log: MeasurementLog
    cameras: CameraRig

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the images, and on what the estimator left out or had to repair."""
        return (*self.notes, *self.estimate.remarks)

    def dense_map(self, frames: Any, **how: Any) -> DenseMap:
        """All that images show along this trajectory: ``surface``, and ``grid`` to drive by.

        Args:
            frames: those that were tracked: a recording as :func:`fgslam.open_recording` gives it,
                with its colours and its depth; or a sequence of (time, images, ...), the images as
                for :meth:`Slam.track`. They are read again.
            how: ``voxel_m``, ``range_m``, ``cameras``, ``every``, ``sigma_m`` of
                :class:`fgslam.runs.dense.DenseSettings`.

        Raises:
            FgslamError: the frames have other times or no images, or they show no depth.
        """
        # These load OpenCV and much of SciPy.
        from fgslam.runs.dense import DenseSettings, fuse, readers_of, rows_along

        def images(i: int) -> tuple[Image, ...]:
            if (given := frames[i][1]) is None:
                raise FrameError(f"frame {i} has no images")
            left, right, *top = (_eight_bits(image) for image in given)
            raw = (right, left, *top)
            return self.cameras.rectified(raw) if isinstance(self.cameras, StereoRig) else raw

        sequence = getattr(frames, "sequence", None)
        readers = (images, None) if sequence is None else readers_of(sequence)
        stamps = [frame[0] for frame in frames] if sequence is None else sequence.timestamps
        rows = rows_along(self.trajectory, np.asarray(stamps, np.float64))
        return fuse(self.log, self.estimate, rows, *readers, DenseSettings(**how))


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

    def __init__(  # noqa: PLR0913 - each is what a session may be given
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
        rig_memory: RigMemory | None = None,
    ) -> None:
        """Begins with an empty map, or in a saved one.

        In a saved map the first pose is found without a prior. Until a frame can be located by the
        map's landmarks, :meth:`track` answers with status `not_located` and no pose; those frames
        are in no result. The map itself is not changed; :meth:`result` has what became of it.

        Args:
            rig: the rectified cameras, two or three; those that made ``start_map``.
            estimator: the kind (``fgslam.backend.settings.ESTIMATORS``), settings of one, or an own
                object with the members of :class:`fgslam.Estimator`.
                In a saved map `landmark_kalman`, `ekf`, `sliding_window`, `isam2` or `batch`.
            frontend: settings of features, matching and tracking; None for the defaults; a mapping
                for what differs from these: ``{"stereo": {"max_disparity_px": 80}}``.
            odometry: what predicts the motion. None: the odometry that is handed in, and constant
                velocity over frames without any. With `constant_velocity` what is handed in is
                ignored. Or an own object with the members of :class:`fgslam.MotionModel`, for this
                session alone.
            features: an own extractor, from a grey image (height, width) uint8 to
                :class:`~fgslam.core.types.Features`, descriptors of any kind; it is called from
                several threads, with two cameras for the right image alone
                (``frontend.stereo.others``). None for SIFT.
            seed: of everything random: samples of place recognition.
            start_map: where to begin, as :meth:`fgslam.Map.load` gives it; None: an empty map.
            extend_map: False leaves the map as it is, and the session only localises in it
                (`landmark_kalman` or `ekf`).
            rig_memory: what earlier drives have shown of the rig's calibration
                (:class:`fgslam.RigMemory`); None: nothing.

        Raises:
            CalibrationError: the rig is impossible, or the memory of other cameras.
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
        # Of landmarks that images in colour began.
        self._colours: dict[int, ByteArray] = {}
        if self._before is not None and self._before.colours is not None:
            ids = self._before.landmarks.ids.tolist()
            self._colours = dict(zip(ids, self._before.colours, strict=True))
        super().__init__(
            rig,
            estimator,
            frontend=frontend,
            odometry=odometry,
            features=features,
            seed=seed,
            beginning=start_map,
            rig_memory=rig_memory,
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
        start, maps = None, settings.map
        if maps.made_from is not None:
            raise ConfigError(
                f"{settings.name}: its map is made by a drive of its own; use fgslam.run, or "
                "Slam(start_map=...) with a map that is there"
            )
        if maps.load is not None:
            start = MapStart(load_map(Path(maps.load)), maps, maps.load)
        slam = cls(
            open_sequence(settings).rig if rig is None else rig,
            settings.estimator,
            frontend=settings.frontend,
            odometry=settings.odometry,
            features=features,
            seed=settings.seed,
            start_map=start,
        )
        slam.numbering = (settings.dataset.start, settings.dataset.stride)
        slam._remark = settings.remark
        return slam

    def track(
        self,
        t: float,
        images: Images | None,
        odometry: Odometry | npt.ArrayLike | None = None,
        measurements: Iterable[Measured] = (),
    ) -> Step:
        """As :meth:`fgslam.slam.session.Session.track`; the map keeps colours.

        Those of the right image where a landmark begins, of images (height, width, 3).
        """
        step = super().track(t, images, odometry, measurements)
        shown = [] if images is None else [image for image in images if image is not None]
        coloured = len(shown) == self.rig.cameras and np.shape(shown[1])[2:] in _CHANNELS
        if coloured and len(self.recorder):
            seen = self.recorder.log.increments[-1].observations
            new = seen.select(seen.is_new)
            left, right, *top = map(_eight_bits, shown)
            if isinstance(self.rig, StereoRig) and self.rig.rectifier is not None:
                right = self.rig.rectifier.image(0, (right, left, *top))
            column, row = np.rint(new.pixels[:, 0]).astype(np.int64).T
            self._colours |= dict(zip(new.ids.tolist(), right[row, column, :3], strict=True))
        return step

    def result(self) -> Result:
        """Trajectory, covariances, map and remarks as known now; tracking may go on afterwards.

        Raises:
            SessionError: there is no frame yet.
        """
        found = super().result()
        seen = found.estimate.landmarks.below(Measured.FIRST_ID)
        points = map_points(seen, self.pipeline.tracker.database)
        if self._colours:
            for row, identity in enumerate(points.ids.tolist()):
                points.colours[row] = self._colours.get(identity, points.colours[row])
        drive = {"remark": self._remark, "remarks": list(map(sentence, found.remarks))}
        estimate = replace(found.estimate, landmarks=seen)
        saved = map_of(self, estimate, self._before, name="session", **drive)
        if self._colours:
            rows = np.searchsorted(points.ids, saved.landmarks.ids)
            saved = replace(saved, colours=points.colours[rows])
        values = {name: getattr(found, name) for name in found.__dataclass_fields__}
        values["notes"] = tuple(map(sentence, found.notes))
        log = self.recorder.log
        return Result(**values, map=Map(saved, points, self._remark), log=log, cameras=self.rig)


_CHANNELS = ((3,), (4,))  # of images in colour


def _eight_bits(image: npt.ArrayLike) -> Image:
    pixels = np.asarray(image)
    return np.asarray(pixels >> 8 if pixels.dtype == np.uint16 else pixels, np.uint8)


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
    if isinstance(overrides, str) or not isinstance(overrides, Iterable):
        raise ConfigError(
            f"overrides: {overrides!r} is one value; give a dict or a list of texts a.b=value"
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
