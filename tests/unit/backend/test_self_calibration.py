"""The rig's calibration from the drive."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fgslam.backend.self_calibration import (
    WINDOW,
    RigEvidence,
    RigFilter,
    RigUnknowns,
    SelfCalibration,
)
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import (
    RigCorrection,
    displacements,
    field_displacements,
    field_modes,
    prior_information,
    term_names,
)
from fgslam.core.sensors import (
    CAMERA_NAMES,
    CameraRig,
    Increment,
    Observations,
    pixel_covariance,
    pixel_model,
    rig_map,
    vertical_to_horizontal,
)
from fgslam.core.store import restore, state_of
from fgslam.core.types import Features
from fgslam.runs.tasks.slam_results import calibration_note

# ------------------------------------------------------------------------------------------
# A filter over a rig's terms and nuisances together


RIG = CameraRig(620, 190, 360.0, 360.0, 310.0, 92.0, 0.54, None, np.eye(4))
THREE = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, np.eye(4))
SIGMA_PX = 0.3


def filtered(of: RigUnknowns, field_px: float, windows: int = 8) -> RigFilter:
    """After windows that see all unknowns of a rig off by a draw of its prior."""
    rng = np.random.default_rng(3)
    deviations = 1.0 / np.sqrt(np.diagonal(of.prior(field_px)))
    true, out = deviations * rng.standard_normal(of.size), RigFilter.none(of)
    for _ in range(windows):
        root = rng.standard_normal((4 * of.size, of.size)) / (0.2 * deviations)
        noise = root.T @ rng.standard_normal(len(root))
        evidence = RigEvidence(root.T @ root, root.T @ root @ true + noise, 0.0, 0)
        out = out.judged(of, evidence)[1].after(of, evidence)
    return out


@pytest.mark.parametrize("field_px", [0.02, 0.1, 0.4])
def test_a_field_is_found_as_large_as_it_is(field_px: float) -> None:
    found = filtered(RigUnknowns(RIG), field_px).field_px
    # 24 modes give a deviation to 15 %, and four more stand for the tenth of a pixel expected.
    assert 0.7 * field_px < found < 1.3 * field_px + 0.03


def test_of_another_rig_the_nuisances_stay_known_and_the_terms_do_not() -> None:
    of = RigUnknowns(RIG)
    known = filtered(of, 0.1)
    other = known.without_terms(of)
    before, after = (np.linalg.inv(one.precision(of)) for one in (known, other))
    p = of.terms
    np.testing.assert_allclose(after[p:, p:], before[p:, p:], rtol=1e-6, atol=1e-12)
    prior = np.linalg.inv(prior_information(RIG))
    np.testing.assert_allclose(after[:p, :p], prior, rtol=1e-6, atol=0.0)
    np.testing.assert_allclose(other.values(of)[p:], known.values(of)[p:], rtol=1e-6, atol=1e-9)
    assert not other.values(of)[:p].any()


# ------------------------------------------------------------------------------------------
# A rig calibrates itself: on a simulated road, with errors of calibration put into its pixels


PATCHES = replace(RIG, places="reference")
"""The same as the default front-end measures with it: by patches of the right image."""
RIGS = {"two cameras": RIG, "patches": PATCHES, "three cameras": THREE}
NEAR_M, FAR_M = 4.0, 60.0


@dataclass(frozen=True)
class Road:
    """Frames on a road, 1 m apart, that winds a little; or a camera that stands, or only turns.

    Of a rig with a shorter baseline all is smaller in proportion. Images shake against each other
    by ``shake_px``, and each is off by a field of ``field_px``.
    """

    frames: int = 36
    points: int = 900
    step_m: float = 1.0
    turn_rad: float = 0.0
    noise: float = 1.0
    rig: CameraRig = RIG
    shake_px: float = 0.0
    field_px: float = 0.0

    @property
    def scale(self) -> float:
        return self.rig.baseline / RIG.baseline


def poses_of(road: Road) -> list[FloatArray]:
    out = [np.eye(4)]
    for k in range(1, road.frames):
        turn = road.turn_rad + (0.02 * np.sin(k / 5.0) if road.step_m else 0.0)
        step = g.se3_exp(np.array([0.0, turn, 0.0, 0.0, 0.0, road.scale * road.step_m]))
        out.append(g.reorthonormalise(out[-1] @ step))
    return out


def drive(road: Road, wrong: FloatArray, rng: np.random.Generator) -> list[Increment]:
    """Increments as a rig measures whose calibration is ``wrong`` (p,) by so much."""
    rig, poses = road.rig, poses_of(road)
    reach = road.frames * road.step_m + FAR_M
    points = rng.uniform([-12.0, -4.0, 0.0], [12.0, 1.6, reach], (road.points, 3)) * road.scale
    model, fuse = pixel_model(rig.cameras, vertical_to_horizontal(rig)), rig_map(rig)
    centre = np.tile([rig.cx, rig.cy], rig.cameras)
    spread = SIGMA_PX * np.linalg.cholesky(pixel_covariance(rig.cameras, rig.places))
    names = ("left.column", "left.row", "left.roll", "left.focal")
    shaken = [term_names(rig).index(name) for name in names]
    other = np.random.default_rng(rng.integers(1 << 32))
    modes = road.field_px * other.standard_normal(field_modes(rig))
    born: set[int] = set()
    out = []
    for k, wTc in enumerate(poses):
        local = g.transform_to_camera(wTc, points)
        ahead = local[:, 2] / road.scale
        seen = np.flatnonzero((ahead > NEAR_M) & (ahead < FAR_M))
        exact = rig.predict(local[seen]) @ model.T
        inside = np.abs(exact - centre) < centre
        seen, exact = seen[inside.all(axis=1)], exact[inside.all(axis=1)]
        flat = exact.reshape(-1, rig.cameras, 2)
        off = wrong.copy()
        off[shaken] += road.shake_px / rig.fx * other.standard_normal(4)
        moved = exact + displacements(rig, flat) @ off + field_displacements(rig, flat) @ modes
        noisy = moved + road.noise * rng.standard_normal(exact.shape) @ spread.T
        pixels = np.full((len(seen), 3, 2), np.nan)
        pixels[:, : rig.cameras] = noisy.reshape(-1, rig.cameras, 2)
        new = np.array([i not in born for i in seen], np.bool_)
        born |= set(seen.tolist())
        observed = Observations(
            seen, noisy @ fuse.T, np.tile(np.eye(3), (len(seen), 1, 1)), pixels, new
        )
        none = np.empty(0, np.int64)
        out.append(Increment(k, 0.1 * k, None, observed, np.zeros(len(seen), np.bool_), none, none))
    return out


def calibrated(road: Road, wrong: FloatArray, seed: int) -> SelfCalibration:
    """After the drive; poses are known to a centimetre and a tenth of a degree."""
    rng = np.random.default_rng(seed)
    itself = SelfCalibration(road.rig, SIGMA_PX)
    for increment, wTc in zip(drive(road, wrong, rng), poses_of(road), strict=True):
        error = np.array([2e-3] * 3 + [1e-2 * road.scale] * 3) * rng.standard_normal(6)
        itself.observe(increment, g.reorthonormalise(wTc @ g.se3_exp(error)))
    return itself


def errors(rig: CameraRig = RIG, camera: str = "left", **terms: float) -> FloatArray:
    names = list(term_names(rig))
    out = np.zeros(len(names))
    for name, value in terms.items():
        out[names.index("all.radial" if name == "radial_of_all" else f"{camera}.{name}")] = value
    return out


def test_a_correction_larger_than_calibrations_leave_is_reported_as_uncertain() -> None:
    plausible, large = (
        calibration_note(calibrated(Road(frames=18), errors(yaw=yaw), 0)) for yaw in (0.002, 0.012)
    )
    true = RigCorrection(RIG, errors(yaw=0.002), np.eye(len(errors()))).rms_px()
    found = re.search(r"corrected during the drive by ([\d.]+) px \(rms over the", plausible)
    assert found is not None
    assert float(found[1]) == pytest.approx(true, rel=0, abs=0.1)
    assert "something large that moved" not in plausible
    assert large.endswith("unless something large that moved was taken for the scene")


def image_error(found: RigCorrection, wrong: FloatArray) -> float:
    """Root mean square over the images of what is left after the correction, pixels."""
    rig = found.rig
    column, row = np.meshgrid(np.linspace(0, rig.width - 1, 9), np.linspace(0, rig.height - 1, 9))
    grid = np.repeat(np.stack([column.ravel(), row.ravel()], 1)[:, None], rig.cameras, axis=1)
    left = displacements(rig, grid) @ (found.values - wrong)
    return float(np.sqrt((left[:, 2:] ** 2).mean()))


@pytest.mark.parametrize("rig", [PATCHES, THREE], ids=["patches", "three cameras"])
def test_an_exact_rig_is_left_alone(rig: CameraRig) -> None:
    found = calibrated(Road(rig=rig), errors(rig), 1).found
    assert image_error(found.applied, errors(rig)) < 0.02
    assert found.probabilities["exact"] > 0.5


@pytest.mark.parametrize(
    "wrong",
    [
        errors(yaw=np.deg2rad(-0.1), pitch=np.deg2rad(0.05), roll=np.deg2rad(0.1), focal=-0.002),
        errors(column=0.02, yaw=-0.02, decentring_x=0.006, radial=0.01),
        errors(yaw=-3e-4, decentring_x=-5e-3, decentring_x_outer=4e-3, decentring_y_outer=1e-3),
        errors(radial_of_all=0.02),
    ],
    ids=["together", "lens", "outer lens", "lens of all"],
)
def test_an_error_of_calibration_is_found(wrong: FloatArray) -> None:
    before = image_error(RigCorrection.none(RIG), wrong)
    found = calibrated(Road(), wrong, 2).found
    assert before > 0.2
    assert image_error(found.applied, wrong) < 0.2 * before + 0.03


@pytest.mark.parametrize("rig", [PATCHES, THREE], ids=["patches", "three cameras"])
def test_errors_together_are_found_by_the_other_kinds_of_rig(rig: CameraRig) -> None:
    wrong = wrong_by_all(rig, 3)
    before = image_error(RigCorrection.none(rig), wrong)
    found = calibrated(Road(rig=rig), wrong, 2).found
    assert before > 0.5
    assert image_error(found.applied, wrong) < 0.06


@pytest.mark.parametrize("seeds", [4, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "rig",
    [
        pytest.param(rig, marks=() if name == "two cameras" else pytest.mark.slow, id=name)
        for name, rig in RIGS.items()
    ],
)
def test_the_error_of_the_correction_matches_its_covariance(rig: CameraRig, seeds: int) -> None:
    """Also where images shake, and each is off by a field."""
    nees, road = [], Road(rig=rig, shake_px=0.02, field_px=0.1)
    spread = np.linalg.cholesky(np.linalg.inv(prior_information(rig)))
    for seed in range(seeds):
        wrong = spread @ np.random.default_rng(seed).standard_normal(len(spread))
        found = calibrated(road, wrong, 100 + seed).found.estimated
        off = found.values - wrong
        nees.append(off @ np.linalg.solve(found.covariance, off) / len(off))
    assert 0.5 < np.mean(nees) < 2.0


def wrong_by(rng: np.random.Generator) -> dict[str, float]:
    """Yaw, pitch and roll of 0.02 to 0.2 degrees, a focal ratio off by 0.1 to 0.5 %."""
    turn = np.deg2rad(rng.uniform(0.02, 0.2, 3)) * rng.choice([-1.0, 1.0], 3)
    focal = rng.uniform(0.001, 0.005) * rng.choice([-1.0, 1.0])
    return {"yaw": turn[0], "pitch": turn[1], "roll": turn[2], "focal": focal}


def wrong_by_all(rig: CameraRig, seed: int, term: str = "all") -> FloatArray:
    """The same of each of a rig's other cameras; of one term alone, where it is named."""
    rng, out = np.random.default_rng(seed), errors(rig)
    for camera in CAMERA_NAMES[1 : rig.cameras]:
        values = wrong_by(rng)
        named = {name: v for name, v in values.items() if term in (name, "all")}
        out += errors(rig, camera, **named)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("term", ["yaw", "pitch", "roll", "focal", "all"])
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
def test_fifty_rigs_are_recovered(rig: CameraRig, term: str) -> None:
    left = []
    for seed in range(50):
        wrong = wrong_by_all(rig, seed, term)
        left.append(image_error(calibrated(Road(rig=rig), wrong, seed).found.applied, wrong))
    assert np.median(left) < 0.02
    assert np.max(left) < 0.06


