"""Simulated measurements as a recording (docs/datasets/simulated_measurements.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

from fgslam.core.recordings import LandmarkTruth, MeasurementRecording
from fgslam.datasets.measurement_files import make_log
from fgslam.datasets.settings import OdometrySettings
from fgslam.worlds.renderer import content_hash
from fgslam.worlds.settings import (
    SimulatedMeasurementsSettings,
)
from fgslam.worlds.simulated_measurements import (
    SimulatedMeasurements,
    simulate_measurements,
)

SIMULATION_VERSION = 2
"""Part of the identity: raised whenever the same settings and seed give other measurements."""


def open_simulated_measurements(
    settings: SimulatedMeasurementsSettings, seed: int, odometry: OdometrySettings
) -> MeasurementRecording:
    """Simulates the drive.

    Raises:
        ConfigError: the drive cannot be driven, or the selection leaves no frame of it.
    """
    simulated = simulate_measurements(settings, seed)
    path = settings.drive.path.replace("_", " ")
    return MeasurementRecording(
        name=f"simulated measurements, {path}",
        identity=_identity(settings, seed),
        log=make_log(simulated.rig, list(simulated.increments), odometry),
        ground_truth=simulated.truth,
        landmark_truth=LandmarkTruth(simulated.landmark_ids, simulated.landmark_positions),
        notes=tuple(_notes(settings, simulated)),
    )


def _identity(settings: SimulatedMeasurementsSettings, seed: int) -> str:
    """SHA-256 of all settings, the seed and the simulation's version."""
    values = {"settings": asdict(settings), "seed": seed, "simulation": SIMULATION_VERSION}
    return content_hash(values)


def _notes(
    settings: SimulatedMeasurementsSettings, simulated: SimulatedMeasurements
) -> Iterator[str]:
    yield "the measurements are simulated"
    if settings.detection.noise_scale != 1.0:
        yield f"noise drawn at {settings.detection.noise_scale:g} times what is stated"
    if settings.outlier_fraction:
        yield f"{simulated.wrong_matches} matched observations are wrong"
    if settings.odometry_fault is not None:
        fault = settings.odometry_fault
        yield f"odometry off by a factor of {fault.scale:g} for {fault.frames} frames"
    if settings.blackout is not None:
        yield f"cameras blocked for {settings.blackout.frames} frames"
    if settings.moved is not None:
        share = 100.0 * settings.moved.fraction
        yield f"{share:g} % of the landmarks move at frame {settings.moved.frame}"
