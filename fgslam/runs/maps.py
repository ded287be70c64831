"""Maps for other tools and later days: point clouds, map files, and finding oneself in one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fgslam.cameras.rig import require_rig
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.checks import require_seed
from fgslam.core.errors import MapError, OutputError
from fgslam.core.estimates import LandmarkMap, Relocalisation, Trajectory
from fgslam.core.files import as_path, require_output
from fgslam.core.geometry import so3_log
from fgslam.core.recordings import Frame
from fgslam.core.saved_map import SavedMap, load_map, save_map
from fgslam.core.saved_map import require_rig as require_rig_of_map
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.report.formats import MapPoints, write_map
from fgslam.slam.choices import chosen_frontend
from fgslam.slam.factory import make_describer, make_relocaliser, make_stereo
from fgslam.slam.inputs import checked_images

if TYPE_CHECKING:
    from fgslam.frontend.places.merging import Alignment

_VALID_HITS = 3  # where the map does not say how many its run asked for (Se et al. 6.1)
_SUFFIX = ".fgmap"


@dataclass(frozen=True, eq=False, repr=False)
class Map:
    """Landmarks with their covariances and appearance: a session's, or one that was saved.

    Attributes:
        saved: everything that a map file holds.
        points: the landmarks as other tools get them: positions (n, 3) metres, covariances
            (n, 3, 3), grey values, numbers of frames that saw and missed each.
        remark: what must be said wherever the map is shown; mostly empty.
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

    def save(self, path: str | Path) -> None:
        """Writes the map in the format that the suffix names.

        `.fgmap` holds all of it, for :meth:`load`; `.ply` and `.pcd` are point clouds for
        other tools, in the world: x right, y down, z forward, metres. The same map gives the same
        bytes; a file is written whole or not at all.

        Raises:
            OutputError: the suffix is another one, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() == _SUFFIX:
            save_map(self.saved, path)
        elif path.suffix.lower() in (".ply", ".pcd"):
            write_map(path, self.points, self.remark)
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
        """Pose of a frame in the map without a prior, or why there is none to be believed.

        The same images, map and seed give the same answer. Of the landmarks those count that are
        permanent or were seen often enough (Se et al. 6.1).

        Args:
            rig: the cameras that made the map.
            images: (left, right[, top]), as for :meth:`fgslam.Slam.track`.
            frontend: settings of features, matching and relocalisation, or a mapping for what
                differs from the defaults.
            seed: of RANSAC's samples.

        Returns:
            ``found`` says whether to believe ``wTc`` (4, 4) with ``covariance`` (6, 6), ordered
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
            raise MapError("the map holds no landmark; make it anew")
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
    return MapPoints(
        ids=landmarks.ids,
        positions=landmarks.positions,
        covariances=landmarks.covariances,
        colours=np.repeat(database.colour[rows, None], 3, axis=1),
        hits=database.hits[rows],
        misses=database.misses[rows],
        valid=database.valid[rows],
        permanent=database.permanent[rows],
    )


def drives_of(saved: SavedMap) -> list[dict[str, Any]]:
    """What the map says about the drives that made it, the last one last."""
    found = saved.about.get("drives")
    return [drive for drive in found if isinstance(drive, dict)] if isinstance(found, list) else []


def remark_of_map(saved: SavedMap) -> str:
    """Marks maps whose odometry was made from ground truth; empty otherwise."""
    return next((str(drive["remark"]) for drive in drives_of(saved) if drive.get("remark")), "")


def valid_of(saved: SavedMap) -> BoolArray:
    """(n,) landmarks seen as often as the strictest of the drives asked for (Se et al. 6.1)."""
    asked = [drive.get("valid_hits") or 0 for drive in drives_of(saved)]
    if not all(isinstance(hits, int) for hits in asked):
        raise MapError(f"the map's drives have valid_hits {asked}, not whole numbers; make it anew")
    return np.asarray(saved.hits >= max(asked, default=_VALID_HITS))


def points_of(saved: SavedMap) -> MapPoints:
    """The landmarks of a map file as a point cloud."""
    return MapPoints(
        ids=saved.landmarks.ids,
        positions=saved.landmarks.positions,
        covariances=saved.landmarks.covariances,
        colours=np.repeat(saved.colour[:, None], 3, axis=1),
        hits=saved.hits,
        misses=saved.misses,
        valid=valid_of(saved),
        permanent=saved.permanent,
    )


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
    from fgslam.frontend.places.merging import adds_nothing, align_maps, merge_maps

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
    return [
        *_about_alignment(found, str(first), str(second)),
        *_in_common(a, b, str(first), str(second)),
        f"{out}: {len(merged)} landmarks of {len(a)} and {len(b)}, {size / 1e6:.2f} MB",
    ]


def _about_alignment(found: Alignment, first: str, second: str) -> list[str]:
    x, y, z = found.aTb[:3, 3]
    turn = np.degrees(np.linalg.norm(so3_log(found.aTb[:3, :3])))
    return [
        f"{second} lies at ({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {turn:.2f} deg, in {first}",
        f"{found.agreeing} of {found.candidates} landmarks that look alike agree, {found.second} "
        "with the second-best alignment elsewhere",
        f"{len(found.pairs)} landmarks fused, residual {100.0 * found.residual_m:.2f} cm rms "
        f"({found.residual_sigmas:.2f} sigma); {found.found} of the {found.among} that lie among "
        "the first map's were found there",
    ]


def _in_common(a: SavedMap, b: SavedMap, first: str, second: str) -> list[str]:
    """A line about the evidence that both maps hold; none where there is none."""
    from fgslam.frontend.places.merging import shared_frames, shared_moments

    once = "they count once (covariance intersection)"
    if common := shared_frames(a, b):
        return [f"{common} of the {len(b.evidence)} frames of {second} are in {first}, too: {once}"]
    if moments := shared_moments(a, b):
        return [
            f"{moments} poses of {second} have times of poses of {first}, though no image is the "
            f"same: one recording read in two ways, by all appearances; {once}"
        ]
    return []
