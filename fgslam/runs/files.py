"""Files that every run folder has: its configuration with what it takes to repeat the run."""

from __future__ import annotations

import json
import platform
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml

from fgslam.core import __version__
from fgslam.core.errors import DatasetError
from fgslam.core.files import write_text
from fgslam.runs.config_models import Experiment
from fgslam.runs.folder import RUN_MARKER

METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"
LOG_FILE = "measurements.npz"
STATE_FILE = "checkpoint.npz"
COMPARISON_FILE = "comparison.csv"

_VERSIONS_OF = ("numpy", "scipy", "opencv-python-headless", "gtsam", "open3d")


def write_config(folder: Path, config: Experiment, provenance: dict[str, Any]) -> None:
    """config.yaml: every default filled in, with the versions and where the data came from."""
    values = config.as_values() | {"provenance": {"versions": versions()} | provenance}
    write_text(folder / RUN_MARKER, yaml.safe_dump(values, sort_keys=False))


def versions() -> dict[str, str | None]:
    """Versions of this program, of Python and of the packages that shape the numbers."""
    own = {"fgslam": __version__, "python": platform.python_version()}
    return own | {name: _version(name) for name in _VERSIONS_OF}


def read_document(path: Path) -> dict[str, Any]:
    """A run's metrics.json. Raises DatasetError where it is none."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read ({error}); run the experiment again") from None
    if not isinstance(document, dict):
        raise DatasetError(f"{path}: holds no metrics; run the experiment again")
    return document


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
