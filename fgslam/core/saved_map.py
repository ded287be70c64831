"""The saved map, one file: landmarks with appearances and counts, and the drive that made them.

The file is a zip of plain ``.npy`` arrays with a JSON header, as ``numpy.load`` reads it, without
pickle; docs/concepts/maps.md has its table. The header holds the SHA-256 of all contents. The same
map gives the same bytes, and a file is written whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, StateArrays
from fgslam.core.errors import MapError
from fgslam.core.files import replacing
from fgslam.core.log import rig_fault
from fgslam.core.sensors import CameraRig
from fgslam.core.store import (
    ArrayFile,
    Items,
    from_upper,
    of_rows,
    require_covariances,
    require_finite,
)
from fgslam.core.types import (
    CUT_PIXELS,
    LandmarkAppearances,
    LandmarkMap,
    LandmarkPatches,
    Trajectory,
)

FILE = ArrayFile(
    name="fgslam map",
    versions=(4,),
    error=MapError,
    give="give a file that fgslam run --map-out wrote",
    again="make the map again",
)
_EVIDENCE = "evidence_frame"
_PATCH, _PATCH_DISTANCE = "landmark_patch", "landmark_patch_distance"
_UPPER = np.triu_indices(3)
_LONG_AGO = (1980, 1, 1, 0, 0, 0)  # the zip format's first moment: equal maps give equal bytes
_RIG = ("width", "height", "fx", "fy", "cx", "cy", "baseline", "vertical_baseline")
_SAME_RIG = 1e-6  # relative: the same calibration, perhaps read from another text

# Arrays by what their first axis counts, with type and the shape of an item.
_ITEMS: dict[str, Items] = {
    "landmarks": {
        "landmark_id": ("i", ()),
        "landmark_position": ("f", (3,)),
        "landmark_covariance": ("f", (3, 3)),
        "landmark_hits": ("i", ()),
        "landmark_misses": ("i", ()),
        "landmark_permanent": ("b", ()),
        "landmark_colour": ("u", ()),
    },
    "views": {
        "view_landmark": ("i", ()),
        "view_descriptor": ("u", (128,)),
        "view_size": ("f", ()),
        "view_orientation": ("f", ()),
        "view_direction": ("f", (3,)),
    },
    "poses": {"pose_time": ("f", ()), "pose": ("f", (4, 4))},
    "evidence": {_EVIDENCE: ("i", ())},
    "patches": {_PATCH: ("u", (CUT_PIXELS,)), _PATCH_DISTANCE: ("f", ())},
}


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """A map with all that a later run needs to localise in it or to extend it.

    Attributes:
        rig: the cameras that saw it.
        landmarks: positions and covariances in the map's world, n of them.
        appearances: their stored views.
        hits: (n,) frames in which each was seen (Se et al. 6.1).
        misses: (n,) frames in which it was expected and not seen.
        permanent: (n,) never to be pruned for being missed (6.2).
        colour: (n,) grey value.
        trajectory: the drive that made the map.
        about: where it comes from: names, versions, the recording's identity (plain JSON values).
        evidence: (f,) the frames whose measurements are in it (``Frame.digest``), ascending.
        patches: the landmarks' own; None where they were not carried.
    """

    rig: CameraRig
    landmarks: LandmarkMap
    appearances: LandmarkAppearances
    hits: IntArray
    misses: IntArray
    permanent: BoolArray
    colour: ByteArray
    trajectory: Trajectory
    about: dict[str, Any]
    evidence: IntArray
    patches: LandmarkPatches | None = None

    def __len__(self) -> int:
        return len(self.landmarks)


def save_map(saved: SavedMap, path: Path) -> int:
    """Writes a map, whole or not at all; the same map gives the same bytes.

    Returns:
        Size of the file in bytes.

    Raises:
        MapError: the map's parts do not fit each other, or ``about`` is not plain JSON.
        OutputError: the file cannot be written.
    """
    arrays = _to_arrays(saved)
    header = _header(saved, str(path))
    _require_consistent(header, arrays, str(path))
    arrays, header["triangles"] = _without_mirrors(arrays)
    header["sha256"] = digest(header, arrays)
    members = FILE.header(**header) | arrays
    with replacing(path) as partial, partial.open("wb") as file:
        with zipfile.ZipFile(file, "w", compresslevel=1) as archive:
            for name, array in members.items():
                _write_member(archive, name, array)
        return file.tell()


def load_map(path: Path) -> SavedMap:
    """Reads a map and checks its checksum.

    Raises:
        MapError: the file is missing, truncated, damaged, foreign, or of another version.
    """
    arrays = FILE.load(path)
    header = _read_header(arrays, str(path))
    if header.pop("sha256", None) != digest(header, arrays):
        raise MapError(
            f"{path}: damaged: its contents do not have the checksum that they were saved with; "
            "restore the file or make the map again"
        )
    arrays = _with_mirrors(arrays, header, str(path))
    _require_consistent(header, arrays, str(path))
    return _from_arrays(header, arrays, str(path))


def require_rig(saved: SavedMap, rig: CameraRig, where: str) -> None:
    """Refuses a map that other cameras made: sizes, places and depths would not agree.

    Raises:
        MapError: what differs first; ``where`` names the map.
    """
    for name in _RIG:
        theirs, ours = getattr(saved.rig, name), getattr(rig, name)
        if (theirs is None) != (ours is None) or (
            ours is not None and not np.isclose(theirs, ours, rtol=_SAME_RIG, atol=0.0)
        ):
            raise MapError(
                f"{where}: made with another rig ({name} {theirs}, the recording's is {ours}); "
                "give a map of the same cameras"
            )
    if not np.allclose(saved.rig.bTc, rig.bTc, rtol=0.0, atol=_SAME_RIG):
        raise MapError(
            f"{where}: made with the cameras mounted otherwise on the robot (bTc differs); give a "
            "map of the same robot"
        )


# --------------------------------------------------------------------------------------------
# Map to arrays and back


def _to_arrays(saved: SavedMap) -> StateArrays:
    landmarks, views = saved.landmarks, saved.appearances
    return {
        "rig_bTc": saved.rig.bTc,
        "landmark_id": landmarks.ids,
        "landmark_position": landmarks.positions,
        "landmark_covariance": landmarks.covariances,
        "landmark_hits": saved.hits,
        "landmark_misses": saved.misses,
        "landmark_permanent": saved.permanent,
        "landmark_colour": saved.colour,
        "view_landmark": views.ids,
        "view_descriptor": views.descriptors,
        "view_size": views.size,
        "view_orientation": views.orientation,
        "view_direction": views.direction,
        "pose_time": saved.trajectory.timestamps,
        "pose": saved.trajectory.poses,
        _EVIDENCE: saved.evidence,
        **_patch_arrays(saved.patches),
    }


def _patch_arrays(patches: LandmarkPatches | None) -> StateArrays:
    if patches is None or not patches.kept:
        return {}
    return {_PATCH: patches.grey, _PATCH_DISTANCE: patches.distances}


def _from_arrays(header: dict[str, Any], arrays: StateArrays, where: str) -> SavedMap:
    ids = arrays["landmark_id"]
    return SavedMap(
        rig=_rig(header, arrays["rig_bTc"], where),
        landmarks=LandmarkMap(ids, arrays["landmark_position"], arrays["landmark_covariance"]),
        appearances=LandmarkAppearances(
            arrays["view_landmark"],
            arrays["view_descriptor"],
            arrays["view_size"],
            arrays["view_orientation"],
            arrays["view_direction"],
        ),
        hits=arrays["landmark_hits"],
        misses=arrays["landmark_misses"],
        permanent=arrays["landmark_permanent"],
        colour=arrays["landmark_colour"],
        trajectory=Trajectory(arrays["pose_time"], arrays["pose"]),
        about=header["about"],
        evidence=arrays[_EVIDENCE],
        patches=LandmarkPatches(arrays[_PATCH], arrays[_PATCH_DISTANCE])
        if _PATCH in arrays
        else None,
    )


def _without_mirrors(arrays: StateArrays) -> tuple[StateArrays, list[str]]:
    """Matrices (n, 3, 3) that are symmetric to the bit as their upper triangles (n, 6)."""
    out, names = dict(arrays), []
    for name, array in arrays.items():
        if array.ndim == 3 and array.shape[1:] == (3, 3) and _mirrors(array):
            out[name] = array[:, _UPPER[0], _UPPER[1]]
            names.append(name)
    return out, names


def _mirrors(array: np.ndarray[Any, Any]) -> bool:
    """Whether all matrices are symmetric to the bit, signs of zeros included."""
    return array.tobytes() == np.swapaxes(array, 1, 2).tobytes()


def _with_mirrors(arrays: StateArrays, header: dict[str, Any], where: str) -> StateArrays:
    out = dict(arrays)
    for name in header["triangles"]:
        upper = arrays.get(name)
        if upper is None or upper.ndim != 2 or upper.shape[1] != 6:
            raise FILE.damaged(name, where)
        out[name] = from_upper(upper, 3)
    return out


# --------------------------------------------------------------------------------------------
# Header and checks


def _header(saved: SavedMap, where: str) -> dict[str, Any]:
    optional = {"patches": len(saved)} if _patch_arrays(saved.patches) else {}
    header = {
        "format": FILE.name,
        "version": FILE.versions[-1],
        "counts": {
            "landmarks": len(saved),
            "views": len(saved.appearances),
            "poses": len(saved.trajectory),
            "evidence": len(saved.evidence),
        }
        | optional,
        "rig": _rig_values(saved.rig),
        "about": saved.about,
    }
    try:
        plain = json.loads(json.dumps(header, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise MapError(f"{where}: `about` is not plain JSON ({error}); leave it out") from None
    return dict(plain)


def _read_header(arrays: StateArrays, where: str) -> dict[str, Any]:
    """The header's values; removes it from the arrays."""
    header = FILE.read_header(arrays, where)
    del arrays["header"]
    groups = ("counts", "rig", "about")
    sound = all(isinstance(header.get(name), dict) for name in groups)
    if not sound or not isinstance(header.get("triangles"), list):
        raise MapError(f"{where}: the map's header is damaged; make the map again")
    return header


