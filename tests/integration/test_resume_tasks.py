"""A run of any task that is killed at any moment goes on to the bytes of an uninterrupted one.

Files appear by renaming alone, so the moments that differ are those just before and just after each
rename. Most tests stop there by an exception that leaves what SIGKILL would: no clearing up, and a
half-written file where the rename was still to come. Units are then done in this process, which
makes a run fast. One test sends SIGKILL to the command itself, with its worker processes.
"""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
import pytest
import yaml
from PIL import Image as PictureFile
from recordings import experiment
from textured_room import SMALL_CAMERA, folder_of

from fgslam.core import files
from fgslam.core.errors import ConfigError, OutputError
from fgslam.runs.compare import Choice, compare_runs
from fgslam.runs.config import make_experiment
from fgslam.runs.engine import RunResult
from fgslam.runs.folder import ExistingFolder, create_folder
from fgslam.runs.run import run_experiment
from fgslam.runs.tables import write_comparison_csv

QUIET = {"pictures": False, "report": False, "checkpoint_seconds": 0.0}
SILENT = {"pictures": 1, "report": False}
VIEWS = 4
TASKS = (
    "slam",
    "slam_compared",
    "measurements",
    "localisation",
    "homing_pairs",
    "topological_map",
    "omni_video",
    "homing_trials",
    "homing",
    "path_following",
    "compare",
    "compare_homing",
    "teach",
    "follow",
    "join",
    "crossroads",
)
WHOLE_DRIVES = ("homing", "slam", "crossroads")
"""A homing is a path of one leg, done by the same module, as are the drives over crossroads; a run
of one estimator is a part of one of several."""
EACH_TASK = pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=pytest.mark.slow if task in WHOLE_DRIVES else ()) for task in TASKS],
)
HOUSE: dict[str, Any] = {
    "name": "short",
    "jobs": 1,
    "trials": 2,
    "dataset": {"path": {"legs": 1, "spacing_m": 2.0}},
    "behaviour": {"loop": {"longest_s": 0.3}},
    "output": SILENT,
}
IN_SMALL_BLOCKS = """
from fgslam.cli.main import main
from fgslam.runs.tasks import homing_replay, homing_views
homing_replay.TRIALS_A_BLOCK = 1
homing_views.VIEWS_A_BLOCK = 2
main()
"""
_TIMED_FILES = ("timing.csv", "trials_timing.csv", "report.html")
_TIMED_VALUES = ("ms", "mb", "seconds", "second", "growth", "memory")


Doing: TypeAlias = Callable[[Path, ExistingFolder], RunResult]


class Killed(BaseException):
    """Stands for the signal that cannot be caught."""


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Panoramas of one place, turned from one to the next."""
    folder = tmp_path_factory.mktemp("views") / "panoramas"
    folder.mkdir()
    coarse = np.random.default_rng(1).integers(0, 255, (12, 24, 3), dtype=np.uint8)
    whole = np.asarray(
        PictureFile.fromarray(coarse).resize((192, 96), PictureFile.Resampling.BICUBIC)
    )
    for k in range(VIEWS):
        PictureFile.fromarray(np.roll(whole, 3 * k, axis=1)).save(folder / f"view_{k}.png")
    return folder


@pytest.fixture(scope="module")
def routes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two routes through one room, beside the panoramas that they were taught from."""
    base = tmp_path_factory.mktemp("routes")
    found = []
    for name, across in (("first", 0.4), ("second", 0.0)):
        folder_of(base / name, np.array([0.2, 1.1, 2.0]), across)
        dataset = panoramas_of(base / name)
        route = base / f"{name}.fgpath"
        values = {"task": "teach", "name": name, "dataset": dataset, "route": str(route)}
        run(values | {"output": {"pictures": 0, "report": False}}, base / f"{name}_taught")
        found.append(route)
    return found[0], found[1]


def panoramas_of(folder: Path) -> dict[str, Any]:
    return {"kind": "panoramas", "path": str(folder), "camera": SMALL_CAMERA}


