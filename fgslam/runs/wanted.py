"""What `export` and `film` are asked for; light: every command loads it before it does anything."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from fgslam.runs.dense import DenseSettings


@dataclass(frozen=True)
class Wanted:
    """What to export: files and folders to write, None where not asked for.

    Attributes:
        map: landmarks as .ply or .pcd
        trajectory: camera poses as .tum, .kitti, .csv (EuRoC) or .mcap (ROS 2)
        graph: measurements, poses and landmarks as .g2o, for other solvers
        images (DIR): images, poses and points, for COLMAP
        frame: what the trajectory is of; default what the recording's truth is of, else left
        axes: of trajectory and map: x right, y down (camera), or x forward, z up (ros); default
            ros with .mcap, else camera
        estimator: which estimator's; default the one that steered
        valid_only: landmarks seen in at least three frames
        colour: --map in the images' colours, with normals
        dense: all that the images show, as points with colours and sigma, .ply or .pcd
        mesh: the same as triangles, .ply
        grid: free, occupied and unknown cells of the floor, Nav2's .yaml with its .pgm
        voxel (METRES): side of voxels and of the grid's cells; default three pixels at the median
            depth
        max_range (--range METRES): farthest depth; default by the cameras' precision
        cameras: 2 leaves the top camera out
        every: of the frames every so many are matched densely
        sigma (METRES): what is known less well is left out of --dense and --mesh; default two
            voxels
        recording: where the run's recording is now; default where it was, or next to the run
        overwrite: replace an earlier one
    """

    map: Path | None = None
    trajectory: Path | None = None
    graph: Path | None = None
    images: Path | None = None
    frame: Literal["left", "right", "body"] | None = None
    axes: Literal["camera", "ros"] | None = None
    estimator: str | None = None
    valid_only: bool = False
    colour: bool = False
    dense: Path | None = None
    mesh: Path | None = None
    grid: Path | None = None
    voxel: float | None = None
    max_range: float | None = None
    cameras: int | None = None
    every: int = 2
    sigma: float | None = None
    recording: Path | None = None
    overwrite: bool = False

    @property
    def how(self) -> DenseSettings:
        """How the dense map is made. Raises ConfigError."""
        from fgslam.runs.dense import DenseSettings  # loads OpenCV and much of SciPy

        return DenseSettings(self.voxel, self.max_range, self.cameras, self.every, self.sigma)

    @property
    def files(self) -> list[Path]:
        """Those to write."""
        grid = (self.grid, self.grid and self.grid.with_suffix(".pgm"))
        files = (self.map, self.trajectory, self.graph, self.dense, self.mesh, *grid)
        return [path for path in files if path is not None]

    @property
    def is_dense(self) -> bool:
        """Whether images are to be matched densely."""
        return (self.dense, self.mesh, self.grid) != (None, None, None)

    @property
    def is_bag(self) -> bool:
        """Whether the trajectory is for ROS 2."""
        return self.trajectory is not None and self.trajectory.suffix.lower() == ".mcap"

    @property
    def chosen_axes(self) -> Literal["camera", "ros"]:
        """Of trajectory and map, which lie in one world."""
        return self.axes or ("ros" if self.is_bag else "camera")


@dataclass(frozen=True)
class Filmed:
    """What a film of a run shows.

    Attributes:
        estimator: whose path and map; default the one that steered
        taught (DIR): of a route that was followed: the run folder of fgslam teach (its --report),
            for the pictures of path images
        recording: where the run's recording is now; default where it was, or next to the run
    """

    estimator: str | None = None
    taught: Path | None = None
    recording: Path | None = None