@pytest.mark.slow
def test_fifty_rigs_with_other_lenses_are_recovered() -> None:
    """As both KITTI rigs are off: outer decentring, and a radial term of all cameras.

    The left camera's own terms are found; the radial term, which 36 m of road hardly show, is as
    uncertain as it is off.
    """
    left, own, deviations = [], [], []
    for seed in range(50):
        x, y, radial = np.random.default_rng(seed).choice([-1.0, 1.0], 3) * [4e-3, 2e-3, 0.012]
        outer = errors(decentring_x_outer=x, decentring_y_outer=y, radial_of_all=radial)
        wrong = errors(**wrong_by(np.random.default_rng(seed))) + outer
        found = calibrated(Road(), wrong, seed).found
        before = image_error(RigCorrection.none(RIG), wrong)
        left.append(image_error(found.applied, wrong) / before)
        of_all = found.estimated.values[-1]
        own.append(image_error(found.estimated, np.append(wrong[:-1], of_all)))
        deviations.append((of_all - radial) / np.sqrt(found.estimated.covariance[-1, -1]))
    assert np.median(left) < 0.2
    assert np.median(own) < 0.07  # what all cameras share is unknown, too
    assert np.max(own) < 0.15
    assert np.mean(np.abs(deviations) < 2.0) >= 0.88  # of 50, in 99 of 100 sets


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
def test_fifty_exact_rigs_are_left_alone(rig: CameraRig) -> None:
    found = [calibrated(Road(rig=rig), errors(rig), seed).found.applied for seed in range(50)]
    assert sum(image_error(one, errors(rig)) < 1e-3 for one in found) >= 45
    assert max(image_error(one, errors(rig)) for one in found) < 0.02