@pytest.fixture(scope="module")
def values_of(
    recording: Path, views: Path, routes: tuple[Path, Path]
) -> Callable[[str], dict[str, Any]]:
    """A small experiment of each task."""
    ways = [panoramas_of(route.with_suffix("")) for route in routes]
    dataset = {"kind": "image_folder", "path": str(recording), "stop": 5}
    images = experiment(recording, dataset=dataset, output=QUIET)
    panoramas = {"name": "x", "jobs": 1, "dataset": {"kind": "panoramas", "path": str(views)}}
    known: dict[str, dict[str, Any]] = {
        "slam": images | {"estimator": {"kind": "fixed_lag"}},
        "slam_compared": images | {"compare": ["odometry", "ekf"]},
        "measurements": {
            "name": "short_drive",
            "dataset": {
                "kind": "simulated_measurements",
                "stop": 12,
                "detection": {"features": 40},
            },
            "frontend": {"ego_motion": {"dof": 3}},
            "compare": ["odometry", "ekf"],
            "output": QUIET | {"report": True},  # and that of comparisons of it
        },
        "localisation": {
            **{k: v for k, v in images.items() if k not in ("compare", "map")},
            "task": "localisation",
            "map": {"made_from": {"dataset": images["dataset"]}},
            "localisation": {"every": 3},
        },
        "homing_pairs": panoramas | {"task": "homing_pairs", "output": {"pictures": 1}},
        "topological_map": panoramas
        | {"task": "topological_map", "held_out_every": 2, "routes": [[0, 3]], "output": SILENT},
        "omni_video": panoramas | {"task": "omni_video"},
        "homing_trials": {
            "task": "homing_trials",
            "name": "few_trials",
            "jobs": 1,
            "trials": 2,
            "outliers": [0.0, 0.2],
            "estimator": {"kind": "homing_ekf"},
            "compare": ["alv"],
            "dataset": {"images_per_s": 2.0},
            "output": {"logs": 1, "report": False},
        },
        "homing": HOUSE | {"task": "homing", "start_offset_m": 0.2},
        "path_following": HOUSE | {"task": "path_following"},
        "crossroads": HOUSE | {"task": "crossroads", "dataset": {"path": {"spacing_m": 2.5}}},
        "teach": {
            "task": "teach",
            "name": "taught",
            "dataset": ways[0],
            "route": str(routes[0].with_name("again.fgpath")),
            "output": {"pictures": 1},
        },
        "follow": {
            "task": "follow",
            "name": "followed",
            "dataset": ways[1] | {"stop": 2},
            "route": str(routes[0]),
        },
        "join": {
            "task": "join",
            "name": "joined",
            "routes": [str(route) for route in routes],
            "map": str(routes[0].with_name("joined.fgmap")),
        },
    }
    return known.__getitem__


