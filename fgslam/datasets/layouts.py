"""The layout of a recording's folder, recognised by the files in it."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.errors import DatasetError

_KITTI_PARTS = ("image_0", "image_1", "calib.txt", "times.txt")
_NAMES = {
    "euroc": "an EuRoC folder",
    "kitti": "a KITTI odometry folder",
    "light_field": "a light field",
    "image_folder": "an image folder",
}


def recognise_layout(folder: Path) -> dict[str, str]:
    """The keys of ``dataset`` in a configuration that open this folder: kind, path and so on.

    A folder with some but not all parts of a layout counts as that layout where it cannot be
    another one, so that its reader says what is missing. Of several KITTI drives the first is
    taken.

    Raises:
        DatasetError: there is no such folder, or it has none of the known layouts.
    """
    if folder.is_file():
        raise DatasetError(
            f"{folder} is neither a folder nor an experiment's .yaml; give the recording's folder"
        )
    if not folder.is_dir():
        raise DatasetError(
            f"{folder}: no such folder or experiment file; give the folder of a recording, or an "
            "experiment's .yaml"
        )
    if (folder / "mav0").is_dir() or (folder / "cam0" / "sensor.yaml").is_file():
        return {"kind": "euroc", "path": str(folder)}
    if kitti_drives(folder):
        return {"kind": "kitti", "path": str(folder), "sequence": kitti_drives(folder)[0]}
    if (folder / "image_0").is_dir() or (folder / "image_1").is_dir():
        return _single_drive(folder)
    if (folder / "positions.csv").is_file():
        return {"kind": "light_field", "path": str(folder)}
    stereo = (folder / "left").is_dir() or (folder / "right").is_dir()
    if stereo or ((folder / "calib.json").is_file() and (folder / "times.txt").is_file()):
        return {"kind": "image_folder", "path": str(folder)}
    raise DatasetError(_unknown(folder))


def layout_hint(folder: Path, kind: str) -> str:
    """What to set where the folder has another layout than that of ``kind``; else empty."""
    try:
        found = recognise_layout(folder)
    except DatasetError:
        return ""
    if found["kind"] == kind:
        return ""
    changed = {key: value for key, value in found.items() if value != str(folder)}
    keys = " ".join(f"--set dataset.{key}={value}" for key, value in changed.items())
    return f"this is {_NAMES[found['kind']]}: {keys}"


def kitti_drives(root: Path) -> tuple[str, ...]:
    """Names of the drives (two digits) in a KITTI odometry folder, ascending; perhaps none."""
    parent = root / "sequences"
    if not parent.is_dir():
        return ()
    return tuple(
        sorted(
            path.name
            for path in parent.iterdir()
            if path.is_dir() and len(path.name) == 2 and path.name.isdecimal()
        )
    )


def _single_drive(folder: Path) -> dict[str, str]:
    """A drive's own folder, sequences/NN: its root is two levels up."""
    here = folder.resolve()
    root = here.parent.parent
    if here.parent.name == "sequences" and here.name in kitti_drives(root):
        return {"kind": "kitti", "path": str(root), "sequence": here.name}
    raise DatasetError(
        f"{folder} looks like one KITTI drive, but it is not in a folder sequences/ under two "
        "digits; move it to ROOT/sequences/00 (its poses to ROOT/poses/00.txt) and give ROOT"
    )


def _unknown(folder: Path) -> str:
    """What was looked for in each layout, and what of it is missing."""
    if (folder / "config.yaml").is_file():
        return (
            f"{folder} is a run folder, not a recording; inspect what it was made from: fgslam "
            f"inspect {folder / 'config.yaml'}"
        )
    wanted = {
        "image folder": ("left", "right", "calib.json", "times.txt"),
        "KITTI": ("sequences/NN",),
        "one KITTI drive": _KITTI_PARTS,
        "EuRoC": ("mav0/cam0", "mav0/cam1"),
        "light field": ("positions.csv", "calib.json"),
    }
    missing = [
        f"{name} (lacks {', '.join(part for part in parts if not (folder / part).exists())})"
        for name, parts in wanted.items()
    ]
    return (
        f"{folder} has none of the known layouts: {'; '.join(missing)}; docs/datasets/ describes "
        "each"
    )
