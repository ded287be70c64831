"""The public functions of homing give the numbers of the engine's tasks, on the rendered house."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import fgslam as fg
from fgslam.cli.main import app
from fgslam.datasets.opening import open_house
from fgslam.homing.settings import (
    DRIVING,
    HomingBehaviourSettings,
    SteeringSettings,
)
from fgslam.homing.steering import CorridorAvoidance, Drive, DriveCommand, RangeScan
from fgslam.worlds.house import OmniWorld
from fgslam.worlds.settings import HouseCameraSettings, HousePathSettings, OmniHouseSettings

STEPS, DT, SEED = 10, 0.1, 0
QUIET = {"pictures": 0, "report": False}
HOUSE = OmniHouseSettings(path=HousePathSettings(legs=1, spacing_m=2.0))
# The house is built once for all tests, not in each process.
pytestmark = pytest.mark.usefixtures("in_this_process")


def run(folder: Path, values: dict[str, Any]) -> Path:
    """Runs an experiment as a user would; its folder."""
    config = folder / "experiment.yaml"
    config.write_text(yaml.safe_dump(values), encoding="utf-8")
    app(["run", str(config), "--out", str(folder / "run")], standalone_mode=False)
    return folder / "run"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def world() -> OmniWorld:
    return open_house(HOUSE, SEED)


@pytest.mark.slow
def test_between_gives_the_numbers_of_the_task_homing_pairs(tmp_path: Path) -> None:
    settings = OmniHouseSettings(
        path=HousePathSettings(legs=2, spacing_m=1.0),
        camera=HouseCameraSettings("equirectangular", width=512),
    )
    world = open_house(settings, SEED)
    images = [world.picture(pose, k) for k, pose in enumerate(world.reference_poses[:2])]
    (tmp_path / "panoramas").mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "panoramas" / f"{k}.png"), image[..., ::-1])
    dataset = {"kind": "panoramas", "path": str(tmp_path / "panoramas")}
    values = {
        "task": "homing_pairs",
        "name": "pair",
        "jobs": 1,
        "dataset": dataset,
        "reference": False,
        "output": QUIET,
    }
    (row,) = rows(run(tmp_path, values | {"homing_vector": {"samples": 500}}) / "pairs.csv")
    answer = fg.HomingVector(world.camera, samples=500).between(*images)
    assert isinstance(answer, fg.TwoViewVector), answer
    sigma = np.sqrt(np.diag(answer.covariance))
    found = np.degrees([answer.direction, sigma[0], answer.rotation, sigma[1]])
    names = ("direction_deg", "sigma_direction_deg", "rotation_deg", "sigma_rotation_deg")
    written = [float(row[name]) for name in names]
    np.testing.assert_allclose(found, written, rtol=1e-9, atol=0)  # the file's ten digits
    assert answer.support == int(row["inliers"])


def test_a_follower_commands_what_the_closed_loop_does(tmp_path: Path, world: OmniWorld) -> None:
    values = yaml.safe_load(Path("experiments/homing_lab.yaml").read_text(encoding="utf-8"))
    values["behaviour"] = {"loop": {"longest_s": STEPS * DT}}
    values["output"] = QUIET
    written = rows(run(tmp_path, values) / "commands.csv")
    assert len(written) == STEPS
    world.put(world.reference_poses[0])
    behaviour = HomingBehaviourSettings()
    path = fg.teach(world.targets, world.camera)
    follower = fg.PathFollower(world.camera, path, behaviour=behaviour, seed=SEED)
    for k, row in enumerate(written):
        command = follower.step(world.image(k * DT), k * DT)
        world.drive(command.v, command.omega, DT)
        assert (row["state"], row["reason"]) == (command.state.value, command.reason)
        reported = [command.v, *np.degrees([command.omega, command.heading]), command.remaining]
        names = ("speed_mps", "turn_deg_s", "heading_deg", "remaining")
        # Times are sums in the one and products in the other.
        np.testing.assert_allclose(
            reported, [float(row[name]) for name in names], rtol=1e-7, atol=1e-7
        )


def test_followers_side_by_side_do_not_disturb_each_other(world: OmniWorld) -> None:
    start, target = world.reference_poses
    camera, path = world.camera, fg.teach(world.targets, world.camera)
    back = fg.teach([world.picture(start, 7)], camera)
    there = [world.picture(start + 0.05 * k * (target - start), k) for k in range(4)]
    here = [world.picture(target + 0.05 * k * (start - target), k) for k in range(4)]

    def alone(images: list[Any], which: fg.PathMemory) -> list[tuple[float, float, str]]:
        follower = fg.PathFollower(camera, which, estimator="homing_ekf")
        commands = [follower.step(image, DT * k) for k, image in enumerate(images)]
        return [(c.v, c.omega, c.reason) for c in commands]

    first = fg.PathFollower(camera, path, estimator="homing_ekf")
    second = fg.PathFollower(camera, back, estimator="homing_ekf")
    both: tuple[list[Any], list[Any]] = ([], [])
    for k in range(4):
        for follower, images, out in ((first, there, both[0]), (second, here, both[1])):
            command = follower.step(images[k], DT * k)
            out.append((command.v, command.omega, command.reason))
    assert list(both) == [alone(there, path), alone(here, back)]
    assert both[0][-1][0] > 0.0


# --------------------------------------------------------------------------------------------
# As a robot uses it: tracks, the default


class Robot:
    """A wheelchair in the house, a follower of ten legs from room to room, and its own avoidance.

    Attributes:
        world: the house.
        follower: of the path; begins before its first target.
        commands: so far.
    """

    def __init__(self) -> None:
        ten_legs = OmniHouseSettings(path=HousePathSettings(legs=10, spacing_m=2.0))
        self.world = open_house(ten_legs, SEED)
        path = fg.teach(self.world.targets, self.world.camera)
        self.follower = fg.PathFollower(self.world.camera, path, seed=SEED)
        self._avoider = CorridorAvoidance(SteeringSettings().max_turn_deg_s)
        self.commands: list[DriveCommand] = []

    def put(self, leg: int, part: float, turned: float) -> None:
        """Sets it down on the way to a target, that part of the leg behind it, turned (rad)."""
        a, b = self.world.reference_poses[leg : leg + 2]
        self.world.put(np.append((a + part * (b - a))[:2], b[2] + turned))

    def step(self, dark: bool = False, blocked: bool = False) -> DriveCommand:
        """One image, one command; ``blocked``: something stands before it, and it is not let go."""
        time = DT * len(self.commands)
        image = self.world.image(time)
        command = self.follower.step(np.zeros_like(image) if dark else image, time)
        wanted = Drive(command.v, command.omega)
        scan = RangeScan(*self.world.scan())
        driven = self._avoider.override(wanted, command.heading, scan) if command.v else wanted
        if blocked:
            driven = Drive(0.0, 0.0, overridden=True)
        self.world.drive(driven.speed, driven.turn_rate, DT)
        if driven.overridden:
            self.follower.driven(driven.speed, driven.turn_rate, DT)
        self.commands.append(command)
        return command

    def until(self, state: str, most: int, **how: bool) -> list[DriveCommand]:
        """The commands until one of that state, which must come within ``most`` images."""
        given = []
        for _ in range(most):
            given.append(self.step(**how))
            if given[-1].state.value == state:
                return given
        raise AssertionError(f"not {state} but {given[-1].state.value}: {given[-1].reason}")

    def away(self, target: int) -> float:
        """Metres to a target."""
        way = self.world.true_pose[:2] - self.world.target_poses[target, :2]
        return float(np.linalg.norm(way))


@pytest.mark.slow
def test_a_robot_that_is_carried_off_is_lost_finds_its_place_again_and_reaches_the_end() -> None:
    robot = Robot()
    robot.put(leg=8, part=0.4, turned=0.3)
    given = robot.until("drive", 20)
    place = given[-1].place
    assert given[-1].target == 8
    assert place is not None
    assert place.sure
    assert place.nearest in (7, 8)
    assert all(c.v == 0.0 for c in given[:-1])  # it stands until it knows
    robot.until("drive", 1)
    before = robot.away(8)
    stopped = [robot.step(blocked=True) for _ in range(10)]
    assert {c.state.value for c in stopped} == {"drive"}
    assert robot.away(8) == pytest.approx(before, abs=0.1)
    went = [robot.step() for _ in range(25)]
    assert went[-1].v > 0.1
    assert robot.away(8) < before - 0.3
    lost = robot.until("wait", 100, dark=True)  # under somebody's coat
    assert "grey" in lost[-1].reason
    assert [robot.step(dark=True).v for _ in range(10)][-1] == 0.0  # after braking
    robot.put(leg=3, part=0.4, turned=-0.4)
    found = robot.until("drive", 60)
    assert found[-1].target == 3
    for _ in range(30):
        robot.step(blocked=True)
    on_the_way = robot.until("arrived", 700)
    assert {c.target for c in on_the_way} == set(range(3, 10))
    while robot.commands[-1].v or robot.commands[-1].omega:
        robot.step()
    assert robot.follower.finished
    assert robot.away(9) < 0.3
    assert robot.follower.legs[-1].result == "arrived"


@pytest.mark.slow
@pytest.mark.parametrize("back", [False, True])
def test_the_experiment_of_crossroads_drives_over_both_routes(tmp_path: Path, back: bool) -> None:
    """Its shortest pair of routes, nine path images each: there, and back."""
    given = {"seed": 6, "trials": 1, "back": back, "output.report": False, "output.pictures": 0}
    result = fg.run("crossroads", given, tmp_path / "run")
    assert result.status == "finished"
    assert result.metrics["arrived"] == result.metrics["drives"] == 1
    assert result.metrics["false_arrivals"] == 0
    legs = rows(tmp_path / "run" / "legs.csv")
    assert len(legs) >= 4
    assert legs[-1]["result"] == "arrived"


def test_a_follower_by_default_has_the_settings_of_the_driving_experiments() -> None:
    for name in ("homing_lab", "path_following"):
        values = yaml.safe_load(Path(f"experiments/{name}.yaml").read_text(encoding="utf-8"))
        for key, value in values["homing_vector"].items():
            assert getattr(DRIVING.homing_vector, key) == value