@pytest.fixture(scope="module")
def doing(
    values_of: Callable[[str], dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Doing]:
    """What does the work of a task into a folder; comparisons are of runs that are made once."""
    base = tmp_path_factory.mktemp("compared")
    estimators = Choice(("odometry", "landmark_kalman", "ekf"))

    def compared(task: str, choice: Choice) -> Doing:
        logged = base / task
        if not logged.is_dir():
            run(values_of(task), logged)
        return lambda folder, existing: compare_runs([logged], choice, folder, existing)[0]

    def found(task: str) -> Doing:
        if task == "compare":
            return compared("measurements", estimators)
        if task == "compare_homing":
            return compared("homing_trials", Choice(("homing_ekf", "alv")))
        return lambda folder, existing: run(values_of(task), folder, existing)

    return found


@pytest.fixture(autouse=True)
def _small_steps(in_this_process: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Units in this process, few in a block, and every state saved."""
    monkeypatch.setattr("fgslam.runs.tasks.homing_views.VIEWS_A_BLOCK", 2)
    monkeypatch.setattr("fgslam.runs.tasks.homing_replay.TRIALS_A_BLOCK", 1)
    monkeypatch.setattr("fgslam.runs.tasks.homing_drives.SAVE_EVERY_S", 0.0)
    monkeypatch.setattr("fgslam.runs.tasks.localisation.SAVE_EVERY_S", 0.0)


def run(
    values: dict[str, Any], folder: Path, existing: ExistingFolder = "refuse", **more: Any
) -> RunResult:
    return run_experiment(make_experiment(values, "test"), folder, existing, **more)


def renames(monkeypatch: pytest.MonkeyPatch, most: float, *, after: bool) -> list[Path]:
    """Counts renamed files from now on; the one of number ``most`` kills, before or after it.

    Those of runs: libraries rename files of their own as well, most of them only once.
    """
    seen: list[Path] = []
    real = os.replace

    def replace(source: Path, target: Path) -> None:
        last = len(seen) >= most
        if not last or after:
            real(source, target)
        seen.append(Path(target))
        if last:
            raise Killed

    def remove_quietly(path: Path) -> None:
        """A process that was killed removes nothing, and may have written only half."""
        if len(seen) <= most:
            real_remove(path)
        elif path.is_file():
            os.truncate(path, path.stat().st_size // 2)

    real_remove = files.remove_quietly
    monkeypatch.setattr(files, "os", SimpleNamespace(**vars(os) | {"replace": replace}))
    monkeypatch.setattr("fgslam.core.files.remove_quietly", remove_quietly)
    return seen


def untimed(value: Any) -> Any:
    """A document without what was measured by a clock."""
    if isinstance(value, dict):
        kept = {k: v for k, v in value.items() if not set(re.split("[_ ]", k)) & set(_TIMED_VALUES)}
        return {k: untimed(v) for k, v in kept.items()}
    return [untimed(item) for item in value] if isinstance(value, list) else value


def content_of(folder: Path) -> dict[str, object]:
    """Every file that says nothing of time, by name."""
    found: dict[str, object] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.name in _TIMED_FILES or (path.name == "frames.csv" and path.parent != folder):
            found[name] = "timed"
        elif path.name == "metrics.json":
            found[name] = untimed(json.loads(path.read_text(encoding="utf-8")))
        elif path.name == "comparison.csv":
            rows = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
            found[name] = untimed(list(rows))
        elif path.suffix == ".yaml":
            found[name] = path.read_text(encoding="utf-8").replace(str(folder), "RUN")
        else:
            found[name] = path.read_bytes()
    return found


class Straight:
    """Uninterrupted runs, each made once."""

    def __init__(self, doing: Callable[[str], Doing]) -> None:
        self._doing = doing
        self._made: dict[str, tuple[dict[str, object], int]] = {}

    def of(self, task: str, folder: Path) -> tuple[dict[str, object], int]:
        """What a run into ``folder`` leaves there, and how many files it renames."""
        if task not in self._made:
            self._doing(task)  # a run that is compared is made before files are counted
            with pytest.MonkeyPatch.context() as patch:
                seen = self._count(task, folder, patch)
            self._made[task] = content_of(folder), len(seen)
            renamed = {
                path.relative_to(folder).as_posix() for path in seen if folder in path.parents
            }
            # A file that is written in place could be found half written after a kill.
            assert self._made[task][0].keys() <= renamed
            shutil.rmtree(folder)
        return self._made[task]

    def _count(self, task: str, folder: Path, patch: pytest.MonkeyPatch) -> list[Path]:
        seen = renames(patch, float("inf"), after=False)
        assert self._doing(task)(folder, "refuse").status == "finished"
        return seen


@pytest.fixture(scope="module")
def straight(doing: Callable[[str], Doing]) -> Straight:
    return Straight(doing)


def moments(task: str, files: int, count: int) -> list[tuple[int, bool]]:
    """Seeded moments at which to kill: number of the file, and whether after it."""
    rng = np.random.default_rng([TASKS.index(task), files])
    chosen = rng.choice(np.arange(1, files), min(count, files - 1), replace=False)
    return [(int(k), bool(rng.integers(2))) for k in chosen]


def killed_and_resumed(
    task: str,
    count: int,
    straight: Straight,
    doing: Callable[[str], Doing],
    tmp_path: Path,
) -> None:
    do = doing(task)
    expected, files = straight.of(task, tmp_path / "run")
    for most, after in moments(task, files, count):
        folder = tmp_path / "run"
        with pytest.MonkeyPatch.context() as patch:
            renames(patch, most, after=after)
            with pytest.raises(Killed):
                do(folder, "refuse")
        if not unfinished(folder):
            shutil.rmtree(folder)
            continue  # killed after its last file
        assert do(folder, "resume").status == "finished"
        found = content_of(folder)
        assert found.keys() == expected.keys(), (most, after)
        assert [n for n in found if found[n] != expected[n]] == [], (most, after)
        shutil.rmtree(folder)


def unfinished(folder: Path) -> bool:
    """Whether there is anything left to do."""
    metrics = folder / "metrics.json"
    begun = (folder / "units").is_dir() or (folder / "checkpoint.npz").is_file()
    return begun or not metrics.is_file() or '"interrupted"' in metrics.read_text()


@EACH_TASK
def test_killed_once_a_run_resumes_to_the_same_bytes(
    task: str,
    straight: Straight,
    doing: Callable[[str], Doing],
    tmp_path: Path,
) -> None:
    killed_and_resumed(task, 1, straight, doing, tmp_path)


@EACH_TASK
def test_overwriting_deletes_every_file_of_a_run(
    task: str, straight: Straight, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    names, _ = straight.of(task, folder)
    for path in map(folder.joinpath, names):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    create_folder(folder, "overwrite")
    assert list(folder.rglob("*")) == []


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_killed_at_ten_moments_a_run_resumes_to_the_same_bytes(
    task: str,
    straight: Straight,
    doing: Callable[[str], Doing],
    tmp_path: Path,
) -> None:
    killed_and_resumed(task, 10, straight, doing, tmp_path)


@pytest.mark.parametrize(
    "task", [pytest.param("slam_compared", marks=pytest.mark.slow), "localisation"]
)
def test_killed_while_it_tidies_up_a_run_tracks_at_most_its_last_frame_again(
    task: str,
    straight: Straight,
    values_of: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    values, folder = values_of(task), tmp_path / "run"
    expected, _ = straight.of(task, folder)
    kept = before_each_deletion(values, folder, tmp_path / "kept")
    assert len(kept) >= 4  # a checkpoint, two files of units and their folder
    for moment in kept[::2]:  # the first one, and one with half of the units
        shutil.rmtree(folder)
        moment.rename(folder)
        stages: list[str] = []

        def progress(what: str, done: int, total: int, into: list[str] = stages) -> None:
            into.append(what)

        assert run(values, folder, "resume", progress=progress).status == "finished", moment.name
        assert stages.count("tracking") <= 1, moment.name
        found = content_of(folder)
        assert found.keys() == expected.keys(), moment.name
        assert [n for n in found if found[n] != expected[n]] == [], moment.name
    with pytest.raises(OutputError, match=r"nothing to resume .* the run has finished"):
        run(values, folder, "resume")


def before_each_deletion(values: dict[str, Any], folder: Path, kept: Path) -> list[Path]:
    """The run folder as a kill would leave it, just before each part of its state is deleted."""

    def keep(deleted: Path) -> None:
        if deleted.exists() and (deleted.name == "checkpoint.npz" or "units" in deleted.parts):
            found.append(kept / f"{len(found)}_{deleted.name}")
            shutil.copytree(folder, found[-1])

    def unlink(path: Path, missing_ok: bool = False) -> None:
        keep(path)
        real_unlink(path, missing_ok)

    def rmdir(path: Path) -> None:
        keep(path)
        real_rmdir(path)

    found: list[Path] = []
    real_unlink, real_rmdir = Path.unlink, Path.rmdir
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        patch.setattr(Path, "rmdir", rmdir)
        assert run(values, folder).status == "finished"
    return found


@pytest.mark.parametrize("stage", ["pairs", "plain pairs"])
def test_interrupted_pairs_say_so_and_count_nothing_that_is_not_done(
    stage: str,
    values_of: Callable[[str], dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values = values_of("homing_pairs") | {"reference": True}
    reached: list[int] = []

    def progress(what: str, done: int, _total: int) -> None:
        if what == stage and done:
            reached.append(done)

    ended = run(values, tmp_path / "run", progress=progress, stopped=lambda: bool(reached))
    every = VIEWS * (VIEWS - 1) // 2
    assert ended.status == "interrupted"
    assert not any("Plain SIFT" in line for line in ended.lines)
    assert ended.metrics["reference"] is None
    done = ended.metrics["pairs"]
    assert ended.reached == f"after {done} of {every} pairs"
    assert (f"{every - done} more are not answered yet" in ended.lines[0]) == (done < every)
    whole = run(values, tmp_path / "run", "resume")
    assert whole.status == "finished"
    assert any("Plain SIFT" in line for line in whole.lines)
    assert "yet" not in whole.lines[0]


def test_a_command_killed_by_a_signal_resumes_to_the_same_bytes(
    straight: Straight,
    values_of: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    """Killed as soon as a worker's first results are kept, wherever it is by then."""
    task, folder = "homing_pairs", tmp_path / "run"
    expected, _ = straight.of(task, folder)
    experiment_file = tmp_path / "experiment.yaml"
    experiment_file.write_text(yaml.safe_dump(values_of(task)))
    command = [sys.executable, "-c", IN_SMALL_BLOCKS, "run", str(experiment_file)]
    with subprocess.Popen([*command, "--out", str(folder)], stdout=subprocess.DEVNULL) as process:  # noqa: S603
        try:
            while process.poll() is None and not any(folder.glob("units/*.npz")):
                time.sleep(0.001)
        finally:
            process.kill()
    assert process.returncode == -signal.SIGKILL, "it was faster than the signal"
    assert unfinished(folder)
    assert run(values_of(task), folder, "resume").status == "finished"
    found = content_of(folder)
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []


@pytest.mark.parametrize("task", ["teach", "join"])
def test_killed_routes_and_maps_outside_the_run_folder_are_whole_or_absent(
    task: str, values_of: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    """Half of a file lies under a hidden name; the same command with --overwrite goes on."""
    (tmp_path / "out").mkdir()
    key = {"teach": "route", "join": "map"}[task]
    written = tmp_path / "out" / "kept"
    values = values_of(task) | {key: str(written), "output": {"pictures": 0, "report": False}}
    with pytest.MonkeyPatch.context() as patch:
        order = renames(patch, float("inf"), after=False)
        run(values, tmp_path / "run")
    whole, number = written.read_bytes(), order.index(written)
    for after in (False, True):
        written.unlink()
        with pytest.MonkeyPatch.context() as patch:
            renames(patch, number, after=after)
            with pytest.raises(Killed):
                run(values, tmp_path / "run", "overwrite")
        left = [path.name for path in (tmp_path / "out").iterdir()]
        assert [name for name in left if not name.startswith(".")] == ["kept"] * after
        assert not after or written.read_bytes() == whole
        run(values, tmp_path / "run", "overwrite")
        assert written.read_bytes() == whole


def killed(do: Callable[[], object], most: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        renames(patch, most, after=True)
        with pytest.raises(Killed):
            do()


def test_comparisons_are_resumed_only_on_what_they_were_begun_with(
    values_of: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    """Another log would make a mixture of two results."""
    logged, values = tmp_path / "run", values_of("measurements")
    run(values, logged)
    killed(lambda: compare_runs([logged]), 4)
    other = tmp_path / "other"
    run(values | {"seed": 1}, other)
    shutil.copy(other / "measurements.npz", logged)
    with pytest.raises(ConfigError, match="begun with log "):
        compare_runs([logged], existing="resume")


def test_of_several_comparisons_those_that_had_finished_stay_as_they_are(
    values_of: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    values = values_of("measurements") | {"compare": ["odometry"], "output": QUIET}
    runs, out = [tmp_path / name for name in ("a", "b", "c")], tmp_path / "out"
    for folder in runs:
        run(values, folder)

    def write(path: Path, *more: Any) -> None:
        if path.parent == out / "b":
            raise Killed
        write_comparison_csv(path, *more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fgslam.runs.slam_comparison.write_comparison_csv", write)
        with pytest.raises(Killed):
            compare_runs(runs, out=out)
    first = (out / "a" / "metrics.json").read_bytes()
    assert not (out / "c").exists()
    results = compare_runs(runs, out=out, existing="resume")
    assert [(one.status, one.failed) for one in results] == [("finished", False)] * 3
    assert (out / "a" / "metrics.json").read_bytes() == first
    rows = list(csv.DictReader((out / "comparison.csv").read_text().splitlines()))
    assert len(rows) == 6
    with pytest.raises(OutputError, match="nothing to resume"):
        compare_runs(runs[:1], out=out / "a", existing="resume")


def test_of_several_comparisons_one_that_finished_otherwise_is_refused(
    values_of: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    """Other estimators or another log would make a table of two different comparisons."""
    values = values_of("measurements") | {"compare": [], "output": QUIET}
    runs, out = [tmp_path / name for name in ("a", "b")], tmp_path / "out"
    for seed, folder in enumerate(runs):
        run(values | {"seed": seed}, folder)
    odometry = Choice(("odometry",))
    compare_runs(runs[:1], odometry, out / "a")
    with pytest.raises(ConfigError, match=r"a/config\.yaml: differs from the configuration given"):
        compare_runs(runs, Choice(("ekf",)), out, "resume")
    kept = (runs[0] / "measurements.npz").read_bytes()
    shutil.copy(runs[1] / "measurements.npz", runs[0])
    with pytest.raises(ConfigError, match=r"a/config\.yaml: was begun with log "):
        compare_runs(runs, odometry, out, "resume")
    assert not (out / "b").exists()
    (runs[0] / "measurements.npz").write_bytes(kept)
    compare_runs(runs, odometry, out, "resume")
    rows = list(csv.DictReader((out / "comparison.csv").read_text().splitlines()))
    assert [row["estimator"] for row in rows] == ["odometry", "odometry"]


def test_of_several_comparisons_a_finished_failure_stays_one_when_resumed(
    values_of: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    values = values_of("measurements") | {"compare": [], "output": QUIET}
    runs, out = [tmp_path / name for name in ("a", "b")], tmp_path / "out"
    for folder in runs:
        run(values, folder)
    choice = Choice(("ekf",), ("estimators.ekf.max_landmarks=5",))
    compare_runs(runs[:1], choice, out / "a")
    results = compare_runs(runs, choice, out, "resume")
    assert [one.failed for one in results] == [True, True]
    assert [one.failed for one in compare_runs(runs, choice, out, "resume")] == [True, True]


@pytest.mark.parametrize(
    "share", [0.5, *(pytest.param(k / 12, marks=pytest.mark.slow) for k in range(12))]
)
def test_on_a_disk_that_fills_up_a_run_ends_with_one_line_and_goes_on_later(
    share: float, straight: Straight, doing: Callable[[str], Doing], tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    expected, count = straight.of("measurements", folder)
    renamed, real = 0, os.replace

    def replace(source: Path, target: Path) -> None:
        nonlocal renamed
        renamed += 1
        if renamed > share * count:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fgslam.core.files.os.replace", replace)
        with pytest.raises(OutputError, match=r"^cannot write [^\n]*: the disk is full; [^\n]*$"):
            doing("measurements")(folder, "refuse")
    assert not list(folder.rglob("*partial*"))
    assert doing("measurements")(folder, "resume").status == "finished"
    assert content_of(folder) == expected