def test_noise_that_is_larger_than_stated_widens_the_covariance() -> None:
    stated, noisy = (calibrated(Road(noise=noise), errors(), 3) for noise in (1.0, 2.0))
    wider = noisy.found.estimated.sigmas / stated.found.estimated.sigmas
    assert 1.1 < np.median(wider) < 2.5  # the prior holds some terms in both


def sigma_in_the_middle(found: RigCorrection) -> float:
    """Of the disparity offset of a point in the middle of both images, pixels."""
    middle = np.broadcast_to([RIG.cx, RIG.cy], (1, RIG.cameras, 2))
    return float(found.at(middle)[1][0, 2])


def offset_sigma(seen: str) -> float:
    """Of the offset in the middle, where rows are known, or all but an offset of all columns."""
    column, row = np.meshgrid(np.linspace(0, RIG.width - 1, 9), np.linspace(0, RIG.height - 1, 9))
    grid = np.repeat(np.stack([column.ravel(), row.ravel()], 1)[:, None], RIG.cameras, axis=1)
    of_columns, of_rows = displacements(RIG, grid)[:, 2], displacements(RIG, grid)[:, 3]
    known = of_rows if seen == "rows" else np.vstack([of_rows, of_columns - of_columns.mean(0)])
    covariance = np.linalg.inv(prior_information(RIG) + 1e8 * known.T @ known)
    return sigma_in_the_middle(RigCorrection(RIG, np.zeros(len(covariance)), covariance))