def digest(header: dict[str, Any], arrays: StateArrays) -> str:
    """SHA-256 over the header and all arrays: names, types, shapes and bytes."""
    whole = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        whole.update(_digest_of(name, arrays[name]))
    return whole.hexdigest()


def _digest_of(name: str, array: np.ndarray[Any, Any]) -> bytes:
    one = hashlib.sha256(f"{name} {array.dtype.str} {array.shape}".encode())
    one.update(np.ascontiguousarray(array).view(np.uint8).data if array.size else b"")
    return one.digest()


def _require_consistent(header: dict[str, Any], arrays: StateArrays, where: str) -> None:
    """Raises MapError unless all arrays are there, of the right type and size, and fit."""
    expected = of_rows(4, {"rig_bTc": ("f", (4,))})
    counts = header["counts"]
    for counted, items in _ITEMS.items():
        if counted != "patches" or _has_patches(header, arrays):
            expected |= of_rows(counts.get("landmarks" if counted == "patches" else counted), items)
    FILE.require(arrays, expected, where)
    ids, views = arrays["landmark_id"], arrays["view_landmark"]
    finite = ["rig_bTc", "landmark_position", "landmark_covariance", "pose", "pose_time"]
    if _PATCH_DISTANCE in arrays:
        finite.append(_PATCH_DISTANCE)
        if (arrays[_PATCH_DISTANCE] < 0.0).any():
            raise MapError(f"{where}: array {_PATCH_DISTANCE} is negative; make the map again")
    for name, sound in {
        "landmark_id": _ascending(ids),
        "view_landmark": bool((np.diff(views) >= 0).all() and np.isin(views, ids).all()),
        "pose_time": _ascending(arrays["pose_time"]),
        _EVIDENCE: _ascending(arrays[_EVIDENCE]),
    }.items():
        if not sound:
            raise MapError(f"{where}: array {name} is out of order; make the map again")
    require_finite(FILE, arrays, finite, where)
    covariances = arrays["landmark_covariance"]
    require_covariances(FILE, "landmark_covariance", covariances, where, definite=False)


