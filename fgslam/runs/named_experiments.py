"""The experiments that come with fgslam, found by name.

A wheel carries them in ``fgslam/experiments`` (see ``setup.py``); a checkout, and so an editable
install, has them next to the package.
"""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_READS = re.compile(r"^ +path: \S*/", re.MULTILINE)
_FOLDERS = (_PACKAGE / "experiments", _PACKAGE.parent / "experiments")


@cache
def experiments_folder() -> Path:
    """Folder of the experiments that come with this installation of fgslam."""
    return next((folder for folder in _FOLDERS if folder.is_dir()), _FOLDERS[0])


def experiment_names() -> tuple[str, ...]:
    """Names that :func:`find_experiment` knows, sorted."""
    return tuple(sorted(path.stem for path in experiments_folder().glob("*.yaml")))


def experiments_of_recordings() -> tuple[str, ...]:
    """Those of :func:`experiment_names` that read a recording which does not come with fgslam.

    Told by one line of each file: what lists them does not load a reader of YAML.
    """
    files = sorted(experiments_folder().glob("*.yaml"))
    return tuple(f.stem for f in files if _READS.search(f.read_text(encoding="utf-8")))


def list_experiments() -> str:
    """One sentence on all, apart those that need a recording."""
    needing = experiments_of_recordings()
    alone = ", ".join(name for name in experiment_names() if name not in needing)
    return (
        f"Experiments that come with fgslam: {alone}. With a recording to be fetched "
        f"('fgslam data': where; --set dataset.path=FOLDER): {', '.join(needing)}."
    )


def find_experiment(given: Path) -> Path:
    """Path of an experiment's file.

    Args:
        given: a path, or the bare name of an experiment that comes with fgslam, e.g. ``lab_loop``.

    Returns:
        The file of that name; ``given`` itself where it is a file, or no known name.
    """
    if given.is_file() or given.name != str(given) or given.name not in experiment_names():
        return given
    return experiments_folder() / f"{given.name}.yaml"


def suggestion(missing: Path) -> str:
    """What to give in place of a file that is not there."""
    close = get_close_matches(missing.stem, experiment_names(), n=1, cutoff=0.75)
    if close:
        return f"the experiment {close[0]} comes with fgslam: give its name"
    return (
        "give a YAML file, or the name of an experiment that comes with fgslam, e.g. lab_loop "
        "(fgslam run --help lists them)"
    )