@pytest.mark.parametrize(
    ("turn_rad", "seen"), [(0.0, "rows"), (0.02, "shape")], ids=["standing", "turning on the spot"]
)
def test_a_rig_that_does_not_move_learns_no_disparity_offset(turn_rad: float, seen: str) -> None:
    """Rows are seen without motion, and how a displacement varies over the image, if it turns.

    A constant offset is not: of what the prior leaves of it then, most stays.
    """
    road = Road(step_m=0.0, points=400, turn_rad=turn_rad)
    standing = calibrated(road, errors(), 4).found.estimated
    driving = calibrated(Road(), errors(), 4).found.estimated
    left = offset_sigma(seen)
    assert left > 0.25 * sigma_in_the_middle(RigCorrection.none(RIG))
    assert sigma_in_the_middle(standing) > 0.6 * left
    assert sigma_in_the_middle(driving) < 0.35 * left


def test_frames_without_landmarks_teach_nothing() -> None:
    itself = calibrated(Road(points=0), errors(), 5)
    assert itself.windows == 0
    assert not itself.found.applied.values.any()
    none = RigCorrection.none(RIG).covariance  # inverted twice, with rounding of the processor's
    np.testing.assert_allclose(itself.found.estimated.covariance, none, rtol=0, atol=1e-15)


