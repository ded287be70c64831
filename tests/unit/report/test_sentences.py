"""All sentences of remarks, with sample values."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.types import Remark
from fgslam.report.content import SENTENCES, sentence

SAMPLES = {
    "all": 200,
    "against": "",
    "camera": "left",
    "degrees": 0.456,
    "fault": "the left camera delivers old images",
    "features": 312.4,
    "high": 87.6,
    "known": 150,
    "low": 12.3,
    "left": " (290 in the left image)",
    "matched": 1.2,
    "percent": 75.0,
    "ratio": 1.494,
    "scatter": 0.006,
    "turns": "0.46 degrees in yaw (9 sigma)",
}
OF_FRAMES = ("{named}", "{span}", "{first}")


def test_sentences_read_as_in_the_file() -> None:
    lines = []
    for code, text in SENTENCES.items():
        with_frames = any(part in text for part in OF_FRAMES)
        values = SAMPLES if with_frames else SAMPLES | {"count": 12}
        lines.append(f"{code}: {sentence(Remark(code, (3, 7, 19) * with_frames, values))}\n")
    golden = Path(__file__).with_name("sentences.txt")
    assert "".join(lines) == golden.read_text(encoding="utf-8")


def test_one_frame_and_words_are_said_as_they_are() -> None:
    assert sentence(Remark("bridged", (20,))).startswith("frame 20: not located")
    undecided = {"errs": "odometry_turned", "degrees": 90.0}
    said = sentence(Remark("witnesses_undecided", (20, 21), undecided))
    assert "holds both; if the odometry errs, its ways are 90 degrees off" in said
    fault = Remark("camera_fault", (20,), {"fault": "the left camera sleeps", "all": 9})
    assert sentence(fault).startswith("the left camera sleeps: 1 of 9 frames, frame 20, are not")
    assert sentence("in words") == "in words"
