"""Rigs behind real lenses: the rendered lab, EuRoC as its cameras gave it, a drone that stands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from rolling_room import FOCAL, HEIGHT, WIDTH, Hand, recording
from running import metrics_of

import fgslam as fg
from benchmarks.evidence import euroc_raw, lenses
from benchmarks.evidence.lens_views import loaded, raw_cameras
from fgslam.backend.considered import shared_covariance
from fgslam.backend.settings import DEFAULT_ESTIMATOR
from fgslam.cameras.lenses import RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import RigCorrection
from fgslam.core.geometry import se3_exp
from fgslam.core.types import Trajectory, read_covariances
from fgslam.datasets.depth import depth_rig
from fgslam.evaluation.statistics import chi_square_band, moved
from fgslam.worlds.lab import make_rig
from fgslam.worlds.settings import LabRigSettings

UNSEEN = {"output.pictures": False, "output.report": False}


@pytest.mark.parametrize("cameras", [2, 3])
def test_the_rig_behind_the_lab_s_lenses_is_the_ideal_one(cameras: int) -> None:
    """Turns of up to 1.4 degrees and distortion are taken out; what is left has the lab's view."""
    ideal = make_rig(LabRigSettings())
    rig = loaded(raw_cameras(ideal)[:cameras])
    assert rig.rectifier is not None
    assert rig.cameras == cameras
    assert rig.baseline == pytest.approx(ideal.baseline, abs=1e-9)
    np.testing.assert_allclose(rig.bTc[:3, 3], ideal.bTc[:3, 3], rtol=0.0, atol=1e-9)
    turn = np.rad2deg(np.arccos(0.5 * (np.trace(rig.bTc[:3, :3].T @ ideal.bTc[:3, :3]) - 1.0)))
    assert turn < 0.2  # the mean of the axes; of three the plane of the baselines
    assert rig.fx == pytest.approx(ideal.fx, rel=0.05)
    assert rig.margins == ()  # no border is black


@pytest.mark.slow
@pytest.mark.parametrize("cameras", lenses.CAMERAS)
def test_lenses_cost_no_accuracy_in_the_lab(cameras: int) -> None:
    """The first 120 frames of two rooms: ATE of one drive differs by a quarter of itself.

    The bound of 5 % is measured over many whole drives (`python -m benchmarks lenses`). What is
    measured in the images is as exact at once.
    """
    found = np.array([lenses.errors(cameras, seed, SHORT) for seed in (1, 2)]).mean(axis=0)
    (pinholes, through), (exact, seen) = found.transpose(2, 1, 0)
    assert (seen < 1.05 * exact).all()
    assert (exact < 0.12).all()
    assert (through < 1.0).all()
    worst = float((through / pinholes).max())
    if worst > 1.25:
        pytest.xfail(f"ATE {worst:.2f} times that of pinholes; wanted: 1.05 over whole drives")
    if exact.max() > 0.1:
        pytest.xfail(f"columns and rows are {exact.max():.3f} px off true points; wanted: 0.1")


SHORT = ("dataset.stop=120",)


@pytest.mark.slow
@pytest.mark.data
def test_raw_images_of_euroc_are_no_worse_than_rectified_ones(shared_data: Path) -> None:
    """The drive of iSAM2 is 1 % too short by the raw images, 0.3 % by the others, 0.8 % by both as
    their calibration is stated: without its scale it is held to the bound, as the filter is with.
    """
    half, raw = (
        euroc_raw.of_set(shared_data, 0, kind, ["landmark_kalman", "isam2"])
        for kind in (False, True)
    )
    assert (raw[:, 1] >= half[:, 1]).all()
    assert raw[0, 0] <= 1.25 * half[0, 0]
    assert raw[1, 3] <= 1.1 * half[1, 3]
    if (ratio := raw[0, 0] / half[0, 0]) > 1.1:
        pytest.xfail(f"the filter's ATE is {ratio:.2f} times that of rectified images; wanted: 1.1")


