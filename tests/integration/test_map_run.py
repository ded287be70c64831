"""Maps that outlive their run: saved, localised in, exported, refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from recordings import experiment, write_recording
from running import (
    KIND,
    bytes_of,
    main,
    metrics_of,
    run_values,
    stop_after,
    write_config,
)

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, EstimatorError, FgslamError, MapError
from fgslam.core.saved_map import load_map, save_map
from fgslam.core.types import Trajectory
from fgslam.report.formats import read_ply
from fgslam.runs.export import export_run
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.wanted import Wanted

CUT = 7
EVERY = (
    KIND,
    *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("ekf", "isam2", "batch")),
)


def mapped(recording: Path, first: int = 0, stop: int | None = None, **changes: Any) -> Any:
    """Values of a run with a map; ``kind`` chooses the estimator, the rest goes to `map`."""
    kind = changes.pop("kind", KIND)
    dataset = {"kind": "image_folder", "path": str(recording), "start": first, "stop": stop}
    return experiment(recording, dataset=dataset, estimator={"kind": kind}, map=changes)


@pytest.fixture(scope="module")
def map_file(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the whole recording, by the paper's filter."""
    folder = tmp_path_factory.mktemp("map")
    run_values(mapped(recording, save=str(folder / "all.fgmap")), folder / "run")
    return folder / "all.fgmap"