def _ascending(values: np.ndarray[Any, Any]) -> bool:
    """Whether each value is larger than the one before; differences of digests may overflow."""
    return bool((values[1:] > values[:-1]).all())


def _has_patches(header: dict[str, Any], arrays: StateArrays) -> bool:
    """Whether the header counts patches or an array of them is there; then both must be."""
    return "patches" in header["counts"] or not _ITEMS["patches"].keys().isdisjoint(arrays)


def _rig_values(rig: CameraRig) -> dict[str, Any]:
    return {name: getattr(rig, name) for name in _RIG}


def _rig(header: dict[str, Any], bTc: FloatArray, where: str) -> CameraRig:
    values = header["rig"]
    if set(values) != set(_RIG):
        raise MapError(f"{where}: the map's header names no rig; make the map again")
    rig = CameraRig(**values, bTc=bTc)
    if fault := rig_fault(rig):
        raise MapError(f"{where}: the map's rig cannot be one: {fault}; make the map again")
    return rig


def _write_member(archive: zipfile.ZipFile, name: str, array: np.ndarray[Any, Any]) -> None:
    """One array; floats as they are, since nothing of their mantissas can be packed."""
    info = zipfile.ZipInfo(f"{name}.npy", _LONG_AGO)
    packs = array.dtype.kind != "f"
    info.compress_type = zipfile.ZIP_DEFLATED if packs else zipfile.ZIP_STORED
    with archive.open(info, "w", force_zip64=True) as member:
        np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