def test_corrections_undo_the_displacement_of_raw_pixels() -> None:
    wrong = errors(yaw=0.001, roll=0.002)
    road = Road(frames=WINDOW, noise=0.0)
    measured, exact = (
        drive(road, by, np.random.default_rng(7))[0].observations for by in (wrong, errors())
    )
    n, correction = len(measured.ids), RigCorrection(RIG, wrong, np.eye(len(wrong)))
    straight = correction.straightened(
        tuple(
            Features(measured.pixels[:, k], np.ones(n), np.zeros(n), np.zeros((n, 128), np.uint8))
            for k in range(RIG.cameras)
        )
    )
    assert np.abs(measured.measurement - exact.measurement).max() > 0.3
    # The displacement is taken where the pixel is seen, a pixel from where it belongs.
    for k, found in enumerate(straight):
        np.testing.assert_allclose(found.xy, exact.pixels[:, k], rtol=0.0, atol=5e-3)


@pytest.mark.parametrize("rig", [RIG, THREE], ids=["two cameras", "three cameras"])
def test_the_prior_expects_a_pixel_over_each_image(rig: CameraRig) -> None:
    column, row = np.meshgrid(np.linspace(0, rig.width - 1, 7), np.linspace(0, rig.height - 1, 7))
    grid = np.repeat(np.stack([column.ravel(), row.ravel()], 1)[:, None], rig.cameras, axis=1)
    unit = displacements(rig, grid)
    covariance = RigCorrection.none(rig).covariance
    shared = np.array([name.startswith("all.") for name in term_names(rig)])
    for camera in range(rig.cameras):  # the reference's are those of all
        own = unit[:, 2 * camera : 2 * camera + 2] * (shared == (camera == 0))
        at = np.einsum("kap,pq,kaq->ka", own, covariance, own)
        assert np.sqrt(at.mean()) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    "seed", [8, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(100, 120))]
)
def test_a_knock_in_mid_drive_is_noticed_and_followed(seed: int) -> None:
    knocked = errors(yaw=np.deg2rad(0.1))
    road, itself = Road(frames=96), SelfCalibration(RIG, SIGMA_PX)
    before, after = (drive(road, by, np.random.default_rng(seed)) for by in (errors(), knocked))
    at = 6 * WINDOW + seed % WINDOW
    noticed = -1
    for k, wTc in enumerate(poses_of(road)):
        itself.observe((before if k < at else after)[k], wTc)
        if itself.knocks and noticed < 0:
            noticed = k + 1 - at
    assert itself.knocks == 1
    assert 0 < noticed <= 4 * WINDOW  # what is left of its own, two that decide, and one more
    assert [(one.code, len(one.frames)) for one in itself.remarks()] == [("rig_moved", 1)]
    before_it = image_error(RigCorrection.none(RIG), knocked)
    assert image_error(itself.found.applied, knocked) < 0.1 * before_it


