"""Runs the examples as notebooks, and keeps them with what they print and draw in docs/notebooks.

    pip install -e '.[notebooks]'
    python -m scripts.make_notebooks [NAME ...]

Then `python -m scripts.make_reference` sets what they print and draw below the code of the
tutorials.
"""

from __future__ import annotations

import base64
import io
import re
import sys
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient
from PIL import Image

from scripts.make_reference import EXAMPLES, LIVE, notebook_of, picture_of


def make(name: str) -> None:
    """Writes one notebook; times and identities that differ from run to run are left out.

    `own_camera` takes the clock's times, so that its counts differ by one now and then.
    """
    notebook = jupytext.read(EXAMPLES / f"{name}.py")
    with TemporaryDirectory() as folder:
        client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": folder}})
        client.execute(cwd=folder)
    for k, cell in enumerate(notebook.cells):
        kept: list[Any] = []
        for one in cell.get("outputs", ()):
            if one.output_type == "stream":  # Open3D greets Jupyter
                one.text = re.sub(
                    r"^(Jupyter environment|\[Open3D INFO\]).*\n", "", one.text, flags=re.M
                )
                if kept and kept[-1].get("name") == one.name:  # split where the kernel was slow
                    kept[-1].text += one.text
                    continue
            elif "image/png" in one.get("data", ()):
                drawn = _small(base64.b64decode(one.data["image/png"]))
                picture_of(name).write_bytes(drawn)
                one.data = {"image/png": base64.b64encode(drawn).decode()}
            kept.append(one)
        if "outputs" in cell:
            cell.outputs = kept
        cell.id, cell.metadata = f"{name}-{k}".replace("_", "-"), {}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata = {"kernelspec": kernel}
    path = notebook_of(name)
    path.parent.mkdir(exist_ok=True)
    text = nbformat.writes(notebook)  # type: ignore[no-untyped-call]
    path.write_text(f"{text}\n", encoding="utf-8")


def _small(drawn: bytes) -> bytes:
    """A picture as small as it can be, without the version of what drew it."""
    out = io.BytesIO()
    with Image.open(io.BytesIO(drawn)) as given:
        given.convert("RGB").quantize(255, Image.Quantize.FASTOCTREE).save(
            out, "png", optimize=True
        )
    return out.getvalue()


if __name__ == "__main__":
    names = [path.stem for path in sorted(EXAMPLES.glob("*.py")) if path.stem not in LIVE]
    for name in sys.argv[1:] or names:
        make(name)
        print(f"{notebook_of(name)}: written")
