"""Closed-loop runs on a light world of landmarks: files, numbers, logs that replay."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from landmark_world import drive_path, make_follower, winding_path

from fgslam.backend.settings import HomingGraphSettings
from fgslam.core.bearings import TrackedBearings
from fgslam.evaluation.homing import homing_errors
from fgslam.homing.closed_loop import (
    DriveRecord,
    cross_track,
    follow,
    pass_distances,
    truly_arrived,
)
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import HomingBehaviourSettings
from fgslam.homing.steering import Steering
from fgslam.runs.config import HomingConfig, PathFollowingConfig, make_experiment
from fgslam.runs.folder import write_config
from fgslam.runs.tasks.homing_drives import (
    DrivenSeed,
    DriveWatcher,
    bearing_log,
    displaced_start,
    draw_leg_views,
    drive_numbers,
    drive_of,
    finish_drives,
)
from fgslam.runs.tasks.homing_replay import load_bearing_logs, replay_homing

EKF = {"kind": "homing_ekf"}


def configuration(**more: Any) -> PathFollowingConfig:
    values = {"task": "path_following", "name": "x", "estimator": EKF, "trials": 1, **more}
    return cast(PathFollowingConfig, make_experiment(values, "test"))


@pytest.fixture(scope="module")
def record() -> DriveRecord:
    return drive_path(winding_path(4, 2, 2.0))


def driven(record: DriveRecord, seed: int = 4) -> DrivenSeed:
    memory = PathMemory.of(winding_path(4, 2, 2.0).path())
    return DrivenSeed(seed, record, memory, (np.array([[0.0, 0.0], [1.0, 0.0]]),), 2.0)


def test_a_homing_s_log_is_in_its_start_frame(record: DriveRecord) -> None:
    log = bearing_log(record, record.homings[0])
    assert log.truth is not None
    assert len(log.truth.robots) == len(log.images)
    start = record.truth[record.homings[0].first_step]
    away = np.hypot(*(record.targets[0, :2] - start[:2]))
    assert log.truth.leg_m == pytest.approx(away)
    # What the robot did last, it did towards the target.
    left = np.hypot(*(log.truth.target[:2] - log.truth.robots[-1, :2]))
    assert left < 0.2 * away


def test_a_replayed_log_gives_the_true_home_direction(record: DriveRecord) -> None:
    log = bearing_log(record, record.homings[0])
    replayed = replay_homing(log.start, log.images, configuration().estimator)
    assert replayed.failure == ""
    assert log.truth is not None
    errors = homing_errors(replayed.estimates, log.truth)
    half = len(log.images) // 2
    assert np.rad2deg(np.median(np.abs(errors.direction[:half]))) < 3.0


def test_covariances_of_landmarks_are_kept_where_wanted(record: DriveRecord) -> None:
    """They are not what a robot drives by, and so not in the time of an update."""
    log = bearing_log(record, record.homings[0])
    graph = HomingGraphSettings()
    few = log.images[:2]
    plain, whole = (replay_homing(log.start, few, graph, landmarks=b) for b in (False, True))
    assert np.isnan(plain.estimates[-1].landmark_covariances).all()
    assert np.isfinite(whole.estimates[-1].landmark_covariances).all()
    np.testing.assert_array_equal(plain.estimates[-1].robot, whole.estimates[-1].robot)
    np.testing.assert_allclose(
        plain.estimates[-1].covariance, whole.estimates[-1].covariance, rtol=1e-6, atol=1e-14
    )


def test_files_and_numbers_of_drives(record: DriveRecord, tmp_path: Path) -> None:
    config = configuration(output={"logs": 1})
    write_config(tmp_path, config, {})
    result = finish_drives(config, tmp_path, [driven(record)], [])
    assert "1 of 1 drives arrive" in result.lines[0]
    with (tmp_path / "legs.csv").open(encoding="utf-8") as lines:
        legs = list(csv.DictReader(lines))
    assert [(leg["seed"], leg["leg"], leg["result"]) for leg in legs] == [
        ("4", "1", "arrived"),
        ("4", "2", "arrived"),
    ]
    reported = [float(leg["pass_distance_m"]) for leg in legs]
    np.testing.assert_allclose(reported, pass_distances(record), rtol=1e-9)
    for name in ("commands.csv", "trajectory.csv"):
        assert len((tmp_path / name).read_text(encoding="utf-8").splitlines()) == len(record) + 1
    assert len(load_bearing_logs(tmp_path)) == sum(bool(h.tracks) for h in record.homings)
    assert len(PathMemory.load(tmp_path / "path_memory.npz")) == 2


def test_a_drive_by_an_average_has_a_page_without_a_map(
    record: DriveRecord, tmp_path: Path
) -> None:
    """Estimators without a map, and without a covariance, are no reason to lose a drive."""
    config = configuration(estimator={"kind": "alv"})
    write_config(tmp_path, config, {})
    finish_drives(config, tmp_path, [driven(record)], [])
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'id="plot-drive"' in page
    assert 'id="plot-local-map"' not in page


def test_direction_of_home_is_drawn_only_while_it_is_known(record: DriveRecord) -> None:
    shown = drive_of(record)
    driving = np.array([state == "drive" for state in record.state])
    assert not driving[-1]  # arrived, and braking
    np.testing.assert_array_equal(np.isfinite(shown.headings), driving)
    k = int(np.flatnonzero(driving)[len(driving) // 3])
    target = record.targets[record.target[k], :2] - record.truth[k, :2]
    off = shown.headings[k] - np.arctan2(target[1], target[0])
    assert abs(np.angle(np.exp(1j * off))) < 0.1


def test_numbers_of_no_drive_at_all_are_null() -> None:
    numbers = drive_numbers([])
    assert numbers["drives"] == 0
    assert numbers["arrival_rate"] is None
    assert numbers["cross_track_slope"]["flat"] is None  # type: ignore[call-overload,index]


def test_arrival_counts_the_last_target(record: DriveRecord) -> None:
    numbers = drive_numbers([record, record])
    assert numbers["arrived"] == 2
    assert numbers["targets_aimed_at"] == 4
    assert numbers["legs"] == {"arrived": 4}
    assert (numbers["false_arrivals"], numbers["failed"]) == (0, 0)
    assert numbers["arrival_rate"] == 1.0


def test_an_arrival_away_from_the_target_does_not_count(record: DriveRecord) -> None:
    """What the robot says counts only where it stands near the last target in truth."""
    off = np.array([0.6, 0.0, 0.0])
    assert truly_arrived(record)
    lost = replace(record, end=record.targets[-1] + off)
    assert lost.arrived
    assert not truly_arrived(lost)
    numbers = drive_numbers([record, lost])
    assert (numbers["arrived"], numbers["false_arrivals"]) == (1, 1)
    assert numbers["arrival_rate"] == 0.5
    assert numbers["end_distance_max_m"] == pytest.approx(0.6)
    assert truly_arrived(replace(lost, targets=np.full((2, 3), np.nan)))  # nobody knows better


def test_drives_that_break_down_and_targets_never_aimed_at_count(record: DriveRecord) -> None:
    """Shares are of all drives and all targets, not of those that went well."""
    early = replace(record, target=np.zeros_like(record.target), legs=record.legs[:0])
    numbers = drive_numbers([record, early], failed=2)
    assert (numbers["drives"], numbers["failed"], numbers["arrived"]) == (4, 2, 1)
    assert numbers["arrival_rate"] == 0.25
    assert (numbers["targets"], numbers["targets_aimed_at"]) == (8, 3)
    near = np.isfinite(pass_distances(early)) & (pass_distances(early) <= 0.2)
    both = np.count_nonzero(pass_distances(record) <= 0.2) + np.count_nonzero(near)
    assert numbers["passed_within_0_2_m"] == both / 8


def test_slope_of_pass_distances_leaves_the_last_target_out(record: DriveRecord) -> None:
    """The robot stops short of that one by design."""
    longer = replace(
        record,
        targets=np.vstack([record.targets, record.targets[-1:], record.targets[-1:] + 9.0]),
        target=np.repeat(np.arange(4), [1, 1, 1, len(record) - 3]),
    )
    value = cast(Any, drive_numbers([longer])["pass_distance_slope"])["value"]
    expected = np.polyfit([1, 2, 3], pass_distances(longer)[:3], 1)[0]
    assert value == pytest.approx(expected)
    assert np.isnan(cross_track(longer)[2])  # two targets in one place: no line between them
    assert np.isfinite(cross_track(longer)[3])


def test_one_homing_is_a_path_of_one_leg() -> None:
    values = {"task": "homing", "name": "x", "estimator": EKF}
    assert cast(HomingConfig, make_experiment(values, "test")).resolved().dataset.path.legs == 1


def test_displaced_starts_stay_near_and_free() -> None:
    def clearance(points: np.ndarray) -> np.ndarray:
        return np.where(points[:, 0] > 0.3, 0.0, 1.0)

    world = SimpleNamespace(true_pose=np.zeros(3), clearance=clearance)
    places = np.array(
        [displaced_start(cast(Any, world), 1.0, np.random.default_rng(k)) for k in range(50)]
    )
    assert (np.hypot(*places[:, :2].T) <= 1.0).all()
    assert (places[:, 0] <= 0.3).all()
    assert np.ptp(places[:, 2]) > 3.0


class ShowingFrontEnd:
    """FrontEnd of the landmark world, with a grey picture whose columns are bearings in degrees."""

    def __init__(self, front_end: Any) -> None:
        self._front_end = front_end

    def __getattr__(self, name: str) -> Any:
        return getattr(self._front_end, name)

    def unwrapped(self, image: np.ndarray) -> np.ndarray:
        return np.full((30, 360), 90, np.uint8)

    def places(self, tracked: TrackedBearings) -> np.ndarray:
        columns = np.rad2deg(np.pi - tracked.bearing)
        return np.column_stack([columns, np.full(len(tracked), 15.0)])


def test_the_camera_s_last_view_of_each_leg_is_drawn(tmp_path: Path) -> None:
    setting, behaviour = winding_path(4, 3, 2.0), HomingBehaviourSettings()
    follower = make_follower(setting)
    watcher = DriveWatcher(cast(Any, ShowingFrontEnd(setting.front_end)), follower)
    steering, loop = Steering(behaviour.steering), behaviour.loop
    record = follow(setting.world, follower, steering, None, loop, setting.targets, watch=watcher)
    assert record.arrived
    assert [view.target for view in watcher.views(8)] == [0, 1, 2]
    assert [view.target for view in watcher.views(1)] == [2]
    assert watcher.views(0) == ()
    views = watcher.views(2)
    assert len(views) == 2
    last = record.homings[-1].tracks[-1]  # nothing is drawn that another image showed
    assert f"{last.time:.1f} s, {len(last)} tracks" in views[-1].caption
    ends = np.array([trail[-1, 0] for trail in views[-1].trails])
    np.testing.assert_allclose(ends, np.rad2deg(np.pi - last.bearing))
    assert max(len(trail) for trail in views[-1].trails) == 15
    pictures = draw_leg_views(tmp_path, 4, views)
    assert all((tmp_path / "pictures" / f"leg_{v.target + 1:02d}.png").is_file() for v in views)
    assert all(picture.content.startswith(b"\x89PNG") for picture in pictures)
    assert "Seed 4, leg 3" in pictures[-1].caption