def test_a_loose_camera_is_named_and_a_knock_of_the_first_frames_is_found() -> None:
    """To one side with the second window, and back two windows later."""
    road, itself = Road(frames=42), SelfCalibration(RIG, SIGMA_PX)
    turned = errors(yaw=np.deg2rad(0.25))
    straight, aside = (drive(road, by, np.random.default_rng(3)) for by in (errors(), turned))
    seems, opened = [], []
    for k, wTc in enumerate(poses_of(road)):
        itself.observe((aside if WINDOW <= k < 4 * WINDOW else straight)[k], wTc)
        seems.append([one.code for one in itself.remarks()])
        opened.append(math.sqrt(np.trace(itself.open_covariances(1)[0, 3:, 3:])))
    # A quarter of a degree is 1.6 px: a tenth of the disparities here, and so of the way.
    assert not any(opened[: 2 * WINDOW - 1])
    assert 0.0 < opened[4 * WINDOW - 1] < 0.2 * opened[3 * WINDOW - 1]  # how well it is known
    assert 0.02 * WINDOW < opened[2 * WINDOW - 1] < opened[3 * WINDOW - 1] < 0.4 * 2 * WINDOW
    assert seems[2 * WINDOW - 1] == ["rig_doubted"]
    assert seems[3 * WINDOW - 1] == ["rig_moved"]
    assert seems[-1] == ["rig_loose"]
    assert itself.moved_at == [WINDOW, 4 * WINDOW]


def test_frames_after_one_that_fits_no_landmark_are_as_uncertain_as_a_stated_rig() -> None:
    """Until a window of frames after it shows that the rig has not moved; earlier ones are not."""
    road, itself = Road(frames=3 * WINDOW), SelfCalibration(RIG, SIGMA_PX)
    at, opened = WINDOW + 2, []
    frames = drive(road, errors(), np.random.default_rng(3))
    for k, wTc in enumerate(poses_of(road)):
        seen = frames[k].observations
        itself.observe(replace(frames[k], rejected=~seen.is_new) if k == at else frames[k], wTc)
        opened.append(math.sqrt(np.trace(itself.open_covariances(1)[0, 3:, 3:])))
        if k == at + 2:
            of_each = itself.open_covariances(k + 1)[:, 3, 3]
            assert not of_each[:at].any()
            assert (np.diff(of_each[at:]) > 0.0).all()
    assert not any(opened[:at])
    assert 0.02 < opened[at] < opened[at + 1]  # metres, of one a frame
    assert not any(opened[at + WINDOW :])
    assert not itself.moves


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_images_that_become_noisy_are_not_of_a_rig_that_was_knocked(seed: int) -> None:
    sharp, blurred = (Road(frames=30, points=300, noise=n) for n in (0.5, 5.0))
    rng, itself = np.random.default_rng(seed), SelfCalibration(RIG, SIGMA_PX)
    before, after = (drive(one, errors(), rng) for one in (sharp, blurred))
    for k, wTc in enumerate(poses_of(sharp)):
        itself.observe((before if k < 2 * WINDOW else after)[k], wTc)
    assert not itself.moves
    assert image_error(itself.found.applied, errors()) < 0.1