def test_scale_is_told_from_the_rest() -> None:
    rng = np.random.default_rng(2)
    truth = np.array([se3_exp(pose) for pose in rng.normal(size=(50, 6))])
    other = moved(se3_exp(np.array([0.3, -1.0, 0.2, 4.0, 5.0, 6.0])), truth)
    other[:, :3, 3] = 0.99 * other[:, :3, 3] + 0.01 * rng.normal(size=(50, 3))
    scale, rest = euroc_raw.without_scale(other, truth)
    assert scale == pytest.approx(1.0 / 0.99, abs=3e-3)
    assert rest == pytest.approx(0.01 * np.sqrt(3.0), rel=0.15)


def extent_m(positions: FloatArray) -> float:
    """Largest distance of two of the positions (n, 3)."""
    return float(np.linalg.norm(positions[:, None] - positions[None], axis=-1).max())


@pytest.mark.data
def test_a_drone_that_stands_stays_where_it_is(shared_data: Path, tmp_path: Path) -> None:
    """Ten raw pairs over 3 s; the truth's own extent is 2.1 mm. Measured: 1.7 mm, sigma 0.3 mm."""
    root = shared_data / "stereo_raw" / "euroc_V1_01_cut"
    out = fg.run(root, UNSEEN, tmp_path / "run").folder / DEFAULT_ESTIMATOR
    found = Trajectory.load(out / "final.tum")
    truth = np.loadtxt(root / "groundtruth_tum.txt")
    nearest = np.abs(truth[:, :1] - found.timestamps).argmin(axis=0)
    real = extent_m(truth[nearest, 1:4])
    assert len(found) == 10
    assert real < 0.0025
    _, covariances = read_covariances(out / "covariance.csv")
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariances[-1, 3:, 3:])[-1]))
    assert sigma < 0.001
    assert extent_m(found.poses[:, :3, 3]) < real + 5.0 * sigma


@pytest.mark.slow
@pytest.mark.data
def test_colour_and_depth_of_a_hand_are_located(shared_data: Path, tmp_path: Path) -> None:
    """Fifteen blurred frames, bare; measured: all located, ATE 0.62 cm."""
    metrics = metrics_of(fg.run(shared_data / "rgbd_fr1", UNSEEN, tmp_path / "run").folder)
    counts = metrics["status_counts"]
    assert sum(counts.get(name, 0) for name in ("first", "ok", "capped", "relocalised")) >= 14
    assert metrics["estimators"][DEFAULT_ESTIMATOR]["ate_rmse_m"] < 0.01


@pytest.mark.slow
def test_a_rolling_shutter_is_found_and_leaves_consistent_motions(tmp_path: Path) -> None:
    """Rendered, rows read in up to 33 ms, calibrations as wrong as they are taken to be.

    Measured: read-outs off by 0.1 to 1.8 of their deviations, ATE 0.4 to 1.6 cm (on the way, where
    it is considered alone, 1.1 to 8), NEES of motions over five frames 1.05, without it 60 to 80.
    """
    matrix = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    rig = depth_rig(RawCamera(WIDTH, HEIGHT, matrix, np.zeros(4), np.eye(4), "room"))
    covariance = shared_covariance(RigCorrection.none(rig))
    off, motions = [], []
    for seed in range(6):
        readout = round(np.random.default_rng(100 + seed).uniform(0.0, 0.033), 3)
        wrong = np.random.default_rng(seed).multivariate_normal(np.zeros(7), covariance)
        root = recording(tmp_path / f"room_{seed}", Hand(seed), readout, off=wrong)
        settings = UNSEEN | {"dataset.depth_scale": 5000}
        metrics = metrics_of(fg.run(root, settings, tmp_path / f"run_{seed}").folder)
        assert metrics["located"] == {"frames": 16, "of": 16}
        found = metrics["estimators"][DEFAULT_ESTIMATOR]
        words = next(remark for remark in found["remarks"] if "rolling shutter" in remark)
        read, sigma = (float(number) for number in re.findall(r"-?\d+\.\d", words))
        off.append((read - 1e3 * readout) / sigma)
        motions.append(found["nees_relative"]["5"]["per_dof"])
        assert found["ate_rmse_m"] < 0.02
    assert np.abs(off).max() < 3.0
    lower, upper = chi_square_band(6.0 * len(motions))
    assert lower < np.mean(motions) < upper
