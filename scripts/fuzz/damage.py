"""Texts, bytes and arrays with faults in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.errors import FgslamError

Rng = np.random.Generator
Arrays = dict[str, np.ndarray[Any, Any]]

ODD = (
    "", "~", "-1", "0", "1e999", "-.inf", ".nan", "9" * 30, "9" * 5000, "0x", "0b_", "!!int x",
    "2020-99-99", "[]", "{}", "[[[[]]]]", "{a: {b: c}}", "'", '"', "\0", "\x1b[31m", "\ud800",
    "true", "no", "*x", "&x [*x]", "<<: 1", "x" * 5000, "../../etc", "/dev/zero", "é", "\u202e",
    "1:60:70", "!!python/object:os.system x", "---", "...", "? x", "- -", "\t", "%YAML 9", "1_0",
)  # fmt: skip
"""Texts that configurations, calibrations and tables stumble over."""


def damaged_text(rng: Rng, text: str) -> str:
    """A text with one to three changes of lines, values or characters."""
    lines = text.splitlines() or [""]
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(lines)))
        odd = ODD[rng.integers(len(ODD))]
        head, colon, _ = lines[at].partition(":")
        choice = rng.integers(6)
        if choice == 0:
            lines[at] = f"{head}{colon} {odd}" if colon else odd
        elif choice == 1:
            lines.insert(at, lines[int(rng.integers(len(lines)))])
        elif choice == 2 and len(lines) > 1:
            del lines[at]
        elif choice == 3:
            lines[at] = lines[at][: rng.integers(len(lines[at]) + 1)]
        elif choice == 4:
            lines[at] = f"{odd}{colon}{lines[at]}"
        else:
            words = lines[at].split(" ")
            words[int(rng.integers(len(words)))] = odd
            lines[at] = " ".join(words)
    return "\n".join(lines) + "\n"


def damaged_bytes(rng: Rng, data: bytes) -> bytes:
    """Bytes cut off, flipped, doubled, or with others put in."""
    at, more = (int(k) for k in np.sort(rng.integers(0, len(data) + 1, 2)))
    choice = rng.integers(4)
    if choice == 0:
        return data[:at]
    if choice == 1:
        return data[:at] + rng.bytes(int(rng.integers(1, 9))) + data[at:]
    if choice == 2:
        return data[:at] + data[more:]
    flipped = bytearray(data)
    for place in rng.integers(0, len(data), rng.integers(1, 4)):
        flipped[place] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def written(path: Path, content: str | bytes) -> Path:
    """The path, with this content."""
    data = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
    path.write_bytes(data)
    return path


def damaged_arrays(rng: Rng, arrays: Arrays) -> Arrays:
    """The arrays, one of them changed in type, shape or value."""
    name = list(arrays)[int(rng.integers(len(arrays)))]
    return arrays | {name: damaged_array(rng, arrays[name])}


def damaged_array(rng: Rng, array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The array changed in type, shape or one value."""
    if array.dtype.kind in "fi" and array.size and rng.random() < 0.6:
        flat = array.copy().reshape(-1)
        odd: tuple[float, ...] = (np.nan, np.inf, -1e300, 1e-300, -1.0)
        if array.dtype.kind == "i":
            odd = (0, -1, min(2**31, np.iinfo(array.dtype).max))
        with np.errstate(over="ignore"):  # 1e300 is infinite as float32
            flat[rng.integers(flat.size)] = odd[rng.integers(len(odd))]
        return flat.reshape(array.shape)
    if rng.random() >= 0.5:
        return array.reshape(-1)[: rng.integers(array.size + 1)]
    if array.dtype.kind in "fib":
        return array.astype("U" if rng.random() < 0.5 else "c16", copy=True)
    return np.array("{" * int(rng.integers(1, 3000)))


_LONGEST = 1600


def require_one_line(error: FgslamError) -> None:
    """Raises AssertionError unless the message is one line, not too long."""
    message = str(error)
    if "\n" in message or len(message) > _LONGEST or not message:
        raise AssertionError(f"no single short line: {message[:200]!r}")