def test_a_state_taken_within_a_window_goes_on_with_the_same_bits() -> None:
    road, rng = Road(frames=32, points=400), np.random.default_rng(9)
    log, poses = drive(road, errors(yaw=0.002), rng), poses_of(road)
    one = SelfCalibration(RIG, SIGMA_PX)
    for increment, wTc in zip(log[:21], poses[:21], strict=True):
        one.observe(increment, wTc)
    other = SelfCalibration(RIG, SIGMA_PX)
    restore(other, state_of(one))
    for increment, wTc in zip(log[21:], poses[21:], strict=True):
        one.observe(increment, wTc)
        other.observe(increment, wTc)
    assert one.windows == 5
    assert state_of(other).keys() == state_of(one).keys()
    for name, array in state_of(one).items():
        np.testing.assert_array_equal(state_of(other)[name], array, err_msg=name)
    np.testing.assert_array_equal(other.found.applied.values, one.found.applied.values)


@pytest.mark.parametrize("rig", [RIG, THREE], ids=["two cameras", "three cameras"])
def test_changes_are_the_turn_of_a_camera_in_degrees(rig: CameraRig) -> None:
    names = list(term_names(rig))
    values = np.zeros(len(names))
    terms = {"yaw": 0.1, "pitch": -0.2, "roll": 0.3}
    for term, degrees in terms.items():
        values[names.index(f"left.{term}")] = np.deg2rad(degrees)
    values[names.index("left.focal")] = 0.004
    found = RigCorrection(rig, values, np.eye(len(names)) * 1e-12).changes()
    assert found["left_yaw_deg"][0] == pytest.approx(0.1, abs=1e-9)
    assert found["left_pitch_deg"][0] == pytest.approx(-0.2, abs=1e-9)
    assert found["left_roll_deg"][0] == pytest.approx(0.3, abs=1e-9)
    assert found["left_focal_percent"][0] == pytest.approx(0.4, abs=1e-9)
    assert ("top_yaw_deg" in found) == (rig.cameras == 3)


def test_a_shifted_principal_point_is_reported_as_a_turn() -> None:
    """Over the image, both move the pixels alike."""
    shifted = RigCorrection(RIG, errors(column=0.001), np.eye(len(errors())) * 1e-12).changes()
    # x^2 of the yaw's 1 + x^2 is 0.25 in the mean over this image.
    assert shifted["left_yaw_deg"][0] == pytest.approx(np.rad2deg(0.001), rel=0.3)


# -- what two of three images show -----------------------------------------------------------


def test_what_one_image_does_not_show_is_no_evidence_of_the_rig() -> None:
    """Observations that lack an image are left out, the others count as before."""
    road = Road(frames=WINDOW, rig=THREE, points=1500)
    wrong = np.zeros(len(term_names(THREE)))
    increments = drive(road, wrong, np.random.default_rng(0))
    missing = [np.random.default_rng(k).uniform(size=len(i.observations)) < 0.3
               for k, i in enumerate(increments)]  # fmt: skip
    found = []
    for lack in (True, False):
        itself = SelfCalibration(THREE, SIGMA_PX)
        for increment, out, wTc in zip(increments, missing, poses_of(road), strict=True):
            observed = increment.observations
            pixels = observed.pixels.copy()
            pixels[out, 2] = np.nan
            seen = replace(observed, pixels=pixels) if lack else observed.select(~out)
            rejected = np.zeros(len(seen), np.bool_)
            itself.observe(replace(increment, observations=seen, rejected=rejected), wTc)
        assert itself.windows == 1
        found.append(itself.found.estimated)
    np.testing.assert_array_equal(found[0].values, found[1].values)
    np.testing.assert_array_equal(found[0].covariance, found[1].covariance)
