"""Recordings to try: what is made here is written as folders of images, of others where they are.

The public ones are named with their licence and the command to type; nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from fgslam.core.errors import ConfigError
from fgslam.core.files import require_output, write_bytes, write_text
from fgslam.core.types import Trajectory
from fgslam.datasets.folders import write_image_folder, write_poses
from fgslam.datasets.images import encoded_png
from fgslam.datasets.recording import TRUTH_RIGHT

if TYPE_CHECKING:
    from fgslam.core.arrays import Image
    from fgslam.core.log import ImageSequence


Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""


@dataclass(frozen=True)
class Offer:
    """One recording: what it is, its size (MB), licence, where it is, what to type.

    ``write`` makes it in a folder; None where it is only to be fetched.
    """

    what: str
    size_mb: float
    licence: str
    where: str
    command: str
    write: Callable[[Path, Progress], None] | None = None


def write_recording(name: str, folder: Path, progress: Progress) -> str:
    """Writes a recording that is made here; the command to type next.

    Raises:
        ConfigError: it is no such recording.
        OutputError: the folder is not new, or cannot be written.
    """
    offer = OFFERS.get(name)
    if offer is None:
        raise ConfigError(f"no recording '{name}'; there are {', '.join(OFFERS)}")
    if offer.write is None:
        raise ConfigError(f"{name} is not made here: fetch it from {offer.where}, then type "
                          f"{offer.command}")  # fmt: skip
    require_output(folder, overwrite=False, folder=True)
    folder.mkdir(exist_ok=True)
    offer.write(folder, progress)
    return offer.command.replace("DIR", str(folder))


def offered() -> Iterator[str]:
    """Lines for all recordings: what each is, and what to type."""
    for name, offer in OFFERS.items():
        yield f"{name}: {offer.what}"
        yield f"  {offer.size_mb:.0f} MB, {offer.licence}; {offer.where}"
        yield f"  $ fgslam data {name}" if offer.write else f"  $ {offer.command}"


def _write_lab(folder: Path, progress: Progress) -> None:
    """Image folder: three cameras, times, odometry of the wheels, exact truth."""
    sequence = lab_sequence()
    times = sequence.timestamps

    def shots() -> Iterator[tuple[float, Sequence[Image]]]:
        for i, t in enumerate(times):
            yield float(t), sequence.frame(i).images
            progress("writing", i + 1, len(times))

    write_image_folder(folder, sequence.rig, shots())
    poses = [np.eye(4)]  # dead reckoning from the first frame
    for i in range(1, len(times)):
        moved = sequence.odometry(i)
        poses.append(poses[-1] if moved is None else poses[-1] @ moved.motion)
    write_poses(folder / "odometry.txt", Trajectory(times, np.array(poses)))
    if sequence.ground_truth is not None:
        write_poses(folder / TRUTH_RIGHT, sequence.ground_truth)


def lab_sequence() -> ImageSequence:
    """The paper's drive through the rendered lab."""
    from fgslam.datasets.rendered import RenderedLabSequence
    from fgslam.worlds.settings import RenderedLabSettings

    return RenderedLabSequence(RenderedLabSettings(), 0)


def _write_house(folder: Path, progress: Progress) -> None:
    """Panoramas every half metre from room to room, with their poses."""
    from fgslam.worlds.house import OmniWorld
    from fgslam.worlds.settings import HouseCameraSettings, HousePathSettings, OmniHouseSettings

    camera = HouseCameraSettings("equirectangular", 1024)
    world = OmniWorld(OmniHouseSettings(camera=camera, path=HousePathSettings(40, 0.5)), seed=0)
    rows = ["id,file,x_m,y_m,heading_deg"]
    poses = world.reference_poses
    for k, (x, y, yaw) in enumerate(poses):
        picture = world.picture(poses[k], k)
        write_bytes(folder / f"{k:03d}.png", encoded_png(picture))
        rows.append(f"{k},{k:03d}.png,{x:.4f},{y:.4f},{np.rad2deg(yaw):.3f}")
        progress("writing", k + 1, len(poses))
    write_text(folder / "poses.csv", "\n".join(rows) + "\n")


OFFERS: dict[str, Offer] = {
    "lab": Offer(
        "249 trinocular frames 320x240 around a chair, wheels, exact truth (rendered)", 35.0,
        "free to use", "made here", "fgslam run DIR", _write_lab,
    ),
    "house": Offer(
        "41 panoramas 1024x512 half a metre apart through rooms, exact poses (rendered)", 35.0,
        "free to use", "made here",
        "fgslam teach DIR --camera equirectangular --out home.fgpath", _write_house,
    ),
    "kitti_odometry": Offer(
        "22 drives of a car, grey stereo 1241x376 at 10 Hz, truth of 11", 22000.0,
        "CC BY-NC-SA 3.0", "www.cvlibs.net/datasets/kitti/eval_odometry.php",
        "fgslam run DIR --set 'dataset.sequence=\"06\"'",
    ),
    "kitti_raw": Offer(
        "drives of the same car, synchronised and rectified, with its odometry", 500.0,
        "CC BY-NC-SA 3.0", "www.cvlibs.net/datasets/kitti/raw_data.php", "fgslam run DIR",
    ),
    "euroc": Offer(
        "11 flights of a drone in rooms and a hall, stereo 752x480 at 20 Hz, gyroscope, truth",
        1000.0, "for non-commercial use",
        "projects.asl.ethz.ch/datasets/euroc-mav", "fgslam run DIR",
    ),
    "tum_vi": Offer(
        "28 walks with a stereo fisheye 512x512 at 20 Hz, gyroscope, truth at both ends", 2000.0,
        "CC BY 4.0", "cvg.cit.tum.de/data/datasets/visual-inertial-dataset", "fgslam run DIR",
    ),
    "tum_rgbd": Offer(
        "39 recordings of a Kinect 640x480 at 30 Hz, truth", 500.0, "CC BY 4.0",
        "cvg.cit.tum.de/data/datasets/rgbd-dataset", "fgslam run DIR",
    ),
}  # fmt: skip
"""By name; DIR in a command is the recording's folder."""