@pytest.fixture(scope="module")
def shorter(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the first frames alone."""
    folder = tmp_path_factory.mktemp("shorter")
    run_values(mapped(recording, stop=CUT, save=str(folder / "a.fgmap")), folder / "run")
    return folder / "a.fgmap"


def landmarks_of(path: Path) -> Mapping[str, Any]:
    saved = load_map(path)
    return {
        "ids": saved.landmarks.ids,
        "positions": saved.landmarks.positions,
        "covariances": saved.landmarks.covariances,
        "hits": saved.hits,
        "descriptors": saved.appearances.descriptors,
    }


def unaligned_errors(run: Path, kind: str = KIND) -> FloatArray:
    """Distances (n,) of the run's positions from the true ones, in the world of the map."""
    truth, found = (
        Trajectory.load(run / "ground_truth.tum"),
        Trajectory.load(run / kind / "final.tum"),
    )
    rows = np.searchsorted(truth.timestamps, found.timestamps - 1e-6)
    apart = truth.poses[rows, :3, 3] - found.poses[:, :3, 3]
    return np.asarray(np.linalg.norm(apart, axis=1))


# --------------------------------------------------------------------------------------------
# Beginning in a map


@pytest.mark.parametrize("kind", EVERY)
@pytest.mark.parametrize("start", ["relocalise", "origin"])
def test_a_run_finds_its_place_in_a_map(
    start: str, kind: str, recording: Path, map_file: Path, tmp_path: Path
) -> None:
    values = mapped(recording, load=str(map_file), start=start, kind=kind)
    run = run_values(values, tmp_path / "run")
    assert unaligned_errors(run.folder, kind).max() < 0.004
    counts = metrics_of(run.folder)["status_counts"]
    assert counts == ({"ok": 11, "relocalised": 1} if start == "relocalise" else {"ok": 12})
    before = len(load_map(map_file))
    assert metrics_of(run.folder)["estimators"][kind]["landmarks"] < 1.2 * before
    if kind in ("isam2", "batch"):  # these keep a whole graph, which begins in the map, too
        graph = run.result.graph()
        final = Trajectory.load(run.folder / kind / "final.tum")
        last = graph.values.atPose3(graph.poses[max(graph.poses)]).matrix()
        np.testing.assert_allclose(last[:3, 3], final.poses[-1, :3, 3], rtol=0, atol=2e-3)


def test_a_run_starts_where_the_last_one_stopped(
    recording: Path, shorter: Path, tmp_path: Path
) -> None:
    values = mapped(recording, first=CUT - 1, load=str(shorter), start="last")
    run = run_values(values, tmp_path / "run")
    assert metrics_of(run.folder)["status_counts"] == {"ok": 13 - CUT}
    # The truth's world is the recording's first frame: that of the map, too. Its landmarks are
    # those of one key frame, and SIFT finds them again from half a metre away.
    assert unaligned_errors(run.folder).max() < 0.005


def test_frames_before_the_first_that_is_located_are_left_out(
    own_recording: Path, map_file: Path, tmp_path: Path
) -> None:
    for name in ("right", "left", "top"):
        for k in (0, 1):
            (own_recording / name / f"{k:06d}.png").write_bytes(b"no image")
    run = run_values(mapped(own_recording, load=str(map_file)), tmp_path / "run")
    metrics = metrics_of(run.folder)
    assert metrics["frames"] == 10
    assert any("first 2 frames could not be located" in note for note in metrics["notes"])
    assert unaligned_errors(run.folder).max() < 0.004
    rows = (run.folder / "timing.csv").read_text().splitlines()
    assert rows[1].startswith("2,")


@pytest.mark.parametrize("kind", EVERY[:2])
def test_a_map_that_is_not_extended_keeps_its_landmarks(
    kind: str, recording: Path, map_file: Path, tmp_path: Path
) -> None:
    before = load_map(map_file)
    values = mapped(recording, load=str(map_file), extend=False, kind=kind)
    run = run_values(values, tmp_path / "run")
    assert unaligned_errors(run.folder, kind).max() < 0.004
    outputs = run.result.outputs
    after = outputs.pipeline.estimator.estimate().landmarks
    np.testing.assert_array_equal(after.ids, before.landmarks.ids)
    np.testing.assert_array_equal(after.positions, before.landmarks.positions)
    np.testing.assert_array_equal(after.covariances, before.landmarks.covariances)
    np.testing.assert_array_equal(outputs.pipeline.tracker.database.hits, before.hits)
    assert not any(len(i.missed_ids) + len(i.pruned_ids) for i in outputs.recorder.log)
    assert (outputs.recorder.column("nis") > 0.0).all()


@pytest.mark.slow
def test_replays_of_it_begin_in_the_map_and_give_the_same_bits(
    recording: Path, map_file: Path, tmp_path: Path
) -> None:
    values = mapped(recording, load=str(map_file))
    values["compare"] = [{"kind": KIND, "label": "again"}, {"kind": "odometry"}]
    folder = run_values(values, tmp_path / "run").folder
    for name in ("final.tum", "covariance.csv"):
        assert (folder / KIND / name).read_bytes() == (folder / "again" / name).read_bytes()
    failure = metrics_of(folder)["estimators"]["odometry"]["failure"]
    assert "cannot begin in a saved map" in failure
    reported = yaml.safe_load((folder / "config.yaml").read_text())
    del reported["provenance"]["map"]["file"]
    (folder / "config.yaml").write_text(yaml.safe_dump(reported))
    with pytest.raises(ConfigError, match="does not say how the run entered its map"):
        arrival_of(folder)


@pytest.mark.slow
def test_resumed_in_a_map(recording: Path, map_file: Path, tmp_path: Path) -> None:
    values = mapped(recording, load=str(map_file))
    whole = run_values(values, tmp_path / "whole")
    partial = run_values(values, tmp_path / "run", stopped=stop_after(4))
    resumed = run_values(values, partial.folder, "resume")
    assert bytes_of(resumed.folder) == bytes_of(whole.folder)


@pytest.mark.slow
def test_a_map_that_changed_meanwhile_is_noticed(
    recording: Path, map_file: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.fgmap"
    own.write_bytes(map_file.read_bytes())
    values = mapped(recording, load=str(own))
    partial = run_values(values, tmp_path / "run", stopped=stop_after(4))
    saved = load_map(own)
    saved.hits[0] += 1
    save_map(saved, own)
    with pytest.raises(MapError, match="the map has changed since the run began"):
        run_values(values, partial.folder, "resume")


@pytest.mark.slow
def test_a_map_made_by_the_run_itself(recording: Path, tmp_path: Path) -> None:
    made_from = {"dataset": {"kind": "image_folder", "path": str(recording)}, "seed": 3}
    values = mapped(recording, made_from=made_from)
    whole = run_values(values, tmp_path / "whole")
    assert (whole.folder / "first" / "map.fgmap").is_file()
    assert unaligned_errors(whole.folder).max() < 0.004
    # Interrupted in the first drive, then in its own.
    run = run_values(values, tmp_path / "run", stopped=stop_after(3))
    assert run.result.status == "interrupted"
    assert not (run.folder / "first" / "map.fgmap").exists()
    run = run_values(values, run.folder, "resume", stop_after(12 + 2))
    assert run.result.status == "interrupted"
    run = run_values(values, run.folder, "resume")
    assert bytes_of(run.folder) == bytes_of(whole.folder)
    replaced = run_values(values, run.folder, "overwrite")
    assert bytes_of(replaced.folder) == bytes_of(whole.folder)


# --------------------------------------------------------------------------------------------
# Refused, before anything is driven


def refused(values: dict[str, Any], folder: Path, reported: str, kind: type[FgslamError]) -> None:
    with pytest.raises(kind, match=reported) as refusal:
        run_values(values, folder)
    assert "\n" not in str(refusal.value)
    assert not folder.exists()


def test_maps_that_cannot_be_used(
    recording: Path, map_file: Path, shorter: Path, tmp_path: Path
) -> None:
    run, given = tmp_path / "run", str(map_file)
    other = write_recording(tmp_path / "other", 3, top=False)
    for values, reported in (
        (mapped(recording, load=str(tmp_path / "none")), "no such file"),
        (mapped(other, load=given), "another rig .vertical_baseline 0.1"),
    ):
        refused(values, run, reported, MapError)
    for values, reported in (
        (mapped(recording, load=given, kind="odometry"), "cannot begin in a saved map"),
        (mapped(recording, load=given, kind="fixed_lag"), "cannot begin in a saved map"),
        (mapped(recording, load=given, extend=False, kind="isam2"), "cannot leave a map as it is"),
    ):
        refused(values, run, reported, ConfigError)
    small = mapped(recording, load=given)
    small["estimator"] = {"kind": "ekf", "max_landmarks": 100}
    refused(small, run, r"the saved map: .* exceed max_landmarks 100", EstimatorError)


def test_nothing_is_located_in_the_map_of_another_place(map_file: Path, tmp_path: Path) -> None:
    elsewhere = write_recording(tmp_path / "elsewhere", 4, seed=5)
    reported = "none of the first 4 frames of elsewhere could be located"
    refused(mapped(elsewhere, load=str(map_file)), tmp_path / "run", reported, MapError)


# --------------------------------------------------------------------------------------------
# The command line


def test_saved_and_used_from_the_command_line(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = write_config(tmp_path / "boards.yaml", experiment(recording))
    saved, run = tmp_path / "boards.fgmap", tmp_path / "run"
    assert main(monkeypatch, "run", config, "--out", tmp_path / "a", "--map-out", saved) == 0
    assert f"saved map   {saved}: " in capsys.readouterr().out
    assert main(monkeypatch, "run", config, "--out", run, "--map-in", saved) == 0
    assert "extended: located at" in capsys.readouterr().out
    assert main(monkeypatch, "export", saved) == 0
    reported = capsys.readouterr().out
    assert "12 frames of" in reported


def test_exported_as_of_a_run(
    map_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved, run = load_map(map_file), map_file.parent / "run" / KIND
    cloud, path = tmp_path / "map.ply", tmp_path / "path.tum"
    assert main(monkeypatch, "export", map_file, "--map", cloud, "--trajectory", path) == 0
    assert cloud.read_bytes() == (run / "map.ply").read_bytes()
    assert path.read_bytes() == (run / "final.tum").read_bytes()
    assert main(monkeypatch, "export", map_file, "--map", cloud, "--valid-only", "--overwrite") == 0
    assert len(read_ply(cloud)) == int((saved.hits >= 3).sum()) < len(saved)
    bare = tmp_path / "bare.fgmap"  # of cameras whose place on a body nothing states
    save_map(replace(saved, rig=replace(saved.rig, bTc=np.eye(4))), bare)
    with pytest.raises(ConfigError, match="nothing states where the cameras sit on a body"):
        export_run(bare, Wanted(trajectory=tmp_path / "body.tum", frame="body"))
    export_run(bare, Wanted(trajectory=tmp_path / "left.tum", frame="left"))
    assert Trajectory.load(tmp_path / "left.tum").frame == "left"


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("--graph", "x.g2o"), "a saved map has landmarks and a trajectory"),
        (("--estimator", "ekf"), "a saved map has landmarks and a trajectory"),
        (("--map", "x.stl"), "x.stl"),
    ],
)
def test_unsupported_exports_of_a_map_are_refused(
    arguments: tuple[str, str],
    reported: str,
    map_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(monkeypatch, "export", map_file, *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("fgslam: ")
    assert reported in error
    assert error.count("\n") == 1
    assert main(monkeypatch, "export", map_file, "--map", map_file) == 2
