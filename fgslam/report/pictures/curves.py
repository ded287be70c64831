"""Curves over time: position error with its 3-sigma envelope, and matches a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.report.pictures.style import BLUE, GREEN, GREY, SKY, picture

_AXIS_NAMES = ("X, right", "Y, down", "Z, ahead")


def draw_errors(
    path: Path,
    timestamps: FloatArray,
    errors: FloatArray,
    sigmas: FloatArray | None = None,
    title: str = "",
) -> None:
    """Position error along the three axes of the world, with the estimator's 3-sigma envelope.

    Args:
        path: the PNG to write.
        timestamps: (n,) seconds.
        errors: (n, 3) estimate minus truth in the estimate's world, first pose aligned, metres.
        sigmas: (n, 3) standard deviations that the estimator claims, metres; None where unknown.
        title: heading.

    Raises:
        OutputError: the file cannot be written.
    """
    seconds = timestamps - timestamps[0] if len(timestamps) else timestamps
    unit, factor = ("cm", 100.0) if np.abs(errors).max(initial=0.0) < 1.0 else ("m", 1.0)
    with picture(path, 11.0, 7.6) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for axis, (axes, name) in enumerate(zip(panels, _AXIS_NAMES, strict=True)):
            error = factor * errors[:, axis]
            axes.axhline(0.0, color=GREY, linewidth=0.8)
            if sigmas is not None:
                bound = 3.0 * factor * sigmas[:, axis]
                axes.fill_between(
                    seconds,
                    -bound,
                    bound,
                    color=SKY,
                    alpha=0.3,
                    linewidth=0,
                    label="3 sigma claimed",
                )
            axes.plot(seconds, error, color=BLUE, linewidth=1.6, label="error")
            axes.set_ylabel(f"{name} ({unit})")
            axes.grid(visible=True)
            axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))
            rmse = float(np.sqrt(np.mean(error**2))) if len(error) else 0.0
            axes.set_title(f"rmse {rmse:.2f} {unit}", loc="right", fontweight="normal", fontsize=11)
        panels[0].set_title(title or "Position error")
        panels[-1].set_xlabel("time (s)")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles[::-1], labels[::-1], loc="outside lower center", ncols=2)


def draw_matches(
    path: Path,
    frames: IntArray,
    matched: IntArray,
    inliers: IntArray,
    landmarks: IntArray,
    title: str = "",
) -> None:
    """Matched landmarks of every frame, those that the pose kept, and the growth of the map.

    Args:
        path: the PNG to write.
        frames: (n,) frame numbers.
        matched: (n,) landmarks matched in the frame.
        inliers: (n,) of them used for the pose.
        landmarks: (n,) landmarks in the map after the frame.
        title: heading.

    Raises:
        OutputError: the file cannot be written.
    """
    with picture(path, 11.0, 6.4) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        upper.plot(frames, matched, color=SKY, linewidth=1.6, label="matched")
        upper.plot(frames, inliers, color=BLUE, linewidth=1.8, label="used for the pose")
        upper.set(ylabel="landmarks a frame", ylim=(0, None))
        upper.set_title(title or "Matches and map")
        if len(frames):
            note = f"median {np.median(matched):.0f} matched, least {matched.min()}"
            upper.set_title(note, loc="right", fontweight="normal", fontsize=12)
        lower.fill_between(frames, landmarks, color=GREEN, alpha=0.25, linewidth=0)
        lower.plot(frames, landmarks, color=GREEN, linewidth=1.8, label="landmarks in the map")
        lower.set(xlabel="frame", ylabel="landmarks in the map", ylim=(0, None))
        for axes in (upper, lower):
            axes.grid(visible=True)
            axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10], integer=True))
        figure.align_ylabels()
        figure.legend(*upper.get_legend_handles_labels(), loc="outside lower center", ncols=2)
